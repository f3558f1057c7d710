"""Read the plain lines of `driving_log.csv` with pandas: three image names and four numbers that have one meaning only.

The bytes of a line decide whether it is plain, before pandas reads it. The tolerant reader reads all other lines.
"""

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from cloning.base.errors import RecordingError
from cloning.recordings.format import CAMERAS, COLUMNS, MAX_NAME, NUMBERS, RANGES

BLOCK = 2 << 20  # bytes read at a time, about 10,000 lines: so much that the 1 ms of each call of pandas hardly counts
COMMA, QUOTE, CARRIAGE_RETURN, NEW_LINE, SPACE, SLASH, BACKSLASH, DELETE = b',"\r\n /\\\x7f'
NEGATIVE_ZERO = re.compile(rb"-0+(?![0-9.])")  # would lose its sign in a column that pandas reads as integers
LONGEST_LINE = 1 << 20  # bytes; at the end of a file that a crash has filled with zeros, there may be far more
SUFFIXES = (b".jpg", b".JPG", b".jpeg", b".JPEG")
PREFIXES = np.array([f"{camera}_".encode() for camera in CAMERAS])
LEAST, GREATEST = np.array([RANGES[name] for name in NUMBERS], float).T

# Characters that no plain line contains: quotes, and control characters, some of which are blanks for Python alone.
ODD = np.zeros(256, bool)
ODD[:32] = True
ODD[[CARRIAGE_RETURN, NEW_LINE]] = False
ODD[[QUOTE, DELETE]] = True


@dataclass
class PlainRows:
    """Rows of plain lines.

    names    bytes (n, 3): file names of the centre, left and right image
    numbers  float64 (n, 4): steering, throttle, brake, speed, in their ranges
    lines    int32 (n,): line in the csv, from 1
    """

    names: np.ndarray
    numbers: np.ndarray
    lines: np.ndarray

    def above(self, line: int) -> "PlainRows":
        """Return the rows above a line."""
        count = int(np.searchsorted(self.lines, line))
        return PlainRows(self.names[:count], self.numbers[:count], self.lines[:count])


def read_blocks(path: Path) -> Iterator[bytes]:
    """Yield the csv in blocks of whole lines.

    Raises RecordingError if a line is too long for any csv.
    """
    with open(path, "rb") as file:
        while block := file.read(BLOCK) + (rest := file.readline(LONGEST_LINE)):
            if len(rest) == LONGEST_LINE:
                raise RecordingError(f"{path}: a line of more than {LONGEST_LINE} bytes: not a csv; copy it again")
            yield block


def line_starts(block: bytes) -> np.ndarray:
    """Return the index of each line's first byte, and the block's length: int64 (lines + 1,).

    Lines end with LF, CRLF or a single CR, as in Python's universal newlines.
    """
    text = np.frombuffer(block, np.uint8)
    ends = text == NEW_LINE
    if b"\r" in block:
        ends |= (text == CARRIAGE_RETURN) & ~np.append(ends[1:], False)
    starts = np.append(0, np.flatnonzero(ends) + 1)
    return starts if starts[-1] == len(block) else np.append(starts, len(block))


def read_plain(block: bytes, starts: np.ndarray, first_line: int) -> tuple[np.ndarray, PlainRows]:
    """Return which lines of a block are plain, bool (lines,), and the rows read from these.

    starts: as `line_starts` returns them; first_line: the number of the block's first line in the csv.
    A line is plain if the tolerant reader would certainly read the same row from it. If any number of the block is
    not a number, or is -0, none of its lines counts as plain.
    """
    is_plain, commas = _seven_fields(block, starts)
    if not is_plain.all():
        block = np.frombuffer(block, np.uint8)[np.repeat(is_plain, np.diff(starts))].tobytes()
        starts = line_starts(block)
        _, commas = _seven_fields(block, starts)
    table = None if not block or NEGATIVE_ZERO.search(block) else _read_numbers(block)
    if table is None or any(dtype.kind not in "if" for dtype in table.dtypes):  # words such as True
        return np.zeros_like(is_plain), PlainRows(np.empty((0, 3), "S1"), np.empty((0, 4)), np.empty(0, np.int32))
    numbers = np.column_stack([table[name].to_numpy(float) for name in NUMBERS])
    commas = commas.reshape(-1, len(COLUMNS) - 1)
    fields = np.column_stack([starts[:-1], commas[:, : len(CAMERAS) - 1] + 1])
    names, is_image = _image_names(block, fields.ravel(), commas[:, : len(CAMERAS)].ravel())
    names, is_image = names.reshape(-1, len(CAMERAS)), is_image.reshape(-1, len(CAMERAS))
    in_range = (numbers >= LEAST) & (numbers <= GREATEST)  # nan is in no range
    is_image &= np.strings.startswith(names, PREFIXES)
    usable = is_image.all(1) & in_range.all(1)
    is_plain[is_plain] = usable
    lines = first_line + np.flatnonzero(is_plain)
    return is_plain, PlainRows(names[usable], numbers[usable], lines.astype(np.int32))


def _seven_fields(block: bytes, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which lines have seven fields and no odd character, bool (lines,), and the indices of all commas."""
    text = np.frombuffer(block, np.uint8)
    commas = np.flatnonzero(text == COMMA)
    is_plain = np.diff(np.searchsorted(commas, starts)) == len(COLUMNS) - 1
    odd = np.flatnonzero(ODD[text])
    is_plain[np.searchsorted(starts, odd, side="right") - 1] = False
    return is_plain, commas


def _image_names(block: bytes, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the file names at the end of paths, bytes (n,), and which are ASCII names of a JPEG, bool (n,).

    starts, ends: int (n,), of the paths in the block. A name that is too long for a file is cut.
    """
    text = np.frombuffer(block, np.uint8)
    slashes = np.append(-1, np.flatnonzero((text == SLASH) | (text == BACKSLASH)))
    starts = starts.copy()
    while (blank := text[starts] == SPACE).any():
        starts += blank
    starts = np.maximum(starts, slashes[np.searchsorted(slashes, ends) - 1] + 1)
    lengths = ends - starts
    width = int(np.clip(lengths.max(), 1, MAX_NAME))
    padded = np.append(text, np.zeros(width, np.uint8))
    characters = np.lib.stride_tricks.sliding_window_view(padded, width)[starts]
    characters[np.arange(width) >= lengths[:, None]] = 0
    names = characters.view(f"S{width}").ravel()
    is_image = np.logical_or.reduce([np.strings.endswith(names, suffix) for suffix in SUFFIXES])
    return names, is_image & (lengths <= MAX_NAME) & (characters < DELETE).all(1)


def _read_numbers(text: bytes) -> pd.DataFrame:
    """Return the table of NUMBERS of plain lines: int64 or float64 where all of a column are numbers."""
    return pd.read_csv(
        io.BytesIO(text),
        engine="c",
        header=None,
        names=list(COLUMNS),
        usecols=list(NUMBERS),  # no dtype: as float, True would become 1
        encoding="latin-1",  # of the paths, which are not read
        skipinitialspace=True,
        quoting=csv.QUOTE_NONE,
        na_filter=False,
        low_memory=False,
    )


def as_narrow_as_possible(names: np.ndarray) -> np.ndarray:
    """Return the names, bytes of any shape, in an array whose items are as long as the longest name."""
    return names.astype(f"S{max(1, np.strings.str_len(names).max(initial=0))}")
