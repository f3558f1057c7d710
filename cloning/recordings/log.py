"""Read folders recorded in the Udacity simulator: their `driving_log.csv`, in every shape that it has in the wild.

A number that cannot be read for certain is never guessed: its row is left out, with file, line and remedy.
"""

import csv
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cloning.errors import RecordingError
from cloning.recordings.format import CAMERAS, COLUMNS, LOG, RANGES, SAMPLE_RATE

WRITTEN = re.compile(r"-?(0|[1-9]\d*)(\.\d*[1-9])?(E[-+]?\d+)?", re.IGNORECASE)  # a number as the simulator writes it


WHERE_TO_GET_RECORDINGS = (
    "Record some in the simulator (training mode, button R), or unpack the public sample data "
    "there: data/README.md says how. A recording is a folder with driving_log.csv and IMG/."
)


@dataclass
class Recording:
    """One folder's rows in the order of their time stamps (of the file where it has none).

    folder   where `driving_log.csv` and `IMG/` are
    names    bytes (m,): file names in `IMG/`, sorted, each once
    images   int32 (n, 3): centre, left and right image of a row, indices into `names`
    steering, throttle, brake, speed  float32 (n,): steering -1..1 (right positive), throttle -1..1, brake -1..1, mph
    time     float64 (n,): seconds since 1970 on the recording machine; where names have no time stamps, since the
             csv's beginning
    lines    int32 (n,): line in the csv, from 1
    read     rows found in the csv, usable or not
    repairs  what was read otherwise than written: kind -> [rows, first line]
    rejected rows left out: (line, kind, detail)
    digests  uint64 (m,): of the files' contents, once checked
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
    read: int
    repairs: dict = field(default_factory=dict)
    rejected: list = field(default_factory=list)
    digests: np.ndarray | None = None

    def __len__(self):
        return len(self.lines)

    def keep(self, rows: np.ndarray) -> None:
        """Keep these rows only: a mask or indices."""
        for column in ("images", "steering", "throttle", "brake", "speed", "time", "lines"):
            setattr(self, column, getattr(self, column)[rows])

    def name(self, row: int, camera: int = 0) -> str:
        """The file name of a row's image; camera: 0 centre, 1 left, 2 right."""
        return os.fsdecode(self.names[self.images[row, camera]])

    def path(self, row: int, camera: int = 0) -> Path:
        """The file of a row's image; camera: 0 centre, 1 left, 2 right."""
        return self.folder / "IMG" / self.name(row, camera)


def find_folders(given: list[str]) -> list[Path]:
    """The folders with a driving_log.csv among and below those given, each once. Raises RecordingError."""
    folders: dict[Path, Path] = {}
    for name in given:
        path = Path(name)
        if not path.exists():
            raise RecordingError(f"{path}: no such folder. {WHERE_TO_GET_RECORDINGS}")
        logs = [path / LOG] if (path / LOG).is_file() else sorted(logs_below(path))
        if not logs:
            raise RecordingError(f"{path}: no {LOG} in or below it. {WHERE_TO_GET_RECORDINGS}")
        for log in logs:
            folders.setdefault(log.parent.resolve(), log.parent)
    return list(folders.values())


def logs_below(path: Path) -> Iterator[Path]:
    """Also through symbolic links: recordings are large, and often lie on another disk."""
    been = set()
    for folder, below, files in os.walk(path, followlinks=True):
        if (real := os.path.realpath(folder)) in been:
            below.clear()  # a link leads back up
            continue
        been.add(real)
        if LOG in files:
            yield Path(folder) / LOG


