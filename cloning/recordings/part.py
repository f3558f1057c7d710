"""Write rows of recordings as a recording of its own, whose images are hard links to the same files."""

import csv
import errno
import os
import shutil
from collections.abc import Sequence
from datetime import timedelta
from math import floor, inf
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.files import csv_bytes, write
from cloning.base.outputs import plural
from cloning.recordings.excluded import TAGS, read_cuts
from cloning.recordings.format import (
    CAMERAS,
    DRIVE_GAP,
    DRIVING_LOG,
    IMAGE_FOLDER,
    LANE_COLUMNS,
    LANE_FILE,
    NUMBERS,
    SAMPLE_RATE,
    STAMP_LENGTH,
    parse_time_stamp,
    time_stamp,
)
from cloning.recordings.images import jpeg_size, nonblocking, read_jpeg
from cloning.recordings.log import Recording
from cloning.recordings.writer import log_bytes

DAY = timedelta(days=1)


def write_part(recordings: Sequence[Recording], folder: Path) -> list[str]:
    """Write all rows of recordings into one new folder: `recording.take` chooses them. Return what did not fit, if any.

    The images are hard links, or copies where the file system has none. Numbers are those that were read, so the new
    log needs no repairs. A `lane.csv` goes along if every recording has one, and it names one of the rows. A recording
    of the same time as another, as a copy is, is put so many days later that each stays a drive of its own. The log is
    written last: a process killed at any time leaves a whole recording, or a folder that is none. Raises RecordingError
    if the folder exists, if an image is missing, if one of several recordings, or with a pause between its rows, has
    images without a time in their names, or if it cannot be written; then nothing is left.
    """
    recordings = sorted(recordings, key=lambda recording: float(recording.time[0]))
    renamed, notes, end = list[dict[str, str]](), list[str](), -inf
    for recording in recordings:
        days = floor(max(-1.0, (end + DRIVE_GAP - recording.time[0]) / DAY.total_seconds())) + 1
        end = recording.time[-1] + (days * DAY).total_seconds()
        has_pause = bool((np.diff(recording.lines) > DRIVE_GAP * SAMPLE_RATE).any())  # without times, the lines tell it
        renamed.append(_renamed(recording, days, check=len(recordings) > 1 or has_pause))
        if days:
            notes.append(f"{recording.folder.name} is put {plural(days, 'day')} later, after another drive")
    lanes = [(recording.folder / LANE_FILE).exists() for recording in recordings]
    if any(lanes) and not all(lanes):
        notes.append(f"{LANE_FILE} is left out: {recordings[lanes.index(False)].folder.name} has none")
    if any(read_cuts(recording.folder, TAGS) for recording in recordings):
        notes.append("tags do not go along")
    try:
        folder.mkdir()
    except FileExistsError:
        raise RecordingError(f"{folder}: exists already; give the new recording another name") from None
    except OSError as error:
        raise RecordingError(f"{folder}: {error.strerror}; make the folder around it writable") from None
    rows, known = list[tuple[list[str], list[np.float32]]](), list[list[str]]()
    try:
        (folder / IMAGE_FOLDER).mkdir()
        for recording, names in zip(recordings, renamed, strict=True):
            for old, new in names.items():
                _link(recording.folder / IMAGE_FOLDER / old, folder / IMAGE_FOLDER / new)
            for row in range(len(recording)):
                images = [names[recording.name(row, camera)] for camera in range(len(CAMERAS))]
                rows.append((images, [getattr(recording, name)[row] for name in NUMBERS]))
            if all(lanes):
                centres = {recording.name(row) for row in range(len(recording))}
                lane, errors = recording.folder / LANE_FILE, "surrogateescape"
                with open(lane, encoding="utf-8", errors=errors, newline="", opener=nonblocking) as file:
                    lines = csv.reader(file, strict=True)
                    known += [[names[line[0]], *line[1:]] for line in lines if line and line[0] in centres]
        if known:
            write(folder / LANE_FILE, csv_bytes([list(LANE_COLUMNS), *known]))
        elif all(lanes):
            notes.append(f"{LANE_FILE} is left out: it names none of these rows")
        write(folder / DRIVING_LOG, log_bytes(folder, rows))
    except (OSError, csv.Error) as error:
        shutil.rmtree(folder, ignore_errors=True)
        where, why = (error.filename or folder, error.strerror) if isinstance(error, OSError) else (lane, error)
        raise RecordingError(f"{where}: {why}; mend it, and export again") from None
    return notes


def _renamed(recording: Recording, days: int, check: bool) -> dict[str, str]:
    """Return the new name of each image of a recording that is put some days later.

    check: whether all names must have a time. Raises RecordingError.
    """
    names = dict[str, str]()
    for image in np.unique(recording.images):
        name = os.fsdecode(recording.names[image])
        names[name] = name
        if check:
            stem, dot, extension = name.rpartition(".")
            try:
                moment = parse_time_stamp(stem[-STAMP_LENGTH:]) + days * DAY
            except ValueError:
                raise RecordingError(
                    f"{recording.folder / IMAGE_FOLDER / name}: no time in its name, by which the drives would follow "
                    "each other; export this recording by itself, one stretch at a time"
                ) from None
            names[name] = f"{stem[:-STAMP_LENGTH]}{time_stamp(moment)}{dot}{extension}"
    return names


def _link(source: Path, copy: Path) -> None:
    """Make a hard link to an image, or a copy if that is not possible. Raises OSError.

    What a symbolic link leads to must be a JPEG: someone else's recording could name any file of the user's.
    """
    try:
        if source.is_symlink():
            jpeg_size(read_jpeg(source))
        os.link(source.resolve(strict=True), copy)
    except FileNotFoundError:
        raise
    except ValueError as error:
        raise OSError(errno.EINVAL, f"a link to another file ({error})", str(source)) from None
    except OSError:
        shutil.copyfile(source, copy)
