"""Write some rows of a recording as a recording of its own, whose images are hard links to the same files."""

import csv
import io
import os
import secrets
import shutil
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.recordings.format import CAMERAS, COLUMNS, DRIVING_LOG, IMAGE_FOLDER, LANE_COLUMNS, LANE_FILE, NUMBERS
from cloning.recordings.log import Recording


def write_part(recording: Recording, folder: Path) -> None:
    """Write all rows of a recording into a new folder, complete or not at all: `recording.take` chooses them.

    The images are hard links, or copies where the file system has none. Numbers are those that were read, so the new
    log needs no repairs. A `lane.csv` goes along. Raises RecordingError if the folder exists, if an image is missing,
    or if it cannot be written.
    """
    if folder.exists():
        raise RecordingError(f"{folder}: exists already; give the new recording another name")
    temporary = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.part")
    try:
        (temporary / IMAGE_FOLDER).mkdir(parents=True)
        for image in np.unique(recording.images):
            name = os.fsdecode(recording.names[image])
            _link(recording.folder / IMAGE_FOLDER / name, temporary / IMAGE_FOLDER / name)
        rows = [
            [f"{IMAGE_FOLDER}/{recording.name(row, camera)}" for camera in range(len(CAMERAS))]
            + [str(getattr(recording, name)[row]) for name in NUMBERS]
            for row in range(len(recording))
        ]
        _write(temporary / DRIVING_LOG, [list(COLUMNS), *rows])
        if (recording.folder / LANE_FILE).exists():
            names = {recording.name(row) for row in range(len(recording))}
            with open(recording.folder / LANE_FILE, encoding="utf-8", errors="surrogateescape", newline="") as file:
                known = [line for line in csv.reader(file) if line and line[0] in names]
            _write(temporary / LANE_FILE, [list(LANE_COLUMNS), *known])
        os.rename(temporary, folder)
    except OSError as error:
        what = error.filename or folder
        raise RecordingError(f"{what}: {error.strerror}; mend it, and export again") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _link(source: Path, copy: Path) -> None:
    """Make a hard link to a file, or a copy if that is not possible. Raises OSError."""
    try:
        os.link(source.resolve(strict=True), copy)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, copy)


def _write(path: Path, rows: list[list[str]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    path.write_bytes(text.getvalue().encode(errors="surrogateescape"))
