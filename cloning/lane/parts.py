"""Finds the parts of a recording that certainly are on a known track, whatever lies between them.

A window of a stretch that certainly is on a track is followed in both directions for as long as what the cameras see
and how the car turns agree with the track. So a car that is stuck, pushed back or off the road ends a part, and the
rows after it are sought near its end, where the car must be.
"""

import copy
import functools
import itertools
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from cloning.lane.follow import Candidate, TrackFilter
from cloning.lane.search import ACROSS, ALONG, Localisation, Part, followed, known_tracks, search
from cloning.recordings.log import Recording
from cloning.road.motion import MIN_STRETCH_ROWS, MPH, TOP_SPEED_MPH, Stretch

WINDOW, WINDOW_STEP = 300, 150  # rows: a shorter window may resemble a bend of any track
# A row's score is 1 if all agrees, and 0 at this log-likelihood of its detections, or at so many standard deviations
# between its turn and the expected one. In the jungle, brows and hairpins hide the road.
ANCHOR_TURN_RESIDUAL = {"lake": ((130, 270, 400), (0.25, 0.4, 0.5)), "jungle": ((130, 270, 400), (0.9, 0.9, 1.2))}
FIT_SCALE, TURN_SCALE = {"lake": 0.15, "jungle": 1.0}, {"lake": 1.2, "jungle": 3.5}
ALARM = 15.0  # a fall of the sum of the scores by so much ends a part, at the rows before the fall
SEED_COVARIANCE = np.diag([1.0, 0.1, 0.003])  # of the state at which a part begins to grow; as `INITIAL_COVARIANCE`
START_COVARIANCE = np.diag([4.0, 0.5, 0.01])  # of its first row's state, once it has grown
FARTHEST_START = np.array([np.inf, 3.0, 0.3])  # that state at most: further off, its rows may leave the road
LENIENCE = 0.7  # added to the scores to find where a fall begins: rows before a mishap may agree less, as at a brow
PROBE, FIRST_PROBE = 40, 15  # rows over which candidates near a neighbour are followed
LONGEST_END = 60  # rows at an end of a part that may be a mishap
STOPS = 5.0  # mph: slower, the car has nearly stopped
KEPT = 4  # candidates that are followed over all of PROBE
PROBES = (0, 10, 20, 30, 45, 60, 80, 100, 130, 160, 200, 250)  # rows after a neighbour, from which to try
# What a part beside another one needs, where the car should be and anywhere near: rows, log-likelihood, turn residual.
# At looser limits in the jungle (-0.42, 1.45) most of a generated road fits there in pieces, after a pause.
EXPECTED = {"lake": (60, -0.05, 0.3), "jungle": (60, -0.25, 0.75)}
MISHAP = {"lake": (100, -0.04, 0.25), "jungle": (100, -0.2, 0.65)}
# Stretches far from any part and too short for a window are certain alone with so many metres at these limits, or with
# so many in several stretches beside each other, of which the longest has as many rows and keeps them. Of 66 windows of
# 160 to 290 m of generated roads, in either network's detections, those that fit the lake best have (-0.03, 0.48), and
# those that fit the jungle best (-0.28, 1.0).
ALONE_ROWS, ALONE_METRES, TOGETHER_METRES = 150, 170.0, 270.0
ALONE = {"lake": (ALONE_ROWS, -0.03, 0.3), "jungle": (ALONE_ROWS, -0.2, 0.65)}
PROBE_STEP = 5.0  # m between candidates
SLACK, SLACK_PER_METRE = 5.0, 0.1  # m, and of the metres driven: where the car should be without a mishap
BACK, BEYOND = 30.0, 20.0  # m: further back, or further on than it drove, the car is not after a mishap
MAX_REACH, MAX_PAUSE = 200.0, 10.0  # m, s: after more, it may be anywhere
MOSTLY = 0.5  # share of a stretch's rows: where fewer fit beside its neighbours, it is another road's
AMBIGUOUS = 0.8  # share of the best part's quality: a part as good as this, but elsewhere, leaves it uncertain
SAME_PLACE = {ALONG: 10.0, ACROSS: 0.3}  # m: what is further apart is elsewhere


