"""The stretches that are cut from a recording, or tagged: `excluded.csv` and `tags.csv` beside the log.

Each line names the centre images of a stretch's first and last row, and a reason or a tag. A cut is undone by deleting
its line. The log itself is never changed.
"""

import contextlib
import csv
import io
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.files import csv_bytes, write
from cloning.recordings.format import DRIVING_LOG
from cloning.recordings.images import nonblocking

if sys.platform != "win32":
    import fcntl

EXCLUDED, TAGS = "excluded.csv", "tags.csv"
HEADERS = {EXCLUDED: ("first image", "last image", "reason"), TAGS: ("first image", "last image", "tag")}
MAX_REASON = 10_000  # characters: one written by hand is as before when its deletion is undone
PATIENCE = 10.0  # s for which another program may change a recording's cuts
BYTES = {"encoding": "utf-8", "errors": "surrogateescape"}  # names of files may hold any bytes
_one_at_a_time = threading.Lock()  # for Windows, where no other lock is taken


@dataclass(frozen=True)
class Cut:
    """A stretch that is cut, or tagged."""

    first: str  # file name of the centre image of its first row
    last: str  # and of its last row
    reason: str  # or the tag: one line of text, perhaps empty
    line: int = 0  # in its file, from 1; 0 for one that is not written yet

    def row(self) -> tuple[str, str, str]:
        """Return its fields, in the order of HEADERS."""
        return self.first, self.last, self.reason


def read_cuts(folder: Path, file: str = EXCLUDED) -> list[Cut]:
    """Return the cuts of a recording, or with TAGS its tags; none if there is no such file.

    Raises RecordingError, with the line, for a file that is not as `HEADERS` says.
    """
    return _parse(folder / file, _lines(folder / file))


def cut_rows(
    folder: Path, cuts: Iterable[Cut], names: np.ndarray, centres: np.ndarray, file: str = EXCLUDED
) -> Iterator[np.ndarray]:
    """Yield which rows each cut leaves out, or with TAGS each tag is of: bool (n,).

    A stretch begins at the first row with its first image, and ends at the next one with its last image. Copies of its
    rows elsewhere in the recording are left out with it.
    names, centres: as `Recording` has them: bytes (m,), sorted; int32 (n,), an index into names for each row.
    Raises RecordingError for an image that no row has, and for a stretch whose end comes before its beginning.
    """
    path, has_copies = folder / file, (np.bincount(centres) > 1).any()
    for cut in cuts:
        where = f"{path}: line {cut.line}" if cut.line else str(path)
        found = []
        for name in (cut.first, cut.last):
            at = int(np.searchsorted(names, os.fsencode(name)))
            is_there = (names[at : at + 1] == os.fsencode(name)).any()
            found.append(np.flatnonzero(centres == at))
            if not is_there or not len(found[-1]):
                raise RecordingError(
                    f"{where}: {name} is not the centre image of a usable row of {DRIVING_LOG}; name another one, or "
                    "delete the line"
                )
        first, last = found
        last = last[last >= first[0]]
        if not len(last):
            raise RecordingError(f"{where}: {cut.last} comes before {cut.first} in the recording; exchange the two")
        is_cut = np.zeros(len(centres), bool)
        is_cut[first[0] : last[0] + 1] = True
        yield np.isin(centres, centres[is_cut]) if has_copies else is_cut


class GoneError(RecordingError):
    """A cut or tag that is to be deleted and is not there any more."""


def add_cuts(folder: Path, *cuts: Cut, file: str = EXCLUDED) -> list[Cut]:
    """Append cuts or tags to a recording's, and return those that were not there; the other lines stay as they are.

    Raises RecordingError if the file is not readable as such, and OSError if it cannot be written; then it stays.
    """
    with _changing(folder / file) as (lines, there):
        present = {each.row() for each in there}
        added = {cut.row(): cut for cut in cuts if cut.row() not in present}
        if added:
            ended = [line if line.endswith(("\n", "\r")) else f"{line}\n" for line in lines]
            lines[:] = [*(ended or [_line(HEADERS[file])]), *map(_line, added)]
    return list(added.values())


