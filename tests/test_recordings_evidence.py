"""Logs in every shape that programs give them, written by hypothesis: read right, or refused, never silently wrong."""

import itertools
import os
import string
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, event, given, settings
from hypothesis import strategies as st

from cloning.base.errors import RecordingError
from cloning.recordings.log import read_recording

CAMERAS = ("center", "left", "right")
NUMBERS = ("steering", "throttle", "brake", "speed")
USUAL = (*CAMERAS, *NUMBERS)
HEADER_NAMES = {
    "center": ["center", "Center", "camera_center", "ct_path", "centre image"],
    "left": ["left", "Left", "camera_left", "lt_path"],
    "right": ["right", "Right", "camera_right", "rt_path"],
    "steering": ["steering", "SteeringAngle", "steer", "angle"],
    "throttle": ["throttle", "Throttle"],
    "brake": ["brake", "Brake", "reverse"],
    "speed": ["speed", "Speed"],
}
EXAMPLES = int(os.environ.get("LOG_EXAMPLES", 200))  # 10,000 take about 6 minutes


@dataclass
class Part:
    """One program's log: the rows' values and how they are written; several are merged into one file.

    order     the columns' names in their order; names that are no columns are extra ones
    header    its line, or None
    values    of each row: column -> number, or text of an extra column
    images    of each row: camera -> file name
    """

    order: tuple[str, ...]
    header: list[str] | None
    values: list[dict]
    images: list[dict[str, str]]
    folder: str
    separator: str
    mark: str
    digits: str
    end: str
    quoted: bool
    trailing: str

    def lines(self):
        """The text of each line, and the row that it holds: None for the header."""
        if self.header is not None:
            yield self.joined(self.header), None
        for values, images in zip(self.values, self.images, strict=True):
            fields, row = [], []
            for column in self.order:
                if column in CAMERAS:
                    fields.append(self.folder + images[column])
                elif isinstance(values[column], str):
                    fields.append(values[column])
                else:
                    fields.append(self.written(values[column]).replace(".", self.mark))
            row = [images[camera] for camera in CAMERAS], [float(self.written(values[name])) for name in NUMBERS]
            yield self.joined(fields), row

    def joined(self, fields):
        fields = [f'"{value}"' for value in fields] if self.quoted else fields
        return self.separator.join(fields) + self.trailing + self.end

    def written(self, value):
        """As C# writes a float, as Python does, or with four decimals."""
        return f"{value:.7G}" if self.digits == "C#" else repr(value) if self.digits == "Python" else f"{value:.4f}"


def steering_angles(signed):
    angle = st.one_of(st.just(0.0), st.sampled_from([-1.0, -0.5, -0.05, 0.05, 0.25, 1.0]), st.floats(-1, 1, width=32))
    return angle if signed else angle.map(abs)


@st.composite
def rows(draw, size, must_be_signed, must_accelerate):
    """Values as the simulator writes them: the pedals are never pressed together."""
    values = []
    moves = draw(st.booleans())
    for _ in range(size):
        pedal = draw(st.one_of(st.sampled_from([0.0, 1.0, 0.3]), st.floats(-1, 1, width=32)))
        values.append(
            {
                "steering": draw(steering_angles(True)),
                "throttle": max(pedal, 0.0),
                "brake": max(-pedal, 0.0) if draw(st.booleans()) else 0.0,
                "speed": draw(st.one_of(st.sampled_from([0.0, 9.0, 30.19, 6.9e-05]), st.floats(0, 31, width=32)))
                if moves
                else draw(st.floats(0, 1, width=32)),
            }
        )
    if must_be_signed:
        values[draw(st.integers(0, size - 1))]["steering"] = -draw(st.sampled_from([0.05, 0.3, 0.9]))
    if must_accelerate:
        for value in values:
            value.update(throttle=0.5, brake=0.0, speed=15.0 + values.index(value))
    return values