class Followers:
    """The filters of a stretch on all known tracks, in both directions of time."""

    def __init__(self, stretch: Stretch, centres: np.ndarray):
        """centres: of the stretch's rows."""
        self.stretch = stretch
        self.ahead = [TrackFilter(stretch, centres, track) for track in known_tracks()]

    @functools.cached_property
    def back(self) -> list[TrackFilter]:
        """The same, from the last row to the first."""
        return [follower.backwards() for follower in self.ahead]

    def grow(
        self, track: int, seed: int, state: np.ndarray, first: int, end: int
    ) -> tuple[int, int, Localisation] | None:
        """Return the rows around a seed that agree with a track, and their localisation; None if they are too few.

        state: in the row `seed`; first, end: the rows beyond which not to grow.
        """
        n = len(self.stretch)
        later = follow_while_certain(Candidate(self.ahead[track], state, seed, SEED_COVARIANCE), end)
        back = Candidate(self.back[track], state, n - 1 - seed, SEED_COVARIANCE)
        earlier = n - follow_while_certain(back, n - first)
        begin = back.filtered[seed - earlier][0]
        while later - earlier >= MIN_STRETCH_ROWS:
            begin = np.clip(begin, -FARTHEST_START, FARTHEST_START)
            whole = Candidate(self.ahead[track], begin, earlier, START_COVARIANCE)
            found = followed(whole, later)
            turns = np.r_[0, whole.turns(found.states)]
            scores = score(found.track.name, np.array(whole.fits), turns)
            after = agreeing(scores[seed - earlier :])
            before = agreeing(scores[: seed - earlier + 1][::-1])
            if after == later - seed and before == seed - earlier + 1:
                return earlier, later, found
            begin = found.states[seed - earlier + 1 - before]
            earlier, later = seed + 1 - before, seed + after
        return None


def is_anchor(found: Localisation) -> bool:
    """Return whether a part is certain by itself."""
    metres = found.states[-1, 0] - found.states[0, 0]
    limit = np.interp(metres, *ANCHOR_TURN_RESIDUAL[found.track.name])
    return found.is_certain() and found.turn_residual < limit


def unrivalled(grown: list[Part], axis: int) -> Part | None:
    """Return the best part; None if another one is nearly as good, and elsewhere; axis: ALONG or ACROSS the road."""
    best = max(grown, key=Part.quality, default=None)
    if not best:
        return None
    rivals = [other for other in grown if other.quality() > AMBIGUOUS * best.quality()]
    return None if any(best.away_from(other, axis) > SAME_PLACE[axis] for other in rivals) else best


