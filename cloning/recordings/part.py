"""Write some rows of a recording as a recording of its own, whose images are hard links to the same files."""

import csv
import os
import shutil
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.files import csv_bytes, write
from cloning.recordings.format import CAMERAS, COLUMNS, DRIVING_LOG, IMAGE_FOLDER, LANE_COLUMNS, LANE_FILE, NUMBERS
from cloning.recordings.log import Recording


def write_part(recording: Recording, folder: Path) -> None:
    """Write all rows of a recording into a new folder: `recording.take` chooses them.

    The images are hard links, or copies where the file system has none. Numbers are those that were read, so the new
    log needs no repairs. A `lane.csv` goes along. The log is written last: a process killed at any time leaves a whole
    recording, or a folder that is none. Raises RecordingError if the folder exists, if an image is missing, or if it
    cannot be written; then nothing is left.
    """
    try:
        folder.mkdir()
    except FileExistsError:
        raise RecordingError(f"{folder}: exists already; give the new recording another name") from None
    except OSError as error:
        raise RecordingError(f"{folder}: {error.strerror}; make the folder around it writable") from None
    try:
        (folder / IMAGE_FOLDER).mkdir()
        for image in np.unique(recording.images):
            name = os.fsdecode(recording.names[image])
            _link(recording.folder / IMAGE_FOLDER / name, folder / IMAGE_FOLDER / name)
        rows = [
            [f"{IMAGE_FOLDER}/{recording.name(row, camera)}" for camera in range(len(CAMERAS))]
            + [str(getattr(recording, name)[row]) for name in NUMBERS]
            for row in range(len(recording))
        ]
        if (recording.folder / LANE_FILE).exists():
            names = {recording.name(row) for row in range(len(recording))}
            with open(recording.folder / LANE_FILE, encoding="utf-8", errors="surrogateescape", newline="") as file:
                known = [line for line in csv.reader(file) if line and line[0] in names]
            write(folder / LANE_FILE, csv_bytes([list(LANE_COLUMNS), *known]))
        write(folder / DRIVING_LOG, csv_bytes([list(COLUMNS), *rows]))
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise RecordingError(f"{error.filename or folder}: {error.strerror}; mend it, and export again") from None


def _link(source: Path, copy: Path) -> None:
    """Make a hard link to a file, or a copy if that is not possible. Raises OSError."""
    try:
        os.link(source.resolve(strict=True), copy)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, copy)