@st.composite
def parts(draw, start):
    """A part whose rows have time stamps from `start` on."""
    headed = draw(st.booleans())
    numbers = draw(st.one_of(st.just(NUMBERS), st.permutations(NUMBERS).map(tuple)))
    worded = draw(st.booleans()) or draw(st.booleans())
    cameras = draw(st.one_of(st.just(CAMERAS), st.permutations(CAMERAS).map(tuple))) if worded or headed else CAMERAS
    order = [*cameras, *numbers]
    if headed and draw(st.integers(0, 5)) == 0:
        order = draw(st.permutations(order))
    for number in range(draw(st.sampled_from([0, 0, 0, 1, 1, 2]))):
        order.insert(draw(st.integers(0, len(order))), f"extra{number}")
    extras = [name for name in order if name.startswith("extra")]
    if draw(st.integers(0, 9)) == 0 and (headed or len(order) == len(USUAL)):
        order.remove(draw(st.sampled_from(order)))
    size = draw(st.integers(2, 12))
    unnamed = not headed and numbers != NUMBERS  # which only signs, ranges and fields can show
    values = draw(rows(size, unnamed, unnamed))
    for extra in extras:
        kind = draw(st.sampled_from(["unit", "lap", "constant", "count", "word", "large", "zero"]))
        constant = draw(st.sampled_from([0, 1, 3, 0.5, 19, -0.5]))
        for at, value in enumerate(values):
            value[extra] = {
                "unit": draw(st.floats(-1, 1, width=32)),
                "lap": at / 3,
                "constant": constant,
                "count": at,
                "word": draw(st.text(string.ascii_letters + " :", max_size=8)),
                "large": 1e5 + at,
                "zero": 0,
            }[kind]
    header = None
    if headed:
        header = [draw(st.sampled_from(HEADER_NAMES.get(name, [name.replace("extra", "lap")]))) for name in order]
    form = draw(st.sampled_from(["{camera}_{stamp}.jpg", "{camera}_{stamp}.JPG", "a_{camera}_{stamp}.jpeg"]))
    if not worded:
        form = "{letter}{stamp}.jpg"
    images = []
    for at in range(size):
        stamp = f"2018_07_16_17_11_{(start + at) % 60:02d}_{start + at:03d}"
        images.append({c: form.format(camera=c, stamp=stamp, letter=c[0] + "x") for c in CAMERAS})
    return Part(
        tuple(order),
        header,
        values,
        images,
        draw(
            st.sampled_from(["", "IMG/", "/Users/driver/data/IMG/", "C:\\Users\\left turn\\IMG\\", "a b/", "Jos\xe9/"])
        ),
        draw(st.sampled_from([",", ",", ",", ", ", ";", "\t"])),
        draw(st.sampled_from([".", ".", "," if not unnamed else "."])),
        draw(st.sampled_from(["C#", "C#", "Python", "fixed"])),
        draw(st.sampled_from(["\n", "\n", "\r\n"])),
        draw(st.integers(0, 5)) == 0,
        draw(st.sampled_from(["", "", "", ",", ",,"])),
    )


@st.composite
def logs(draw):
    """The parts of one file; below a header of another order, rows without one have something that shows it."""
    chosen = []
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        chosen.append(draw(parts(sum(len(part.values) for part in chosen))))
    numbers = NUMBERS
    for part in chosen:
        own = tuple(name for name in part.order if name in NUMBERS)
        if part.header is not None:
            numbers = own
        elif own != numbers or numbers != NUMBERS:
            part.values[0]["steering"] = -0.25
            for value in part.values:
                value.update(throttle=0.5, brake=0.0, speed=15.0 + part.values.index(value))
    assume(not any(leaves_no_evidence(*pair) for pair in itertools.combinations(chosen, 2)))
    return chosen


def leaves_no_evidence(part, later):
    """Whether nothing in two merged logs shows which columns one of them has; the values and names are both's."""
    cameras = tuple(name for name in part.order if name in CAMERAS)
    wordless = not any("center" in image for image in later.images[0].values())
    pedals = [[name for name in one.order if name in ("throttle", "brake")] for one in (part, later)]
    return (part.header is not None and later.header is None and cameras != CAMERAS and wordless) or (
        (part.header is None or later.header is None) and ["brake", "throttle"] in pedals
    )


@st.composite
def files(draw):
    """The bytes of a driving_log.csv, and of each line's row: the names of the images and the numbers."""
    lines = [line for part in draw(logs()) for line in part.lines()]
    for _ in range(draw(st.sampled_from([0, 0, 1, 3]))):
        at = draw(st.integers(0, len(lines) - 1))
        text, row = lines[at]
        damage = draw(st.sampled_from(["cut", "twice", "between"]))
        # Before the numbers end, so that it shows; not a row that steers left: it may be the evidence of the order.
        if damage == "cut" and row is not None and row[1][0] >= 0:
            lines[at] = text[: draw(st.integers(0, max(0, text.lower().rfind(".jp"))))] + "\n", None
        elif damage == "twice":
            lines.insert(at, (text, row))
        else:
            lines.insert(
                at, (draw(st.sampled_from(["\n", ",,,,,,\n", "=======\n", "\0\0\n", "\x1a\n", "a, b\n"])), None)
            )
    text = "".join(text for text, _ in lines)
    if draw(st.integers(0, 4)) == 0:
        text = text.rstrip("\r\n")
    truth = {number: row for number, (_, row) in enumerate(lines, 1) if row is not None}
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"]))), truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("log")


def read(folder, content):
    """What is read of each line: names and numbers."""
    (folder / "driving_log.csv").write_bytes(content)
    recording = read_recording(folder)
    numbers = np.column_stack([getattr(recording, name) for name in NUMBERS])
    names = [[recording.name(row, camera) for camera in range(3)] for row in range(len(recording))]
    found = {int(line): row for line, row in zip(recording.lines, zip(names, numbers, strict=True), strict=True)}
    assert not found.keys() & {line for line, _, _ in recording.rejected}
    assert len(found) == len(recording)
    return found, recording


@settings(
    max_examples=EXAMPLES,
    deadline=None,
    database=None,
    derandomize="LOG_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large],
)
@given(files())
def test_no_number_is_ever_silently_wrong(folder, file):
    content, truth = file
    try:
        found, _ = read(folder, content)
    except RecordingError as error:
        assert "driving_log.csv" in str(error)
        event("the file is refused")
        return
    event("all rows are read" if len(found) == len(truth) else "some rows are left out")
    for line, (names, numbers) in found.items():
        assert line in truth, f"line {line} is no row"
        assert names == truth[line][0], f"line {line}"
        np.testing.assert_allclose(numbers, truth[line][1], rtol=1e-6, atol=1e-9, err_msg=f"line {line}")
