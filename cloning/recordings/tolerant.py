"""Read lines of `driving_log.csv` that are not plain: headers, quotes, tabs, extra columns, decimal commas, damage.

Rows are collected by their shape until the end of the file: only all of them together show what their columns mean, and
whether the file has decimal points or decimal commas.
"""

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.recordings.columns import (
    NUMBER,
    Shape,
    UnclearColumns,
    base_name,
    brakes_most,
    by_camera,
    check_numbers,
    check_places,
    decimal_comma_readings,
    header_columns,
    is_header,
    is_image,
    number,
)
from cloning.recordings.format import CAMERAS, COLUMNS, NUMBERS, RANGES
from cloning.recordings.plain import PlainRows

MERGE_MARKERS = ("<<<<<<<", "|||||||", "=======", ">>>>>>>")  # what git leaves in a file with a conflict
BYTE_ORDER_MARK = "\ufeff"  # which some programs write at the beginning; files are also joined
NO_CONTENT = re.compile(r"(sep=.)?[\s\0\x1a,;]*", re.IGNORECASE)  # Excel's first line; \x1a: what copy adds at the end
DECIMAL_COMMA = re.compile(r"^([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)$", re.ASCII)
LONGEST_LINE = 20_000  # characters: more than three paths and some columns can have


class TolerantReader:
    """Collects rows, repairs and rejected rows from the lines of a file, in their order; call `finish` at the end.

    rows      number of rows so far, usable or not
    names     file names of the images, three for each usable row, in one flat list
    numbers   steering, throttle, brake, speed of each usable row, in one flat list
    lines     line in the csv of each usable row
    plain     usable rows that pandas has read
    repairs   rows that were interpreted, by kind of repair: kind -> [rows, first line]
    rejected  rows that were left out: (line, kind, detail)
    header    line of the last header, 0 before the first
    """

    def __init__(self, path: Path):
        """path: the csv, which error messages name."""
        self.path, self.rows, self.header = path, 0, 0
        self.names: list[bytes] = []
        self.numbers: list[float] = []
        self.lines: list[int] = []
        self.plain: list[PlainRows] = []
        self.repairs: dict[str, list[int]] = {}
        self.rejected: list[tuple[int, str, str]] = []
        self._columns: tuple[str, ...] | None = None  # of the last header, if there was one
        self._shapes: dict[tuple[int, int, tuple[int, ...]], Shape] = {}  # by header, fields and images
        self._points = False  # a number with a decimal point has been seen
        self._commas = False  # a fraction after a decimal comma has been seen
        self._pointless: list[tuple[Shape, Shape, int, Sequence[str], list[str]]] = []  # see _read_decimal_commas

    @property
    def settled(self) -> bool:
        """Whether pandas may read plain lines, because it is known how the lines up to the next header are read.

        There are no decimal commas once there is a decimal point.
        """
        return self.rows > 0 and self._points and self._columns in (None, COLUMNS)

    def shape(self, fields: int = len(COLUMNS), images: tuple[int, ...] = (0, 1, 2)) -> Shape:
        """Return the shape of rows below the last header; by default, of the simulator's own rows."""
        key = (self.header, fields, images)
        if key not in self._shapes:
            self._shapes[key] = Shape(self._columns, fields, images)
        return self._shapes[key]

    def read_line(self, line: int, text: str) -> None:
        """Read a line; line: its number in the csv, from 1.

        Raises RecordingError if it is an unusable header, or the first line and neither a row nor a header.
        """
        text = text.removeprefix(BYTE_ORDER_MARK)
        fields = text.split(",")
        if len(fields) == len(COLUMNS) and '"' not in text and self._columns in (None, COLUMNS):
            names = [base_name(value) for value in fields[:3]]
            if is_image(names[0]) and is_image(names[1]) and is_image(names[2]):
                self.rows += 1
                self._points = self._points or "." in fields[3] or "." in fields[6]
                return self._collect(self.shape(), line, names, [token.strip() for token in fields[3:]])
        self._read_odd_line(line, text)

    def finish(self, open_line: int) -> None:
        """Interpret the rows, because all are known now; open_line: the last one if it has no line end, else 0."""
        self._read_decimal_commas()
        for shape in self._shapes.values():
            own = [[number(token) for token in tokens[: len(NUMBERS)]] for tokens in shape.tokens]
            lines = np.concatenate([np.array(shape.lines, np.int32), *(rows.lines for rows in shape.plain)])
            numbers = np.concatenate([np.reshape(own, (-1, len(NUMBERS))), *(rows.numbers for rows in shape.plain)])
            try:
                check_places(shape)
                check_numbers(lines, numbers, shape.columns is not None)
            except UnclearColumns as error:
                for line in lines.tolist():
                    self._reject(line, error.kind, str(error))
                continue
            if shape.columns is None and brakes_most(numbers):
                for line in sorted(lines.tolist()):
                    self._repair(
                        "the brake is pressed more than the throttle, as in braking or driving backwards", line
                    )
            self.plain += shape.plain
            for line, names, tokens, values in zip(shape.lines, shape.names, shape.tokens, own, strict=True):
                if shape.has_extra_columns:
                    self._repair("extra columns ignored", line)
                self._add_row(line, names, tokens[: len(NUMBERS)], values)
        if open_line in self.lines or any(open_line in rows.lines[-1:] for rows in self.plain):
            self._repair("the file ends within this line: its last number may be cut short", open_line)
        self.repairs = dict(sorted(self.repairs.items(), key=lambda item: item[1][1]))

    def _read_odd_line(self, line: int, text: str) -> None:
        """Read a line that is not seven plain columns: blank, a header, quoted, tabs, extra columns, decimal commas."""
        text = text.strip("\r\n")
        if NO_CONTENT.fullmatch(text):
            if "\0" in text:
                self._reject(line, "binary zeros", "the file was cut off while it was written; delete the line")
            return
        if text.startswith(MERGE_MARKERS):
            return self._reject(line, "merge conflict", f"{text[:20]!r}: resolve the merge, delete the line")
        if len(text) > LONGEST_LINE:
            self.rows += 1
            detail = f"a line of {len(text)} characters: {text[:40]!r}…; delete it"
            return self._reject(line, "not a row", detail)
        enough = [mark for mark in "\t;," if text.count(mark) >= len(COLUMNS) - 1]  # commas may also be decimal marks
        delimiter = enough[0] if enough else max(",;\t", key=text.count)
        fields = [value.strip() for value in next(csv.reader([text], delimiter=delimiter, skipinitialspace=True))]
        names = [base_name(value) for value in fields]
        images = tuple(at for at, name in enumerate(names) if is_image(name))
        if not images and (is_header(fields) or not (self.rows or self.header)):
            return self._read_header(line, fields)
        self.rows += 1
        if delimiter != ",":
            self._repair("tab-separated" if delimiter == "\t" else "separated by semicolons", line)
        if delimiter != "," or '"' in text:  # else no field has a comma
            with_points = [DECIMAL_COMMA.sub(r"\1.\2", value) for value in fields]
            if with_points != fields:
                self._repair("decimal commas", line)
                fields = with_points
        try:
            self._read_row(line, fields, images, delimiter == ",")
        except UnclearColumns as error:
            self._reject(line, error.kind, str(error))

    def _read_header(self, line: int, fields: list[str]) -> None:
        try:
            columns, usual_places_taken = header_columns(fields)
        except UnclearColumns as error:
            raise RecordingError(f"{self.path}: line {line}: {error}") from None
        self.header, self._columns = line, columns
        if usual_places_taken:
            self._repair("header lacks names; usual places taken", line)

    def _read_row(self, line: int, fields: list[str], images: tuple[int, ...], by_commas: bool) -> None:
        """Collect a row; images: their places; by_commas: the fields are separated by them.

        Raises UnclearColumns if it lacks images or numbers.
        """
        shape = self.shape(len(fields), images)
        if shape.is_named:
            by_name = dict(zip(self._columns or (), fields, strict=True))
            names = [base_name(by_name[name]) for name in CAMERAS]
            if not all(map(is_image, names)):
                raise UnclearColumns("not a row", f"{', '.join(names)}: not the three images that the header names")
            if fields[-1] and (self._columns or ("",))[-1] == f" ({len(fields) - 1})":
                raise UnclearColumns("columns unclear", f"{fields[-1]!r} is below a comma at the header's end; name it")
            tokens = [by_name[name] for name in NUMBERS]
            self._points = self._points or any("." in token for token in tokens)
            return self._collect(shape, line, names, tokens)
        if len(images) != len(CAMERAS):
            count = "1 image name" if len(images) == 1 else f"{len(images)} image names"
            raise UnclearColumns(
                "not a row",
                f"{count} where center, left and right are expected; record again, or add the columns",
            )
        names, tokens = [base_name(fields[at]) for at in images], fields[images[-1] + 1 :]
        if len(tokens) < len(NUMBERS):
            raise UnclearColumns(
                "columns missing",
                f"{len(tokens)} numbers where steering, throttle, brake, speed are expected; "
                "record again, or add the columns",
            )
        has_point = any("." in token and NUMBER.fullmatch(token) for token in tokens)
        self._points = self._points or has_point
        if len(tokens) > len(NUMBERS) and by_commas and not has_point:
            # Only the fractions of decimal commas have so many digits, or begin with zeros.
            self._commas = self._commas or any(
                token.isdigit() and (len(token) > 3 or token[0] == "0" < token[1:]) for token in tokens[1:]
            )
            self._pointless.append((shape, self.shape(), line, names, tokens))
        else:
            self._collect(shape, line, names, tokens)

    def _read_decimal_commas(self) -> None:
        """Collect the rows that may have decimal commas: those with more than four numbers and no decimal point.

        For each, the shape that it has as it stands, and the shape that it has if commas are decimal marks. A row whose
        numbers cannot be four with decimal commas shows that the rows have other columns.
        """
        readings = [decimal_comma_readings(tokens) for *_, tokens in self._pointless]
        other_columns = [
            line
            for (_, _, line, _, tokens), found in zip(self._pointless, readings, strict=True)
            if not found and not any(number(token) != number(token) for token in tokens)
        ]
        if self._points:
            hint = ", but the file also has decimal points"
        else:
            hint = f", but not those in line {other_columns[0]}" if other_columns else ""
        for (shape, joined, line, names, tokens), found in zip(self._pointless, readings, strict=True):
            if self._commas and not hint and len(found) == 1 and joined.is_usual:
                self._repair("decimal commas", line)
                self._collect(joined, line, names, found[0])
            elif self._commas or found:
                ways = f" in {len(found)} ways" if len(found) > 1 else ""
                reason = f"may be four numbers with decimal commas{ways}{hint}" if found else "are not four numbers"
                remedy = "write decimal points, or delete the extra columns"
                self._reject(line, "ambiguous columns", f"{','.join(tokens)!r} {reason}; {remedy}")
            else:
                self._collect(shape, line, names, tokens)

    def _collect(self, shape: Shape, line: int, names: Sequence[str], tokens: list[str]) -> None:
        """Add a row to its shape, with the images in the order of CAMERAS, unless the cameras are unclear."""
        try:
            ordered = by_camera(names)
            if ordered != names:
                if shape.columns is not None:
                    raise UnclearColumns(
                        "cameras unclear",
                        f"{', '.join(names)}: not in the header's order of cameras; correct the header or the row",
                    )
                self._repair("images in another order; ordered by the cameras in their names", line)
        except UnclearColumns as error:
            return self._reject(line, error.kind, str(error))
        shape.lines.append(line)
        shape.names.append(ordered)
        shape.tokens.append(tokens)
        return None

    def _add_row(self, line: int, names: Sequence[str], tokens: list[str], numbers: list[float]) -> None:
        """Add a row if its four tokens are numbers in their ranges, else reject it."""
        if any(value != value for value in numbers):
            return self._reject(line, "not a number", f"{','.join(tokens)!r}; correct or delete the row")
        for (name, (least, greatest)), value in zip(RANGES.items(), numbers, strict=True):
            if not least <= value <= greatest:
                lost = " (has its decimal point been lost?)" if name == "speed" else ""
                detail = f"{name} {value:g} is not in {least}..{greatest}{lost}; correct or delete the row"
                return self._reject(line, f"{name} out of range", detail)
        self.names += [name.encode(errors="surrogateescape") for name in names]
        self.numbers += numbers
        self.lines.append(line)
        return None

    def _reject(self, line: int, kind: str, detail: str) -> None:
        self.rejected.append((line, kind, detail))

    def _repair(self, kind: str, line: int) -> None:
        self.repairs.setdefault(kind, [0, line])[0] += 1
