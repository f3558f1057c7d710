"""Servers as processes, for the tools that measure them."""

import re
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from cloning.base.errors import UserError


def start_server(
    command: Sequence[str | Path], environment: Mapping[str, str] | None = None
) -> tuple[subprocess.Popen[str], int]:
    """Start a server, such as drive.py, and return its process and the port that it prints.

    command: arguments for the Python interpreter. What the server prints later is discarded. Raises UserError if it
    ends before it listens.
    """
    process = subprocess.Popen(
        [sys.executable, *map(str, command)], env=environment, stderr=subprocess.PIPE, text=True, encoding="utf-8"
    )
    assert process.stderr
    printed = []
    for line in process.stderr:
        printed.append(line)
        if port := re.search(r"Listening on .*:(\d+)", line):
            threading.Thread(target=process.stderr.read, daemon=True).start()
            return process, int(port[1])
    process.wait()
    raise UserError(f"{' '.join(map(str, command))} ended before it listened: {''.join(printed).strip()}")
