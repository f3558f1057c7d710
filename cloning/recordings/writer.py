"""Write recordings as the simulator does: IMG/ with three cameras' JPEGs, and driving_log.csv; beside it lane.csv."""

import errno
import math
import os
import zlib
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import Self

import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.files import csv_bytes, written_whole
from cloning.base.outputs import claimed
from cloning.recordings.columns import UnclearLogError, check_numbers
from cloning.recordings.format import (
    CAMERAS,
    COLUMNS,
    DRIVE_GAP,
    DRIVING_LOG,
    IMAGE_FOLDER,
    LANE_COLUMNS,
    LANE_FILE,
    PROBLEM_AREAS,
    SAMPLE_RATE,
    time_stamp,
)

DEFAULT_START = datetime(2018, 1, 1, 12)


def start_of(seed: int, *what: object) -> datetime:
    """Return a date for a recording's start: on any day the same of what is recorded, of something else another.

    So the same command makes the same file names, and others' images do not replace them where programs put those of
    several recordings into one folder. It is in 1990 to 2018. what: things with a `repr` of their content.
    """
    return DEFAULT_START - timedelta(days=(seed + zlib.crc32(repr(what).encode())) % 10_000)


def csharp_number(value: float) -> str:
    """Return a number as C# writes a float: with seven significant digits, for example 6.9E-05."""
    return f"{value + 0:.7G}"  # + 0 turns -0 into 0


def log_bytes(folder: Path, rows: Sequence[tuple[Sequence[str], Sequence[np.float32]]]) -> bytes:
    """Return a folder's whole `driving_log.csv`, as programs that read the simulator's expect it.

    rows: three names of images, and four numbers each. It has whole paths, and no header: most programs take one for a
    row. Only above numbers that the simulator never writes is there one: without it they would be refused.
    """
    images = folder.absolute() / IMAGE_FOLDER
    try:
        numbers = np.array([values for _, values in rows], float)
        has_header = bool(check_numbers(np.arange(len(rows)) + 1, numbers, is_named=False).any())
    except UnclearLogError:
        has_header = True
    lines = [[*(str(images / name) for name in names), *map(str, values)] for names, values in rows]
    return csv_bytes([list(COLUMNS), *lines] if has_header else lines)


def check_name_of_corrections(folder: str | Path) -> None:
    """Raise RecordingError if training would not repeat a recording of this name, as it does with problem areas."""
    path = Path(folder).absolute()
    if not path.name.endswith(PROBLEM_AREAS):
        remedy = path.with_name(f"{path.name}{PROBLEM_AREAS[-1]}")
        raise RecordingError(
            f"{folder}: model.py repeats corrections only if the folder's name ends in "
            f"{' or '.join(PROBLEM_AREAS)}; name it {remedy.name}"
        )


class RecordingWriter:
    """Writes samples into a folder: three images, a row of `lane.csv`, and one of `driving_log.csv` each.

    The last is written after the others are complete: a process killed at any time leaves a readable recording, and at
    most three whole images, a row of `lane.csv` and a temporary file that no row names.
    """

    def __init__(self, folder: str | Path, start: datetime = DEFAULT_START):
        """Begin a recording; start: the date and time of simulated second 0, for the names of the images.

        An empty driving_log.csv, of a process that was killed before its first row, is used. Until `close`, or the end
        of this process, no other one records there, where a system has locks. Raises OutputError if one does or the
        folder cannot be made, RecordingError if it already contains a recording or cannot be written.
        """
        self.folder = Path(folder).absolute()
        self.images = self.folder / IMAGE_FOLDER
        log = self.folder / DRIVING_LOG
        try:
            with ExitStack() as stack:
                stack.enter_context(claimed(self.folder))
                if log.exists() and log.stat().st_size:
                    raise RecordingError(f"{log}: exists already; name another folder, or delete this one")
                self.images.mkdir(exist_ok=True)
                self.log = stack.enter_context(open(log, "ab", buffering=0))
                self.lane = stack.enter_context(open(self.folder / LANE_FILE, "wb", buffering=0))
                self._held = stack.pop_all()
        except OSError as error:
            raise RecordingError(f"{self.folder}: {error.strerror}; name a folder that can be written") from error
        self.start = start
        self.rows, self.stamp = 0, ""  # the last row's

    def add(self, time: float, images: list[bytes], numbers: Sequence[float], lane: tuple[float, float]) -> None:
        """Write a sample; time: simulated seconds, growing; images: JPEGs of the centre, left and right camera.

        numbers: steering, -1..1, throttle and brake, 0..1, speed, mph; lane: lateral offset, m, and heading error,
        radians, as in `LanePosition`. Raises RecordingError if the disk is full, or the time not later than the row's
        before; then nothing of the sample is left.
        """
        stamp = time_stamp(self.start + timedelta(seconds=time))
        if stamp <= self.stamp:
            late = f"row {self.rows + 1} is of {stamp}, and that before of {self.stamp}, whose images it might replace"
            raise RecordingError(f"{self.folder}: {late}; let time go on from one drive to the next")
        paths = [self.images / f"{name}_{stamp}.jpg" for name in CAMERAS]
        row = ",".join([*map(str, paths), *map(csharp_number, numbers)]) + "\n"
        header = "" if self.rows else ",".join(LANE_COLUMNS) + "\n"
        lane_row = f"{header}{paths[0].name},{lane[0]:.4f},{lane[1]:.5f}\n"
        sizes = {file: os.fstat(file.fileno()).st_size for file in (self.log, self.lane)}
        try:
            for path, image in zip(paths, images, strict=True):
                with written_whole(path) as temporary:
                    temporary.write_bytes(image)
            for file, text in ((self.lane, lane_row), (self.log, row)):
                data = text.encode(errors="surrogateescape")  # the folder's name may have any bytes
                if file.write(data) != len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            with suppress(OSError):  # the first error matters more
                for file, size in sizes.items():  # first: a row without its images would be unusable
                    os.ftruncate(file.fileno(), size)
                for path in paths:
                    path.unlink(missing_ok=True)
            complete = f"the {self.rows} rows before it are complete"
            raise RecordingError(f"{self.folder}: {error.strerror}; {complete}") from error
        self.rows, self.stamp = self.rows + 1, stamp

    def begin_drive(self) -> None:
        """Let the next samples be a drive of their own: they are dated later, by more than a drive's longest pause."""
        self.start += timedelta(seconds=DRIVE_GAP)

    def close(self) -> None:
        """Close the files, and remove a recording without a row, which no program could read; other files stay."""
        if self.log.closed:
            return
        self.log.close()
        self.lane.close()
        with self._held:
            if not self.rows:
                for name in (DRIVING_LOG, LANE_FILE):
                    (self.folder / name).unlink()
                for folder in (self.images, self.folder):
                    if not any(folder.iterdir()):
                        folder.rmdir()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class SampleClock:
    """Tells at which simulation steps a sample is due."""

    def __init__(self, start: float = 0.0, rate: float = SAMPLE_RATE):
        """start: when the first sample is due, simulated seconds; rate: samples a second."""
        self.rate, self.taken = rate, math.ceil(start * rate - 1e-9)

    def due(self, time: float) -> bool:
        """Return whether a sample is due at this time, simulated seconds; if so, count it as taken."""
        if time * self.rate < self.taken - 1e-9:
            return False
        self.taken += 1
        return True
