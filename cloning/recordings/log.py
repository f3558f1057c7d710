"""Read recordings of the Udacity simulator, whatever other programs have done to their `driving_log.csv`.

A number that cannot be read for certain is never guessed: its row is left out and reported with file, line and remedy.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from cloning.base import program
from cloning.base.errors import RecordingError, printable
from cloning.base.outputs import as_typed, plural
from cloning.base.table import Column, Table
from cloning.recordings.columns import Finding, Rejected, UnclearLogError
from cloning.recordings.excluded import EXCLUDED, Cut, cut_rows, read_cuts
from cloning.recordings.format import DRIVE_GAP, DRIVING_LOG, IMAGE_FOLDER, SAMPLE_RATE, STAMP_LENGTH
from cloning.recordings.frames import FrameCache
from cloning.recordings.images import read_frame
from cloning.recordings.rows import RowReader, read_lines
from cloning.recordings.saved_frames import DRIVEN

WHERE_TO_GET_RECORDINGS = (
    "Record some: in the simulator (training mode, button R), or by `python -m simulator record data/lake-ccw`; or "
    f"unpack the public sample data there: data/README.md says how. A recording is a folder with {DRIVING_LOG} and "
    f"{IMAGE_FOLDER}/. donkeycar's tubs and LeRobot's data sets become recordings by `python -m cloning.lerobot`."
)
SHOWN_REJECTED = 5  # rows of each finding that are printed, so that a damaged recording does not fill the screen
STAMP_SEPARATORS = [4, 7, 10, 13, 16, 19]  # where its underscores are
STAMP_PARTS = [4, 6, 8, 10, 12, 14]  # where, without them, month, day, hour, minute, second and millisecond begin


@dataclass(frozen=True)
class Recording(Table):
    """The rows of one recording, sorted by their time stamps; without time stamps, in the order of the csv."""

    folder: Path  # contains `driving_log.csv` and `IMG/`
    names: np.ndarray  # bytes (m,): file names in `IMG/`, sorted, without duplicates
    images: Column  # int32 (n, 3): indices into `names` of a row's centre, left and right image
    steering: Column  # float32 (n,): -1..1, right positive
    throttle: Column  # float32 (n,): 0..1
    brake: Column  # float32 (n,): 0..1
    speed: Column  # float32 (n,): mph
    time: Column  # float64 (n,): s since 1970 by the recording computer's clock; without time stamps, line / 15
    lines: Column  # int32 (n,): line in the csv, from 1
    rows_read: int  # rows in the csv, usable or not
    repairs: dict[str, list[int]] = field(default_factory=dict)  # of rows read otherwise: how -> [rows, first line]
    rejected: list[Rejected] = field(default_factory=list)  # rows that were left out
    # Stretches that `excluded.csv` leaves out, and how many rows each leaves out that none before it does.
    cuts: list[tuple[Cut, int]] = field(default_factory=list)
    # Keeps decoded frames in memory for `road`; none unless `check_images` is given a larger one.
    frames: FrameCache = field(default_factory=FrameCache)

    def originals(self) -> np.ndarray:
        """Return the first of successive rows with the same centre image: int (m,); oversampling makes such copies."""
        return np.flatnonzero(np.diff(self.images[:, 0], prepend=-1))

    def without_copies(self) -> Self:
        """Return the rows of `originals`: in the others no time passes."""
        return self.take(self.originals())

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


@dataclass(frozen=True, kw_only=True)
class CheckedRecording(Recording):
    """A recording whose images `check_images` has decoded."""

    digests: np.ndarray  # uint64 (m,): of the image files' contents


def find_folders(given: Iterable[str | Path], exact: bool = False) -> list[Path]:
    """Return the recordings (folders with a driving_log.csv) among and below the given folders, without duplicates.

    exact: each was a recording before; below one there may be others, which are not meant.
    Raises RecordingError if a name is of no folder, or if neither the folder nor one below it is a recording.
    """
    folders: dict[Path, Path] = {}
    for name in given:
        path = Path(name)
        if not path.exists():
            remedy = "Put the recording back, or name its new folder" if exact else WHERE_TO_GET_RECORDINGS
            raise RecordingError(f"{path}: no such folder. {remedy}")
        if path.is_file():
            wanted = f"the folder of a recording, with {DRIVING_LOG} and IMG/, unpacked if it is an archive"
            raise RecordingError(f"{path}: a file; name {wanted}")
        found = [path] if exact and (path / DRIVING_LOG).is_file() else sorted(folders_below(path))
        if not found and (path / DRIVEN).is_file():
            command = as_typed("python", "-m", "cloning.lerobot", path, "--output", f"{path}-recording")
            raise RecordingError(f"{path}: what drive.py saved; `{command}` makes a recording of it, not for training")
        if not found:
            raise RecordingError(f"{path}: no {DRIVING_LOG} in or below it. {WHERE_TO_GET_RECORDINGS}")
        for folder in found:
            folders.setdefault(folder.resolve(), folder)
    return list(folders.values())


def folders_below(path: Path) -> Iterator[Path]:
    """Yield each recording in and below a folder, through symbolic links too: recordings are often on another disk.

    A folder that cannot be read is named on stderr.
    """

    def left_out(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):  # it has just gone
            program.warn_once(f"{error.filename}: {error.strerror}; left out with what is in it")

    visited = set()
    for folder, below, files in os.walk(path, onerror=left_out, followlinks=True):
        if (real := os.path.realpath(folder)) in visited:
            below.clear()  # reached a second time, through a link
            continue
        visited.add(real)
        below.sort()  # of several links to a recording the first name counts, in whatever order the disk lists them
        if DRIVING_LOG in files:
            below[:] = [name for name in below if name != IMAGE_FOLDER]  # which takes long to list
            yield Path(folder)


def print_findings(recording: Recording) -> None:
    """Print a recording's repairs, cuts, and first five rejected rows of each finding, with file, line and remedy."""
    path, excluded = (printable(str(recording.folder / name)) for name in (DRIVING_LOG, EXCLUDED))
    for repair, (rows, line) in recording.repairs.items():
        are = plural(rows, "row is", "rows are")
        print(f"{path}: line {line}: {repair} ({are} read this way; check that it is meant)")
    for finding in Finding:
        rejected = [row for row in recording.rejected if row.finding == finding]
        for row in rejected[:SHOWN_REJECTED]:
            print(f"{path}: line {row.line}: left out: {printable(row.detail)}")
        if len(rejected) > SHOWN_REJECTED:
            print(f"{path}: … and {len(rejected) - SHOWN_REJECTED} more of this kind")
    for cut, rows in recording.cuts:
        stretch = printable(f"from {cut.first} to {cut.last}: {cut.reason or 'no reason given'}")
        print(f"{excluded}: line {cut.line}: {plural(rows, 'row is', 'rows are')} left out, {stretch}")


