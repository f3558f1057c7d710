"""Decide what the columns of `driving_log.csv` mean, by evidence that must agree.

The evidence is the header, the cameras' names in the names of the images, the number of fields, and the numbers of all
rows of one shape: steering is signed, -1..1; the pedals are 0..1 and never pressed together; speed runs to 30 mph, and
falls when the car brakes. Where it disagrees, or leaves a choice, the rows are left out, and the reason says what would
settle it.

Some things leave no evidence. Without a header, or below one that was not meant for them: images in another order
without the cameras' names; numbers in another order while the car stands or never steers left, or together with decimal
commas; throttle and brake in another order in one of several merged logs, or while the car is slow; a number that is
missing or stands before the images, with another column in its place. Anywhere: another unit that stays within the
ranges, such as steering in radians, and steering positive to the left.
"""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cloning.recordings.format import CAMERAS, COLUMNS, MAX_NAME, NUMBERS, RANGES
from cloning.recordings.plain import PlainRows

SETTLE = f"name the columns in a header line above them, such as {','.join(COLUMNS)}"
SUFFIXES = (".jpg", ".jpeg")
CAMERA_WORD = re.compile(r"(?<![a-z])(cent(?:er|re)|left|right)(?![a-z])")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)
SIMULATOR_NUMBER = re.compile(r"-?(0|[1-9]\d*)(\.\d*[1-9])?(E[-+]?\d+)?", re.IGNORECASE | re.ASCII)
WORD = re.compile(r".*[^\W\d_]|\D*$", re.DOTALL)  # what has a letter, or no digit, if it is no number
OTHER_UNITS = re.compile(r"deg|rad|°|km|kph|m/s|mps|%|percent", re.IGNORECASE)
HEADER_WORDS = {  # beginnings of other names that headers have for the columns
    "ct": "center",
    "lt": "left",
    "rt": "right",
    "angle": "steering",
    "gas": "throttle",
    "steer": "steering",
    "reverse": "brake",
}
MOST_ERRORS = 0.01  # share of a column's values out of range; if there are more, the column is not what it is taken for
FAST = 10  # mph; a car that drives backwards, with the brake, is slower
# Share of the fast rows with the brake on in which the speed falls; in two real recordings 27 of 27 and 3 of 3.
LEAST_BRAKING = 0.75


class UnclearColumns(ValueError):
    """The evidence disagrees; `kind` is a short name of the reason, the message says what would settle it."""

    def __init__(self, kind: str, detail: str):
        """Keep the kind, and the detail as the message."""
        super().__init__(detail)
        self.kind = kind


@dataclass
class Shape:
    """The rows below one header line that have the same number of fields, with the images at the same places.

    columns  of the header: names of COLUMNS where it means them, its own for others; None without a header
    fields   number of fields in a row
    images   the places of the images' names among the fields
    lines    of the rows in the csv
    names    the images' names of each row, for the centre, left and right camera
    tokens   the fields that may be numbers, of each row: those that a header names steering, throttle, brake and speed,
             else all after the images
    plain    rows of the same shape that pandas has read
    """

    columns: tuple[str, ...] | None
    fields: int
    images: tuple[int, ...]
    lines: list[int] = field(default_factory=list)
    names: list[Sequence[str]] = field(default_factory=list)
    tokens: list[list[str]] = field(default_factory=list)
    plain: list[PlainRows] = field(default_factory=list)

    @property
    def is_named(self) -> bool:
        """Whether the header names each field."""
        return self.columns is not None and len(self.columns) == self.fields

    @property
    def is_usual(self) -> bool:
        """Whether the header, if there is one, names the simulator's columns in their order, none between them."""
        if self.columns is None:
            return True
        start = self.columns.index(COLUMNS[0])
        return self.columns[start : start + len(COLUMNS)] == COLUMNS

    @property
    def has_extra_columns(self) -> bool:
        """Whether a row has fields that no header names, beside the simulator's."""
        return not self.is_named and self.fields > len(COLUMNS)


def number(text: str) -> float:
    """Return a number as programs write it; nan for anything else, such as digits with underscores."""
    return float(text) if NUMBER.fullmatch(text) else math.nan


def base_name(path: str) -> str:
    """Return the file name at the end of a path with slashes or backslashes."""
    return path.strip().replace("\\", "/").rsplit("/", 1)[-1]


def is_image(name: str) -> bool:
    """Return whether a file name is that of a JPEG."""
    return name[-5:].lower().endswith(SUFFIXES)


