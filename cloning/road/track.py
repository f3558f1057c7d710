"""The tracks: their centre lines and edges, and the position of a point relative to them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cloning.base.errors import TrackError
from cloning.road.generated import generate, road_number
from cloning.road.motion import right_of, wrap_angle

LEFT, RIGHT = -1, 1  # sides of a road, with the signs of lateral offsets


@dataclass(frozen=True)
class Pose:
    """A pose on the road: position in metres, heading in radians, grade.

    x is east, y north, z up; heading is 0 towards the east and grows counter-clockwise; grade is dz/ds.
    """

    x: float
    y: float
    z: float
    heading: float
    grade: float


@dataclass(frozen=True)
class Section:
    """A section of one side of a road, in the direction in which the track's points are listed.

    side        LEFT or RIGHT
    start, end  metres along the centre line; a negative start lies before the first point
    """

    side: int
    start: float
    end: float


@dataclass(frozen=True)
class Road:
    """The properties of a track besides its centre line.

    forward               direction in which its points are listed, "cw" or "ccw"; the real simulator's direction
    edge                  metres from the centre line to the edge of the road surface
    bridge                its start and end, metres along the centre line; equal where there is none
    bridge_edge           as edge, on the bridge; None if it is the same
    kerbs, kerb_edge      sections with a kerb, and the edge of the road surface there
    centre_line           whether a line is painted along the centre
    training, autonomous  x, y at which these modes start, in metres; None: the first point listed
    """

    forward: str
    edge: float
    bridge: tuple[float, float] = (0.0, 0.0)
    bridge_edge: float | None = None
    kerbs: tuple[Section, ...] = ()
    kerb_edge: float = 0.0
    centre_line: bool = False
    training: tuple[float, float] | None = None
    autonomous: tuple[float, float] | None = None


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
    "jungle": Road(forward="cw", edge=4.5, bridge=(806, 872), centre_line=True),
}


def find_road(name: str) -> tuple[Road, np.ndarray]:
    """Return a track's properties and the points of its centre line, float64 (n, 2) or (n, 3), m.

    name: a key of ROADS, or road-N for the generated road of the number N. Raises TrackError if there is none.
    """
    if name in ROADS:
        return ROADS[name], np.loadtxt(Path(__file__).with_name(f"{name}.csv"), delimiter=",", skiprows=1)
    number = road_number(name)
    if number is None:
        raise TrackError(f"{name[:40]}: there is no such track; there are {', '.join(ROADS)}, road-1, road-2 and so on")
    generated = generate(number)
    return Road(forward="ccw", edge=generated.width / 2), generated.points


class Track:
    """A track driven in one direction, as points about 1 m apart; s is the distance from the first point in metres.

    points     float64 (n, 3): m
    heading    float64 (n,): radians, continuous
    rightward  float64 (n, 2): unit vectors to the right
    curvature  float64 (n,): 1/m, right positive
    grade      float64 (n,): dz/ds
    edges      float64 (n, 2): metres from the centre line to the left and the right edge of the road surface
    length     of a lap, m
    step       between two points, m
    starts     s at which the modes "training" and "autonomous" start
    """

    def __init__(self, name: str, direction: str | None = None):
        """Load a track; name: see `find_road`; direction: "cw", "ccw" or None for the road's `forward`.

        Raises TrackError if there is no such track.
        """
        from scipy.interpolate import CubicSpline  # large, and not needed to train as the report does

        road, listed = find_road(name)
        self.name, self.direction = name, direction or road.forward
        if listed.shape[1] == 2:
            listed = np.c_[listed, np.zeros(len(listed))]
        points = np.vstack([listed, listed[:1]])
        chord = np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
        fine = CubicSpline(chord, points, bc_type="periodic")(np.arange(0, chord[-1], 0.05))
        fine = np.vstack([fine, fine[:1]])
        along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(fine[:, :2], axis=0), axis=1))]
        self.length = float(along[-1])
        n = round(self.length)
        self.step = self.length / n
        self.points = np.column_stack([np.interp(np.arange(n) * self.step, along, fine[:, i]) for i in range(3)])
        self.edges = np.full((n, 2), road.edge)
        for kerb in road.kerbs:
            self.edges[self._indices(kerb.start, kerb.end), 0 if kerb.side == LEFT else 1] = road.kerb_edge
        if road.bridge_edge is not None:
            self.edges[self._indices(*road.bridge)] = road.bridge_edge
        if self.direction != road.forward:  # the first point remains the first
            self.points = np.roll(self.points[::-1], 1, axis=0)
            self.edges = np.roll(self.edges[::-1, ::-1], 1, axis=0)
        around = np.roll(self.points, -1, axis=0) - np.roll(self.points, 1, axis=0)
        flat = np.linalg.norm(around[:, :2], axis=1)
        tangent = around[:, :2] / flat[:, None]
        self.rightward = right_of(tangent)
        self.grade = around[:, 2] / flat
        self.heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        turn = np.diff(np.r_[self.heading, self.heading[0] + self.turns()])
        kernel = np.ones(5) / 5
        self.curvature = -np.convolve(np.r_[turn[-3:], turn, turn[:2]], kernel, "valid")[:n] / self.step
        self.starts = {
            mode: self.locate(*start)[0] if start else 0.0
            for mode, start in (("training", road.training), ("autonomous", road.autonomous))
        }

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

    def index(self, s: float) -> int:
        """Return the index of the last point at or before s metres along the track."""
        return int(s / self.step) % len(self.points)

    def at(self, s: float, right: float = 0.0) -> Pose:
        """Return the pose at s metres along the track, `right` metres to the right of the centre line."""
        n = len(self.points)
        i, part = divmod(s / self.step, 1)
        i = int(i) % n
        j = (i + 1) % n
        x, y, z = self.points[i] * (1 - part) + self.points[j] * part
        heading = self.heading[i] + part * wrap_angle(self.heading[j] - self.heading[i])
        grade = self.grade[i] * (1 - part) + self.grade[j] * part
        return Pose(x + np.sin(heading) * right, y - np.cos(heading) * right, z, heading, grade)

    def locate(self, x: float, y: float, near: float | None = None) -> tuple[float, float]:
        """Return s and the lateral offset, in metres, of the position (x, y).

        near: s shortly before. Only points within 15 m of it are searched, which is fast and keeps the car on its road
        where the track crosses itself.
        """
        n = len(self.points)
        if near is None:
            indices = np.arange(n)
        else:
            indices = np.arange(int(near / self.step) - 15, int(near / self.step) + 16) % n
        away = self.points[indices, :2] - (x, y)
        i = int(indices[np.argmin(np.einsum("ij,ij->i", away, away))])
        dx, dy = x - self.points[i, 0], y - self.points[i, 1]
        right_x, right_y = self.rightward[i]
        ahead = dy * right_x - dx * right_y  # the tangent is the vector to the right, turned left
        bend = 1 - self.curvature[i] * (dx * right_x + dy * right_y)
        s = (i * self.step + ahead / max(bend, 0.2)) % self.length
        there = self.at(s)
        return s, float((x - there.x) * np.sin(there.heading) - (y - there.y) * np.cos(there.heading))
