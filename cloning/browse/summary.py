"""What the page shows of a whole recording: its figures at a glance, and the rows worth watching."""

from typing import Any

import numpy as np

from cloning.browse.analyses import Result
from cloning.recordings.format import BINS, SAMPLE_RATE
from cloning.recordings.log import SHOWN_REJECTED, Recording
from cloning.road.motion import MAX_GAP

PATH_POINTS = 500  # of a drive on the map
AT_STOP = 0.999  # |steering| from which the wheels are at their stop
JUMPS = 20  # rows to jump to, for each reason
APART = 2 * SAMPLE_RATE  # rows between two of them
MAP = "outline", "path"  # of `road_of`, m
MIN_DIRECTION = 0.05  # share of the rows with a known road below which a road or direction is left out


def driven_seconds(time: np.ndarray) -> np.ndarray:
    """Return the seconds driven until each row, float64 (n,): a break counts as long as a row.

    time: float64 (n,), s, ascending.
    """
    pause = np.diff(time)
    pause[pause > MAX_GAP] = 1 / SAMPLE_RATE
    return np.r_[0.0, np.cumsum(pause)]


def largest(values: np.ndarray) -> list[int]:
    """Return the rows with the largest absolute values, in this order: at most JUMPS, at least APART rows apart.

    After the largest comes the largest of those far enough away from it, and so on. values: float (n,), nan for none.
    """
    size = np.where(np.isnan(values), -1.0, np.abs(values))
    rows: list[int] = []
    while len(rows) < JUMPS and size.max(initial=0) > 0:
        row = int(size.argmax())
        rows.append(row)
        size[max(0, row - APART + 1) : row + APART] = -1
    return rows


def at_stop(steering: np.ndarray) -> list[int]:
    """Return the first row of each stretch with the wheels at their stop, ascending; steering: float (n,), -1..1."""
    side = np.sign(steering) * (np.abs(steering) >= AT_STOP)
    return np.flatnonzero((side != 0) & (np.diff(side, prepend=0) != 0)).tolist()


def jumps(
    steering: np.ndarray, offset: np.ndarray | None, models: list[np.ndarray], is_cut: np.ndarray
) -> dict[str, list[int]]:
    """Return the rows to jump to, ascending, by the reason for it; none that is cut.

    steering, offset, models: float32 (n,), the human driver's -1..1, m or None, and models' -1..1; is_cut: bool (n,).
    """
    found = {"stop": at_stop(np.where(is_cut, 0, steering))}
    if offset is not None:
        found["offset"] = largest(np.where(is_cut, np.nan, offset))
    if models:
        difference = np.fmax.reduce([np.abs(model - steering) for model in models])
        found["difference"] = largest(np.where(is_cut, np.nan, difference))
    return found


def figures(recording: Recording, is_cut: np.ndarray) -> dict[str, Any]:
    """Return the figures of the log alone; is_cut: bool (n,). Steering and speed are those of the rows not cut.

    picture is the row that shows the recording in the list: the middle one of those that are not cut.
    """
    kept = ~is_cut
    steering, speed = recording.steering[kept], recording.speed[kept]
    counts, _ = np.histogram(steering, np.linspace(-1, 1, BINS + 1))
    seconds = driven_seconds(recording.time)
    return {
        "frames": len(recording),
        "seconds": float(seconds[-1]),
        "cut_frames": int(is_cut.sum()),
        "picture": int(np.flatnonzero(kept)[kept.sum() // 2]) if kept.any() else 0,
        "histogram": counts.tolist(),
        "zeros": float((steering == 0).mean()) if len(steering) else None,
        "speed": [float(function(speed)) for function in (np.mean, np.max)] if len(speed) else None,
        "rows_read": recording.rows_read,
        "repairs": [[repair, rows, line] for repair, (rows, line) in recording.repairs.items()],
        "rejected": len(recording.rejected),
        "first_rejected": [[row.line, row.detail] for row in recording.rejected[:SHOWN_REJECTED]],
    }


def road_of(result: Result, centres: np.ndarray, is_cut: np.ndarray) -> dict[str, Any]:
    """Return on which roads and in which directions a recording was driven, and its path on the most driven one.

    result: of the analysis of the lane; centres: int32 (n,), the rows' centre images; is_cut: bool (n,). The path is a
    list of strokes, lists of [x, y] in m, east and north. offset is [mean, largest], m from the lane's centre in the
    rows that are not cut, None if it is not known.
    """
    about = result.about
    offset = np.abs(result.column("offset", centres)[~is_cut])
    offset = offset[~np.isnan(offset)]
    road, x, y = (result.column(name, centres) for name in ("road", "x", "y"))
    rows = [int((road == index).sum()) for index in range(len(about["roads"]))]
    order = sorted(range(len(rows)), key=lambda index: -rows[index])
    driven = [index for index in order if rows[index] >= MIN_DIRECTION * sum(rows)]
    roads = [about["roads"][index] for index in driven]
    strokes = []
    for index, found in zip(driven, roads, strict=True):
        if found["name"] != roads[0]["name"]:
            continue
        on_road = np.flatnonzero(road == index)
        step = max(1, len(on_road) // PATH_POINTS)
        for stroke in np.split(on_road, np.flatnonzero(np.diff(on_road) > 1) + 1):
            strokes.append([[round(float(x[row]), 1), round(float(y[row]), 1)] for row in stroke[::step]])
    return {
        "roads": [[found["name"], found["direction"]] for found in roads],
        "outline": roads[0]["outline"] if roads else [],
        "path": strokes,
        "offset": [round(float(function(offset)), 2) for function in (np.mean, np.max)] if len(offset) else None,
        "unusable": about["unusable"],
        "first_unusable": about["first_unusable"],
    }