def read_recording(folder: str | Path) -> Recording:
    """Read a folder's `driving_log.csv` without the stretches that its `excluded.csv` leaves out.

    Raises RecordingError as `read_uncut` does, and if `excluded.csv` is wrong or leaves out every row.
    """
    recording = read_uncut(folder)
    cuts, counted, is_cut = read_cuts(recording.folder), [], np.zeros(len(recording), bool)
    for cut, rows in zip(cuts, cut_rows(recording.folder, cuts, recording.names, recording.images[:, 0]), strict=True):
        counted.append((cut, int((rows & ~is_cut).sum())))
        is_cut |= rows
    if cuts and is_cut.all():
        raise RecordingError(f"{recording.folder / EXCLUDED}: leaves out every row of {DRIVING_LOG}; delete a line")
    return recording.take(~is_cut, cuts=counted) if cuts else recording


def read_uncut(folder: str | Path) -> Recording:
    """Read a folder's `driving_log.csv`; images are in the folder's own `IMG/`, whatever paths the csv has.

    Raises RecordingError if the file is not such a csv, or has no usable row.
    """
    folder = Path(folder)
    path = folder / DRIVING_LOG
    reader, line, text = RowReader(), 0, ""
    try:
        for line, text in enumerate(read_lines(path), 1):
            reader.read_line(line, text)
        image_names, numbers, lines = reader.finish(0 if text.endswith(("\n", "\r")) else line)
    except UnclearLogError as error:
        raise RecordingError(f"{path}: {error}") from None
    if not len(lines):
        reasons = {row.finding: f"line {row.line}: {row.detail}" for row in reversed(reader.rejected)}
        nothing = f"nothing was recorded; delete the folder {folder}, or record again"
        raise RecordingError(f"{path}: no usable row: {'; '.join(reversed(reasons.values())) or nothing}")
    # With return_index, NumPy sorts by merging, which is fast where the names of each camera are in order.
    names, _, images = np.unique(image_names.T, return_index=True, return_inverse=True)
    images = np.ascontiguousarray(images.reshape(image_names.T.shape).T, np.int32)
    time = _time_stamps(names)[images[:, 0]]
    steering, throttle, brake, speed = np.ascontiguousarray(numbers.astype(np.float32).T)
    if (untold := np.isnan(time)).any():
        assumed = f"no time in the image's name, so the whole file counts as one drive, {SAMPLE_RATE} rows a second"
        reader.repair(assumed, int(lines[untold].min()), int(untold.sum()))
        time, jumps = lines / float(SAMPLE_RATE), _jumps(lines, images[:, 0])
        if len(jumps):
            told = "a copy of other rows begins or ends here: taken for the start of another drive"
            reader.repair(told, int(jumps[0]), len(jumps))
            time += 2 * DRIVE_GAP * np.searchsorted(jumps, lines, side="right")
    contradicting = _contradicting(images[:, 0], steering)
    for row in np.flatnonzero(contradicting):
        name = os.fsdecode(image_names[row, 0])
        detail = f"{name} also has a row with another steering angle; delete the wrong one"
        reader.rejected.append(Rejected(int(lines[row]), Finding.CONTRADICTION, detail))
    repairs = dict(sorted(reader.repairs.items(), key=lambda item: item[1][1]))
    rows_read, rejected = reader.rows_read, sorted(reader.rejected)
    recording = Recording(
        folder, names, images, steering, throttle, brake, speed, time, lines, rows_read, repairs, rejected
    )
    order = np.lexsort((lines, time))  # sessions may have been merged in any order
    return recording.take(order[~contradicting[order]])