def print_findings(recording: Recording) -> None:
    """What was read otherwise than written, and what was left out: file, line, remedy; five a kind."""
    path = recording.folder / LOG
    for kind, (count, line) in recording.repairs.items():
        print(f"{path}: line {line}: {kind} ({count} rows; read so, check that it is meant)")
    kinds: dict[str, list] = {}
    for line, kind, detail in recording.rejected:
        kinds.setdefault(kind, []).append((line, detail))
    for found in kinds.values():
        for line, detail in found[:5]:
            print(f"{path}: line {line}: left out: {detail}")
        if len(found) > 5:
            print(f"{path}: … and {len(found) - 5} more of this kind")


# --------------------------------------------------------------------------------------------------
# driving_log.csv


def read_recording(folder) -> Recording:
    """Read a folder's `driving_log.csv`; images are looked for in the folder's own `IMG/`, whatever the csv's paths.

    Raises RecordingError for a file that is no such csv, or has no usable row.
    """
    folder = Path(folder)
    path = folder / LOG
    parser = _Parser(path)
    with open(path, encoding=_encoding(path), errors="surrogateescape", newline="") as file:
        for line, text in enumerate(file, 1):
            parser.line(line, text)
    parser.finish()
    if not parser.lines:
        first = "; ".join(f"line {line}: {detail}" for line, _, detail in parser.rejected[:3]) or "the file has no rows"
        raise RecordingError(f"{path}: no usable row ({first}). A row is {','.join(COLUMNS)}")
    names, images = np.unique(np.array(parser.names, dtype=bytes), return_inverse=True)
    images = images.astype(np.int32).reshape(-1, 3)
    lines = np.array(parser.lines, np.int32)
    columns = np.ascontiguousarray(np.array(parser.numbers, np.float32).reshape(-1, 4).T)
    time = _time_stamps(names[images[:, 0]])
    if np.isnan(time).any():
        time = lines / float(SAMPLE_RATE)
    recording = Recording(folder, names, images, *columns, time, lines, parser.read, parser.repairs, parser.rejected)
    recording.keep(np.lexsort((lines, time)))  # sessions are merged out of date order in the wild
    return recording


def _encoding(path: Path) -> str:
    """The csv's encoding from its first bytes. Raises RecordingError for what is no text."""
    try:
        with open(path, "rb") as file:
            start = file.read(4)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from None
    if start[:2] == b"PK":
        raise RecordingError(f"{path}: line 1: an Excel workbook under a csv's name; open it and save it as CSV")
    if start == b"\x00\x05\x16\x07":
        raise RecordingError(f"{path}: line 1: a macOS resource file (AppleDouble), not the csv; copy the real {LOG}")
    return "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


