"""Read lines of `driving_log.csv` that are not plain: headers, quotes, tabs, extra columns, decimal commas, damage.

Most lines are interpreted one by one. A line with more than four numbers has to wait for the end of the file: only then
is it known whether the file has decimal points or decimal commas.
"""

import csv
import re
from pathlib import Path

from cloning.errors import RecordingError
from cloning.recordings.format import CAMERAS, COLUMNS, NUMBERS, RANGES

SIMULATOR_NUMBER = re.compile(r"-?(0|[1-9]\d*)(\.\d*[1-9])?(E[-+]?\d+)?", re.IGNORECASE)  # as the simulator writes it
MERGE_MARKERS = ("<<<<<<<", "=======", ">>>>>>>")  # what git leaves in a file with a conflict
HEADER_WORDS = {  # beginnings of other names that headers have for the columns
    "ct": "center",
    "lt": "left",
    "rt": "right",
    "angle": "steering",
    "steer": "steering",
    "reverse": "brake",
}


class TolerantReader:
    """Collects rows, repairs and rejected rows from the lines of a file, in their order; call `finish` at the end.

    rows      number of rows so far, usable or not
    names     file names of the images, three for each usable row, in one flat list
    numbers   steering, throttle, brake, speed of each usable row, in one flat list
    lines     line in the csv of each usable row
    repairs   rows that were interpreted, by kind of repair: kind -> [rows, first line]
    rejected  rows that were left out: (line, kind, detail)
    """

    def __init__(self, path: Path):
        """path: the csv, which error messages name."""
        self.path, self.rows = path, 0
        self.names: list[bytes] = []
        self.numbers: list[float] = []
        self.lines: list[int] = []
        self.repairs: dict[str, list[int]] = {}
        self.rejected: list[tuple[int, str, str]] = []
        self._columns: tuple[str, ...] | None = None  # of the header, if there is one
        self._points = False  # a number with a decimal point has been seen
        self._commas = False  # a fraction after a decimal comma has been seen
        self._undecided: list[tuple[int, list[str], list[str]]] = []  # line, names, numbers

    @property
    def settled(self) -> bool:
        """Whether plain lines can no longer change how other lines are read, so that pandas may read them.

        There is no header after the first row, and there are no decimal commas once there is a decimal point.
        """
        return self.rows > 0 and self._points and self._columns in (None, COLUMNS)

    def read_line(self, line: int, text: str) -> None:
        """Read a line; line: its number in the csv, from 1.

        Raises RecordingError if the first line is neither a row nor a usable header.
        """
        fields = text.split(",")
        if len(fields) == len(COLUMNS) and '"' not in text and self._columns in (None, COLUMNS):
            names = [_base_name(value) for value in fields[:3]]
            if _is_image(names[0]) and _is_image(names[1]) and _is_image(names[2]):
                self.rows += 1
                self._points = self._points or "." in fields[3] or "." in fields[6]
                return self._add_row(line, names, fields[3:])
        self._read_odd_line(line, text)

    def finish(self) -> None:
        """Interpret the rows with more than four numbers, because it is known now how the file writes fractions."""
        for line, names, tokens in self._undecided:
            if self._points:
                self._repair("extra columns ignored", line)
                self._add_row(line, names, tokens[:4])
                continue
            readings = _decimal_comma_readings(tokens) if self._commas else []
            readings = [
                numbers for numbers in readings if not (float(numbers[1]) and float(numbers[2]))
            ]  # never both pedals
            if len(readings) == 1:
                self._repair("decimal commas", line)
                self._add_row(line, names, readings[0])
            else:
                self._reject(
                    line,
                    "ambiguous columns",
                    f"{','.join(tokens)!r} can be read in {len(readings)} ways; "
                    "write decimal points, or delete the extra columns",
                )

    def _read_odd_line(self, line: int, text: str) -> None:
        """Read a line that is not seven plain columns: blank, a header, quoted, tabs, extra columns, decimal commas."""
        text = text.strip("\r\n")
        if not text.strip("\0 \t,;"):
            if "\0" in text:
                self._reject(line, "binary zeros", "the file was cut off while it was written; delete the line")
            return
        if text.startswith(MERGE_MARKERS):
            return self._reject(line, "merge conflict", f"{text[:20]!r}: resolve the merge, delete the line")
        delimiter = max(",;\t", key=text.count) if text.count(",") < 6 else ","
        fields = [value.strip() for value in next(csv.reader([text], delimiter=delimiter))]
        names = [_base_name(value) for value in fields]
        images = [at for at, name in enumerate(names) if _is_image(name)]
        if not images and not self.rows and self._columns is None:
            self._columns = self._header(line, fields)
            return None
        self.rows += 1
        if delimiter != ",":
            self._repair("tab-separated" if delimiter == "\t" else "separated by semicolons", line)
            if any("," in value for value in fields[images[-1] + 1 :] if images):
                self._repair("decimal commas", line)
                fields = [value.replace(",", ".") for value in fields]
        if self._columns and len(fields) == len(self._columns):
            by_name = dict(zip(self._columns, fields, strict=True))
            names = [_base_name(by_name[name]) for name in CAMERAS]
            return self._add_row(line, names, [by_name[name] for name in NUMBERS])
        if len(images) != 3:
            count = "1 image name" if len(images) == 1 else f"{len(images)} image names"
            return self._reject(
                line,
                "not a row",
                f"{count} where center, left and right are expected; record again, or add the columns",
            )
        names, tokens = [names[at] for at in images], fields[images[-1] + 1 :]
        self._points = self._points or any("." in token for token in tokens)
        self._commas = self._commas or any(
            token.isdigit() and (len(token) > 3 or token[0] == "0" < token[1:]) for token in tokens[1:]
        )
        if len(tokens) == 4:
            return self._add_row(line, names, tokens)
        if len(tokens) < 4:
            return self._reject(
                line,
                "columns missing",
                f"{len(tokens)} numbers where steering, throttle, brake, "
                "speed are expected; record again, or add the columns",
            )
        self._undecided.append((line, names, tokens))
        return None

    def _header(self, line: int, fields: list[str]) -> tuple[str, ...]:
        """Return the names of the header's columns: those of COLUMNS where it means them, its own for others.

        Raises RecordingError if the header lacks columns, unless their positions are certain.
        """
        columns = tuple(_column(value) or f"{value} ({at})" for at, value in enumerate(fields))
        known = [name for name in columns if name in COLUMNS]
        if known != list(dict.fromkeys(known)) or "center" not in known or "steering" not in known:
            raise RecordingError(
                f"{self.path}: line {line}: neither a row nor a header with center and steering: "
                f"{','.join(fields)[:80]!r}; a header is {','.join(COLUMNS)}"
            )
        if len(known) < len(COLUMNS):  # unnamed columns must be at the usual positions
            start = columns.index("center")
            usual = (*columns[:start], *COLUMNS, *columns[start + len(COLUMNS) :])
            if len(columns) != len(usual) or any(
                name != place for name, place in zip(columns, usual, strict=True) if name in COLUMNS
            ):
                missing = [name for name in COLUMNS if name not in known]
                raise RecordingError(f"{self.path}: line {line}: the header lacks {', '.join(missing)}; add them")
            columns = usual
            self._repair("header lacks names; usual places taken", line)
        return columns

    def _add_row(self, line: int, names: list[str], tokens: list[str]) -> None:
        """Add a row if its four tokens are numbers in their ranges, else reject it."""
        try:
            numbers = [float(token) for token in tokens]
        except ValueError:
            return self._reject(line, "not a number", f"{','.join(tokens).strip()!r}; correct or delete the row")
        for (name, (least, greatest)), value in zip(RANGES.items(), numbers, strict=True):
            if not least <= value <= greatest:  # nan is in no range
                lost = " (has its decimal point been lost?)" if name == "speed" else ""
                return self._reject(
                    line,
                    f"{name} out of range",
                    f"{name} {value:g} is not in {least}..{greatest}{lost}; correct or delete the row",
                )
        self.names += [name.encode(errors="surrogateescape") for name in names]
        self.numbers += numbers
        self.lines.append(line)
        return None

    def _reject(self, line: int, kind: str, detail: str) -> None:
        self.rejected.append((line, kind, detail))

    def _repair(self, kind: str, line: int) -> None:
        self.repairs.setdefault(kind, [0, line])[0] += 1


