"""Roads from points: a centre line of one's own, from a file or a program, checked before it is driven.

    road = make_road([(0, 0), (60, 0), (110, 30)], width=8, marking="white")
    road = read_road("road.json", land="desert")
    track = Track(road)  # of cloning.road.track; `--road FILE` of `python -m simulator` does this

A file has one of three forms, whatever its name:

* CSV: a line x,y or x,y,z (z up) for each point, with commas, semicolons or spaces. A line of the columns' names above
  them (x, x_m or x [m], and so on; also after #) gives another order, or names columns that are ignored. Lines that
  begin with # are comments
* JSON: a list of such points, or of objects with "x" and "y", or an object that has it as "road_points", and may have
  "width", "marking", "land" and "closed" beside it; other keys are ignored
* the text x,y,z@x,y,z@… that programs of road tests send to the simulator, in which y is the height

The points are in metres. A road whose last point is its first one is a closed loop.
"""

import csv
import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cloning.base.errors import TrackError
from cloning.base.outputs import plural
from cloning.road.generated import LANDS, MARKINGS, PointRoad
from cloning.road.track import Track

WIDTH, MARKING, LAND = 8.0, "white", "meadow"  # m: two lanes, as road tests have them
MIN_WIDTH, MAX_WIDTH = 5.0, 12.0  # m: room for the car, and for the scenery beside the road
MIN_LENGTH, MAX_LENGTH = 20.0, 8000.0  # m: Spa has 7000
FARTHEST = 10_000.0  # m from (0, 0): further away the render engine's numbers get coarse
MAX_GRADE = 0.4  # dz/ds; the real simulator's steepest road has 0.3
SHOULDER = 1.0  # m between the edges of two parts of a road
SAME_POINT = 0.01  # m: nearer points are one
LEADS = (30.0, 15.0, 5.0)  # m: an open road goes on so far beyond its ends, if there is room
AXES = ("x", "y", "z")
UNIT = re.compile(r"(_| ?[\[(])m[\])]?$")  # of a column, after its name
NAMES = "the columns' names, such as x,y,z,speed"
MAX_BYTES = 4_000_000  # of a file
SPLINE_PIECES = 10  # points of a spline between two nodes


def make_road(
    points: Iterable[Sequence[float]],
    *,
    closed: bool | None = None,
    width: float | np.integer | np.floating = WIDTH,
    marking: str = MARKING,
    land: str = LAND,
    name: str = "road",
    checked: bool = True,
) -> PointRoad:
    """Return a road whose centre line is a smooth curve through points (x, y) or (x, y, z), m.

    closed: join the last point to the first; None: if they are the same point. width: 5 to 12 m; marking: one of
    MARKINGS; land: one of LANDS; name: of the track in reports; checked: refuse a faulty course.

    Raises TrackError, with the reason and the place, for a road that crosses itself or comes too near to itself,
    bends within its own width, is too short, too long or too steep, and for values that are not as described.
    """
    numbers = _numbers(points)
    kept = numbers[:1].tolist()
    for point in numbers[1:].tolist():  # from the last one that is kept: else a chain of near points would vanish
        if math.dist(kept[-1], point) >= SAME_POINT:
            kept.append(point)
    numbers = np.array(kept).reshape(-1, 3)
    ends_meet = len(numbers) > 2 and bool(np.linalg.norm(numbers[0] - numbers[-1]) < SAME_POINT)
    if ends_meet and closed is not False:
        numbers = numbers[:-1]
    closed = ends_meet if closed is None else bool(closed)
    if len(numbers) < (3 if closed else 2):
        found = f"{plural(len(numbers), 'point')} at least {SAME_POINT:g} m apart"
        raise TrackError(f"{found}; a road needs 2, and a closed one 3")
    if not isinstance(width, int | float | np.integer | np.floating) or not MIN_WIDTH <= width <= MAX_WIDTH:
        raise TrackError(f"width {width!r}: it must be {MIN_WIDTH:g} to {MAX_WIDTH:g} (m)")
    for kind, value, known in (("marking", marking, MARKINGS), ("land", land, LANDS)):
        if value not in known:
            raise TrackError(f"{kind} {value!r}: it must be one of {', '.join(known)}")
    flat = numbers[:, :2]
    changes = np.diff(np.vstack([numbers, numbers[:1]]) if closed else numbers, axis=0)
    length, climb = float(np.linalg.norm(changes[:, :2], axis=1).sum()), float(np.abs(changes[:, 2]).sum())
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        raise TrackError(f"the road is {length:.7g} m long; it must be {MIN_LENGTH:g} to {MAX_LENGTH:g} m")
    if climb > MAX_LENGTH:  # a curve through such points takes any amount of memory
        raise TrackError(f"the road climbs and falls by {climb:.1f} m; it must be {MAX_LENGTH:g} m at most; z is in m")
    road = PointRoad(name, numbers, float(width), marking, land, closed)
    reason = _fault(road)
    for lead in () if closed or reason else LEADS:
        road = replace(road, lead=lead)
        reason = _fault(road)
        if not reason:
            break
    if reason and checked:
        steps = np.linalg.norm(np.diff(flat, axis=0), axis=1)
        if not (closed or ends_meet) and np.linalg.norm(flat[0] - flat[-1]) <= 2 * steps.max():
            reason += "; if it is a loop, repeat the first point at the end"
        raise TrackError(reason)
    return road


