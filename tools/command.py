"""What the tools share: commands in other processes, and tables in Markdown."""

import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command of the Python interpreter in a process of its own; options: of `subprocess.run`."""
    return subprocess.run([sys.executable, *map(str, words)], encoding="utf-8", **options)


def row(*cells: object) -> str:
    """Return a row of a table in Markdown."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*titles: str) -> str:
    """Return the first two rows of a table in Markdown."""
    return f"{row(*titles)}\n|{'---|' * len(titles)}"
