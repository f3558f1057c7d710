"""Roads of points; and those made from a number: closed loops with bends, hills and one of the usual markings.

A random polygon gets round corners and is smoothed; polygons that give too sharp a bend or come too close to themselves
are refused. The random numbers depend on the road's number alone, so a number always gives the same road.
"""

import functools
import itertools
import re
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

# Yellow double lines as on the lake, white lines as in the jungle, or no lines and only such an edge.
MARKINGS = ("yellow double", "white", "kerb", "grass", "dirt", "wall", "rail")
LANDS = ("meadow", "forest", "desert", "canyon", "highland")
SPACING = 2.0  # m between the points
MIN_LENGTH, MAX_LENGTH = 600.0, 1500.0  # m
MIN_WIDTH, MAX_WIDTH = 6.0, 10.0  # m
APART = 50.0  # m or more along the road are between two parts of it that must keep a distance


@dataclass(frozen=True)
class Course:
    """What all generated roads of one kind have in common; ranges are (least, most)."""

    seed: tuple[int, ...]  # of their random numbers, before a road's own number
    corners: tuple[int, int]  # of the polygon
    nearest: tuple[float, float]  # distance from the middle to the nearest corner, as a share of that to the farthest
    radius: float  # m, of the centre line, at least
    rounding: float  # m over which corners are averaged, so that the steering need not jump at them
    turns: tuple[float, float]  # full circles that the bends to both sides have together, at least
    clearance: float  # m between the centre lines of two parts of the road
    flat: float  # share of roads without hills
    wave: float  # m, the shortest wave of the hills
    grade: float  # the steepest, dz/ds
    steepness: tuple[float, float]  # a road's steepest grade, as a share of `grade`
    crest: float  # m, radius of the height over the distance, at least


COURSES = {
    "road": Course(
        seed=(),
        corners=(8, 20),
        nearest=(0.1, 0.5),
        radius=12.0,
        rounding=9.0,
        turns=(1, 2.3),
        clearance=24.0,
        flat=0.12,
        wave=90.0,
        grade=0.25,
        steepness=(0.1, 0.97),
        crest=40.0,
    ),
    # As winding and as steep as the simulator's jungle, whose bends have a radius of 8 m and more, half of the track
    # below 21 m, with grades of up to 0.32 and crests of 37 m and more.
    "mountain": Course(
        seed=(1,),
        corners=(30, 50),
        nearest=(0.2, 0.6),
        radius=7.5,
        rounding=5.0,
        turns=(5, 6.5),
        clearance=22.0,
        flat=0.0,
        wave=40.0,
        grade=0.32,
        steepness=(0.7, 1.0),
        crest=35.0,
    ),
}
# Where the roads of the benchmark begin, by number: as in its published scores, from before `_start` rounded.
STARTS = {
    "road": """
        304 562 332 570 145 62 193 93 147 503 400 350 189 510 369 623 434 307 504 168 178 653 497 516 249 192 515 242 30
        121 590 173 343 269 218 462 215 279 49 102 399 68 83 526 211 318 43 236 83 112 680 405 71 158 177 327 121 416
        129 237 288 432 73 276 343 363 219 62 522 401 296 407 81 556 267 412 328 290 70 318 184 427 469 441 116 138 371
        514 376 404 360 157 294 125 256 363 237 151 168 177
    """,
    "mountain": "657 518 196 196 446 526",
}
NAME = re.compile(f"({'|'.join(COURSES)})-([1-9][0-9]{{0,8}})")


@dataclass(frozen=True, eq=False)
class PointRoad:
    """A road given by the points of its centre line; roads of the same content are equal."""

    name: str  # of the track
    points: np.ndarray  # float64 (n, 3): m east, north and up; the first point of a closed loop is not repeated
    width: float  # m, of the road surface
    marking: str  # one of MARKINGS
    land: str  # one of LANDS
    closed: bool = True  # whether it is a loop; an open road is driven from its first point to its last
    lead: float = 0.0  # m that an open road goes on straight before its first and after its last point
    seed: int = 0  # of the random numbers of its land and light

    def _content(self) -> tuple[object, ...]:
        return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in vars(self).values())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PointRoad) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())


@functools.lru_cache(maxsize=16)
def generate(name: str) -> PointRoad | None:
    """Return the generated road of this name: counter-clockwise, with points about 2 m apart; None if there is none.

    35 roads one after another have all combinations of marking and land.
    """
    match = NAME.fullmatch(name)
    if not match:
        return None
    course, number = COURSES[match[1]], int(match[2])
    rng = np.random.default_rng([*course.seed, number] if course.seed else number)
    width = rng.uniform(MIN_WIDTH, MAX_WIDTH)
    winding = 2 * np.pi * rng.uniform(*course.turns)
    flat = next(loop for loop in (draw_loop(rng, course, winding) for _ in itertools.count()) if loop is not None)
    points = np.c_[np.roll(flat, -_start(match[1], number, flat), axis=0), hills(rng, course, len(flat))]
    # Rounded, because the last bit of a sine differs from machine to machine.
    marking, land = (kinds[(number - 1) % len(kinds)] for kinds in (MARKINGS, LANDS))
    return PointRoad(name, points.round(4), round(width, 2), marking, land, seed=number)