def score(name: str, fits: np.ndarray | float, turns: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the scores of rows on a track of this name; fits, turns: of `Candidate`."""
    return 1 + fits / FIT_SCALE[name] - (np.asarray(turns) / TURN_SCALE[name]) ** 2


def agreeing(scores: np.ndarray) -> int:
    """Return how many rows, from the first on, are before the first fall by ALARM of the sum of their scores."""
    total = np.cumsum(scores)
    fallen = np.maximum.accumulate(total) - total > ALARM
    if not fallen.any():
        return len(scores)
    return int(np.cumsum(scores[: fallen.argmax() + 1] + LENIENCE).argmax()) + 1


def follow_while_certain(candidate: Candidate, end: int) -> int:
    """Follow a candidate until the sum of its scores falls by ALARM; return the row after the last before that fall."""
    name, total, best = candidate.follower.track.name, 0.0, 0.0
    for row in range(candidate.first, end):
        candidate.follow(row + 1)
        total += float(score(name, candidate.fits[-1]))
        best = max(best, total)
        if best - total > ALARM:
            break
    return candidate.first + agreeing(score(name, np.array(candidate.fits)))


class Placing:
    """The search for the parts of a recording that certainly are on a known track."""

    def __init__(self, recording: Recording, stretches: list[Stretch], centres: np.ndarray):
        """centres: float32 (n, 3, 5): of `reader.detect_centres`, in the recording's rows."""
        self.recording = recording
        self.followers = [Followers(stretch, centres[stretch.rows]) for stretch in stretches]
        self.parts: list[Part] = []
        self.grown: dict[tuple, Part | None] = {}  # what `best_of` has found: the same is sought again later
        self.cuts_ends = False  # whether a part that is not certain may be so without rows at its ends

    def anchors(self) -> None:
        """Find the parts that are certain by themselves."""
        for index, followers in enumerate(self.followers):
            n, at, free = len(followers.stretch), 0, 0
            while at + WINDOW <= n:
                grown = []
                for candidate in search(followers.ahead, at, at + WINDOW):
                    window, seed = followed(candidate, at + WINDOW), at + WINDOW // 2
                    if is_anchor(window):
                        track = known_tracks().index(window.track)
                        rows = followers.grow(track, seed, window.states[WINDOW // 2], free, n)
                        if rows and rows[1] - rows[0] >= WINDOW and is_anchor(rows[2]):
                            grown.append(Part(index, track, *rows))
                if found := unrivalled(grown, ALONG):
                    self.parts.append(found)
                    at = free = found.end
                    continue
                at = at + WINDOW_STEP if at + WINDOW == n else min(at + WINDOW_STEP, n - WINDOW)

    def spread(self, forward: bool) -> None:
        """Place what is left, from the ends of the parts that there are on, or from their starts back."""
        parts, self.parts = self.parts[:: 1 if forward else -1], []
        for part, other in itertools.zip_longest(parts, parts[1:]):
            self.parts.append(part)
            while found := self.next_to(self.parts[-1], other, forward):
                self.parts.append(found)
        self.parts = self.parts[:: 1 if forward else -1]

    def together(self) -> None:
        """Place stretches that are far from every part, alone or with those beside them: see ALONE."""
        placed = {part.stretch for part in self.parts}
        for index in sorted(range(len(self.followers)), key=lambda i: -len(self.followers[i].stretch)):
            if index in placed or not (first := self.alone(index)):
                continue
            if not self.are_in_reach(first, *self.parts):
                continue
            group = copy.copy(self)
            group.parts = [first]
            for forward in (True, False):
                group.spread(forward)
            new = [part for part in group.parts if part.stretch not in placed]
            if first.metres() >= ALONE_METRES or sum(part.metres() for part in new) >= TOGETHER_METRES:
                self.parts = sorted([*self.parts, *new], key=lambda part: (part.stretch, part.start))
                placed |= {part.stretch for part in new}

    def leave_out_other_roads(self) -> None:
        """Leave out the parts of stretches of which neither MOSTLY all rows nor those of a window are placed."""
        rows = np.array([len(followers.stretch) for followers in self.followers])
        placed = np.zeros(len(rows), int)
        for part in self.parts:
            placed[part.stretch] += part.end - part.start
        enough = placed >= np.minimum(MOSTLY * rows, WINDOW)
        self.parts = [part for part in self.parts if enough[part.stretch]]

    def alone(self, index: int) -> Part | None:
        """Return the part of a stretch that is at the limits ALONE, or None."""
        followers = self.followers[index]
        n, middle = len(followers.stretch), len(followers.stretch) // 2
        if not ALONE_ROWS <= n < WINDOW:
            return None
        found = followed(search(followers.ahead, 0, n)[0], n)
        track = known_tracks().index(found.track)
        grown = followers.grow(track, middle, found.states[middle], 0, n)
        part = Part(index, track, *grown) if grown else None
        return part if part and part.is_beyond(ALONE[found.track.name]) else None

    def next_to(self, part: Part, other: Part | None, forward: bool) -> Part | None:
        """Return the nearest part that is certain between two, or None; other: the next one, as yet, if any."""
        for index, first, end in self.gaps(part, other, forward):
            for skipped in PROBES:
                start = first + skipped if forward else end - PROBE - skipped
                if not first <= start <= end - PROBE:
                    break
                reach, paused = self.reach(part, index, start if forward else start + PROBE - 1, forward)
                if reach > MAX_REACH:
                    return None
                if found := self.near(part, index, (start, first, end), reach, forward, paused):
                    beside = [found, *(each for each in (part, other) if each)]
                    if self.are_in_reach(*beside):
                        return found
                    if self.cuts_ends and self.are_in_reach(*(cut := [self.without_mishaps(each) for each in beside])):
                        return cut[0]
                    break
        return None

    def without_mishaps(self, part: Part) -> Part:
        """Return a part without the rows at its ends that do not agree: a mishap need not end it."""
        follower, (rows, fit, turn) = self.followers[part.stretch].ahead[part.track], EXPECTED[part.found.track.name]
        whole = Candidate(follower, part.found.states[0], part.start, START_COVARIANCE)
        whole.follow(part.end)
        excess = np.array(whole.fits) / fit + (np.r_[0, whole.turns(whole.smooth())] / turn) ** 2 - 2
        # A mishap lies between two parts of a stretch, or stops the car; else the frames may be cut where the stretch
        # ends, and its last rows be of another road.
        stretch = self.followers[part.stretch].stretch
        speed = self.recording.speed[stretch.rows][part.start : part.end]
        others = [each for each in self.parts if each.stretch == part.stretch]
        may_cut = (
            any(each.end <= part.start for each in others) or speed[:LONGEST_END].min() < STOPS,
            any(each.start >= part.end for each in others) or speed[-LONGEST_END:].min() < STOPS,
        )
        first, last = (
            int(np.cumsum(np.r_[0, end[: LONGEST_END * may]]).argmax())
            for end, may in zip((excess, excess[::-1]), may_cut, strict=True)
        )
        if not first + last or part.end - last - part.start - first < rows:
            return part
        inside = Candidate(follower, part.found.states[first], part.start + first, START_COVARIANCE)
        found = followed(inside, part.end - last)
        return replace(part, start=part.start + first, end=part.end - last, found=found)

    def are_in_reach(self, part: Part, *others: Part) -> bool:
        """Return whether a car may drive between a part and each of the others."""
        return all(self.may_drive_between(part, other) for other in others)

    def may_drive_between(self, part: Part, other: Part) -> bool:
        """Return whether a car has the time to drive, or to be pushed, from one part to the other.

        Rows of another road may resemble the track where the part before them ends, and seem to lead on from there; but
        the part after them does not begin where they end.
        """
        earlier, later = sorted((part, other), key=lambda each: (each.stretch, each.start))
        leaves, arrives = (self.followers[each.stretch].stretch.rows.start for each in (earlier, later))
        time = self.recording.time[leaves + earlier.end - 1 : arrives + later.start + 1]
        if time[-1] - time[0] > MAX_PAUSE or np.diff(time).min() < 0:
            return True
        ahead, length = later.found.states[0, 0] - earlier.found.states[-1, 0], earlier.found.track.length
        ahead = (ahead + length / 2) % length - length / 2
        reach = TOP_SPEED_MPH * MPH * (time[-1] - time[0])
        near = -reach - SLACK < ahead < (1 + SLACK_PER_METRE) * reach + SLACK
        return earlier.track == later.track and bool(near)

    def gaps(self, part: Part, other: Part | None, forward: bool) -> Iterable[tuple[int, int, int]]:
        """Yield the rows between two parts: the index of a stretch, and its rows."""
        last = other.stretch if other else (len(self.followers) - 1 if forward else 0)
        for index in range(part.stretch, last + (1 if forward else -1), 1 if forward else -1):
            first, end = 0, len(self.followers[index].stretch)
            for each, is_before in ((part, forward), (other, not forward)):
                if each and each.stretch == index:
                    first, end = (max(first, each.end), end) if is_before else (first, min(end, each.start))
            if end - first >= PROBE:
                yield index, first, end

    def reach(self, part: Part, index: int, row: int, forward: bool) -> tuple[float, bool]:
        """Return how many metres the car may have driven between a part's end, or start, and a row of a stretch.

        And whether it may have been put anywhere meanwhile, in a pause: that counts no metres.
        """
        recording = self.recording
        inside = self.followers[part.stretch].stretch.rows.start + (part.end - 1 if forward else part.start)
        outside = self.followers[index].stretch.rows.start + row
        rows = slice(min(inside, outside), max(inside, outside) + 1)
        pause = np.diff(recording.time[rows])
        drives = (pause >= 0) & (pause <= MAX_PAUSE)
        speed = recording.speed[rows].astype(float) * MPH
        return float((np.maximum(speed[1:], speed[:-1]) * pause)[drives].sum()), not drives.all()

    def near(
        self, part: Part, index: int, rows: tuple[int, int, int], reach: float, forward: bool, paused: bool
    ) -> Part | None:
        """Return the part around some rows of a stretch if it certainly is near another one.

        First it is sought where the car should be by its speed, then wherever it may be after a mishap. rows: the first
        row of those that are probed, and the rows beyond which not to grow; reach: m that the car drove between.
        """
        start = rows[0]
        probed = float(self.followers[index].ahead[part.track].step[start : start + PROBE].sum())
        s = part.found.states[-1, 0] if forward else part.found.states[0, 0] - probed
        slack = SLACK + SLACK_PER_METRE * reach
        anywhere_near = -BACK, reach + BEYOND
        expected = EXPECTED, reach - slack, reach + slack
        for limits, least, most in [(ALONE, *anywhere_near)] if paused else [expected, (MISHAP, *anywhere_near)]:
            least, most = (least, most) if forward else (-most, -least)
            sought = tuple(s + np.arange(least, most + PROBE_STEP / 2, PROBE_STEP)), part.track, index, rows
            if sought not in self.grown:
                self.grown[sought] = self.best_of(*sought)
            found = self.grown[sought]
            # It may have grown from rows that were followed along the track, or back.
            if not found or not least - SLACK <= found.position(start) - s <= most + SLACK:
                continue
            # Where the car should be, a long part needs no more than what would be certain anywhere.
            if limits is not MISHAP and found.metres() >= ALONE_METRES and is_anchor(found.found):
                return found
            if not found.is_beyond(limits[found.found.track.name]) and self.cuts_ends:
                found = self.without_mishaps(found)
            if found.is_beyond(limits[found.found.track.name]):
                return found
        return None

    def best_of(self, positions: tuple[float, ...], track: int, index: int, rows: tuple[int, int, int]) -> Part | None:
        """Return the part that grows best from one of these positions, if it is `unrivalled`; rows: as for `near`."""
        (start, first, end), followers = rows, self.followers[index]
        candidates = [Candidate(followers.ahead[track], np.array([s, 0.0, 0.0]), start) for s in positions]
        for until in (start + FIRST_PROBE, start + PROBE):
            fits = {candidate: candidate.follow(until) for candidate in candidates}
            candidates = sorted(candidates, key=fits.__getitem__, reverse=True)[:KEPT]
        grown = []
        for candidate in candidates:
            state = candidate.smooth()[PROBE // 2]
            if found := followers.grow(track, start + PROBE // 2, state, first, end):
                grown.append(Part(index, track, *found))
        return unrivalled(grown, ACROSS)


def certain_parts(
    recording: Recording, stretches: list[Stretch], centres: np.ndarray
) -> list[tuple[Stretch, Localisation]]:
    """Return the parts of a recording that certainly are on a known track, in order.

    centres: float32 (n, 3, 5): of `reader.detect_centres`, in the recording's rows.
    """
    placing = Placing(recording, stretches, centres)
    placing.anchors()
    for cuts_ends in (False, True):  # first those that are certain as they are
        placing.cuts_ends = cuts_ends
        for forward in (True, False):
            placing.spread(forward)
    placing.together()
    placing.leave_out_other_roads()
    found = []
    for part in placing.parts:
        whole = stretches[part.stretch].rows.start
        found.append((Stretch.of(recording, slice(whole + part.start, whole + part.end)), part.found))
    return found
