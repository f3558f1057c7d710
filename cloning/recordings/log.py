"""Read recordings of the Udacity simulator, whatever other programs have done to their `driving_log.csv`.

A number that cannot be read for certain is never guessed: its row is left out and reported with file, line and remedy.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.recordings.excluded import EXCLUDED, Cut, cut_rows, read_cuts
from cloning.recordings.format import COLUMNS, DRIVING_LOG, IMAGE_FOLDER, SAMPLE_RATE
from cloning.recordings.frames import FrameCache
from cloning.recordings.images import read_frame
from cloning.recordings.plain import as_narrow_as_possible, line_starts, read_blocks, read_plain
from cloning.recordings.tolerant import TolerantReader

WHERE_TO_GET_RECORDINGS = (
    "Record some in the simulator (training mode, button R), or unpack the public sample data "
    f"there: data/README.md says how. A recording is a folder with {DRIVING_LOG} and {IMAGE_FOLDER}/."
)
SHOWN_PER_KIND = 5  # rejected rows that are printed, so that a damaged recording does not fill the screen
STAMP_LENGTH = 23  # characters of yyyy_MM_dd_HH_mm_ss_fff
STAMP_SEPARATORS = [4, 7, 10, 13, 16, 19]  # where its underscores are


@dataclass
class Recording:
    """The rows of one recording, sorted by their time stamps; without time stamps, in the order of the csv.

    folder     contains `driving_log.csv` and `IMG/`
    names      bytes (m,): file names in `IMG/`, sorted, without duplicates
    images     int32 (n, 3): indices into `names` of a row's centre, left and right image
    steering   float32 (n,): -1..1, right positive
    throttle   float32 (n,): -1..1
    brake      float32 (n,): -1..1
    speed      float32 (n,): mph
    time       float64 (n,): seconds since 1970 by the recording computer's clock; without time stamps, line / 15
    lines      int32 (n,): line in the csv, from 1
    rows_read  rows in the csv, usable or not
    repairs    rows that were interpreted, by kind of repair: kind -> [rows, first line]
    rejected   rows that were left out: (line, kind, detail)
    cuts       stretches that `excluded.csv` leaves out, and how many rows each leaves out that none before it does
    digests    uint64 (m,): of the image files' contents; None before `check_images` has set them
    frames     keeps decoded frames in memory for `road`; none unless `check_images` is given a larger one
    """

    folder: Path
    names: np.ndarray
    images: np.ndarray
    steering: np.ndarray
    throttle: np.ndarray
    brake: np.ndarray
    speed: np.ndarray
    time: np.ndarray
    lines: np.ndarray
    rows_read: int
    repairs: dict[str, list[int]] = field(default_factory=dict)
    rejected: list[tuple[int, str, str]] = field(default_factory=list)
    cuts: list[tuple[Cut, int]] = field(default_factory=list)
    digests: np.ndarray | None = None
    frames: FrameCache = field(default_factory=FrameCache)

    def __len__(self) -> int:
        return len(self.lines)

    def keep(self, rows: np.ndarray) -> None:
        """Keep only these rows, in this order; rows: a mask, bool (n,), or indices."""
        for column in ("images", "steering", "throttle", "brake", "speed", "time", "lines"):
            setattr(self, column, getattr(self, column)[rows])

    def drop_copies(self) -> None:
        """Keep only the first of successive rows with the same centre image: copies that oversampling made."""
        self.keep(np.r_[True, np.diff(self.images[:, 0]) != 0])

    def name(self, row: int, camera: int = 0) -> str:
        """Return the file name of a row's image; camera: 0 centre, 1 left, 2 right."""
        return os.fsdecode(self.names[self.images[row, camera]])

    def path(self, row: int, camera: int = 0) -> Path:
        """Return the file of a row's image; camera: 0 centre, 1 left, 2 right."""
        return self.folder / IMAGE_FOLDER / self.name(row, camera)

    def road(self, row: int, camera: int = 0, read: Callable[[Path], np.ndarray] = read_frame) -> np.ndarray:
        """Return the `ROAD_ROWS` of a row's frame, decoded once: uint8 (90, 320, 3), RGB, not to be changed.

        read: decodes the file if need be; its errors are raised.
        """
        key = self.folder, int(self.images[row, camera])  # rows may share an image
        return self.frames.get(key, lambda: read(self.path(row, camera)))


def find_folders(given: list[str]) -> list[Path]:
    """Return the recordings (folders with a driving_log.csv) among and below the given folders, without duplicates.

    Raises RecordingError if a folder does not exist, or if neither it nor a folder below it is a recording.
    """
    folders: dict[Path, Path] = {}
    for name in given:
        path = Path(name)
        if not path.exists():
            raise RecordingError(f"{path}: no such folder. {WHERE_TO_GET_RECORDINGS}")
        logs = [path / DRIVING_LOG] if (path / DRIVING_LOG).is_file() else sorted(logs_below(path))
        if not logs:
            raise RecordingError(f"{path}: no {DRIVING_LOG} in or below it. {WHERE_TO_GET_RECORDINGS}")
        for log in logs:
            folders.setdefault(log.parent.resolve(), log.parent)
    return list(folders.values())