class _Parser:
    """Rows from lines. A row whose columns are not certain waits until the whole file has been seen."""

    def __init__(self, path: Path):
        self.path, self.read, self.columns = path, 0, None
        self.names: list[bytes] = []  # three a row
        self.numbers: list[float] = []  # four a row
        self.lines: list[int] = []
        self.repairs: dict[str, list[int]] = {}
        self.rejected: list[tuple[int, str, str]] = []
        self.waiting: list[tuple[int, list[str], list[str]]] = []
        self.points = False  # a number with a decimal point was seen
        self.commas = False  # a fraction behind a decimal comma was seen

    def line(self, line: int, text: str) -> None:
        fields = text.split(",")
        if len(fields) == 7 and '"' not in text and self.columns in (None, COLUMNS):
            names = [_base_name(value) for value in fields[:3]]
            if _is_image(names[0]) and _is_image(names[1]) and _is_image(names[2]):
                self.read += 1
                self.points = self.points or "." in fields[3] or "." in fields[6]
                return self.row(line, names, fields[3:])
        self.odd_line(line, text)

    def odd_line(self, line: int, text: str) -> None:
        """A line that is not seven plain columns: blank, a header, quoted, tabs, extra columns, decimal commas."""
        text = text.strip("\r\n")
        if not text.strip("\0 \t,;"):
            if "\0" in text:
                self.reject(line, "binary zeros", "the file was cut off while it was written; delete the line")
            return
        if text.startswith(("<<<<<<<", "=======", ">>>>>>>")):
            return self.reject(line, "merge conflict", f"{text[:20]!r}: resolve the merge, delete the line")
        delimiter = max(",;\t", key=text.count) if text.count(",") < 6 else ","
        fields = [value.strip() for value in next(csv.reader([text], delimiter=delimiter))]
        names = [_base_name(value) for value in fields]
        images = [at for at, name in enumerate(names) if _is_image(name)]
        if not images and not self.read and self.columns is None:
            self.columns = self.header(line, fields)
            return None
        self.read += 1
        if delimiter != ",":
            self.repair("tab-separated" if delimiter == "\t" else "separated by semicolons", line)
            if any("," in value for value in fields[images[-1] + 1 :] if images):
                self.repair("decimal commas", line)
                fields = [value.replace(",", ".") for value in fields]
        if self.columns and len(fields) == len(self.columns):
            by_name = dict(zip(self.columns, fields, strict=True))
            return self.row(line, [_base_name(by_name[name]) for name in CAMERAS], [by_name[n] for n in COLUMNS[3:]])
        if len(images) != 3:
            found = "1 image name" if len(images) == 1 else f"{len(images)} image names"
            return self.reject(
                line,
                "not a row",
                f"{found} where center, left and right are expected; record again, or add the columns",
            )
        names, tokens = [names[at] for at in images], fields[images[-1] + 1 :]
        self.points = self.points or any("." in token for token in tokens)
        self.commas = self.commas or any(
            token.isdigit() and (len(token) > 3 or token[0] == "0" < token[1:]) for token in tokens[1:]
        )
        if len(tokens) == 4:
            return self.row(line, names, tokens)
        if len(tokens) < 4:
            return self.reject(
                line,
                "columns missing",
                f"{len(tokens)} numbers where steering, throttle, brake, "
                "speed are expected; record again, or add the columns",
            )
        self.waiting.append((line, names, tokens))
        return None

    def header(self, line: int, fields: list[str]) -> tuple[str, ...]:
        """The names of the columns as COLUMNS has them, other columns under their own."""
        columns = tuple(_column(value) or f"{value} ({at})" for at, value in enumerate(fields))
        known = [name for name in columns if name in COLUMNS]
        if known != list(dict.fromkeys(known)) or "center" not in known or "steering" not in known:
            raise RecordingError(
                f"{self.path}: line {line}: neither a row nor a header with center and steering: "
                f"{','.join(fields)[:80]!r}; a header is {','.join(COLUMNS)}"
            )
        if len(set(known)) < len(COLUMNS):  # some are not named: their places must be the usual ones
            start = columns.index("center")
            usual = (*columns[:start], *COLUMNS, *columns[start + 7 :])
            if len(columns) < start + 7 or any(a != b for a, b in zip(columns, usual, strict=True) if a in COLUMNS):
                missing = [name for name in COLUMNS if name not in known]
                raise RecordingError(f"{self.path}: line {line}: the header lacks {', '.join(missing)}; add them")
            columns = usual
            self.repair("header lacks names; usual places taken", line)
        return columns

    def row(self, line: int, names: list[str], tokens: list[str]) -> None:
        """Take a row whose columns are certain, if its four numbers are numbers and in range."""
        try:
            numbers = [float(token) for token in tokens]
        except ValueError:
            return self.reject(line, "not a number", f"{','.join(tokens).strip()!r}; correct or delete the row")
        steering, throttle, brake, speed = numbers
        if -1 <= steering <= 1 and -1 <= throttle <= 1 and -1 <= brake <= 1 and -100 <= speed <= 100:
            self.names += [name.encode(errors="surrogateescape") for name in names]
            self.numbers += numbers
            self.lines.append(line)
            return None
        name, value = next(
            (name, value)
            for name, value in zip(RANGES, numbers, strict=True)
            if not RANGES[name][0] <= value <= RANGES[name][1]
        )  # nan is in no range
        lost = " (has its decimal point been lost?)" if name == "speed" else ""
        return self.reject(
            line,
            f"{name} out of range",
            f"{name} {value:g} is not in {RANGES[name][0]}..{RANGES[name][1]}{lost}; correct or delete the row",
        )

    def finish(self) -> None:
        """Decide the rows with more than four numbers, now that it is known how the file writes fractions."""
        for line, names, tokens in self.waiting:
            if self.points:
                self.repair("extra columns ignored", line)
                self.row(line, names, tokens[:4])
                continue
            readings = _decimal_commas(tokens) if self.commas else []
            readings = [r for r in readings if not (float(r[1]) and float(r[2]))]  # one pedal at a time
            if len(readings) == 1:
                self.repair("decimal commas", line)
                self.row(line, names, readings[0])
            else:
                self.reject(
                    line,
                    "ambiguous columns",
                    f"{','.join(tokens)!r} can be read in {len(readings)} ways; "
                    "write decimal points, or delete the extra columns",
                )

    def reject(self, line: int, kind: str, detail: str) -> None:
        self.rejected.append((line, kind, detail))

    def repair(self, kind: str, line: int) -> None:
        self.repairs.setdefault(kind, [0, line])[0] += 1