def by_camera(names: Sequence[str]) -> Sequence[str]:
    """Return three names in the order of CAMERAS, by the cameras' names in them; as they are if there are none.

    Raises UnclearColumns if two are the same, only some contain a camera's name, or one is too long for a file.
    """
    if (longest := max(len(os.fsencode(name)) for name in names)) > MAX_NAME:
        raise UnclearColumns("name too long", f"an image name of {longest} bytes; correct or delete the row")
    if len(set(names)) < len(names):
        raise UnclearColumns("one image for two cameras", f"{', '.join(names)}: correct or delete the row")
    cameras = [camera_of(name) for name in names]
    if not any(cameras):
        return names
    if sorted(camera or "" for camera in cameras) != sorted(CAMERAS):
        raise UnclearColumns(
            "cameras unclear",
            f"{', '.join(names)}: these are not one image each of center, left and right; correct or delete the row",
        )
    return [names[cameras.index(camera)] for camera in CAMERAS]


def camera_of(name: str) -> str | None:
    """Return the camera that a file's name begins with or contains as a word; None if there is none, or several."""
    words = [word.replace("centre", "center") for word in CAMERA_WORD.findall(name.lower())]
    return words[0] if len(set(words)) == 1 or (words and CAMERA_WORD.match(name.lower())) else None


def is_header(fields: Sequence[str]) -> bool:
    """Return whether a line without images names columns: at least two of COLUMNS, or as many words in any language.

    A word that contains a point is a file and not a name.
    """
    words = [value for value in fields if value and "." not in value and math.isnan(number(value))]
    return len(words) >= len(COLUMNS) or len({_column(value) for value in words} - {None}) >= 2


def header_columns(fields: Sequence[str]) -> tuple[tuple[str, ...], bool]:
    """Return a header's columns, as Shape has them, and whether usual places were taken for names that it lacks.

    Raises UnclearColumns if it lacks columns whose places are not certain, or has other units.
    """
    columns = tuple(_column(value) or f"{value} ({at})" for at, value in enumerate(fields))
    known = [name for name in columns if name in COLUMNS]
    for name in COLUMNS:
        if known.count(name) > 1:
            same = [value for column, value in zip(columns, fields, strict=True) if column == name]
            raise UnclearColumns(
                "header unclear",
                f"{' and '.join(same)} both mean {name}; rename the one that the simulator didn't write",
            )
    if "center" not in known or "steering" not in known:
        raise UnclearColumns(
            "header unclear",
            f"neither a row nor a header with center and steering: {','.join(fields)[:80]!r}; "
            f"correct it: a header is {','.join(COLUMNS)}",
        )
    for name, value in zip(columns, fields, strict=True):
        if name in NUMBERS and OTHER_UNITS.search(value.lower().replace(name, "")):
            raise UnclearColumns(
                "other units",
                f"the header's {value!r} has another unit; steering is expected as -1..1 (1 is 25 degrees), pedals as "
                "0..1, speed in mph: convert the column and rename it",
            )
    if len(known) == len(COLUMNS):
        return columns, False
    start = columns.index("center")  # columns with a number or nothing for a name must be at the usual places
    usual = (*columns[:start], *COLUMNS, *columns[start + len(COLUMNS) :])
    if len(columns) != len(usual) or any(
        name != place and (name in COLUMNS or re.search("[^\\W\\d]", value))
        for name, place, value in zip(columns, usual, fields, strict=True)
    ):
        missing = [name for name in COLUMNS if name not in known]
        raise UnclearColumns("header unclear", f"the header lacks {', '.join(missing)}; add them")
    return usual, True


def check_places(shape: Shape) -> None:
    """Raise UnclearColumns if the places of the four numbers in a shape's rows are not certain.

    They are certain by a header that names each field; else they are the first four after the images, as the simulator
    writes them, unless another field could be one of them as well: only words and numbers out of all ranges could not.
    """
    if shape.is_named or not shape.tokens:
        return
    if not shape.is_usual:
        raise UnclearColumns(
            "columns unclear",
            f"{shape.fields} fields below a header that names {len(shape.columns or ())} in another order than the "
            "simulator's; correct the header, or write one above these rows",
        )
    for line, tokens in zip(shape.lines, shape.tokens, strict=True):
        for token in tokens[len(NUMBERS) :]:
            if _may_be_meant(token):
                raise UnclearColumns(
                    "columns unclear",
                    f"{len(tokens)} numbers where {len(NUMBERS)} are expected, and {token} in line {line} could be "
                    f"meant as well as the others; {SETTLE}",
                )


