"""Finds where on which known track a stretch of a recording is, by how its road bends and what a network detects."""

import functools
import math
from dataclasses import dataclass

import numpy as np

from cloning.lane.follow import Candidate, TrackFilter
from cloning.road.motion import REAR_AXLE, wrap_angle
from cloning.road.track import ROADS, Track

PROFILE_LENGTH, PROFILE_STEP = 200.0, 2.0  # m: part of the trajectory whose heading is compared, and its step
MAX_DEVIATION = 0.5  # radians, standard deviation: windows of real recordings have 0.02 to 0.29 where they are
SEARCH = ((8, 100), (3, 200), (2, 600))  # rounds: number of the best candidates that the filter follows, and rows
# Stretches of 300 rows of real recordings have -0.25 to 0 on their own track, -0.45 or less on the other.
MIN_LOG_LIKELIHOOD = -0.35
# Real recordings and rendered drives have 0.12 to 0.33 on the lake and 0.56 to 0.92 in the jungle. Laps of generated
# roads, which a position on a track can follow nearly as well, have at least 1.5; 315 m along the middle of gentle ones
# at least 0.67. Of 135 m along the middle, a quarter of the roads still has less than 0.5.
MAX_TURN_RESIDUAL = {"lake": 0.5, "jungle": 1.2}
ALONG, ACROSS = 0, 1  # the road: columns of `Localisation.states`


@dataclass(frozen=True)
class Localisation:
    """The result of localising a stretch of a recording on a known track."""

    track: Track  # in the direction driven
    # float64 (n, 3): the rear axle's state in each row: s, m along the track; lateral offset, m to the right of its
    # centre line; heading error, radians to its right.
    states: np.ndarray
    # Of a detection, on average, for a Cauchy distribution: 0 where detections agree with the track, -2.3 where they
    # have nothing to do with it.
    log_likelihood: float
    # Root mean square of the changes of the heading error that neither steering nor the track explains, in standard
    # deviations of the process noise: below 1 on the right track, where the car turns as it steers.
    turn_residual: float

    def middle(self) -> np.ndarray:
        """Return the lateral offset and heading error of the car's middle as in `LanePosition`: float64 (n, 2)."""
        return np.array([self._middle(*state) for state in self.states.tolist()])

    def _middle(self, s: float, right: float, heading_error: float) -> tuple[float, float]:
        # Exactly, since in a sharp bend the road turns by 0.16 radians between the rear axle and the middle.
        axle = self.track.at(s, right)
        heading = axle.heading - heading_error
        x, y = axle.x + REAR_AXLE * math.cos(heading), axle.y + REAR_AXLE * math.sin(heading)
        beside, offset = self.track.locate(x, y, s)
        return offset, wrap_angle(self.track.at(beside).heading - heading)

    def is_certain(self) -> bool:
        """Return whether the stretch certainly is on this track."""
        likely = self.log_likelihood > MIN_LOG_LIKELIHOOD
        return likely and self.turn_residual < MAX_TURN_RESIDUAL[self.track.name]


@dataclass(frozen=True)
class Part:
    """Rows of a stretch that certainly are on a track."""

    stretch: int  # its index, as the next
    track: int
    start: int  # the first row of the stretch
    end: int  # the row after the last
    found: Localisation  # in these rows

    def quality(self) -> float:
        """Return a measure of how many rows agree with the track, and how well."""
        found = self.found
        fit = found.log_likelihood / -MIN_LOG_LIKELIHOOD
        return (self.end - self.start) * (2 + fit - (found.turn_residual / MAX_TURN_RESIDUAL[found.track.name]) ** 2)

    def is_beyond(self, limits: tuple[int, float, float]) -> bool:
        """Return whether the part has more rows, a higher log-likelihood and a lower turn residual than these."""
        rows, log_likelihood, turn_residual = limits
        found = self.found
        fits = found.log_likelihood > log_likelihood and found.turn_residual < turn_residual
        return fits and self.end - self.start >= rows

    def metres(self) -> float:
        """Return how far the car drives in the part, m."""
        return float(self.found.states[-1, 0] - self.found.states[0, 0])

    def position(self, row: int) -> float:
        """Return where on the track the car is in a row of the stretch, or in the nearest one of the part, m."""
        return float(self.found.states[min(max(row, self.start), self.end - 1) - self.start, ALONG])

    def away_from(self, other: "Part", axis: int) -> float:
        """Return how far from here another part is placed in the rows of both, on average, m.

        axis: ALONG or ACROSS the road; inf on another track or in its other direction, or without a common row.
        """
        start, end = max(self.start, other.start), min(self.end, other.end)
        if (self.track, self.stretch) != (other.track, other.stretch) or start >= end:
            return np.inf
        here, there = (part.found.states[start - part.start : end - part.start, axis] for part in (self, other))
        return float(np.abs(here - there).mean())


@functools.cache
def known_tracks() -> tuple[Track, ...]:
    """Return the known tracks in both directions."""
    return tuple(Track(name, direction) for name in ROADS for direction in ("ccw", "cw"))


def candidate_positions(follower: TrackFilter, first: int = 0) -> list[tuple[float, float]]:
    """Find positions on the track at which the road bends like a stretch from row `first` on.

    Returns (deviation, s): the standard deviation of the difference in heading, radians, and m along the track; only
    local minima of the deviation.
    """
    driven = np.r_[0, np.cumsum(follower.step[first:])]
    # Two points at least: a single one deviates nowhere, and so has no minima.
    wanted = np.arange(0, np.clip(driven[-1], 2 * PROFILE_STEP, PROFILE_LENGTH), PROFILE_STEP)
    heading = np.interp(wanted, driven, np.r_[0, np.cumsum(follower.turn[first:])])
    track = follower.track
    n = round(track.length / PROFILE_STEP)
    two_laps = np.r_[track.heading, track.heading + track.turns(), track.heading[0] + 2 * track.turns()]
    resampled = np.interp(np.arange(n + len(wanted)) * PROFILE_STEP, np.arange(len(two_laps)) * track.step, two_laps)
    deviation = (np.lib.stride_tricks.sliding_window_view(resampled, len(wanted))[:n] + heading).std(1)
    minima = (deviation <= np.roll(deviation, 1)) & (deviation < np.roll(deviation, -1))
    return [(float(deviation[i]), i * PROFILE_STEP) for i in np.flatnonzero(minima)]


def search(filters: list[TrackFilter], first: int, end: int) -> list[Candidate]:
    """Return the best candidates for the rows from `first` to `end` of a stretch, two at most, the best one first."""
    found = [
        (badness, Candidate(each, np.array([s, 0.0, 0.0]), first))
        for each in filters
        for badness, s in candidate_positions(each, first)
    ]
    likely = [candidate for candidate in found if candidate[0] < MAX_DEVIATION]
    found = likely or [min(found, key=lambda candidate: candidate[0])]
    for count, rows in SEARCH:
        best = sorted(found, key=lambda candidate: candidate[0])[:count]
        found = [(-candidate.follow(min(first + rows, end)), candidate) for _, candidate in best]
    return [candidate for _, candidate in sorted(found, key=lambda candidate: candidate[0])]


def followed(candidate: Candidate, end: int) -> Localisation:
    """Return the localisation of the rows from a candidate's first to `end`."""
    log_likelihood, states = candidate.follow(end), candidate.smooth()
    turn_residual = float(np.sqrt(np.mean(candidate.turns(states) ** 2)))
    return Localisation(candidate.follower.track, states, log_likelihood, turn_residual)
