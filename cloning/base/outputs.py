"""Write the files that the user asked for, such as reports and pictures; errors say what to do."""

import contextlib
import json
import os
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloning.base.errors import OutputError, UserError
from cloning.base.files import locked, write


def names_folder(path: str) -> bool:
    """Return whether a name is of a folder, which need not exist if it ends as one."""
    return path.endswith(("/", os.sep)) or Path(path).is_dir()


def check_folders(*paths: str | None, read: Iterable[str | Path | None] = ()) -> None:
    """Raise OutputError, before the work, for an output that can't be written, or would replace a file that is needed.

    It would if it is one of the files that are read, or another output.
    """
    inputs = [each for each in read if each and os.path.exists(each)]
    outputs = [path for path in paths if path]
    names = Counter(map(os.path.realpath, outputs))
    for path in outputs:
        if names[os.path.realpath(path)] > 1:
            raise OutputError(f"{path}: is named for two outputs, and one would replace the other; name another file")
        if os.path.exists(path) and any(os.path.samefile(path, each) for each in inputs):
            raise OutputError(f"{path}: is read, and would be replaced; name another file")
        if not Path(path).absolute().parent.is_dir():
            raise OutputError(f"{path}: no such folder to write it in; make the folder first")
        if names_folder(path):
            raise OutputError(f"{path}: is a folder; name a file in it")
        if Path(path).exists() and not Path(path).is_file():
            raise OutputError(f"{path}: is a device or a pipe; name a file")
        if not os.access(os.path.dirname(os.path.realpath(path)), os.W_OK):
            raise OutputError(f"{path}: its folder cannot be written; name a file in another one")


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[bool | None]:
    """Make a folder for results, and keep other programs that claim it out until the block ends, or this process.

    Yields None where they cannot be kept out, else True: see `locked`. Raises OutputError if the folder cannot be made
    or another program has claimed it.
    """
    with contextlib.ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            free = stack.enter_context(locked(folder))
        except OSError as error:
            reason = "not a folder" if folder.is_file() else f"cannot be made ({error.strerror})"
            raise OutputError(f"{folder}: {reason}; name another folder") from error
        if free is False:
            raise OutputError(f"{folder}: another program writes there; wait for its end, or name another folder")
        yield free


def write_output(path: str | Path, data: bytes) -> None:
    """Write a file that the user named. Raises OutputError."""
    try:
        write(path, data)
    except OSError as error:
        raise OutputError(f"{path}: {error.strerror}; name another file, in a folder that can be written") from error


def write_json(path: str | Path, value: Mapping | Sequence) -> None:
    """Write a report as JSON. Raises OutputError."""
    write_output(path, json.dumps(value, indent=1).encode() + b"\n")


def read_json(path: Path) -> Any:
    """Return what `write_json` has written. Raises UserError if the file is damaged, OSError."""
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: damaged ({error}); delete it, and start again") from None


def as_typed(*words: object) -> str:
    """Return the words of a command as they are typed in a shell of this machine."""
    texts = [*map(str, words)]
    return subprocess.list2cmdline(texts) if sys.platform == "win32" else shlex.join(texts)


def plural(count: int, noun: str, several: str = "") -> str:
    """Return a count with its noun, as `1 lap` or `2 laps`; several: the plural, if it is not the noun with an s."""
    return f"{count} {noun if count == 1 else several or noun + 's'}"


def short_names(paths: Iterable[Path]) -> list[str]:
    """Return the paths' names, with the folders around them where others have the same: `lake`, or `a/lake`."""
    every = [Path(os.path.abspath(path)).parts for path in paths]
    ends = Counter(parts[-length:] for parts in every for length in range(1, len(parts)))

    def short(own: tuple[str, ...]) -> str:
        for length in range(1, len(own)):
            if ends[own[-length:]] == 1:
                return "/".join(own[-length:])
        return str(Path(*own))

    return [short(parts) for parts in every]


def run_all(*steps: Callable[[], object]) -> None:
    """Run all steps in order, even if an earlier one fails or is interrupted, so that no output is lost.

    Raises UserError if steps failed, with all their messages; any other exception is raised after the last step.
    """
    failures: list[UserError] = []

    def attempt(step: Callable[[], object]) -> None:
        try:
            step()
        except UserError as error:
            failures.append(error)

    with contextlib.ExitStack() as stack:  # runs the last callback first, and the others even if one raises
        for step in reversed(steps):
            stack.callback(attempt, step)
    if len(failures) > 1:
        raise UserError("; ".join(map(str, failures)))
    if failures:
        raise failures[0]
