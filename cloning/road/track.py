"""The two roads: their centre lines, where their surface ends, and where on them a point lies."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class Place:
    """A pose on the road: metres, x east, y north, z up; heading in radians, 0 east, counter-clockwise; grade
    dz/ds."""

    x: float
    y: float
    z: float
    heading: float
    grade: float


@dataclass(frozen=True)
class Road:
    """What is known of a track beside its centre line; distances along it in metres, in its file's order."""

    forward: str  # the direction in which its file lists the points
    edge: float  # from the centre line to the surface's end, m
    kerbs: tuple = ()  # (side, from, to, edge): stretches where the surface ends elsewhere; side +1 is left
    training: tuple | None = None  # x, y where the training mode starts; the first point otherwise
    autonomous: tuple | None = None


# Kerbs, verges and bridge were read off recordings of the real simulator, aligned to the centre line by their
# steering.
ROADS = {
    "lake": Road(
        forward="ccw",
        edge=3.95,
        training=(179.8, 89.9),
        autonomous=(-40.6, 108.7),
        kerbs=(
            (1, -45, 50, 4.95),
            (-1, -45, 55, 4.95),
            (1, 465, 545, 4.95),
            (-1, 478, 545, 4.95),
            (1, 815, 892, 4.95),
            (-1, 825, 845, 4.95),
            (-1, 860, 885, 4.95),
            (1, 965, 1022, 4.95),
            (-1, 958, 1022, 4.95),
            (1, 674, 783, 4.6),
            (-1, 674, 783, 4.6),
        ),
    ),
    "jungle": Road(forward="cw", edge=4.1),
}


class Track:
    """A track in one direction, as points about 1 m apart; s is the distance driven from the first, in metres.

    points     float64 (n, 3): m
    heading    float64 (n,): radians, continuous
    rightward  float64 (n, 2): unit vectors to the right
    curvature  float64 (n,): 1/m, right positive
    grade      float64 (n,): dz/ds
    edges      float64 (n, 2): m to the left and to the right at which the surface ends
    """

    def __init__(self, name: str, direction: str | None = None):
        self.name, road = name, ROADS[name]
        self.direction = direction or road.forward
        listed = np.loadtxt(Path(__file__).with_name(f"{name}.csv"), delimiter=",", skiprows=1)
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
        for side, start, end, edge in road.kerbs:
            self.edges[self._stretch(start, end), 0 if side > 0 else 1] = edge
        self.backward = self.direction != road.forward
        if self.backward:  # the first point stays the first
            self.points = np.roll(self.points[::-1], 1, axis=0)
            self.edges = np.roll(self.edges[::-1, ::-1], 1, axis=0)
        around = np.roll(self.points, -1, axis=0) - np.roll(self.points, 1, axis=0)
        flat = np.linalg.norm(around[:, :2], axis=1)
        tangent = around[:, :2] / flat[:, None]
        self.rightward = np.column_stack([tangent[:, 1], -tangent[:, 0]])
        self.grade = around[:, 2] / flat
        self.heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        turn = np.diff(np.r_[self.heading, self.heading[0] + self.turns()])
        kernel = np.ones(5) / 5
        self.curvature = -np.convolve(np.r_[turn[-3:], turn, turn[:2]], kernel, "valid")[:n] / self.step
        self.starts = {
            mode: self.locate(*where)[0] if where else 0.0
            for mode, where in (("training", road.training), ("autonomous", road.autonomous))
        }

    def turns(self) -> float:
        """Radians by which the heading has grown after a lap."""
        return 2 * np.pi * round((self.heading[-1] - self.heading[0]) / (2 * np.pi))

    def _stretch(self, start: float, end: float) -> np.ndarray:
        """Indices of the points from `start` to `end` metres along the listed direction; start may be
        negative."""
        return np.arange(round(start / self.step), round(end / self.step) + 1) % len(self.points)

    def at(self, s: float, right: float = 0.0) -> Place:
        """The pose at s metres along the track and `right` metres to the right of the centre line."""
        n = len(self.points)
        i, part = divmod(s / self.step, 1)
        i = int(i) % n
        j = (i + 1) % n
        x, y, z = self.points[i] * (1 - part) + self.points[j] * part
        turn = (self.heading[j] - self.heading[i] + np.pi) % (2 * np.pi) - np.pi
        heading = self.heading[i] + part * turn
        grade = self.grade[i] * (1 - part) + self.grade[j] * part
        return Place(x + np.sin(heading) * right, y - np.cos(heading) * right, z, heading, grade)

    def locate(self, x: float, y: float, near: float | None = None) -> tuple[float, float]:
        """(s, metres to the right) of the point of the centre line nearest to (x, y), in metres.

        near: an earlier s; only 30 m around it are looked at, which is fast and tells a road from one it crosses.
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

    def listed(self, s: float) -> float:
        """s, driven in this direction, as the distance along the file's order, which features are given
        in."""
        return (self.length - s) % self.length if self.backward else s
