"""Where on one of the known roads a recording was driven: both tracks' centre lines are known, so that the lane's
centre is, too, where no single frame shows it well.

An extended Kalman filter with a Rauch-Tung-Striebel smoother over (s, right, yaw) of the rear axle's middle: moved on
by the steering, speed and time stamps, held by where `lane.py` sees the lane's centre ahead, which need not be right in
each frame.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cloning.lane.reader import AHEAD, MOUNT_OFFSETS, Lane, LaneNetwork, combine, see
from cloning.recordings.log import Recording
from cloning.road.motion import AXLE_TO_CAMERA, REAR_AXLE, Stretch
from cloning.road.track import ROADS, Track

BLUR = (0.3 + 0.08 * AHEAD) * 2  # m: of what is seen ahead, twice as much as of a single frame: neighbours err alike
CLEAR = 2.0  # standard deviations, from which on what is seen counts less
LOST = 3.0  # standard deviations, that what ought to be seen and is not counts for
AROUND = np.stack([AHEAD, AHEAD - 0.5, AHEAD + 0.5])
NEAR = np.arange(-6, 40)  # of the road's points, which are a metre apart, what may be seen
LONG, LIKELY = 300, -0.35  # rows, and a likelihood, from which on a stretch is believed to be where it was placed
PROFILE, PACE = 200.0, 2.0  # m of the way whose bends are looked for on the roads, and between two points of it
BEGIN = ((8, 150), (2, 600))  # how many of the places found so are followed over how many rows
APART = 4.0  # m: the standard deviation of such a place
# Variances: of where a drive begins; and standard deviations by which a row's way is unsure, by metre driven and radian
# turned: along, beside and of the yaw. A car that turns hard slides.
BEGINS = np.diag([APART**2, 4.0, 0.05])
BY_METRE, BY_TURN, ALWAYS = np.array([0.03, 0.02, 0]), np.array([0, 0.4, 0.2]), np.array([0, 0, 0.003])


def centre_ahead(track: Track, s: float, x: float, y: float, heading: float, ahead=AHEAD) -> np.ndarray:
    """Where the centre line lies ahead of a camera at (x, y) that looks along `heading`, in the track's own metres and
    radians, near the track's metre s: metres to its right at the distances `ahead`, nan beyond where it turns back.

    ahead: (k,). float64 (k,).
    """
    near = (round(s / track.step) + NEAR) % len(track.points)
    away = track.points[near, :2] - (x, y)
    forward = away @ (np.cos(heading), np.sin(heading))
    aside = away @ (np.sin(heading), -np.cos(heading))
    back = np.flatnonzero(np.diff(forward) <= 0)
    end = back[0] + 1 if len(back) else len(forward)
    return np.interp(ahead, forward[:end], aside[:end], right=np.nan)


@dataclass
class Placed:
    """A stretch of a recording on a known road.

    track   in the direction driven
    place   float64 (n, 3): of the rear axle's middle in each row: m along the track, m to the right of its centre line
            and radians to it
    likely  what was seen of the lane, and where it ought to have been seen: 0 where they are the same, -2.3 where they
            have nothing to do with one another
    """

    track: Track
    place: np.ndarray
    likely: float


class Filter:
    """Follows a stretch along a track. A state is (s, right, yaw), as `Placed.place` has it."""

    def __init__(self, stretch: Stretch, seen: np.ndarray, track: Track):
        """seen: float32 (n, 3, 5), what the three cameras see in the stretch's rows."""
        self.track, self.step, self.turn = track, np.diff(stretch.driven), np.diff(stretch.heading)
        self.seen = np.median(seen + MOUNT_OFFSETS[:, None], axis=1)

    def bend(self, s: float) -> float:
        """The road's curvature, 1/m, right positive."""
        return float(self.track.curvature[round(s / self.track.step) % len(self.track.curvature)])

    def move(self, at: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state a row later, and its derivatives by this one: (3,), (3, 3)."""
        s, right, yaw = state
        step, turn, bend = self.step[at], self.turn[at], self.bend(s)
        slower = max(0.3, 1 - bend * right)  # on the inside of a bend the centre line is the shorter way
        on = step * np.cos(yaw + turn / 2) / slower
        headings = self.track.at(s).heading - self.track.at(s + on).heading
        road = (headings + np.pi) % (2 * np.pi) - np.pi
        by = np.array(
            [
                [1, on * bend / slower, -step * np.sin(yaw)],
                [0, 1, step],
                [bend - self.bend(s + on), -bend * on * bend / slower, 1],
            ]
        )
        moved = s + on, right + step * np.sin(yaw + (turn - road) / 2), yaw + turn - road
        return np.array(moved), by

    def view(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What would be seen of the centre line, and its derivatives by the state: (5,), (5, 3); nan out of reach."""
        s, right, yaw = state
        axle = self.track.at(s, right)
        heading = axle.heading - yaw
        eye = axle.x + AXLE_TO_CAMERA * np.cos(heading), axle.y + AXLE_TO_CAMERA * np.sin(heading)
        seen, before, after = centre_ahead(self.track, s, *eye, heading, AROUND.ravel()).reshape(3, -1)
        slope = (after - before) / (AROUND[2] - AROUND[1])
        bend = self.bend(s)
        turned = -(AHEAD + AXLE_TO_CAMERA) - slope * seen  # by the car's turning about its rear axle
        on = (1 - bend * right) * (slope * np.cos(yaw) + np.sin(yaw)) + bend * turned
        return seen, np.stack([on, slope * np.sin(yaw) - np.cos(yaw), turned], axis=1)

    def run(self, s: float, n: int, smooth: bool = False) -> tuple[np.ndarray, float]:
        """The places of the first n rows, begun at s; the last one alone unless smooth; and their likelihood."""
        x, p = np.array([s, 0.0, 0.0]), BEGINS
        filtered, predicted, likely = [], [], 0.0
        for at in range(n):
            f = np.eye(3)
            if at:
                x, f = self.move(at - 1, x)
                unsure = BY_METRE * self.step[at - 1] + BY_TURN * abs(self.turn[at - 1]) + ALWAYS
                p = f @ p @ f.T + np.diag(unsure**2)
            predicted.append((x, p, f))
            expected, by = self.view(x)
            sight = ~np.isnan(by).any(1)
            likely -= np.log1p(np.where(sight, (self.seen[at] - expected) / BLUR, LOST) ** 2).mean()
            for k in np.flatnonzero(sight):
                h = by[k]
                off = self.seen[at, k] - expected[k] - h @ (x - predicted[-1][0])
                expecting = h @ p @ h
                far = max(1.0, off**2 / (expecting + BLUR[k] ** 2) / CLEAR**2)
                gain = p @ h / (expecting + BLUR[k] ** 2 * far)
                x, p = x + gain * off, p - np.outer(gain, h @ p)
            filtered.append((x, p))
        places = [filtered[-1][0]]
        for (x, p), (y, q, f) in zip(filtered[-2::-1], predicted[:0:-1], strict=True) if smooth else ():
            places.append(x + p @ f.T @ np.linalg.solve(q, places[-1] - y))
        return np.array(places[::-1]), likely / n


def beginnings(one: Filter) -> list[tuple[float, float]]:
    """Where on its track the stretch's bends are found: how far they are off (radians, standard deviation), and m along
    the track; the best of each few metres."""
    driven = np.r_[0, np.cumsum(one.step)]
    wanted = np.arange(0, min(PROFILE, driven[-1]), PACE)
    heading = np.interp(wanted, driven, np.r_[0, np.cumsum(one.turn)])
    track = one.track
    n = round(track.length / PACE)
    around = np.r_[track.heading, track.heading + track.turns(), track.heading[0] + 2 * track.turns()]
    lap = np.interp(np.arange(n + len(wanted)) * PACE, np.arange(len(around)) * track.step, around)
    off = (np.lib.stride_tricks.sliding_window_view(lap, len(wanted))[:n] + heading).std(1)
    least = (off <= np.roll(off, 1)) & (off < np.roll(off, -1))
    return [(float(off[i]), i * PACE) for i in np.flatnonzero(least)]


def placed(stretch: Stretch, seen: np.ndarray) -> Placed:
    """A stretch on the road that it fits best.

    seen: float32 (n, 3, 5): where the lane's centre is seen in the stretch's rows, as `lane.see` gives it.
    """
    n = len(stretch)
    tries = []
    for name in ROADS:
        for direction in ("ccw", "cw"):
            one = Filter(stretch, seen, Track(name, direction))
            tries += [(off, one, s) for off, s in beginnings(one)]
    for few, first in BEGIN:
        tries = sorted(tries, key=lambda tried: tried[0])[:few]
        tries = [(-one.run(s, min(first, n))[1], one, s) for _, one, s in tries]
    _, one, s = min(tries, key=lambda tried: tried[0])
    return Placed(one.track, *one.run(s, n, smooth=True))


def known(whole: list[Stretch], seen: np.ndarray) -> Iterator[tuple[slice, Placed]]:
    """The stretches of a recording that are surely on a known road; seen: float32 (n, 3, 5), as `lane.see` has it.

    Pieces of real recordings of 300 rows have a likelihood of -0.25 to 0 on their road, and of -0.45 and less on the
    other track. Shorter ones find a bend that is like their own anywhere.
    """
    for stretch in whole:
        if len(stretch) >= LONG and (found := placed(stretch, seen[stretch.rows])).likely > LIKELY:
            yield stretch.rows, found


def read_lane(recording: Recording, whole: list[Stretch], network: LaneNetwork | None = None) -> Lane:
    """The place in the lane at every row of a recording: on a known road by that, on others as `lane.combine` has it.

    Raises OSError, ValueError for images that can't be read.
    """
    seen = see(recording, network)
    lane = combine(recording, seen)
    for rows, found in known(whole, seen):
        lane.yaw[rows] = found.place[:, 2]
        lane.offset[rows] = found.place[:, 1] + REAR_AXLE * np.sin(found.place[:, 2])
        lane.trusted[rows] = True
    return lane
