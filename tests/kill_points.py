"""Commands that are killed, or find the disk full, at a chosen change to their files.

`python tests/kill_points.py REQUEST COMMAND` runs a command as `python COMMAND` does. Points are counted in the folders
that are watched: before each file or folder is opened for writing, made, renamed, shortened or deleted, and halfway
through each write. A kill is the system's own: SIGKILL.
"""

import builtins
import errno
import io
import json
import os
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warm
from commands import HERE, PICTURE, ROOT

CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink")
OPEN = io.open


# ----------------------------------------------------------------------------------------------------------------------
# In the child


class Points:
    """Counts the changes to the files below some folders; ends the process, or fills the disk, at one of them."""

    def __init__(self, folders: list[str], trace: str, kill: int | None, full: int | None):
        """trace: a file for a line per point; kill: the point at which to end; full: from which on nothing fits."""
        self.folders, self.kill, self.full = folders, kill, full
        self.trace = os.open(trace, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        self.count, self.lock = 0, threading.Lock()

    def watched(self, path: object) -> bool:
        if isinstance(path, int) and path > 2:
            path = os.readlink(f"/proc/self/fd/{path}")
        if not isinstance(path, str | bytes | os.PathLike):
            return False
        whole = os.path.abspath(os.fsdecode(path))
        return any(whole == folder or whole.startswith(folder + os.sep) for folder in self.folders)

    def reached(self, event: str, path: Any) -> bool:
        """Count a point; return whether it is the one at which to end."""
        with self.lock:
            self.count += 1
            os.write(self.trace, f"{event} {os.fspath(path) if not isinstance(path, int) else path}\n".encode())
            return self.count == self.kill

    def audit(self, event: str, arguments: tuple) -> None:
        """Python's audit hook: called before each change."""
        if event == "open":
            path, _, flags = arguments
            if not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC):
                return
        elif event in CHANGES:
            path = arguments[0]
            if (event == "os.mkdir" and os.path.isdir(path)) or (event == "os.remove" and not os.path.lexists(path)):
                return  # it changes nothing
        else:
            return
        if (self.watched(path) or (event == "os.rename" and self.watched(arguments[1]))) and self.reached(event, path):
            end()

    def open(self, file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, closefd=True, opener=None):
        """In place of Python's open: each write to a watched file is a point."""
        if not set("wax+") & set(mode) or isinstance(file, int) or not self.watched(file):
            return OPEN(file, mode, buffering, encoding, errors, newline, closefd, opener)
        raw = WatchedFile(file, "".join(set(mode) - set("bt")))
        raw.points = self
        if buffering == 0:
            return raw
        buffered = (io.BufferedRandom if "+" in mode else io.BufferedWriter)(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding, errors, newline)


class WatchedFile(io.FileIO):
    """A file of which half a write is written when the process is killed in it, or when the disk fills up."""

    points: Points

    def write(self, data) -> int:
        before = self.points.count
        half = memoryview(data).cast("B")[: len(data) // 2]
        if self.points.reached("write", self.name):
            super().write(half)
            end()
        if self.points.full is None or before + 1 < self.points.full:
            return super().write(data)
        if before + 1 == self.points.full:
            return super().write(half)  # as the system does: what still fits, and then the error
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def end() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def main() -> None:
    request = json.loads(sys.argv[1])
    if request["bytes"] is not None:
        import resource

        # The system kills the process in the write that would make a file longer; libraries written in C as well.
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_FSIZE, (request["bytes"], request["bytes"]))
    points = Points(request["watch"], request["trace"], request["kill"], request["full"])
    sys.addaudithook(points.audit)
    vars(io)["open"] = vars(builtins)["open"] = points.open
    warm.run_command(sys.argv[2:])


# ----------------------------------------------------------------------------------------------------------------------
# In the test

# Costs a child a tenth of what its own imports, a scenery of its own, and drawn pictures and curves would. A renderer
# is a copy of the child, which has no thread yet; another way to start it takes a second.
PREPARE = f"""
import functools, multiprocessing, sys
sys.path.append({str(ROOT)!r})
from cloning.base import figure
figure.png = lambda *_, **__: {PICTURE!r}
import pandas  # or else pyarrow does for its first table, in every child
import av, matplotlib.figure, model, video, drive, simulator.client, simulator.film, simulator.record, simulator.report
import cloning.network.attention, cloning.replay.command
from cloning.report import pictures as charts
from cloning.training import pictures
from simulator import record, scenery, workers
pictures.SCALE, record.MAX_RENDERERS, pictures.grid = 1, 1, figure.png
charts.chart = lambda *draws: charts.Chart("", "")
workers._context = lambda: multiprocessing.get_context("fork")
scenery.build = functools.cache(scenery.build)
scenery.build("lake", 0)
"""


@dataclass
class Ended:
    """A command that has ended: its exit status (-9 if it was killed), what it printed, and the points it passed."""

    status: int
    printed: str
    points: list[str]


class Watched:
    """A running command whose changes to its files are counted, and the files that it prints and counts in."""

    def __init__(
        self, command: list, folder: Path, *, kill: int | None = None, full: int | None = None, bytes: int | None = None
    ):
        """command: as behind `python`; folder: where it runs; kill, full: see `Points`; bytes: the longest file's."""
        self.output, self.trace = folder.with_name("output"), folder.with_name("trace")
        request = {"watch": [str(folder)], "trace": str(self.trace), "kill": kill, "full": full, "bytes": bytes}
        with self.output.open("wb") as output:
            self.process = warm.Popen(
                [sys.executable, __file__, json.dumps(request), *map(str, command)],
                cwd=folder,
                env={**os.environ, **HERE, "XDG_CACHE_HOME": str(folder / "cache")},
                stdout=output,
                stderr=output,
                prepare=PREPARE,
            )

    def printed(self) -> str:
        return self.output.read_text(encoding="utf-8", errors="replace")

    def wait(self) -> Ended:
        status = self.process.wait(300)
        return Ended(status, self.printed(), self.trace.read_text(encoding="utf-8").splitlines())


if __name__ == "__main__":
    main()
