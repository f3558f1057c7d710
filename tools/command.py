"""What the tools share: commands and servers in other processes, and tables in Markdown."""

import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, Self

from cloning.base.errors import UserError

ROOT = Path(__file__).resolve().parent.parent


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command of the Python interpreter in a process of its own; options: of `subprocess.run`."""
    return subprocess.run([sys.executable, *map(str, words)], encoding="utf-8", errors="replace", **options)


def row(*cells: object) -> str:
    """Return a row of a table in Markdown."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*titles: str) -> str:
    """Return the first two rows of a table in Markdown."""
    return f"{row(*titles)}\n|{'---|' * len(titles)}"


class ServerProcess:
    """A server, such as drive.py, in a process that ends with the `with` statement; port: that it listens on."""

    def __init__(self, *command: object):
        """Run Python with these arguments until it listens; what it prints later is lost. Raises UserError."""
        self.process = subprocess.Popen(
            [sys.executable, *map(str, command)], stderr=subprocess.PIPE, encoding="utf-8", errors="replace"
        )
        assert self.process.stderr
        printed = []
        for line in self.process.stderr:
            printed.append(line)
            if port := re.search(r"Listening on .*:(\d+)", line):
                threading.Thread(target=self.process.stderr.read, daemon=True).start()
                self.port = int(port[1])
                return
        self.process.wait()
        raise UserError(f"{' '.join(map(str, command))} ended before it listened: {''.join(printed).strip()}")

    def memory(self, line: str = "VmRSS") -> float:
        """Return its resident memory in MB, or another line of Linux's /proc/PID/status, such as VmHWM, the peak."""
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
        return int(status.split(f"{line}:")[1].split()[0]) / 1024

    def cpu_seconds(self) -> float:
        """Return its processor time so far in s, user and system; needs Linux."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
