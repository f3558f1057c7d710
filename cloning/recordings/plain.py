"""Read the plain lines of `driving_log.csv` with pandas: three image names and four numbers that have one meaning only.

The bytes of a line decide whether it is plain, before pandas reads it. The tolerant reader reads all other lines.
"""

import codecs
import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from cloning.recordings.format import CAMERAS, COLUMNS, NUMBERS, RANGES

BLOCK = 2 << 20  # bytes read at a time, about 10,000 lines: so much that the 1 ms of each call of pandas hardly counts
COMMA, QUOTE, CARRIAGE_RETURN, NEW_LINE, DELETE = b',"\r\n\x7f'
NEGATIVE_ZERO = re.compile(rb"-0+(?![0-9.])")  # would lose its sign in a column that pandas reads as integers
SUFFIXES = (b".jpg", b".JPG", b".jpeg", b".JPEG")
LEAST, GREATEST = np.array([RANGES[name] for name in NUMBERS], float).T

# Characters that no plain line contains: quotes, and control characters, some of which are blanks for Python alone.
ODD = np.zeros(256, bool)
ODD[:32] = True
ODD[[CARRIAGE_RETURN, NEW_LINE]] = False
ODD[[QUOTE, DELETE]] = True

# For pandas, \ becomes / and all that is not ASCII becomes DELETE, which may be in a folder's name but not an image's.
TO_ASCII = bytes.maketrans(b"\\" + bytes(range(128, 256)), b"/" + bytes([DELETE]) * 128)


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


def read_blocks(path: Path) -> Iterator[bytes]:
    """Yield the csv in blocks of whole lines, without the byte order mark that some programs write at its beginning."""
    with open(path, "rb") as file:
        if file.read(len(codecs.BOM_UTF8)) != codecs.BOM_UTF8:
            file.seek(0)
        while block := file.read(BLOCK) + file.readline():
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
    is_plain = _has_seven_fields(block, starts)
    if not is_plain.all():
        block = np.frombuffer(block, np.uint8)[np.repeat(is_plain, np.diff(starts))].tobytes()
    table = None if not block or NEGATIVE_ZERO.search(block) else _read_table(block)
    if table is None or any(table[name].dtype.kind not in "if" for name in NUMBERS):  # words such as True
        return np.zeros_like(is_plain), PlainRows(np.empty((0, 3), "S1"), np.empty((0, 4)), np.empty(0, np.int32))
    paths = np.column_stack([table[camera].to_numpy().astype(bytes) for camera in CAMERAS])
    names = np.strings.slice(paths, np.strings.rfind(paths, b"/") + 1, paths.itemsize)
    numbers = np.column_stack([table[name].to_numpy(float) for name in NUMBERS])
    is_image = np.logical_or.reduce([np.strings.endswith(names, suffix) for suffix in SUFFIXES])
    is_image &= np.strings.find(names, bytes([DELETE])) < 0
    in_range = (numbers >= LEAST) & (numbers <= GREATEST)  # nan is in no range
    usable = is_image.all(1) & in_range.all(1)
    is_plain[is_plain] = usable
    lines = first_line + np.flatnonzero(is_plain)
    return is_plain, PlainRows(as_narrow_as_possible(names[usable]), numbers[usable], lines.astype(np.int32))


def _has_seven_fields(block: bytes, starts: np.ndarray) -> np.ndarray:
    """Return which lines have seven fields and no odd character: bool (lines,)."""
    text = np.frombuffer(block, np.uint8)
    commas = np.diff(np.searchsorted(np.flatnonzero(text == COMMA), starts))
    odd = np.flatnonzero(ODD[text])
    is_plain = commas == len(COLUMNS) - 1
    is_plain[np.searchsorted(starts, odd, side="right") - 1] = False
    return is_plain


def _read_table(text: bytes) -> pd.DataFrame:
    """Return plain lines as a table of COLUMNS: paths with /, and the others as int64 or float64 if all are numbers."""
    return pd.read_csv(
        io.BytesIO(text.translate(TO_ASCII)),
        engine="c",
        header=None,
        names=list(COLUMNS),
        dtype=dict.fromkeys(CAMERAS, object),  # no dtype for the numbers: as float, True would become 1
        skipinitialspace=True,
        quoting=csv.QUOTE_NONE,
        na_filter=False,
        low_memory=False,
    )


def as_narrow_as_possible(names: np.ndarray) -> np.ndarray:
    """Return the names, bytes of any shape, in an array whose items are as long as the longest name."""
    return names.astype(f"S{max(1, np.strings.str_len(names).max(initial=0))}")