def spline_road(steps: np.ndarray, **options: Any) -> PointRoad:
    """Return an open road whose centre line is a Catmull-Rom spline, as programs of road tests make them.

    steps: float64 (nodes - 1, 3), to each node from that before: the turn in degrees, the distance in m, and the grade;
    options: of `make_road`, whose errors are raised.
    """
    from scipy.interpolate import CubicHermiteSpline

    turn, length, grade = steps.T
    heading = np.cumsum(np.radians(turn))
    moves = length[:, None] * np.column_stack([np.cos(heading), np.sin(heading), grade])
    nodes = np.vstack([np.zeros(3), np.cumsum(moves, axis=0)])
    # With these slopes it is the Catmull-Rom spline.
    spline = CubicHermiteSpline(np.arange(len(nodes)), nodes, np.gradient(nodes, axis=0))
    points = spline(np.linspace(0, len(moves), SPLINE_PIECES * len(moves) + 1))
    return make_road(points.round(3), **options)  # mm, as files have them


def _numbers(points: Iterable[Sequence[float]]) -> np.ndarray:
    """Return points as float64 (n, 3), m. Raises TrackError."""
    rows: list[list[float]] = []
    for i, point in enumerate(points, 1):
        try:
            row = [float(value) for value in point]
        except (TypeError, ValueError, OverflowError):
            row = []
        if len(row) not in (2, 3) or not all(abs(value) <= FARTHEST for value in row):
            raise TrackError(
                f"point {i} is {str(point)[:60]}: it must be (x, y) or (x, y, z), in m within {FARTHEST:g} m of (0, 0)"
            )
        if rows and len(row) != len(rows[0]):
            raise TrackError(
                f"point {i} has {len(row)} numbers, the first one {len(rows[0])}: all must have z, or none"
            )
        rows.append(row)
    return np.array([[*row, 0.0][:3] for row in rows]).reshape(-1, 3)


def _fault(road: PointRoad) -> str:
    """Return what is wrong with a road's course, and where, or an empty text."""
    from scipy.spatial import cKDTree  # large, and only a road of one's own needs it

    track = Track(road)

    def place(i: int) -> str:
        x, y, _ = track.points[i]
        return f"{(i - track.first) * track.step:.0f} m along it ({x:.1f}, {y:.1f})"

    steepest = int(np.abs(track.grade).argmax())
    if abs(track.grade[steepest]) > MAX_GRADE:
        grade = f"{track.grade[steepest]:.2f} m a metre, of {MAX_GRADE:g}"
        remedy = "if z is not the height, begin a CSV with its columns' names, such as x,z,y or x,y,speed"
        return f"the road is too steep, {place(steepest)}: {grade}; {remedy}"
    flat = track.points[:, :2]
    for side in (-1, 1):
        edge = flat + side * road.width / 2 * track.rightward
        ahead = np.roll(edge, -1, axis=0) - edge
        forwards = np.stack([-track.rightward[:, 1], track.rightward[:, 0]], axis=-1)  # to the right, turned left
        advance = (ahead * forwards).sum(axis=1)[: None if road.closed else -1]
        worst = int(advance.argmin())
        if advance[worst] <= 0:
            return (
                f"the road folds within its own width, {place(worst)}: its bend's radius is less than half of the "
                f"width, which is {road.width:g} m"
            )
    apart = road.width + SHOULDER
    pairs = cKDTree(flat).query_pairs(apart, output_type="ndarray")
    along = np.abs(pairs[:, 0] - pairs[:, 1])
    if road.closed:
        along = np.minimum(along, len(flat) - along)
    # Half a turn of the sharpest bend that does not fold is this long, and leads to this distance.
    pairs = pairs[along * track.step > math.pi / 2 * apart]
    if len(pairs):
        i, j = sorted(pairs[np.linalg.norm(flat[pairs[:, 0]] - flat[pairs[:, 1]], axis=1).argmin()].tolist())
        distance = np.linalg.norm(flat[i] - flat[j])
        does = "crosses itself" if distance < 1 else f"comes within {distance:.1f} m of itself"
        return f"the road {does}, {place(i)} and {place(j)}; a road {road.width:g} m wide needs {apart:g} m"
    return ""


