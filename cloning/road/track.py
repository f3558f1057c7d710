"""The tracks: their centre lines and edges, and the position of a point relative to them."""

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from cloning.base.errors import TrackError
from cloning.road.generated import COURSES, PointRoad, generate
from cloning.road.motion import right_of, wrap_angle

FOLDER = Path(__file__).parent
LEFT, RIGHT = -1, 1  # sides of a road, with the signs of lateral offsets

Indices = TypeVar("Indices", int, np.ndarray)


class Pose(NamedTuple):
    """A pose on the road."""

    x: float  # m, east
    y: float  # m, north
    z: float  # m, up
    heading: float  # radians, 0 towards the east, growing counter-clockwise
    grade: float  # dz/ds


@dataclass(frozen=True)
class Section:
    """A section of one side of a road, in the direction in which the track's points are listed."""

    side: int  # LEFT or RIGHT
    start: float  # m along the centre line; negative before the first point
    end: float


@dataclass(frozen=True)
class Road:
    """The properties of a track besides its centre line."""

    forward: str  # direction in which its points are listed, "cw" or "ccw"; the real simulator's direction
    edge: float  # m from the centre line to the edge of the road surface
    bridge: tuple[float, float] = (0.0, 0.0)  # its start and end, m along the centre line; equal where there is none
    bridge_edge: float | None = None  # as edge, on the bridge; None if it is the same
    kerbs: tuple[Section, ...] = ()  # sections with a kerb
    kerb_edge: float = 0.0  # as edge, where there is a kerb
    centre_line: bool = False  # whether a line is painted along the centre
    training: tuple[float, float] | None = None  # x, y where this mode starts, m; None: at the first point listed
    autonomous: tuple[float, float] | None = None  # likewise
    # m, of a lap; None: as it is computed. Its last bit, another on ARM, decides which points the jungle's surface has.
    length: float | None = None


# The real simulator's two. Kerbs and bridges were measured in its recordings, aligned to the centre lines.
ROADS = {
    "lake": Road(
        forward="ccw",
        edge=3.95,
        bridge=(674, 783),
        bridge_edge=4.6,
        kerbs=(
            Section(LEFT, -45, 50),
            Section(RIGHT, -45, 55),
            Section(LEFT, 465, 545),
            Section(RIGHT, 478, 545),
            Section(LEFT, 815, 892),
            Section(RIGHT, 825, 845),
            Section(RIGHT, 860, 885),
            Section(LEFT, 965, 1022),
            Section(RIGHT, 958, 1022),
        ),
        kerb_edge=4.95,
        training=(179.8, 89.9),
        autonomous=(-40.6, 108.7),
    ),
    "jungle": Road(forward="cw", edge=4.5, bridge=(806, 872), centre_line=True, length=1493.5740055860442),
}


def find_points(source: str | PointRoad) -> PointRoad | None:
    """Return the road of points that a track's source is, or None for the real simulator's tracks.

    source: a key of ROADS, road-N or mountain-N, which are generated, or a road of points. Raises TrackError.
    """
    if isinstance(source, PointRoad) or source in ROADS:
        return source if isinstance(source, PointRoad) else None
    road = generate(source)
    if road is None:
        known = ", ".join((*ROADS, *(f"{kind}-1, {kind}-2 and so on" for kind in COURSES)))
        raise TrackError(f"{source[:40]}: there is no such track; there are {known}")
    return road


def centre_line(source: str | PointRoad) -> np.ndarray:
    """Return the points of a road's centre line as they are listed: float64 (n, 2) or (n, 3), m.

    source: see `find_points`, whose errors are raised.
    """
    road = find_points(source)
    return road.points if road else np.loadtxt(FOLDER / f"{source}.csv", delimiter=",", skiprows=1)


