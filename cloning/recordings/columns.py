"""What the columns of `driving_log.csv` mean: only whole names are understood, nothing is looked for inside words.

Below a header, a column is taken if its whole name is understood. Without one, the columns are those that the simulator
writes: the images of the centre, left and right camera, then steering, throttle, brake and speed. An image is taken if
its file's whole name tells its camera. What is not understood is refused, and the message has the remedy.

Some things leave no evidence. Without a header that names all columns, or below one that was not meant for them:
numbers in another order, with another sign or in another unit that stay within the ranges, such as the km/h of a car
that hardly exceeds 20 mph. Below a header: values that are not what their column's name says, such as steering in
radians. That the car drives at most 30 mph is certain of the simulator's own logs, which have no header; below one, a
faster car is believed, and told.
"""

import itertools
import os
import re
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from cloning.recordings.format import CAMERAS, COLUMNS, IMAGE_FOLDER, MAX_NAME, NUMBERS, RANGES

REMEDY = (
    f"name the columns in a header line above the rows: {','.join(COLUMNS)}, in their order, other words for others; "
    "convert what is not steering -1..1, right positive, pedals 0..1, speed in mph"
)
# Before an exponent all programs write one digit, and then a point: 175494E-38 is a half of 1,175494E-38. Nor does one
# write 05: it is a half of 0,05.
NUMBER = re.compile(r"[-+]?(?:(?:\d(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|[1-9]\d*(?:\.\d*)?)", re.ASCII)
WHOLE_NUMBER = re.compile(r"[-+]?\d+(?:[eE][-+]?\d+)?", re.ASCII)  # or half a number, split at a decimal comma
SIMULATOR_NUMBER = re.compile(r"-?(?:(0|[1-9]\d*)(\.\d*[1-9])?|[1-9](\.\d*[1-9])?E[-+]?\d+)", re.IGNORECASE | re.ASCII)
IMAGE = re.compile(r"(center|centre|left|right)([\W\d_]*\.jpe?g)", re.IGNORECASE)  # no letters but these
FASTEST = 32  # mph: the simulator's car is clamped to 30; the largest speed in 6,706 rows of real recordings is 30.7
MOST_ERRORS = 0.01  # share of a column's values out of range; if there are more, the column is not what it is taken for

# The whole names that headers have for the columns, without the spaces, underscores and hyphens between words.
MEANINGS = {
    **{name: "steering" for name in ("steering", "steeringangle", "steer", "steerangle", "angle")},
    **{"throttle": "throttle", "gas": "throttle", "speed": "speed"},
    **{name: "brake" for name in ("brake", "break", "reverse")},  # many write Break
    **{"ctpath": "center", "ltpath": "left", "rtpath": "right"},
    **{
        name: camera
        for word, camera in {**dict(zip(CAMERAS, CAMERAS, strict=True)), "centre": "center"}.items()
        for image in ("", "camera", "image", "img", "path", "imagepath", "imgpath")
        for name in (word + image, image + word)
    },
}
BETWEEN_WORDS = re.compile(r"(?<=[a-z])[ _-]+(?=[a-z])")


class Finding(StrEnum):
    """Why a row is left out."""

    NOT_A_ROW = "not a row"
    MERGE_CONFLICT = "merge conflict"
    CAMERAS = "cameras unclear"
    COLUMNS = "columns unclear"
    NOT_A_NUMBER = "not a number"
    OUT_OF_RANGE = "out of range"
    CONTRADICTION = "one image, two angles"
    IMAGE_MISSING = "image missing"
    IMAGE_UNUSABLE = "image unusable"


class Rejected(NamedTuple):
    """A row that is left out: its line in the csv, from 1; why; and in words, with the remedy."""

    line: int
    finding: Finding
    detail: str


class UnclearLogError(ValueError):
    """What the columns of a log are is not understood; the message says in which line, and what would settle it."""


class UnclearRowError(ValueError):
    """A row is not understood; the message says what would settle it."""

    def __init__(self, finding: Finding, detail: str):
        super().__init__(detail)
        self.finding = finding


def base_name(path: str) -> str:
    """Return the file name at the end of a path with slashes or backslashes."""
    return path.strip().replace("\\", "/").rsplit("/", 1)[-1]


def is_image(path: str) -> bool:
    """Return whether a path is that of an image; `check_names` refuses all but JPEGs."""
    return path.lower().endswith((".jpg", ".jpeg", ".png", ".bmp"))


def check_names(names: Sequence[str]) -> None:
    """Raise UnclearRowError unless three file names are one moment's images of the centre, left and right camera."""
    moments = set()
    for name, camera in zip(names, CAMERAS, strict=True):
        if name.lower().endswith((".png", ".bmp")):
            remedy = f"convert the images, and name them .jpg, here and in {IMAGE_FOLDER}/"
            raise UnclearRowError(Finding.CAMERAS, f"{name[:MAX_NAME]}: not a JPEG; {remedy}")
        match = IMAGE.fullmatch(name)
        if not match or len(os.fsencode(name)) > MAX_NAME:
            raise UnclearRowError(
                Finding.CAMERAS,
                f"{name[:MAX_NAME]}: not understood as an image of the {camera} camera, such as "
                f"{camera}_2018_07_16_17_11_43_382.jpg; rename it, here and in {IMAGE_FOLDER}/; if it stands "
                f"in another camera's column, {REMEDY}",
            )
        if match[1].lower().replace("centre", "center") != camera:
            raise UnclearRowError(Finding.CAMERAS, f"{name}: not of the {camera} camera; delete the row, or {REMEDY}")
        moments.add(match[2])
    if len(moments) > 1:
        raise UnclearRowError(
            Finding.CAMERAS,
            f"{', '.join(names)} are of different times: has a column been sorted or moved by itself? Copy the csv "
            "again, or delete the row",
        )