def _may_be_meant(token: str) -> bool:
    """Return whether a field may be one of the four numbers, perhaps with other separators or quotes around it."""
    value = number(token)
    if math.isnan(value):
        return not WORD.match(token)
    return any(least <= value <= greatest for least, greatest in RANGES.values())


def check_numbers(lines: np.ndarray, numbers: np.ndarray, is_named: bool) -> None:
    """Raise UnclearColumns if the numbers of a shape's rows show that its columns are others than they are taken for.

    lines: int (n,), in the csv; numbers: float (n, 4), in the order of NUMBERS, nan where there is none; is_named: by
    a header. A few steering angles or speeds out of range are taken for single errors. Negative pedals are not: they
    are what steering looks like in a pedal's column.
    """
    for name, column in zip(NUMBERS, numbers.T, strict=True):
        least, greatest = RANGES[name]
        outside = np.isfinite(column) & ((column < least) | (column > greatest))
        single = outside & (column > greatest) if name == "speed" else outside & (name == "steering")
        if (outside & ~single).any() or single.sum() > max(1, MOST_ERRORS * len(column)):
            at = np.flatnonzero(outside)[np.argmin(lines[outside])]
            raise UnclearColumns(
                "columns unclear",
                f"{name} is {column[at]:g} in line {lines[at]} and out of {least}..{greatest} in {outside.sum()} of "
                f"{len(column)} rows: is this column {name}, and in the simulator's unit? If only they are wrong, "
                f"delete those rows; if the unit is another one, convert the column; if it is another column, {SETTLE}",
            )
    throttle, brake = numbers[:, NUMBERS.index("throttle")], numbers[:, NUMBERS.index("brake")]
    both = (throttle > 0) & (brake > 0)
    if is_named or not (both.any() or brakes_most(numbers)):
        return
    if both.any():
        doubt = f"the brake is pressed with the throttle in line {lines[both].min()}"
    elif line := _keeps_its_speed(lines, brake, numbers[:, NUMBERS.index("speed")]):
        doubt = f"the brake is pressed more than the throttle, and the car is not seen to slow down in line {line}"
    else:
        return
    raise UnclearColumns("columns unclear", f"{doubt}: are they other columns, or in another order? {SETTLE}")


def brakes_most(numbers: np.ndarray) -> bool:
    """Return whether the brake is pressed more than the throttle; numbers: float (n, 4), as in `check_numbers`.

    So it is in a short recording of braking or of driving backwards, and where the two columns are exchanged.
    """
    return bool(np.nansum(numbers[:, NUMBERS.index("brake")]) > np.nansum(numbers[:, NUMBERS.index("throttle")]))


def _keeps_its_speed(lines: np.ndarray, brake: np.ndarray, speed: np.ndarray) -> int:
    """Return the first line in which a fast car is not seen to slow down with the brake on; 0 if it usually does."""
    order = np.argsort(lines)
    lines, brake, speed = lines[order], brake[order], speed[order]
    faster = np.diff(speed)
    fast = (np.diff(lines) == 1) & (brake[:-1] > 0) & (brake[1:] > 0) & (speed[:-1] > FAST) & np.isfinite(faster)
    braking = (brake > 0) & (speed > FAST)
    if not fast.any() and braking.any():  # in single rows only, which show no change of speed
        return int(lines[braking][0])
    keeps = fast & (faster >= 0)
    return int(lines[:-1][keeps][0]) if keeps.sum() > (1 - LEAST_BRAKING) * fast.sum() else 0


def decimal_comma_readings(tokens: list[str]) -> list[list[str]]:
    """Return all ways to join tokens, which were split at commas, into four numbers in their ranges.

    The simulator writes no trailing zeros: a fraction never ends with 0. It never has both pedals pressed.
    """
    return [row for row in _joined(tokens, NUMBERS) if not (float(row[1]) and float(row[2]))]


def _joined(tokens: list[str], names: tuple[str, ...]) -> list[list[str]]:
    if not tokens or not names:
        return [] if tokens or names else [[]]
    readings, (least, greatest) = [], RANGES[names[0]]
    for size in range(1, min(len(tokens), 2) + 1):
        joined = ".".join(tokens[:size])
        if SIMULATOR_NUMBER.fullmatch(joined) and least <= float(joined) <= greatest:
            readings += [[joined, *rest] for rest in _joined(tokens[size:], names[1:])]
    return readings


def _column(name: str) -> str | None:
    """Return the column that a word such as `camera_center`, `ct_path` or `SteeringAngle` means; None if unknown."""
    name = name.lower().replace("centre", "center")
    for column in COLUMNS:
        if column in name:
            return column
    return next((column for word, column in HEADER_WORDS.items() if name.startswith(word)), None)
