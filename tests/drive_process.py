"""drive.py as a process, for the tests."""

import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import warm
from commands import HERE, ROOT

# What Ctrl-C sends; Windows sends it to a whole console, and Ctrl-Break to one process group.
STOP = signal.CTRL_BREAK_EVENT if sys.platform == "win32" else signal.SIGINT


class Process:
    """A drive.py process; first: Python code to run before it."""

    def __init__(self, *arguments, port=0, cwd=None, first=""):
        self.process = warm.Popen(
            [*script("drive.py", first), *map(str, arguments), "--port", str(port)],
            cwd=cwd,
            env={**os.environ, **HERE},
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )
        self.lines, self.listening = [], threading.Event()
        self.reader = threading.Thread(target=self._read)
        self.reader.start()
        assert self.listening.wait(120)
        self.port = int(re.search(r"Listening on [\d.]+:(\d+)", "".join(self.lines))[1])

    def _read(self):
        for line in self.process.stderr:
            self.lines.append(line)
            if "Watch at" in line:
                self.listening.set()
        self.listening.set()

    def stop(self, number=STOP) -> int:
        if self.process.poll() is None:
            self.process.send_signal(number)
        code = self.process.wait(60)
        self.reader.join()
        self.process.stdout.close()
        self.process.stderr.close()
        return code

    def memory(self) -> float:
        """Resident MB; 0 where the system does not tell it like Linux."""
        if not Path("/proc/self/status").exists():
            return 0.0
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="utf-8")
        return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024


def script(name: str, first: str = "") -> list[str]:
    """The command of a script at the top; first: Python code to run before it."""
    if not first:
        return [sys.executable, str(ROOT / name)]
    run = f"import runpy, sys; sys.argv = sys.argv[1:]\nrunpy.run_path({str(ROOT / name)!r}, run_name='__main__')"
    return [sys.executable, "-c", f"{first}\n{run}", name]


@contextmanager
def serving(*arguments, **more):
    process = Process(*arguments, **more)
    try:
        yield process
    finally:
        process.process.kill()
        process.stop()