def draw_loop(rng: Generator, course: Course, winding: float) -> np.ndarray | None:
    """Draw a closed curve, float64 (n, 2), m, about its middle; None if it breaks one of the limits.

    winding: radians that its bends to both sides have together, at least.
    """
    corners = int(rng.integers(*course.corners, endpoint=True))
    turn = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.35, 0.35, corners)) / corners
    reach = rng.uniform(rng.uniform(*course.nearest), 1, corners)
    turn += rng.uniform(-1.3, 1.3) * reach  # twisted, so that not every part is visible from the middle
    polygon = np.stack([reach * np.cos(turn) * rng.uniform(1, 1.8), reach * np.sin(turn)], axis=-1)
    perimeter = np.linalg.norm(polygon - np.roll(polygon, 1, axis=0), axis=1).sum()
    polygon *= rng.uniform(1.1 * MIN_LENGTH, 1.1 * MAX_LENGTH) / perimeter
    radii = rng.uniform(1.1, 2) * course.radius * rng.uniform(1, 4, corners)
    loop = round_corners(polygon, radii, 1.1 * course.radius)
    if loop is None:
        return None
    loop = resample(loop, 1.0)
    for _ in range(2):
        loop = moving_average(loop, round(course.rounding))
    loop = resample(loop, SPACING)
    bends = curvatures(loop)
    length = len(loop) * SPACING
    if not MIN_LENGTH + SPACING < length < MAX_LENGTH - SPACING or np.abs(bends).max() * 1.02 > 1 / course.radius:
        return None
    shifts = range(round(APART / SPACING), len(loop) // 2 + 1)
    nearest = (np.linalg.norm(loop - np.roll(loop, shift, axis=0), axis=1).min() for shift in shifts)
    if np.abs(bends).sum() * SPACING < winding or min(nearest) < course.clearance:
        return None
    return loop - (loop.min(axis=0) + loop.max(axis=0)) / 2


def _start(course: str, number: int, loop: np.ndarray) -> int:
    """Return the index of a road's first point in its loop, (n, 2): where it is straightest."""
    starts = [int(start) for start in STARTS[course].split()]
    if number <= len(starts):
        return starts[number - 1]
    bend = moving_average(np.abs(curvatures(loop))[:, None], round(40 / SPACING))[:, 0]
    return int(bend.round(9).argmin())  # on a straight, the last bits decided, and differ from processor to processor


def round_corners(polygon: np.ndarray, radii: np.ndarray, smallest: float) -> np.ndarray | None:
    """Return a closed polygon, (n, 2), with arcs for corners, (m, 2).

    radii: (n,), m; an arc too large for its corner becomes smaller. None if it would be smaller than `smallest`.
    """
    edges = np.roll(polygon, -1, axis=0) - polygon
    lengths = np.linalg.norm(edges, axis=1)
    after, before = edges / lengths[:, None], np.roll(edges / lengths[:, None], 1, axis=0)
    turns = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    tangent = np.tan(np.abs(turns) / 2)
    room = 0.49 * np.minimum(lengths, np.roll(lengths, 1))
    radii = np.minimum(radii, room / np.maximum(tangent, 1e-6))
    if radii.min() < smallest:
        return None
    arcs = []
    for corner, forward, turn, radius, reach in zip(polygon, before, turns, radii, radii * tangent, strict=True):
        angle = np.linspace(0, np.abs(turn), max(3, round(radius * np.abs(turn) / 0.5)))[:, None]
        inwards = np.sign(turn) * np.array([-forward[1], forward[0]])
        arcs.append(corner - reach * forward + radius * (np.sin(angle) * forward + (1 - np.cos(angle)) * inwards))
    return np.vstack(arcs)


def resample(loop: np.ndarray, spacing: float) -> np.ndarray:
    """Return points of a closed curve, (n, 2), at equal distances of about `spacing` m."""
    closed = np.vstack([loop, loop[:1]])
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))]
    wanted = np.linspace(0, along[-1], round(along[-1] / spacing), endpoint=False)
    return np.stack([np.interp(wanted, along, column) for column in closed.T], axis=-1)


def moving_average(values: np.ndarray, count: int) -> np.ndarray:
    """Return the means over `count` neighbours along a closed curve; values: (n, k)."""
    shifts = range(-(count // 2), count - count // 2)
    return np.mean([np.roll(values, shift, axis=0) for shift in shifts], axis=0)


def curvatures(loop: np.ndarray) -> np.ndarray:
    """Return the curvature at each point of a closed curve, 1/m, left positive: of the circle through three points."""
    before, after = loop - np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0) - loop
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    sides = [np.linalg.norm(side, axis=1) for side in (before, after, before + after)]
    return 2 * cross / np.prod(sides, axis=0)


def hills(rng: Generator, course: Course, n: int) -> np.ndarray:
    """Return heights in m along a closed curve of n points; all are 0 on a flat road."""
    if rng.uniform() < course.flat:
        return np.zeros(n)
    waves = np.arange(1, int(n * SPACING / course.wave) + 1)
    phases = 2 * np.pi * (waves * np.arange(n)[:, None] / n + rng.uniform(0, 1, len(waves)))
    height = (np.sin(phases) * rng.uniform(0, 1, len(waves)) / waves ** rng.uniform(0.5, 1.5)).sum(axis=1)
    steepest = np.abs(np.roll(height, -1) - height).max() / SPACING
    sharpest = np.abs(np.roll(height, -1) - 2 * height + np.roll(height, 1)).max() / SPACING**2
    return height * min(rng.uniform(*course.steepness) * course.grade / steepest, 1 / (course.crest * sharpest))
