"""Frames that driving saves in a folder: yyyy_MM_dd_HH_mm_ss_fff.jpg, as the original drive.py names them."""

import itertools
import logging
import queue
import re
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cloning.errors import FolderError
from cloning.files import written_whole

# A recording's centre frames can be made into a film, too.
FRAME_NAME = re.compile(r"(?:center_)?(\d{4}(?:_\d\d){5}_\d{3})\.jpg")
PARTIAL_NAME = re.compile(r"\.(.+)\.part")  # a frame whose writing was killed
MAX_QUEUED = 2000  # frames in memory when the disk is slow, about 30 MB; beyond them driving waits for the disk
log = logging.getLogger("drive")


def taken_at(name: str) -> datetime | None:
    """The time in a frame's file name; None for a file that is not a frame."""
    match = FRAME_NAME.fullmatch(name)
    try:
        return datetime.strptime(match[1] + "000", "%Y_%m_%d_%H_%M_%S_%f") if match else None
    except ValueError:  # such as month 13
        return None


def check(folder: Path) -> None:
    """Raise FolderError if emptying the folder would delete anything but saved frames."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise FolderError(f"{folder}: not a folder; name another one for the frames")
    for entry in folder.iterdir():
        partial = PARTIAL_NAME.fullmatch(entry.name)
        name = partial[1] if partial else entry.name
        is_saved_frame = taken_at(name) and not name.startswith("center_")  # which is a recording's
        if not entry.is_file() or not is_saved_frame:
            raise FolderError(
                f"{folder}: contains {entry.name}, which is not a saved frame, so it is not emptied; "
                "name another folder or move that file away"
            )


def empty(folder: Path) -> None:
    """Make the folder, or delete the frames in it. Raises FolderError."""
    check(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for entry in folder.iterdir():
            entry.unlink()
    except OSError as error:
        raise FolderError(f"{folder}: cannot be made or emptied ({error.strerror}); name another one") from error


class Saver:
    """Saves frames in a thread of its own, so that driving does not wait for the disk.

    The first session's frames are saved in `path`, which is emptied at the start, those of the next sessions in
    path-2, path-3, … as far as these do not exist yet.
    """

    def __init__(self, path: Path):
        """Empty the folder and start the thread. Raises FolderError."""
        empty(path)
        resolved = path.resolve()  # "." has no name of its own
        others = (resolved.with_name(f"{resolved.name}-{number}") for number in itertools.count(2))
        self._folders = itertools.chain([path], (other for other in others if not other.exists()))
        self._queue: queue.Queue[tuple[Path, bytes] | None] = queue.Queue(MAX_QUEUED)
        self._thread = threading.Thread(target=self._write)
        self._thread.start()

    def folder(self) -> "Folder":
        """The folder of a new session."""
        path = next(self._folders)
        log.info(f"saving frames in {path}")
        return Folder(path, self._queue)

    def close(self) -> None:
        """Wait until every frame is written, and end the thread."""
        self._queue.put(None)
        self._thread.join()

    def _write(self) -> None:
        while (item := self._queue.get()) is not None:
            path, jpeg = item
            try:
                path.parent.mkdir(exist_ok=True)
                with written_whole(path) as temporary:
                    temporary.write_bytes(jpeg)
            except OSError as error:
                log.warning(f"frames can't be saved: {error}")


class Folder:
    """The frames of one session, named by the time at which they arrive (UTC), each by another millisecond."""

    def __init__(self, path: Path, waiting: queue.Queue[tuple[Path, bytes] | None]):
        """waiting: the queue of the thread that writes the frames."""
        self.path, self._waiting = path, waiting
        self._last = datetime.min.replace(tzinfo=UTC)

    def save(self, jpeg: bytes) -> None:
        """Queue a frame; wait only if the queue is full."""
        now = datetime.now(UTC)
        now -= timedelta(microseconds=now.microsecond % 1000)
        self._last = max(now, self._last + timedelta(milliseconds=1))
        self._waiting.put((self.path / (self._last.strftime("%Y_%m_%d_%H_%M_%S_%f")[:-3] + ".jpg"), jpeg))