class Track:
    """A track driven in one direction, as points about 1 m apart; s is the distance from the first point in metres."""

    source: str | PointRoad  # what it was made from, see `find_points`
    points: np.ndarray  # float64 (n, 3): m
    heading: np.ndarray  # float64 (n,): radians, continuous
    rightward: np.ndarray  # float64 (n, 2): unit vectors to the right
    curvature: np.ndarray  # float64 (n,): 1/m, right positive
    grade: np.ndarray  # float64 (n,): dz/ds
    edges: np.ndarray  # float64 (n, 2): m from the centre line to the left and the right edge of the road surface
    length: float  # of a lap, m
    step: float  # between two points, m
    closed: bool  # whether it is a loop
    first: int  # number of points before s = 0: an open road goes on straight beyond both ends
    starts: dict[str, float]  # s at which the modes "training" and "autonomous" start

    def __init__(self, source: str | PointRoad, direction: str | None = None):
        """Load a track; source: see `find_points`; direction: "cw", "ccw" or None for the road's `forward`.

        An open road's `forward` is "ccw", whatever its shape. Raises TrackError if there is no such track.
        """
        self.source, of_points, listed = source, find_points(source), centre_line(source)
        if of_points is None:
            road = ROADS[str(source)]
        else:
            x, y = listed[:, :2].T
            clockwise = of_points.closed and (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0
            road = Road(forward="cw" if clockwise else "ccw", edge=of_points.width / 2)
        self.name = of_points.name if of_points else str(source)
        self.direction, self.closed = direction or road.forward, of_points is None or of_points.closed
        if listed.shape[1] == 2:
            listed = np.c_[listed, np.zeros(len(listed))]
        self._place_points(listed, of_points.lead if of_points else 0.0, road.length)
        n = len(self.points)
        self.edges = np.full((n, 2), road.edge)
        for kerb in road.kerbs:
            self.edges[self._indices(kerb.start, kerb.end), 0 if kerb.side == LEFT else 1] = road.kerb_edge
        if road.bridge_edge is not None:
            self.edges[self._indices(*road.bridge)] = road.bridge_edge
        if self.direction != road.forward:  # a loop's first point remains the first
            self.points = np.roll(self.points[::-1], 1 if self.closed else 0, axis=0)
            self.edges = np.roll(self.edges[::-1, ::-1], 1 if self.closed else 0, axis=0)
        before, after = self._beyond(self.points)
        around = np.vstack([self.points[1:], after]) - np.vstack([before, self.points[:-1]])
        flat = np.linalg.norm(around[:, :2], axis=1)
        tangent = around[:, :2] / flat[:, None]
        self.rightward = right_of(tangent)
        self.grade = around[:, 2] / flat
        self.heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        turn = np.diff(np.r_[self.heading, self.heading[0] + self.turns() if self.closed else self.heading[-1]])
        ends = (turn[-3:], turn[:2]) if self.closed else (np.zeros(3), np.zeros(2))
        kernel = np.ones(5) / 5
        self.curvature = -np.convolve(np.r_[ends[0], turn, ends[1]], kernel, "valid")[:n] / self.step
        self.starts = {
            mode: self.locate(*start)[0] if start else 0.0
            for mode, start in (("training", road.training), ("autonomous", road.autonomous))
        }

    def _place_points(self, listed: np.ndarray, lead: float, length: float | None) -> None:
        """Place points about 1 m apart on a smooth curve through those listed, float64 (n, 3).

        lead: m of straight road before and after an open road; length: see `Road`.
        """
        from scipy.interpolate import CubicSpline  # large, and not needed to train as the report does

        ring = np.vstack([listed, listed[:1]]) if self.closed else listed
        chord = np.r_[0, np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))]
        curve = CubicSpline(chord, ring, bc_type="periodic" if self.closed else "natural")
        fine = np.vstack([curve(np.arange(0, chord[-1], 0.05)), ring[-1:]])
        along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(fine[:, :2], axis=0), axis=1))]
        self.length = length or float(along[-1])
        n = round(self.length)
        self.step = self.length / n
        s = np.arange(n if self.closed else n + 1) * self.step
        self.points = np.column_stack([np.interp(s, along, fine[:, i]) for i in range(3)])
        self.first = round(lead / self.step)
        if self.first:
            before, after = self._beyond(self.points)
            steps = np.arange(1, self.first + 1)[:, None]
            start, end = self.points[0], self.points[-1]
            self.points = np.vstack([start + steps[::-1] * (before - start), self.points, end + steps * (after - end)])

    def _beyond(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points before the first and after the last one, (3,): of the loop, or straight on."""
        if self.closed:
            return points[-1], points[0]
        return 2 * points[0] - points[1], 2 * points[-1] - points[-2]

    @property
    def extent(self) -> tuple[float, float]:
        """The first and the last s at which there is road: those of a lap, or of an open road with its leads."""
        return -self.first * self.step, self.length + self.first * self.step

    def turns(self) -> float:
        """Return by how many radians the heading grows over a lap."""
        return 2 * np.pi * round((self.heading[-1] - self.heading[0]) / (2 * np.pi))

    def straight(self, length: float) -> float:
        """Return s at which the straightest stretch of this length, m, begins."""
        n = min(round(length / self.step), len(self.points))
        bend = np.abs(np.r_[self.curvature, self.curvature[: n - 1]])
        return float(np.lib.stride_tricks.sliding_window_view(bend, n).max(axis=1).argmin() * self.step)

    def _indices(self, start: float, end: float) -> np.ndarray:
        """Return the indices of the points from `start` to `end` metres along the file's direction."""
        return np.arange(round(start / self.step), round(end / self.step) + 1) % len(self.points)

    def wrap(self, i: Indices) -> Indices:
        """Return the index of the i-th point from s = 0 on: round the loop, or up to an open road's ends."""
        return i % len(self.points) if self.closed else np.clip(i + self.first, 0, len(self.points) - 1)

    def index(self, s: float) -> int:
        """Return the index of the last point at or before s metres along the track."""
        return int(self.wrap(math.floor(s / self.step)))

    def at(self, s: float, right: float = 0.0) -> Pose:
        """Return the pose at s metres along the track, `right` metres to the right of the centre line."""
        number, part = divmod(float(s) / self.step, 1)
        i = int(number)
        *before, before_heading = self._poses[self.wrap(i)]
        *after, after_heading = self._poses[self.wrap(i + 1)]
        x, y, z, grade = [here * (1 - part) + there * part for here, there in zip(before, after, strict=True)]
        heading = before_heading + part * wrap_angle(after_heading - before_heading)
        return Pose(x + float(np.sin(heading)) * right, y - float(np.cos(heading)) * right, z, heading, grade)

    @functools.cached_property
    def _poses(self) -> list[list[float]]:
        """x, y, z, grade and heading at each point: floats, since `at` would take twice as long with small arrays."""
        return np.column_stack([self.points, self.grade, self.heading]).tolist()

    def locate(self, x: float, y: float, near: float | None = None) -> tuple[float, float]:
        """Return s and the lateral offset, in metres, of the position (x, y).

        near: s shortly before. Only points within 15 m of it are searched, which is fast and keeps the car on its road
        where the track crosses itself.
        """
        if near is None:
            indices = np.arange(len(self.points))
        else:
            indices = self.wrap(np.arange(int(near / self.step) - 15, int(near / self.step) + 16))
        away = self.points[indices, :2] - (x, y)
        i = int(indices[np.argmin(np.einsum("ij,ij->i", away, away))])
        dx, dy = x - self.points[i, 0], y - self.points[i, 1]
        right_x, right_y = self.rightward[i]
        ahead = dy * right_x - dx * right_y  # the tangent is the vector to the right, turned left
        bend = 1 - self.curvature[i] * (dx * right_x + dy * right_y)
        s = (i - self.first) * self.step + ahead / max(bend, 0.2)
        if self.closed:
            s %= self.length
        there = self.at(s)
        return s, float((x - there.x) * np.sin(there.heading) - (y - there.y) * np.cos(there.heading))
