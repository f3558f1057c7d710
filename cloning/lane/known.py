"""The position in the lane of a recording that has a `lane.csv` with it beside its `driving_log.csv`.

The stand-in simulator knows where its car is, so its recordings have this file, and the position need not be estimated
from their frames. Each line has the name of a row's centre image, the lateral offset and the heading error, in the
units of `LanePosition`.
"""

import csv
import io
import os
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.lane.localise import estimate_lane_position
from cloning.lane.recovery import LanePosition
from cloning.recordings.columns import NUMBER, base_name
from cloning.recordings.format import DRIVING_LOG, LANE_COLUMNS, LANE_FILE
from cloning.recordings.log import Recording
from cloning.road.motion import Stretch

REMEDY = f"correct it, or delete {LANE_FILE}, and the lane is estimated from the frames"
LIMITS = (100.0, np.pi)  # m and radians: larger values are certainly wrong


def lane_position(recording: Recording, stretches: list[Stretch]) -> LanePosition:
    """Return the position in the lane at every row: the known one if there is a `lane.csv`, or else an estimate.

    stretches: of the recording, `motion.stretches`. Raises the errors of `known_position`, and RecordingError for
    images that can't be read, ModelError without a usable lane network.
    """
    return known_position(recording) or estimate_lane_position(recording, stretches)


def known_position(recording: Recording) -> LanePosition | None:
    """Return the position in the lane from a recording's `lane.csv`, or None if there is no such file.

    It is trusted in the rows that the file names. Raises RecordingError for a file that is not as described above, and
    for one that names none of the rows.
    """
    path = recording.folder / LANE_FILE
    if not path.exists():
        return None
    known = read_known(path)
    unknown = (0.0, 0.0)
    names = [os.fsencode(recording.name(row)) for row in range(len(recording))]
    offset, heading_error = np.array([known.get(name, unknown) for name in names], np.float32).reshape(-1, 2).T
    trusted = np.array([name in known for name in names], bool)
    if names and not trusted.any():
        raise RecordingError(f"{path}: names no centre image of a usable row of {DRIVING_LOG}; {REMEDY}")
    if not trusted.all():
        print(f"{path}: the lane is unknown in {(~trusted).sum()} of {len(names)} rows, which it does not name")
    return LanePosition(offset, heading_error, trusted, trusted, np.zeros(len(names), np.int32))


def read_known(path: Path) -> dict[bytes, tuple[float, float]]:
    """Return the lateral offset and heading error of each centre image in a `lane.csv`.

    A last line without an end is left out: a process that was killed has not written all of it, nor the row in the log.
    Raises RecordingError, with the line, for anything else that is not as `LANE_COLUMNS` says, and for two lines of an
    image that differ.
    """
    try:
        if not path.is_file():  # a pipe would never end
            raise RecordingError(f"{path}: not a regular file; make it a readable file, or delete it")
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; make it a readable file, or delete it") from None
    text = data[: data.rfind(b"\n") + 1].decode("utf-8-sig", "surrogateescape")
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    known: dict[bytes, tuple[float, float]] = {}
    try:
        if tuple(next(lines, ())) != LANE_COLUMNS:
            raise ValueError(f"not {','.join(LANE_COLUMNS)}")
        for fields in lines:
            name, position = _parse(fields)
            if known.setdefault(name, position) != position:
                raise ValueError(f"another position for {os.fsdecode(name)}")
    except (ValueError, csv.Error) as error:
        raise RecordingError(f"{path}: line {max(lines.line_num, 1)}: {error}; {REMEDY}") from None
    return known


def _parse(fields: list[str]) -> tuple[bytes, tuple[float, float]]:
    """Return the image, lateral offset and heading error of a line. Raises ValueError."""
    if len(fields) != len(LANE_COLUMNS):
        raise ValueError(f"{len(fields)} fields where {len(LANE_COLUMNS)} are expected")
    if fields[0] != base_name(fields[0]):
        raise ValueError(f"{fields[0]!r} is not the name of an image alone, without its folder")
    for text, limit, column in zip(fields[1:], LIMITS, LANE_COLUMNS[1:], strict=True):
        if not NUMBER.fullmatch(text) or abs(float(text)) > limit:
            raise ValueError(f"{column}: {text!r} is not a number within ±{limit:g}")
    return os.fsencode(fields[0]), (float(fields[1]), float(fields[2]))