def _base_name(path: str) -> str:
    return path.strip().replace("\\", "/").rsplit("/", 1)[-1]


def _is_image(name: str) -> bool:
    return name[-4:].lower() == ".jpg" or name[-5:].lower() == ".jpeg"


def _column(name: str) -> str | None:
    """The simulator's name for a header's: `Center`, `camera_center`, `ct_path`, `SteeringAngle` …"""
    name = name.lower().replace("centre", "center")
    words = {"ct": "center", "lt": "left", "rt": "right", "angle": "steering", "steer": "steering", "reverse": "brake"}
    for column in COLUMNS:
        if column in name:
            return column
    return next((column for word, column in words.items() if name.startswith(word)), None)


def _decimal_commas(tokens: list[str], names=COLUMNS[3:]) -> list[list[str]]:
    """All ways to read tokens, torn at decimal commas, as steering, throttle, brake and speed in their ranges.

    The simulator writes neither leading nor closing zeros: a fraction never ends with 0.
    """
    if not tokens or not names:
        return [] if tokens or names else [[]]
    readings, (least, greatest) = [], RANGES[names[0]]
    for size in range(1, min(len(tokens), 2) + 1):
        number = ".".join(tokens[:size])
        if WRITTEN.fullmatch(number) and least <= float(number) <= greatest:
            readings += [[number, *rest] for rest in _decimal_commas(tokens[size:], names[1:])]
    return readings


def _time_stamps(names: np.ndarray) -> np.ndarray:
    """Seconds since 1970 from names like center_2018_07_16_17_11_43_382.jpg, nan for others: float64 (m,)."""
    stamps = np.full((len(names), 23), ord(" "), np.uint8)
    for start in range(0, len(names), 65536):  # in pieces: a name is 36 bytes, a Python string of it 90
        part = [name.rsplit(b".", 1)[0][-23:].rjust(23) for name in names[start : start + 65536].tolist()]
        stamps[start : start + len(part)] = np.frombuffer(b"".join(part), np.uint8).reshape(-1, 23)
    separators = [4, 7, 10, 13, 16, 19]
    digits = np.delete(stamps, separators, axis=1)
    good = ((digits >= ord("0")) & (digits <= ord("9"))).all(1) & (stamps[:, separators] == ord("_")).all(1)
    stamps[:, separators] = np.frombuffer(b"--T::.", np.uint8)
    time = np.full(len(names), np.nan)
    try:
        time[good] = stamps[good].view("S23").ravel().astype("M8[ms]").astype(np.int64) / 1000
    except ValueError:  # a thirteenth month: the names are somebody's own
        return np.full(len(names), np.nan)
    return time