def _base_name(path: str) -> str:
    return path.strip().replace("\\", "/").rsplit("/", 1)[-1]


def _is_image(name: str) -> bool:
    return name[-4:].lower() == ".jpg" or name[-5:].lower() == ".jpeg"


def _column(name: str) -> str | None:
    """Return the column that a word such as `camera_center`, `ct_path` or `SteeringAngle` means; None if unknown."""
    name = name.lower().replace("centre", "center")
    for column in COLUMNS:
        if column in name:
            return column
    return next((column for word, column in HEADER_WORDS.items() if name.startswith(word)), None)


def _decimal_comma_readings(tokens: list[str], names: tuple[str, ...] = NUMBERS) -> list[list[str]]:
    """Return all ways to join tokens, which were split at commas, into numbers of these columns in their ranges.

    The simulator writes no trailing zeros: a fraction never ends with 0.
    """
    if not tokens or not names:
        return [] if tokens or names else [[]]
    readings, (least, greatest) = [], RANGES[names[0]]
    for size in range(1, min(len(tokens), 2) + 1):
        number = ".".join(tokens[:size])
        if SIMULATOR_NUMBER.fullmatch(number) and least <= float(number) <= greatest:
            readings += [[number, *rest] for rest in _decimal_comma_readings(tokens[size:], names[1:])]
    return readings
