"""Frames in a folder: yyyy_MM_dd_HH_mm_ss_fff.jpg, as the simulator and the original drive.py name them."""

import itertools
import logging
import os
import queue
import re
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cloning.errors import FolderError

NAME = re.compile(r"(?:center_)?(\d{4}(?:_\d\d){5}_\d{3})\.jpg")  # a recording's centre frames are welcome in a film
BESIDE = ".frame"  # what a frame is called while it is written
WAITING = 2000  # frames in memory when the disk is slow, about 30 MB; beyond them driving waits for the disk
log = logging.getLogger("drive")


def taken_at(name: str) -> datetime | None:
    """The time in a frame's name; None for a file that is no frame."""
    match = NAME.fullmatch(name)
    try:
        return match and datetime.strptime(match[1] + "000", "%Y_%m_%d_%H_%M_%S_%f")
    except ValueError:  # such as month 13
        return None


def check(folder: Path) -> None:
    """Raises FolderError if emptying the folder would delete anything but frames."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise FolderError(f"{folder}: not a folder; name another one for the frames")
    for entry in folder.iterdir():
        saved = taken_at(entry.name) and not entry.name.startswith("center_")  # which is a recording's
        if not entry.is_file() or not (saved or entry.name == BESIDE):
            raise FolderError(
                f"{folder}: holds {entry.name}, which is no frame, so it is not emptied; "
                "name another folder or move that away"
            )


def empty(folder: Path) -> None:
    """Make the folder, or empty it of its frames. Raises FolderError."""
    check(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for entry in folder.iterdir():
            entry.unlink()
    except OSError as error:
        raise FolderError(f"{folder}: can't be made or emptied ({error.strerror}); name another one") from error


class Saver:
    """Saves frames in a thread of its own, so that driving does not wait for the disk: the first session's in
    `path`, which is emptied now, the next ones' in path-2, path-3, … as far as they are free."""

    def __init__(self, path: Path):
        empty(path)
        beside = path.resolve()  # "." has a name, too
        self._free = (beside.with_name(f"{beside.name}-{number}") for number in itertools.count(2))
        self._first = path
        self._queue = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._write)
        self._thread.start()

    def folder(self) -> "Folder":
        """The folder of a new session."""
        path, self._first = self._first, None
        if path is None:
            path = next(path for path in self._free if not path.exists())
        log.info(f"saving frames in {path}")
        return Folder(path, self._queue)

    def close(self) -> None:
        """Returns when every frame is on the disk."""
        self._queue.put(None)
        self._thread.join()

    def _write(self):
        while (item := self._queue.get()) is not None:
            path, jpeg = item
            try:
                path.parent.mkdir(exist_ok=True)
                beside = path.with_name(BESIDE)  # renamed when whole, so a kill leaves no half of a frame
                beside.write_bytes(jpeg)
                os.replace(beside, path)
            except OSError as error:
                log.warning(f"frames can't be saved: {error}")


class Folder:
    """The frames of one session, named by their time (UTC), no two alike."""

    def __init__(self, path: Path, waiting: queue.Queue):
        self.path, self._waiting = path, waiting
        self._last = datetime.min.replace(tzinfo=UTC)

    def save(self, jpeg: bytes) -> None:
        now = datetime.now(UTC)
        now -= timedelta(microseconds=now.microsecond % 1000)
        self._last = max(now, self._last + timedelta(milliseconds=1))
        self._waiting.put((self.path / (self._last.strftime("%Y_%m_%d_%H_%M_%S_%f")[:-3] + ".jpg"), jpeg))
