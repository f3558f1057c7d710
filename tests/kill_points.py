"""Commands in children of a warm process, which are killed, or find the disk full, at a chosen change to their files.

`python tests/kill_points.py` imports what the commands need, and then forks a child for each, which costs a tenth of
what a new process would. Points are counted in the folders that are watched: before each file or folder is opened for
writing, made, renamed, shortened or deleted, and halfway through each write. A kill is the system's own: SIGKILL.
"""

import contextlib
import errno
import functools
import gc
import importlib
import io
import json
import os
import runpy
import signal
import subprocess
import sys
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
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

    def reached(self, event: str, path: object) -> bool:
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


def child(request: dict) -> None:
    """Run a command as `python NAME ARGUMENTS` does, and end with its exit status."""
    os.chdir(request["cwd"])
    os.environ.update(request["env"])
    out = os.open(request["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for number, to in ((0, os.open(os.devnull, os.O_RDONLY)), (1, out), (2, out)):
        os.dup2(to, number)
    if request["bytes"] is not None:
        import resource

        # The system kills the process in the write that would make a file longer; libraries written in C as well.
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_FSIZE, (request["bytes"], request["bytes"]))
    points = Points(request["watch"], request["trace"], request["kill"], request["full"])
    sys.addaudithook(points.audit)
    io.open = sys.modules["builtins"].open = points.open
    name, *sys.argv[1:] = request["command"]
    status = 0
    try:
        if name.endswith(".py"):
            sys.argv[0] = str(ROOT / name)
            runpy.run_path(sys.argv[0], run_name="__main__")
        else:
            runpy.run_module(name, run_name="__main__", alter_sys=True)
    except SystemExit as error:
        if isinstance(error.code, str):
            print(error.code, file=sys.stderr)
        status = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 70
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    os._exit(status)


def main() -> None:
    """The warm process: each line on its standard input is a request, each line on its output an answer."""
    sys.path[:0] = [str(ROOT)]
    # Imported, never used here: a library that has started threads would not survive a fork.
    for name in (
        *("model", "video", "drive", "torch._dynamo", "av", "matplotlib.backends.backend_agg"),
        *("matplotlib.figure", "PIL.PngImagePlugin", "cloning.replay.command", "cloning.network.attention"),
        *("simulator.record", "simulator.report", "simulator.client", "simulator.film", "simulator.run"),
    ):
        importlib.import_module(name)
    from simulator import scenery

    scenery.build = functools.cache(scenery.build)
    scenery.build("lake", 0)
    gc.freeze()  # the children then share more of their memory
    for line in sys.stdin:
        request = json.loads(line)
        if "alive" in request:  # without reaping it: WNOWAIT
            answer = os.waitid(os.P_PID, request["alive"], os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
        elif "wait" in request:
            answer = os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1])
        else:
            answer = os.fork()
            if not answer:
                child(request)
        print(json.dumps(answer), flush=True)


# ----------------------------------------------------------------------------------------------------------------------
# In the test


@dataclass
class Ended:
    """A command that has ended: its exit status (-9 if it was killed), what it printed, and the points it passed."""

    status: int
    printed: str
    points: list[str]


class Warm:
    """The warm process, and the files in which its children write what they print and the points that they pass."""

    def __init__(self, folder: Path):
        """folder: for those files."""
        self.output, self.trace = folder / "output", folder / "trace"
        self.process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
        )

    def close(self) -> None:
        """End the warm process."""
        self.process.communicate()

    def _ask(self, request: dict) -> int:
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def start(self, command, watch, cwd, env=None, *, kill=None, full=None, bytes=None) -> int:
        """Start a command; return its process id."""
        self.output.write_bytes(b"")
        return self._ask(
            {
                "command": [str(word) for word in command],
                "watch": [str(folder) for folder in watch],
                "cwd": str(cwd),
                "env": env or {},
                "output": str(self.output),
                "trace": str(self.trace),
                "kill": kill,
                "full": full,
                "bytes": bytes,
            }
        )

    def alive(self, process: int) -> bool:
        """Whether a command has not ended yet."""
        return bool(self._ask({"alive": process}))

    def wait(self, process: int) -> Ended:
        """Wait until a command has ended."""
        status = self._ask({"wait": process})
        printed = self.output.read_text(encoding="utf-8", errors="replace")
        return Ended(status, printed, self.trace.read_text(encoding="utf-8").splitlines())

    def run(self, *arguments, **more) -> Ended:
        """Run a command to its end."""
        return self.wait(self.start(*arguments, **more))


if __name__ == "__main__":
    main()