def _jumps(lines: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Return the lines where copied rows begin or end, ascending: int (k,); images: int (n,), a row's centre image.

    A copy may follow the row that it follows in the original, or its own original, as oversampling makes it.
    """
    order = np.argsort(lines)
    order = order[np.flatnonzero(np.diff(images[order], prepend=-1))]
    _, first, which = np.unique(images[order], return_index=True, return_inverse=True)
    original = first[which]  # of each row, where its image is first
    is_copy = original < np.arange(len(order))
    follows = original[1:] == original[:-1] + 1
    return lines[order[1:][(is_copy[1:] | is_copy[:-1]) & ~follows]]


def _contradicting(images: np.ndarray, steering: np.ndarray) -> np.ndarray:
    """Return which rows have the image of a row with other steering: bool (n,); images: int (n,), an index each."""
    order = np.lexsort((steering, images))
    images_in_order, steering_in_order = images[order], steering[order]
    differ = (np.diff(images_in_order) == 0) & (np.diff(steering_in_order) != 0)
    return np.isin(images, images_in_order[1:][differ])


def _time_stamps(names: np.ndarray) -> np.ndarray:
    """Return seconds since 1970 from names like center_2018_07_16_17_11_43_382.jpg, nan for others: float64 (m,).

    NumPy does not parse the stamps: at the first one that is wrong in a long array, NumPy 2.4 crashes.
    """
    ends = np.strings.rfind(names, b".")
    stamps = np.strings.slice(names, np.maximum(ends - STAMP_LENGTH, 0), ends).astype(f"S{STAMP_LENGTH}")
    characters = stamps.view(np.uint8).reshape(-1, STAMP_LENGTH)
    digits = np.delete(characters, STAMP_SEPARATORS, axis=1).astype(int) - ord("0")
    year, month, day, hour, minute, second, millisecond = (
        part @ 10 ** np.arange(part.shape[1])[::-1] for part in np.split(digits, STAMP_PARTS, axis=1)
    )
    months = 12 * (year - 1970) + month - 1
    days = months.astype("M8[M]").astype("M8[D]").astype(int) + day - 1
    is_stamp = (characters[:, STAMP_SEPARATORS] == ord("_")).all(1) & ((digits >= 0) & (digits <= 9)).all(1)
    is_stamp &= (month >= 1) & (month <= 12) & (days.astype("M8[D]").astype("M8[M]").astype(int) == months)
    is_stamp &= (hour < 24) & (minute < 60) & (second < 60)
    milliseconds = (((days * 24 + hour) * 60 + minute) * 60 + second) * 1000 + millisecond
    return np.where(is_stamp, milliseconds / 1000, np.nan)
