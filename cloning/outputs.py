"""Write the files that a user asked for, such as reports and pictures, with messages that say what to do."""

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from cloning.errors import OutputError, UserError
from cloning.files import write


def check_folders(*paths: str | None) -> None:
    """Raise OutputError if a file cannot be written because of missing or existing folders: before the work."""
    for path in paths:
        if path and not Path(path).absolute().parent.is_dir():
            raise OutputError(f"{path}: there is no such folder; make it first")
        if path and Path(path).is_dir():
            raise OutputError(f"{path}: is a folder; name a file in it")


def write_output(path: str | Path, data: bytes) -> None:
    """Write a file that the user named. Raises OutputError."""
    try:
        write(path, data)
    except OSError as error:
        raise OutputError(f"{path}: {error.strerror}; give a place that can be written") from error


def write_json(path: str | Path, value: Mapping | Sequence) -> None:
    """Write a report as JSON. Raises OutputError."""
    write_output(path, json.dumps(value, indent=1).encode() + b"\n")


def run_all(*steps: Callable[[], object]) -> None:
    """Run every step in order, even if an earlier one fails or is interrupted, so that no output is lost.

    Raises the UserError of a step that failed; that of several holds all their messages.
    """
    failures: list[UserError] = []

    def attempt(step: Callable[[], object]) -> None:
        try:
            step()
        except UserError as error:
            failures.append(error)

    with contextlib.ExitStack() as stack:  # calls back in reverse order, and last raises what is no UserError
        for step in reversed(steps):
            stack.callback(attempt, step)
    if len(failures) > 1:
        raise UserError("; ".join(map(str, failures)))
    if failures:
        raise failures[0]
