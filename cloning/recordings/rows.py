"""Read the rows of `driving_log.csv`, whatever other programs have done to it: quotes, tabs, decimal commas, damage."""

import csv
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.outputs import plural
from cloning.recordings.columns import (
    FASTEST,
    NUMBER,
    REMEDY,
    WHOLE_NUMBER,
    Finding,
    Rejected,
    UnclearRowError,
    base_name,
    check_names,
    check_numbers,
    decimal_comma_readings,
    header_columns,
    is_header,
    is_image,
    number_ranges,
)
from cloning.recordings.format import CAMERAS, COLUMNS, DRIVING_LOG, LFS_POINTER, NOT_PULLED, NUMBERS

FOLDER = r'(?:[^,"/\\]*+[/\\])*+'  # of an image; nearly always the same for all three: \1, which is found faster
# A row as the simulator writes it: nearly all are, so these are read at once.
PLAIN_ROW = re.compile(
    rf" *+({FOLDER})(center(_[\d_]{{1,99}}\.jpg)) *, *+(?:\1|{FOLDER})(left\3) *, *+(?:\1|{FOLDER})(right\3) *"
    + rf", *({NUMBER.pattern}) *" * len(NUMBERS),
    re.ASCII,
)
MERGE_MARKERS = ("<<<<<<<", "|||||||", "=======", ">>>>>>>")  # what git leaves in a file with a conflict
BYTE_ORDER_MARK = "\ufeff"  # which some programs write at the beginning; files are also joined
NO_CONTENT = re.compile(r"(sep=.)?[\s\0\x1a,;]*", re.IGNORECASE)  # Excel's first line; \x1a: what copy adds at the end
DECIMAL_COMMA = re.compile(r"^([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)$", re.ASCII)
LONGEST_ROW = 20_000  # characters: more than three paths and some columns can have
LONGEST_LINE = 1 << 20  # at the end of a file that a crash has filled with zeros, there may be far more


def read_lines(path: Path) -> Iterator[str]:
    """Yield the csv's lines with their ends. Raises RecordingError if it cannot be read, or is not a text."""
    try:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: not a regular file; put the real {DRIVING_LOG} there")
        encoding = _encoding(path)
        errors = "surrogateescape" if encoding == "utf-8" else "replace"
        with open(path, encoding=encoding, errors=errors, newline="") as text:
            for at, line in enumerate(iter(partial(text.readline, LONGEST_LINE), ""), 1):
                if len(line) == LONGEST_LINE:
                    raise RecordingError(f"{path}: line {at}: longer than any row: not a csv; copy it again")
                yield line
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file; name the folder of a recording") from None
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; make it readable") from None


def _encoding(path: Path) -> str:
    """Return the csv's encoding, judged by its first bytes. Raises RecordingError if it is not text."""
    with open(path, "rb") as file:
        start = file.read(len(LFS_POINTER))
    if start == LFS_POINTER:
        raise RecordingError(f"{path}: line 1: {NOT_PULLED}")
    start = start[:4]
    if start == b"PK\x03\x04":
        raise RecordingError(f"{path}: line 1: an Excel workbook under a csv's name; open it and save it as CSV")
    if start == b"\x00\x05\x16\x07":
        raise RecordingError(f"{path}: line 1: a macOS resource file (AppleDouble); copy the real {DRIVING_LOG}")
    if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if len(start) == 4 and any(start[0::2]) != any(start[1::2]):  # every other byte is 0
        raise RecordingError(f"{path}: line 1: UTF-16 without a byte-order mark; save it as CSV in UTF-8")
    return "utf-8"


