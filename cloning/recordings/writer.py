"""Write recordings as the simulator does: IMG/ with three cameras' JPEGs, and driving_log.csv."""

import math
import os
import re
from datetime import datetime, timedelta
from pathlib import Path
from typing import Self

from cloning.errors import RecordingError
from cloning.recordings.format import CAMERAS, LOG, SAMPLE_RATE

# When a recording with seed 0 begins: the same command makes the same file names on any day.
EPOCH = datetime(2018, 1, 1, 12)


def csharp_number(value: float) -> str:
    """A number as C# writes a float: seven digits, 6.9E-05."""
    return re.sub(r"E([+-]\d)$", r"E\g<1>", f"{value:.7G}").replace("-0", "0") if value == 0 else f"{value:.7G}"


class RecordingWriter:
    """Writes samples into a folder.

    A row is written after its three images are complete, so a process killed at any time leaves a readable folder.
    """

    def __init__(self, folder: str | Path, begin: datetime = EPOCH):
        """Start a recording; begin: the moment of simulated second 0, for the images' names.

        Raises RecordingError if the folder holds a recording already, or cannot be made.
        """
        self.folder = Path(folder).absolute()
        self.images = self.folder / "IMG"
        log = self.folder / LOG
        if log.exists():
            raise RecordingError(f"{log} exists already: give another folder, or delete this one")
        try:
            self.images.mkdir(parents=True, exist_ok=True)
            self.log = open(log, "ab", buffering=0)  # noqa: SIM115 - closed in close()
        except OSError as error:
            raise RecordingError(f"{self.folder}: {error.strerror}; give a folder that can be written") from error
        self.begin = begin
        self.rows = 0

    def add(
        self, time: float, images: list[bytes], steering: float, throttle: float, brake: float, speed: float
    ) -> None:
        """Write a sample; time: simulated seconds; images: JPEGs of center, left, right; speed: mph.

        Raises RecordingError, with nothing half-written, if the disk is full.
        """
        moment = (self.begin + timedelta(seconds=time)).strftime("%Y_%m_%d_%H_%M_%S_%f")[:-3]
        paths = [self.images / f"{name}_{moment}.jpg" for name in CAMERAS]
        row = ",".join([*map(str, paths), *map(csharp_number, (steering, throttle, brake, speed))]) + "\n"
        size = os.fstat(self.log.fileno()).st_size
        try:
            for path, image in zip(paths, images, strict=True):
                path.write_bytes(image)
            if self.log.write(row.encode()) != len(row.encode()):
                raise OSError(28, "No space left on device")
        except OSError as error:
            for path in paths:
                path.unlink(missing_ok=True)
            os.ftruncate(self.log.fileno(), size)
            raise RecordingError(f"{self.folder}: {error.strerror}; the {self.rows} rows before are whole") from error
        self.rows += 1

    def close(self) -> None:
        """Close driving_log.csv."""
        self.log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Clock:
    """Tells after which simulation steps (0.02 s each) a sample is due: 15 a second."""

    def __init__(self, start: float = 0.0):
        """start: simulated seconds; the first sample is due then."""
        self.taken = math.ceil(start * SAMPLE_RATE - 1e-9)

    def due(self, time: float) -> bool:
        """Whether a sample is due at this time (simulated seconds); if so, it counts as taken."""
        if time * SAMPLE_RATE < self.taken - 1e-9:
            return False
        self.taken += 1
        return True
