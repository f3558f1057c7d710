"""Save the frames of a drive in a folder, named yyyy_MM_dd_HH_mm_ss_fff.jpg as by Udacity's original drive.py.

Beside them `driven.csv` tells how the car was driven: each frame's name, steering, throttle and speed.
"""

import itertools
import logging
import os
import queue
import re
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

from cloning.base.errors import UserError
from cloning.base.files import TEMPORARY_NAME, written_whole
from cloning.base.outputs import claimed
from cloning.recordings.format import parse_time_stamp, time_stamp

# The prefix is that of a recording's centre frames, which video.py films, too.
FRAME_NAME = re.compile(r"(?:center_)?(\d{4}(?:_\d\d){5}_\d{3})\.jpg")
DRIVEN = "driven.csv"
LEFT_BY_FILE_MANAGERS = (".DS_Store", "Thumbs.db", "desktop.ini")  # when somebody looks into a folder
DRIVEN_COLUMNS = ("frame", "steering", "throttle", "speed (mph)")
MAX_QUEUED = 2000  # frames, about 30 MB; with more waiting in memory, driving waits for the disk
Jobs = queue.Queue[Callable[[], None] | None]  # what the saving thread does next; None ends it
log = logging.getLogger("drive")  # the log of drive.py


def taken_at(name: str) -> datetime | None:
    """Return the time in a frame's file name; None if it is not the name of a frame."""
    match = FRAME_NAME.fullmatch(name)
    try:
        return parse_time_stamp(match[1]) if match else None
    except ValueError:  # such as month 13
        return None


def check_folder(folder: Path) -> None:
    """Raise UserError if the folder contains anything but saved frames, or is not a folder."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise UserError(f"{folder}: not a folder; name a folder for the frames")
    for entry in folder.iterdir():
        if entry.name in (DRIVEN, *LEFT_BY_FILE_MANAGERS):
            continue
        temporary = TEMPORARY_NAME.fullmatch(entry.name)  # of a frame that a killed process was writing
        name = temporary[1] if temporary else entry.name
        is_saved_frame = taken_at(name) and not name.startswith("center_")  # a recording's frame is never deleted
        if not entry.is_file() or not is_saved_frame:
            raise UserError(
                f"{folder}: contains {entry.name}, which is not a saved frame, so the folder is not emptied; "
                "name another folder, or move that file away"
            )


def empty_folder(folder: Path) -> ExitStack:
    """Make the folder if it does not exist, and delete the saved frames in it. Raises UserError.

    Until what is returned is closed, or this process ends, no other one empties it, where a system has locks.
    """
    check_folder(folder)
    try:
        with ExitStack() as stack:
            stack.enter_context(claimed(folder))
            for entry in folder.iterdir():
                entry.unlink()
            return stack.pop_all()
    except OSError as error:
        raise UserError(f"{folder}: cannot be emptied ({error.strerror}); name another folder") from error


class FrameSaver:
    """Saves the frames of all sessions in a thread, so that driving does not wait for the disk.

    The first session's frames are saved in `path`, which is emptied at the start; those of later sessions in path-2,
    path-3 …, of which existing ones are skipped. A frame that cannot be saved is counted, and driving goes on.
    """

    def __init__(self, path: Path):
        """Empty the folder and start the thread. Raises UserError."""
        self._held = empty_folder(path)
        self._path = path
        named = path if path.name not in ("", "..") else path.resolve()  # "." has no name
        numbered = (named.with_name(f"{named.name}-{session}") for session in itertools.count(2))
        # os.path, because Path.exists raises an error where it may not look; saving then counts what it loses.
        self._folders = itertools.chain([path], (folder for folder in numbered if not os.path.exists(folder)))
        self._sessions: list[SessionFolder] = []
        self._queue: Jobs = queue.Queue(MAX_QUEUED)
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def start_session(self) -> "SessionFolder":
        """Return the folder for the frames of a new session."""
        path = next(self._folders)
        log.info(f"saving frames in {path}")
        self._sessions.append(SessionFolder(path, self._queue))
        return self._sessions[-1]

    def close(self) -> None:
        """Wait until all frames are written, and end the thread. Raises UserError if frames were lost."""
        self._queue.put(None)
        self._thread.join()
        self._held.close()
        if lost := sum(session.lost for session in self._sessions):
            frames = lost + sum(session.saved for session in self._sessions)
            reason = next(session.error for session in self._sessions if session.lost)
            raise UserError(
                f"{self._path}: {lost} of {frames} frames were not saved ({reason}); "
                "free some disk space, or name a folder that can be written"
            )

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            job()


class SessionFolder:
    """The folder of one session; each frame is named by its UTC time, and no two have the same name.

    It is the time of its arrival, or, if the simulator tells its own time, that since the session's first frame: so a
    film of a simulator that waits for its answers plays as fast as the car drove.
    """

    def __init__(self, path: Path, jobs: Jobs):
        """jobs: the queue of the thread that writes the frames."""
        self.path, self._queue = path, jobs
        self.saved, self.lost, self.error = 0, 0, ""  # frames written, and not; why the last one was lost
        self._booted = datetime.now(UTC) - timedelta(seconds=time.monotonic())  # the clock may be set while it drives
        self._last = datetime.min.replace(tzinfo=UTC)  # time in the last frame's name
        self._zero: datetime | None = None  # of the simulator's clock
        self._simulated = 0.0  # s, of the last frame

    def save(self, jpeg: bytes, driven: tuple[float, float, float], simulated: float | None = None) -> None:
        """Queue a frame for writing; wait only while the queue is full.

        driven: the answer's steering and throttle, -1..1, and the frame's speed, mph; simulated: seconds by the
        simulator's own clock, 0 to 1e6, if it tells them.
        """
        now = self._booted + timedelta(seconds=time.monotonic())
        if simulated is not None:
            if self._zero is None or simulated < self._simulated:  # its first frame, or it has begun anew
                self._zero = max(now, self._last) - timedelta(seconds=simulated)
            self._simulated, now = simulated, self._zero + timedelta(seconds=simulated)
        self._last = max(now, self._last + timedelta(milliseconds=1))
        self._queue.put(partial(self._write, self.path / f"{time_stamp(self._last)}.jpg", jpeg, driven))

    def when_written(self, report: Callable[[], None]) -> None:
        """Have the thread call `report` when all frames that were queued are written or lost."""
        self._queue.put(report)

    def progress(self) -> str:
        """Return how many frames are saved and lost so far, and where."""
        lost = f", {self.lost} LOST ({self.error})" if self.lost else ""
        return f"{self.saved} frames saved in {self.path}{lost}"

    def _write(self, path: Path, jpeg: bytes, driven: tuple[float, float, float]) -> None:
        try:
            path.parent.mkdir(exist_ok=True)
            with open(path.with_name(DRIVEN), "ab", buffering=0) as rows:
                header = "" if rows.tell() else ",".join(DRIVEN_COLUMNS) + "\n"
                rows.write((header + ",".join([path.name, *(f"{value:.6g}" for value in driven)]) + "\n").encode())
            with written_whole(path) as temporary:
                temporary.write_bytes(jpeg)
            self.saved += 1
        except Exception as error:  # whatever it is: without this thread, driving would wait for ever
            self.lost += 1
            self.error = (error.strerror if isinstance(error, OSError) else None) or f"{type(error).__name__}: {error}"
            log.warning(f"frames can't be saved in {path.parent}: {self.error}; driving goes on")