class RowReader:
    """Reads the lines of a csv in their order, and then returns their rows."""

    def __init__(self) -> None:
        self.rows_read = 0  # so far, usable or not
        self.repairs: dict[str, list[int]] = {}  # of rows that were interpreted: how -> [rows, first line]
        self.rejected: list[Rejected] = []  # rows that were left out
        self._columns: tuple[str, ...] = COLUMNS  # below the last header, as `header_columns` returns them
        self._headers = {0: False}  # line -> whether it names all columns; 0 for none
        self._lines: list[int] = []  # of the rows
        self._texts: list[str] = []  # of the rows, one after the other: three names and four numbers of each
        self._has_points = False  # a number with a decimal point has been seen
        self._with_commas: list[tuple[int, list[str], list[str]]] = []  # line, names and fields that may be numbers

    def read_line(self, line: int, text: str) -> None:
        """Read a line; line: its number in the csv, from 1.

        Raises UnclearLogError if it is an unusable header, or the first line and neither a row nor a header.
        """
        text = text.rstrip("\r\n").removeprefix(BYTE_ORDER_MARK)
        plain = PLAIN_ROW.fullmatch(text) if self._columns == COLUMNS else None
        if plain and ("." in text[plain.end(5) :] or "e" not in text[plain.end(6) :].lower()):
            self.rows_read += 1
            self._has_points = self._has_points or "." in text[plain.end(5) :]
            self._lines.append(line)
            self._texts += plain.group(2, 4, 5, 6, 7, 8, 9)
        elif text.startswith(MERGE_MARKERS):
            self._reject(line, Finding.MERGE_CONFLICT, f"{text[:20]!r}: resolve the merge, delete the line")
        elif not NO_CONTENT.fullmatch(text):
            try:
                self._read_odd_line(line, text)
            except UnclearRowError as error:
                self._reject(line, error.finding, str(error))
        elif "\0" in text:
            self._reject(line, Finding.NOT_A_ROW, "zeros: the file was cut off while it was written; delete the line")

    def finish(self, open_line: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the usable rows, in any order; open_line: the last line if it has no end, else 0.

        They are the file names of their images, bytes (n, 3), in the order of CAMERAS; steering, throttle, brake and
        speed, float64 (n, 4); and their lines in the csv, int32 (n,). Raises UnclearLogError if the numbers below a
        header, or without one, are not those of its columns.
        """
        self._read_decimal_commas()
        lines, count = np.array(self._lines, np.int32), len(self._lines)
        columns = [self._texts[at :: len(COLUMNS)] for at in range(len(COLUMNS))]
        images, tokens = columns[: len(CAMERAS)], columns[len(CAMERAS) :]
        numbers = np.array([np.fromiter(map(float, column), float, count) for column in tokens]).T
        below = np.searchsorted(list(self._headers), lines) - 1
        outside, is_named = np.zeros(numbers.shape, bool), list(self._headers.values())
        for header in np.flatnonzero(np.bincount(below)):  # np.unique would first import numpy.ma, which takes 40 ms
            rows = below == header
            outside[rows] = check_numbers(lines[rows], numbers[rows], is_named[header])
        usable = ~outside.any(1)
        for row in np.flatnonzero(~usable):
            column = outside[row].argmax()
            name = NUMBERS[column]
            least, greatest = number_ranges(is_named[below[row]])[name]
            lost = " (has its decimal point been lost, or is it in another unit?)" if name == "speed" else ""
            detail = f"{name} {numbers[row, column]:g} is not in {least}..{greatest}{lost}; correct or delete the row"
            self._reject(int(lines[row]), Finding.OUT_OF_RANGE, detail)
        if (fast := usable & (numbers[:, -1] > FASTEST)).any():
            told = f"speed above {FASTEST}, which the simulator's car never reaches, is taken for mph"
            self.repair(told, int(lines[fast].min()), int(fast.sum()))
        if open_line in lines[usable]:
            self.repair("the file ends within this line: its last number may be cut short", open_line)
        names = np.array([[name.encode(errors="surrogateescape") for name in column] for column in images], bytes).T
        return names[usable], numbers[usable], lines[usable]

    def _read_odd_line(self, line: int, text: str) -> None:
        """Read a line that is not as the simulator writes it. Raises UnclearRowError, UnclearLogError."""
        if len(text) > LONGEST_ROW:
            self.rows_read += 1
            raise UnclearRowError(Finding.NOT_A_ROW, f"a line of {len(text)} characters: {text[:40]!r}…; delete it")
        enough = [mark for mark in "\t;," if text.count(mark) >= len(COLUMNS) - 1]  # commas may also be decimal marks
        delimiter = enough[0] if enough else max(",;\t", key=text.count)
        folder = text[: text.find(CAMERAS[0])]
        is_whole = folder.endswith(("/", "\\")) and not folder.startswith('"')  # else quotes keep it together
        if "," in folder and is_whole and text.count(folder) == len(CAMERAS):
            text = text.replace(folder, "")  # "Doe, John"
        fields = [value.strip() for value in next(csv.reader([text], delimiter=delimiter, skipinitialspace=True))]
        is_first = not self.rows_read and len(self._headers) == 1
        if not any(map(is_image, fields)) and (is_header(fields) or is_first):
            return self._read_header(line, fields)
        self.rows_read += 1
        if delimiter != ",":
            self.repair("tab-separated" if delimiter == "\t" else "separated by semicolons", line)
        if delimiter != "," or '"' in text:  # else no field has a comma
            with_points = [DECIMAL_COMMA.sub(r"\1.\2", value) for value in fields]
            if with_points != fields:
                self.repair("decimal commas", line)
                fields = with_points
        has_decimal_commas = delimiter == "," and '"' not in text and fields[-1] != ""
        return self._read_row(line, fields, has_decimal_commas)

    def _read_header(self, line: int, fields: list[str]) -> None:
        while fields and not fields[-1]:
            fields.pop()  # a comma at its end names no column: a value below it is not read
        self._columns, is_filled = header_columns(line, fields)
        self._headers[line] = not is_filled
        if is_filled:
            self.repair("header lacks names; usual columns taken", line)

    def _read_row(self, line: int, fields: list[str], has_decimal_commas: bool) -> None:
        """Read a row; has_decimal_commas: it may have been split at them. Raises UnclearRowError."""
        columns = self._columns
        ends_empty = len(fields) > len(columns) > len(COLUMNS)
        while len(fields) > len(columns) and not fields[-1]:
            fields.pop()
        if len(fields) != len(columns):
            if ",".join(COLUMNS) not in ",".join(columns):
                raise UnclearRowError(
                    Finding.COLUMNS,
                    f"{len(fields)} fields below a header that names {len(columns)} in another order than the "
                    "simulator's; correct the header, or write one above these rows",
                )
            columns = COLUMNS
        by_name = dict(zip(columns, fields, strict=False))
        images, numbers = ([by_name.get(name, "") for name in names] for names in (CAMERAS, NUMBERS))
        if not all(map(is_image, images)):
            count = sum(map(is_image, fields))
            found = f"{'1 image name' if count == 1 else f'{count} image names'} where {', '.join(CAMERAS)} belong"
            remedy = f"record again, add them, or {REMEDY}"
            raise UnclearRowError(Finding.NOT_A_ROW, f"{found}; delete the row; if all are so, {remedy}")
        names, extra = [base_name(image) for image in images], fields[len(columns) :]
        check_names(names)
        tokens = [*numbers, *extra]
        if extra and has_decimal_commas and all(map(WHOLE_NUMBER.fullmatch, tokens)):
            self._with_commas.append((line, names, tokens))
            return
        self._has_points = self._has_points or any("." in token and NUMBER.fullmatch(token) for token in tokens)
        if any(map(is_image, extra)):  # files are also joined whose last line has no end
            raise UnclearRowError(Finding.COLUMNS, "two rows in one line; put a line break between them")
        if any(map(str.isdigit, "".join(extra))):
            raise UnclearRowError(
                Finding.COLUMNS,
                f"{len(tokens)} numbers where {len(NUMBERS)} are expected: {','.join(tokens)[:80]!r}; {REMEDY}",
            )
        if not all(map(NUMBER.fullmatch, numbers)):
            detail = f"{','.join(numbers)[:80]!r} is not {', '.join(NUMBERS)}; correct or delete the row"
            raise UnclearRowError(Finding.NOT_A_NUMBER, detail)
        text = ",".join(numbers)
        if "." not in text and (ends_empty or "e" in text.partition(",")[2].lower()):
            detail = f"{text!r} may be fewer numbers, one with a decimal comma; write decimal points, or {REMEDY}"
            raise UnclearRowError(Finding.COLUMNS, detail)
        if extra:
            self.repair("extra columns ignored", line)
        self._lines.append(line)
        self._texts += [*names, *numbers]

    def _read_decimal_commas(self) -> None:
        """Add the rows of more than four whole numbers, if they are surely four numbers with decimal commas.

        They are if no number in the file has a decimal point, each such row can be read in this way, and in one of them
        digits follow as only fractions have them: more than three, or after a zero.
        """
        readings = [decimal_comma_readings(tokens) for *_, tokens in self._with_commas]
        others = [line for (line, *_), found in zip(self._with_commas, readings, strict=True) if not found]
        later = [token for *_, tokens in self._with_commas for token in tokens[1:] if token.isdigit()]
        doubt = ""
        if self._has_points:
            doubt = ", but the file also has decimal points"
        elif others:
            doubt = f", but not those in line {others[0]}"
        elif not any(len(token) > 3 or token[0] == "0" < token[1:] for token in later):
            doubt = ", or more columns"
        elif all(len(tokens) == 2 * (len(NUMBERS) - 1) for *_, tokens in self._with_commas):
            doubt = ", or in each row three, all with one"
        for (line, names, tokens), found in zip(self._with_commas, readings, strict=True):
            if len(found) == 1 and not doubt:
                self.repair("decimal commas", line)
                self._lines.append(line)
                self._texts += [*names, *found[0]]
            else:
                reason = f"may be four numbers with decimal commas in {plural(len(found), 'way')}{doubt}"
                detail = f"{','.join(tokens)!r} {reason}; write decimal points, or {REMEDY}"
                self._reject(line, Finding.COLUMNS, detail)

    def _reject(self, line: int, finding: Finding, detail: str) -> None:
        self.rejected.append(Rejected(line, finding, detail))

    def repair(self, repair: str, line: int, rows: int = 1) -> None:
        """Note a repair, or what is assumed; line: of the first of so many rows."""
        self.repairs.setdefault(repair, [0, line])[0] += rows