def logs_below(path: Path) -> Iterator[Path]:
    """Yield each driving_log.csv below a folder, through symbolic links too: recordings are often on another disk."""
    visited = set()
    for folder, below, files in os.walk(path, followlinks=True):
        if (real := os.path.realpath(folder)) in visited:
            below.clear()  # reached a second time, through a link
            continue
        visited.add(real)
        if DRIVING_LOG in files:
            yield Path(folder) / DRIVING_LOG


def print_findings(recording: Recording) -> None:
    """Print a recording's repairs, cuts, and first five rejected rows of each kind, with file, line and remedy."""
    path = recording.folder / DRIVING_LOG
    for kind, (rows, line) in recording.repairs.items():
        count = "1 row is" if rows == 1 else f"{rows} rows are"
        print(f"{path}: line {line}: {kind} ({count} read this way; check that it is meant)")
    kinds: dict[str, list[tuple[int, str]]] = {}
    for line, kind, detail in recording.rejected:
        kinds.setdefault(kind, []).append((line, detail))
    for rejected in kinds.values():
        for line, detail in rejected[:SHOWN_PER_KIND]:
            print(f"{path}: line {line}: left out: {detail}")
        if len(rejected) > SHOWN_PER_KIND:
            print(f"{path}: … and {len(rejected) - SHOWN_PER_KIND} more of this kind")
    for cut, size in recording.cuts:
        count = "1 row is" if size == 1 else f"{size} rows are"
        stretch = f"from {cut.first} to {cut.last}: {cut.reason or 'no reason given'}"
        print(f"{recording.folder / EXCLUDED}: line {cut.line}: {count} left out, {stretch}")


def read_recording(folder: str | Path) -> Recording:
    """Read a folder's `driving_log.csv` without the stretches that its `excluded.csv` leaves out.

    Raises RecordingError as `read_uncut` does, and if `excluded.csv` is wrong or leaves out every row.
    """
    recording = read_uncut(folder)
    cuts = read_cuts(recording.folder)
    is_cut = np.zeros(len(recording), bool)
    for cut, rows in zip(cuts, cut_rows(recording.folder, cuts, recording.names, recording.images[:, 0]), strict=True):
        recording.cuts.append((cut, int((rows & ~is_cut).sum())))
        is_cut |= rows
    if is_cut.all() and cuts:
        raise RecordingError(f"{recording.folder / EXCLUDED}: leaves out every row of {DRIVING_LOG}; delete a line")
    if cuts:
        recording.keep(~is_cut)
    return recording


def read_uncut(folder: str | Path) -> Recording:
    """Read a folder's `driving_log.csv`; images are in the folder's own `IMG/`, whatever paths the csv has.

    Raises RecordingError if the file is not such a csv, or has no usable row.
    """
    folder = Path(folder)
    path = folder / DRIVING_LOG
    reader = _read_rows(path)
    plain = reader.plain
    lines = np.concatenate([np.array(reader.lines, np.int32), *(rows.lines for rows in plain)])
    if not len(lines):
        first_lines = {detail: line for line, _, detail in reversed(reader.rejected)}
        reasons = [f"line {line}: {detail}" for detail, line in first_lines.items()][-3:]
        first = "; ".join(reversed(reasons)) or "the file has no rows"
        raise RecordingError(f"{path}: no usable row ({first}). A row is {','.join(COLUMNS)}")
    numbers = np.concatenate([np.reshape(reader.numbers, (-1, 4)), *(rows.numbers for rows in plain)])
    columns = np.ascontiguousarray(numbers.astype(np.float32).T)
    names = np.concatenate([np.array(reader.names, bytes).reshape(-1, 3), *(rows.names for rows in plain)])
    rows_read, repairs, rejected = reader.rows, reader.repairs, reader.rejected
    del numbers, plain, reader
    names, images = _unique(names)
    times = _time_stamps(names)[images]
    time = times[:, 0]
    if np.isnan(time).any():
        time = lines / float(SAMPLE_RATE)
    steering, throttle, brake, speed = columns
    recording = Recording(
        folder, names, images, steering, throttle, brake, speed, time, lines, rows_read, repairs, rejected
    )
    order = np.lexsort((lines, time))  # sessions may have been merged in any order
    contradicting = _contradicting(images[:, 0], steering)
    for row in np.flatnonzero(contradicting):
        detail = f"{recording.name(int(row))} also has a row with another steering angle; delete the wrong one"
        rejected.append((int(lines[row]), "one image, two angles", detail))
    torn = np.nanmin(times, axis=1, initial=np.inf) < np.nanmax(times, axis=1, initial=-np.inf)
    for row in np.flatnonzero(torn):
        detail = f"{', '.join(recording.name(int(row), camera) for camera in range(3))} are of different times: has a "
        detail += "column been sorted or moved by itself? Copy the csv again, or delete the row"
        rejected.append((int(lines[row]), "images of different times", detail))
    rejected.sort()
    recording.keep(order[~(contradicting | torn)[order]])
    return recording