def delete_cuts(folder: Path, *cuts: Cut, file: str = EXCLUDED) -> list[Cut]:
    """Delete the lines of cuts or tags, and return those that were there; the other lines stay as they are.

    Raises GoneError if none of them is there, and the errors of `add_cuts`.
    """
    with _changing(folder / file) as (lines, there):
        present, gone = {each.row() for each in there}, {cut.row() for cut in cuts}
        deleted = {each.line for each in there if each.row() in gone}  # also if the same one was written twice
        lines[:] = [line for number, line in enumerate(lines, 1) if number not in deleted]
    found = [cut for cut in cuts if cut.row() in present]
    if cuts and not found:
        raise GoneError(
            f"{folder / file}: the stretch from {cuts[0].first} to {cuts[0].last} is not there any more; it was "
            "deleted elsewhere"
        )
    return found


def one_line(reason: str) -> str:
    """Return a reason as one line of at most MAX_REASON characters, without control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in reason).split())[:MAX_REASON]


@contextlib.contextmanager
def _changing(path: Path) -> Iterator[tuple[list[str], list[Cut]]]:
    """Yield a file's lines, to be changed, and the cuts in them, while no other thread or process changes the file."""
    log = path.with_name(DRIVING_LOG)
    try:
        locked = _locked(log)
    except OSError as error:
        raise RecordingError(f"{log}: {error.strerror}; put the recording back, or forget its cuts") from None
    with locked, _one_at_a_time:
        lines = _lines(path)
        before = list(lines)
        yield lines, _parse(path, lines)
        if lines != before:
            write(path, "".join(lines).encode(**BYTES))


def _locked(log: Path) -> BinaryIO:
    """Open a recording's log, and lock it for whoever changes its cuts, where there are locks, until it is closed.

    Raises RecordingError if another program keeps it locked, OSError.
    """
    try:
        file: BinaryIO = open(log, "r+b", opener=nonblocking)  # noqa: SIM115 - NFS locks only what may be written
    except OSError:
        file = open(log, "rb", opener=nonblocking)  # noqa: SIM115
    until = time.monotonic() + PATIENCE
    while sys.platform != "win32":
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError:
            if time.monotonic() > until:
                file.close()
                remedy = "try again, or end that one if it has stopped"
                raise RecordingError(f"{log}: another program is changing its cuts; {remedy}") from None
        except OSError:  # a network's file system without locks
            break
        time.sleep(0.01)
    return file


def _lines(path: Path) -> list[str]:
    """Return the file's lines with their ends, none if there is no file. Raises RecordingError if it is not text."""
    try:
        if path.exists() and not path.is_file():  # a pipe would never end
            raise RecordingError(f"{path}: not a regular file; make it a readable file")
        data = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; make it a readable file") from None
    if b"\0" in data:
        raise RecordingError(f"{path}: line 1: not a text in UTF-8; save it as CSV in UTF-8")
    return io.StringIO(data.decode(**BYTES), newline="").readlines()


def _parse(path: Path, lines: list[str]) -> list[Cut]:
    """Return the cuts in the file's lines. Raises RecordingError."""
    cuts, header = [], HEADERS[path.name]
    for at, line in enumerate(lines, 1):
        text = line.removeprefix("\ufeff").strip()
        try:
            fields = next(csv.reader([text], strict=True, skipinitialspace=True), [])
        except csv.Error as error:
            raise RecordingError(f"{path}: line {at}: {error}; a line is {_line(header).strip()}") from None
        fields = [field.strip() for field in fields]
        if not any(fields) or (at == 1 and tuple(field.lower() for field in fields) == header):
            continue
        if len(fields) != len(header):
            raise RecordingError(
                f"{path}: line {at}: {len(fields)} fields where {len(header)} are expected: "
                f"{_line(header).strip()}; put a reason that has commas in double quotes"
            )
        first, last = (name.replace("\\", "/").rpartition("/")[2] for name in fields[:2])
        cuts.append(Cut(first, last, fields[2], at))
    return cuts


def _line(fields: tuple[str, ...]) -> str:
    """Return a line of a csv, with its end."""
    return csv_bytes([fields]).decode(**BYTES)