def read_road(path: str | Path, **options: Any) -> PointRoad:
    """Return the road in a file, see above; options: those of `make_road`, in place of the file's own.

    Its name is the file's, without the ending. Raises TrackError, with the file and, where there is one, the line.
    """
    path = Path(path)
    try:
        with open(path, encoding="utf-8-sig") as file:
            text = file.read(MAX_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        raise TrackError(f"{path}: {getattr(error, 'strerror', None) or 'not a text'}; name a file of points") from None
    try:
        if len(text) == MAX_BYTES:
            raise TrackError(f"longer than {MAX_BYTES} characters")
        points, own = parse_road(text)
        return make_road(points, **{"name": path.stem} | own | options)
    except TrackError as error:
        raise TrackError(f"{path}: {error}") from None


def parse_road(text: str) -> tuple[list[list[float]], dict[str, Any]]:
    """Return the points in a file's text, and its own options of `make_road`. Raises TrackError."""
    if text.lstrip()[:1] in ("{", "["):
        try:
            found = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise TrackError(f"not JSON: {str(error)[:100]}") from None
        own = found if isinstance(found, dict) else {"road_points": found}
        points = own.get("road_points")
        if isinstance(points, list):
            points = [_in_order(point) if isinstance(point, dict) else point for point in points]
        if not isinstance(points, list) or not all(isinstance(point, list) and point for point in points):
            raise TrackError('no list of one road\'s points, nor one under the key "road_points"')
        if not isinstance(own.get("closed", False), bool):
            raise TrackError(f"closed {own['closed']!r}: it must be true or false")
        return points, {key: own[key] for key in ("closed", "width", "marking", "land") if key in own}
    if "@" in text.partition("#")[0]:  # not in a comment
        return parse_track_string(text), {}
    return _parse_table(text), {}


def _parse_table(text: str) -> list[list[float]]:
    """Return the points in the lines of a CSV. Raises TrackError."""
    points, names, in_comment = list[list[float]](), list[str](), False
    for number, line in enumerate(text.splitlines(), 1):
        content, separator = line.strip().lstrip("# "), next((mark for mark in ";," if mark in line), None)
        comment = line.lstrip().startswith("#")
        try:
            fields = next(csv.reader([content], delimiter=separator), []) if separator else content.split()
        except csv.Error as error:  # a line that is no point
            raise TrackError(f"line {number}: not CSV: {error}") from None
        found = [UNIT.sub("", field.strip().lower()) for field in fields]
        if not points and sorted(name for name in found if name in AXES) in (["x", "y"], ["x", "y", "z"]):
            names, in_comment = found, comment
        elif any(found) and not comment:
            if in_comment and not points and len(names) != len(fields):
                names = []  # it was a sentence
            try:
                row = _in_order(dict(zip(names, fields, strict=True))) if names else fields
                if len(row) not in (2, 3):
                    raise ValueError
                points.append([float(field) for field in row])
            except ValueError:
                what = f"line {number}: {line.strip()[:60]} is not a point x,y or x,y,z"
                remedy = "" if points or names else f", nor a line of {NAMES}; begin with one"
                raise TrackError(what + remedy) from None
    return points


def _in_order(values: dict[str, Any]) -> list[Any]:
    """Return the values that are named x, y and, if there is one, z; none without x and y."""
    return [values[name] for name in AXES if name in values] if {"x", "y"} <= values.keys() else []


def parse_track_string(text: str) -> list[list[float]]:
    """Return the points (x, y, z), z up, in x,y,z@x,y,z@…, where y is up, as in Unity. Raises TrackError."""
    points = []
    for number, part in enumerate(text.strip().strip("@").split("@"), 1):
        try:
            x, y, z = map(float, part.split(","))
        except ValueError:
            raise TrackError(f"point {number}: {part[:60]!r} is not x,y,z") from None
        points.append([x, z, y])
    return points