def _read_rows(path: Path) -> TolerantReader:
    """Read a csv: plain lines with pandas, all others with the tolerant reader in the order of the file."""
    reader, number, is_whole = TolerantReader(path), 0, True
    encoding = _encoding(path)
    if encoding == "utf-8":
        for block in read_blocks(path):
            starts = line_starts(block)
            _read_block(reader, block, starts, number + 1)
            number += len(starts) - 1
            is_whole = block.endswith((b"\n", b"\r"))
    else:
        with open(path, encoding=encoding, errors="replace", newline="") as text:
            for number, line in enumerate(text, 1):
                reader.read_line(number, line)
                is_whole = line.endswith(("\n", "\r"))
    reader.finish(0 if is_whole else number)
    return reader


def _read_block(reader: TolerantReader, block: bytes, starts: np.ndarray, first_line: int) -> None:
    """Read a block: its plain rows with pandas; all other lines, and all lines until it is settled, tolerantly.

    starts: of the lines, as `line_starts` returns them; first_line: the number of the first line in the csv.
    """

    def read_tolerantly(at: int) -> None:
        text = block[starts[at] : starts[at + 1]].decode("utf-8", "surrogateescape")
        reader.read_line(first_line + at, text)

    first, end = 0, len(starts) - 1
    while first < end and not reader.settled:
        read_tolerantly(first)
        first += 1
    shape, header = reader.shape(), reader.header
    is_plain, rows = read_plain(block[starts[first] :], starts[first:] - starts[first], first_line + first)
    for at in first + np.flatnonzero(~is_plain):
        read_tolerantly(int(at))
        if reader.header != header:  # the columns below it may be others
            rows = rows.above(reader.header)
            for below in range(int(at) + 1, end):
                read_tolerantly(below)
            break
    reader.rows += len(rows.lines)
    shape.plain.append(rows)


def _encoding(path: Path) -> str:
    """Return the csv's encoding, judged by its first bytes. Raises RecordingError if it is not text."""
    try:
        with open(path, "rb") as file:
            start = file.read(4)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from None
    if start[:2] == b"PK":
        raise RecordingError(f"{path}: line 1: an Excel workbook under a csv's name; open it and save it as CSV")
    if start == b"\x00\x05\x16\x07":
        raise RecordingError(
            f"{path}: line 1: a macOS resource file (AppleDouble), not the csv; copy the real {DRIVING_LOG}"
        )
    return "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"


def _unique(names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the names, bytes (n, 3), sorted without duplicates, (m,), and the index of each in that: int32 (n, 3).

    Like np.unique, but with timsort camera by camera: 0.3 instead of 1.7 s for a million rows in order of time.
    """
    flat = names.T.ravel()
    order = flat.argsort(kind="stable")
    flat = flat[order]
    is_first = np.append(True, flat[1:] != flat[:-1])
    images = np.empty(len(flat), np.int32)
    images[order] = np.cumsum(is_first) - 1
    unique = flat[is_first]
    return as_narrow_as_possible(unique), np.ascontiguousarray(images.reshape(3, -1).T)


def _contradicting(images: np.ndarray, steering: np.ndarray) -> np.ndarray:
    """Return which rows have the image of a row with other steering: bool (n,); images: int (n,), an index each."""
    if np.bincount(images).max() == 1:
        return np.zeros(len(images), bool)
    order = images.argsort(kind="stable")
    starts = np.flatnonzero(np.diff(images[order], prepend=-1))
    differ = np.minimum.reduceat(steering[order], starts) != np.maximum.reduceat(steering[order], starts)
    contradicting = np.empty(len(images), bool)
    contradicting[order] = np.repeat(differ, np.diff(starts, append=len(images)))
    return contradicting


def _time_stamps(names: np.ndarray) -> np.ndarray:
    """Return seconds since 1970 from names like center_2018_07_16_17_11_43_382.jpg, nan for others: float64 (m,)."""
    ends = np.strings.rfind(names, b".")
    stamps = np.strings.slice(names, np.maximum(ends - STAMP_LENGTH, 0), ends).astype(f"S{STAMP_LENGTH}")
    characters = stamps.view(np.uint8).reshape(-1, STAMP_LENGTH)
    digits = np.delete(characters, STAMP_SEPARATORS, axis=1)
    is_stamp = ((digits >= ord("0")) & (digits <= ord("9"))).all(1)
    is_stamp &= (characters[:, STAMP_SEPARATORS] == ord("_")).all(1)
    characters[:, STAMP_SEPARATORS] = np.frombuffer(b"--T::.", np.uint8)
    time = np.full(len(names), np.nan)
    try:
        time[is_stamp] = stamps[is_stamp].astype("M8[ms]").astype(np.int64) / 1000
    except ValueError:  # such as month 13: the names are not the simulator's
        return np.full(len(names), np.nan)
    return time
