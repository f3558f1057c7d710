"""What the tools share: how they end, commands in other processes, and tables in Markdown."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from cloning.base import program
from cloning.base.errors import UserError

ROOT = Path(__file__).resolve().parent.parent


def run_tool(main: Callable[[], int]) -> NoReturn:
    """Run a tool's main function, print an error of the user as `PROGRAM: MESSAGE`, and end with the exit status."""

    def status() -> int:
        try:
            return main()
        except (UserError, OSError) as error:
            return program.failed(error)

    program.run(status)


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command of the Python interpreter in a process of its own; options: of `subprocess.run`."""
    return subprocess.run([sys.executable, *map(str, words)], encoding="utf-8", **options)


def row(*cells: object) -> str:
    """Return a row of a table in Markdown."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*titles: str) -> str:
    """Return the first two rows of a table in Markdown."""
    return f"{row(*titles)}\n|{'---|' * len(titles)}"