def is_header(fields: Sequence[str]) -> bool:
    """Return whether a line without images names columns: two that are understood, or seven in any language."""
    words = [field for field in fields if any(map(str.isalpha, field)) and not re.search(r"\.\w", field)]
    return len(words) >= len(COLUMNS) or sum(column_of(field) != "" for field in fields) >= 2


def column_of(name: str) -> str:
    """Return the column that a header's whole name means, such as `camera_center` or `SteeringAngle`; else ""."""
    return MEANINGS.get(BETWEEN_WORDS.sub("", name.strip().lower()), "")


def header_columns(line: int, fields: Sequence[str]) -> tuple[tuple[str, ...], bool]:
    """Return a header's columns, with other words for other columns, and whether the pedals' were taken without names.

    They are if numbers or nothing stand for their names between steering and speed. line: in the csv, from 1. Raises
    UnclearLogError unless each column is named once.
    """
    named = ",".join("" if not field or field.isdecimal() else column_of(field) or "?" for field in fields)
    filled = named.replace("center,left,right,steering,,,speed", ",".join(COLUMNS))
    columns = tuple(filled.split(","))
    if wrong := [f"{name} {'twice' if name in columns else 'never'}" for name in COLUMNS if columns.count(name) != 1]:
        unknown = [repr(field) for field in fields if field and not column_of(field)]
        reason = f"; not understood: {', '.join(unknown)}" if unknown else ""
        if not any(map(column_of, fields)):
            wrong, reason = ["none (is it the right file?)"], ""
        raise UnclearLogError(
            f"line {line}: neither a row nor a header, which names each column once: {','.join(fields)[:200]!r} names "
            f"{', '.join(wrong)}{reason[:200]}; correct or delete this line; {REMEDY}",
        )
    return columns, filled != named


def number_ranges(is_named: bool) -> dict[str, tuple[int, int]]:
    """Return the least and greatest value of each column of numbers; is_named: all by a header."""
    return RANGES if is_named else RANGES | {"speed": (0, FASTEST)}


def check_numbers(lines: np.ndarray, numbers: np.ndarray, is_named: bool) -> np.ndarray:
    """Return which numbers are out of range: bool (n, 4).

    lines: int (n,), in the csv; numbers: float (n, 4), in the order of NUMBERS; is_named: all by a header. Raises
    UnclearLogError if they show that their columns or units are others than they are taken for. A few steering angles
    or speeds out of range are taken for single errors. Negative pedals are not: they are what steering looks like in a
    pedal's column. If not is_named, neither are pedals that are pressed together, which the simulator never writes,
    nor more braking than throttle, which may be the two in another order.
    """
    limits = np.array(list(number_ranges(is_named).values()))
    is_outside = (numbers < limits[:, 0]) | (numbers > limits[:, 1])
    for name, column, outside, (least, greatest) in zip(NUMBERS, numbers.T, is_outside.T, limits, strict=True):
        single = name == "steering" or (name == "speed" and column.min(initial=0) >= least)
        if outside.sum() > (max(1, MOST_ERRORS * len(column)) if single else 0):
            at = np.flatnonzero(outside)[np.argmin(lines[outside])]
            raise UnclearLogError(
                f"line {lines[at]}: {name} is {column[at]:g} here, and not in {least}..{greatest} in {outside.sum()} "
                f"of {len(column)} rows; delete them if only they are wrong; if it is another column or unit, {REMEDY}",
            )
    _, throttle, brake, _ = numbers.T
    both = (throttle > 0) & (brake > 0)
    if not is_named and (both.any() or brake.sum() > throttle.sum()):
        at = lines[both if both.any() else brake > 0].min()
        more = "more than the throttle in the rows without a header that names both"
        doubt = "with the throttle" if both.any() else more
        raise UnclearLogError(
            f"line {at}: the brake is pressed {doubt}: are they other columns, or in another order? If not, {REMEDY}",
        )
    return is_outside


def decimal_comma_readings(tokens: Sequence[str]) -> list[list[str]]:
    """Return all ways to join tokens, which were split at commas, into four numbers in their ranges.

    The simulator writes no trailing zeros: a fraction never ends with 0. It never has both pedals pressed.
    """
    readings = []
    for sizes in itertools.product((1, 2), repeat=len(NUMBERS)):
        ends = [0, *itertools.accumulate(sizes)]
        row = [".".join(tokens[start:end]) for start, end in itertools.pairwise(ends)]
        if ends[-1] == len(tokens) and all(map(SIMULATOR_NUMBER.fullmatch, row)):
            values = [float(text) for text in row]
            limits = zip(values, RANGES.values(), strict=True)
            if all(least <= value <= greatest for value, (least, greatest) in limits) and not (values[1] and values[2]):
                readings.append(row)
    return readings
