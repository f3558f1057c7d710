"""Write files that are either complete or absent: under a temporary name first, renamed at the end.

This holds for a process that is killed anywhere. After a power cut it holds for what `write` wrote, which waits for the
disk; films, saved frames and recordings do not wait, so the ones of the last seconds may then be empty or missing.
"""

import csv
import errno
import functools
import io
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform != "win32":
    import fcntl

TEMPORARY_NAME = re.compile(r"\.(.+)\.[0-9a-f]{8}\.part")
HELD_OPEN = 3.0  # s for which another program may have a file open
LEFT_BEHIND = 86_400.0  # s: the temporary file of a process that still writes is not so old
_locked: set[int] = set()  # the folders that this process has locked, as it has opened them


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder and rename it to `path` when the block ends without an exception.

    A process killed at any time leaves the old file or the new one, complete. After an exception the temporary file
    is deleted and the old file stays. The block writes and closes the temporary file; if it does not create it, an
    existing `path` stays as it is. The temporary file (`.NAME.RANDOM.part`) is no other process's, so several may write
    `path` at the same time, and the last one to finish wins. The first use in a folder deletes those that are a day
    old, which killed processes left. Through a symbolic link the file is written to which it leads.

    Raises OSError with the name `path`, not the temporary one, for example when the disk is full, and at once when
    `path` is a folder or a device, which would be replaced.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is a device or a pipe, not a file", str(path))
    target = path.resolve()
    temporary = _temporary(target)
    try:
        yield temporary
        if temporary.exists():
            _rename(temporary, target, os.replace)
    except BaseException as error:
        with suppress(OSError):  # the first error matters more
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(temporary), temporary):
            reason = error.strerror or str(error)  # NumPy's OSError has a message but no errno
            raise OSError(error.errno or errno.EIO, reason, str(path)) from error
        raise


@contextmanager
def locked(folder: Path) -> Iterator[bool | None]:
    """Lock a folder until the block ends, or this process; yield whether no other process has locked it.

    None if that cannot be told: on Windows, and on a file system without locks, as some of networks are. Raises OSError
    if there is no such folder.
    """
    if sys.platform == "win32":
        yield None
    else:  # not after it: mypy would report that as never reached
        opened = os.open(folder, os.O_RDONLY)
        _locked.add(opened)
        _close_in_forks()
        free: bool | None = True
        try:
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                free = False if isinstance(error, BlockingIOError) else None
            yield free
        finally:
            if opened in _locked:
                _locked.remove(opened)
                os.close(opened)


@functools.cache  # once
def _close_in_forks() -> None:
    """Let a forked process hold none of the folders that this one has locked: it may end later, as after a kill."""

    def close() -> None:
        while _locked:
            os.close(_locked.pop())

    os.register_at_fork(after_in_child=close)


def _rename(old: Path, new: Path, rename: Callable[[Path, Path], None]) -> None:
    """Rename a file or folder; on Windows, wait for programs that have it open for a moment, as virus scanners do."""
    until = time.monotonic() + (HELD_OPEN if sys.platform == "win32" else 0.0)
    while True:
        try:
            return rename(old, new)
        except PermissionError as error:
            if time.monotonic() >= until:
                if sys.platform == "win32":  # Excel has a table open for as long as it shows it
                    error.strerror = f"{error.strerror} (if another program has it open: close it there)"
                raise
        time.sleep(0.05)


def _temporary(path: Path) -> Path:
    """Return a name for what will be `path`, beside it; the first time in a folder, clean that."""
    _clean(path.absolute().parent)
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")


@functools.cache  # once: a folder of saved frames takes long to list
def _clean(folder: Path) -> None:
    """Delete what killed processes left in a folder, if it can be deleted."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if TEMPORARY_NAME.fullmatch(entry.name) and time.time() - entry.stat().st_mtime > LEFT_BEHIND:
                delete = shutil.rmtree if entry.is_dir(follow_symlinks=False) else os.unlink
                delete(entry)


@contextmanager
def folder_written_whole(path: str | Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`, and rename it to `path` when the block ends without an exception.

    A process killed at any time leaves `path` absent or complete. The temporary folder is as `written_whole`'s file. Of
    several that write `path` at the same time the first one to finish wins. Raises OSError, with the name `path`, also
    if that exists.
    """
    path = Path(path).absolute()
    if os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    temporary = _temporary(path)
    try:
        temporary.mkdir()
        yield temporary
        _rename(temporary, path, os.rename)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError) and error.filename and str(error.filename).startswith(str(temporary)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def csv_bytes(rows: Iterable[Iterable[object]]) -> bytes:
    """Return a csv file's contents, in UTF-8; names of files in it may hold any bytes."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode(errors="surrogateescape")


def write(path: str | Path, data: bytes) -> None:
    """Write a file completely or not at all, and wait until it is on the disk. Raises OSError; the old file stays."""
    with written_whole(path) as temporary, open(temporary, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
