"""Logs in every shape that programs give them, written by hypothesis: read right, or refused, never silently wrong."""

import itertools
import os
import string
from collections.abc import Iterator
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
OTHERS = ["lap", "predicted_steering", "steering_error", "angle_of_car", "target_speed", "throttle_limit", "left_wheel"]
# Names of columns with another sign, range or unit: column -> name -> factor and summand of what is written.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "steering": {"steering_ccw": (-1, 0), "-steering": (-1, 0), "steering 0..1": (0.5, 0.5), "steering/4": (0.25, 0)},
    "throttle": {"throttle_pct": (100, 0), "throttle/2": (0.5, 0)},
    "brake": {"no brake": (-1, 1)},
    "speed": {
        "speed_m_s": (0.447, 0),
        "speed (metres/second)": (0.447, 0),
        "speed ft/s": (1.467, 0),
        "kmh": (1.609, 0),
    },
}
IMAGES = ["{camera}_{stamp}.jpg", "{camera}_{stamp}.JPG", "{Camera}_{at}.jpg", "{camera} {at}.jpeg"]
# Names that say the camera, but not as a whole, in another language, or not at all.
UNCLEAR_IMAGES = [
    "a_{camera}_{stamp}.jpg",
    "img{Camera}_{at}.jpg",
    "{camera}cam_{at}.jpg",
    "{letter}_{at}.jpg",
    "{letter}x{stamp}.jpg",
    "{stamp}-{camera}.jpg",
    "{camera}/{at}.jpg",
    "{german}_{stamp}.jpg",
]
GERMAN = {"center": "mitte", "left": "links", "right": "rechts"}
EXAMPLES = int(os.environ.get("LOG_EXAMPLES", 200))  # 10,000 take about 6 minutes


@dataclass
class Part:
    """One program's log: the rows' values and how they are written; several are merged into one file.

    order     the columns' names in their order; names that are no columns are extra ones
    header    its line, or None
    units     column -> factor and summand of what is written
    values    of each row: column -> number, or text of an extra column
    images    of each row: camera -> file name, perhaps with a folder
    """

    order: tuple[str, ...]
    header: list[str] | None
    units: dict[str, tuple[float, float]]
    values: list[dict]
    images: list[dict[str, str]]
    folder: str
    separator: str
    mark: str
    digits: str
    end: str
    quoted: bool
    trailing: str

    def lines(self) -> Iterator[tuple[str, tuple[list[str], list[float]] | None]]:
        """The text of each line, and the row that it holds: None for the header."""
        if self.header is not None:
            yield self.joined(self.header), None
        for values, images in zip(self.values, self.images, strict=True):
            fields = []
            for column in self.order:
                if column in CAMERAS:
                    fields.append(self.folder + images[column])
                elif isinstance(values[column], str):
                    fields.append(values[column])
                else:
                    factor, summand = self.units.get(column, (1, 0))
                    fields.append(self.written(values[column] * factor + summand).replace(".", self.mark))
            names = [images[camera].rpartition("/")[2] for camera in CAMERAS]
            yield self.joined(fields), (names, [float(self.written(values[name])) for name in NUMBERS])

    def joined(self, fields: list[str]) -> str:
        fields = [f'"{value}"' for value in fields] if self.quoted else fields
        return self.separator.join(fields) + self.trailing + self.end

    def written(self, value: float) -> str:
        """As C# writes a float, as Python does, or with four decimals."""
        return f"{value:.7G}" if self.digits == "C#" else repr(value) if self.digits == "Python" else f"{value:.4f}"


@st.composite
def rows(draw, size, must_show_columns):
    """Values as the simulator writes them: the pedals are never pressed together."""
    values = []
    moves = draw(st.booleans())
    steering = st.one_of(st.just(0.0), st.sampled_from([-1.0, -0.05, 0.05, 0.25, 1.0]), st.floats(-1, 1, width=32))
    for _ in range(size):
        pedal = draw(st.one_of(st.sampled_from([0.0, 1.0, 0.3]), st.floats(-1, 1, width=32)))
        speed = st.one_of(st.sampled_from([0.0, 9.0, 30.19, 6.9e-05]), st.floats(0, 31, width=32))
        values.append(
            {
                "steering": draw(steering),
                "throttle": max(pedal, 0.0),
                "brake": max(-pedal, 0.0) if draw(st.booleans()) else 0.0,
                "speed": draw(speed if moves else st.floats(0, 1, width=32)),
            }
        )
    if must_show_columns:
        values[draw(st.integers(0, size - 1))]["steering"] = -draw(st.sampled_from([0.05, 0.3, 0.9]))
        accelerate(values)
    return values


def accelerate(values):
    for at, value in enumerate(values):
        value.update(throttle=0.5, brake=0.0, speed=15.0 + at)


@st.composite
def extra_column(draw, size):
    """The values of a column that is none of the simulator's."""
    constant = draw(st.sampled_from([0, 1, 3, 0.5, 19, -0.5]))
    choices = {
        "unit": lambda at: draw(st.floats(-1, 1, width=32)),
        "lap": lambda at: at / 3,
        "constant": lambda at: constant,
        "count": lambda at: at,
        "word": lambda at: draw(st.text(string.ascii_letters + " :", max_size=8)),
        "large": lambda at: 1e5 + at,
        "zero": lambda at: 0,
    }
    chosen = choices[draw(st.sampled_from(sorted(choices)))]
    return [chosen(at) for at in range(size)]


@st.composite
def image_names(draw, start, size):
    """The images of each row: camera -> file name. Time stamps count on from `start`."""
    form = draw(st.sampled_from(IMAGES if draw(st.integers(0, 9)) else UNCLEAR_IMAGES))
    images = []
    for at in range(start, start + size):
        fields = {"stamp": f"2018_07_16_17_11_{at % 60:02d}_{at:03d}", "at": at}
        words = [
            {"camera": name, "Camera": name.title(), "letter": name[0], "german": GERMAN[name]} for name in CAMERAS
        ]
        images.append({each["camera"]: form.format(**each, **fields) for each in words})
    return images


@st.composite
def parts(draw, start):
    """A part whose rows have time stamps from `start` on."""
    headed = draw(st.booleans())
    is_usual = not headed and draw(st.integers(0, 2)) > 0
    numbers = NUMBERS if is_usual else draw(st.one_of(st.just(NUMBERS), st.permutations(NUMBERS).map(tuple)))
    cameras = CAMERAS if is_usual else draw(st.one_of(st.just(CAMERAS), st.permutations(CAMERAS).map(tuple)))
    order = [*cameras, *numbers]
    if headed and draw(st.integers(0, 5)) == 0:
        order = list(draw(st.permutations(order)))
    for number in range(draw(st.sampled_from([0, 0, 0, 1, 1, 2]))):
        order.insert(draw(st.integers(0, len(order))), f"extra{number}")
    extras = [name for name in order if name.startswith("extra")]
    if draw(st.integers(0, 9)) == 0 and (headed or len(order) == len(USUAL)):
        order.remove(draw(st.sampled_from(order)))
    size = draw(st.integers(2, 12))
    unnamed = not headed and numbers != NUMBERS  # which only signs, ranges and fields can show
    values = draw(rows(size, unnamed))
    for extra in extras:
        for value, text in zip(values, draw(extra_column(size)), strict=True):
            value[extra] = text
    header, units = None, {}
    if headed:
        header = [draw(st.sampled_from(HEADER_NAMES.get(name, OTHERS))) for name in order]
        if draw(st.integers(0, 5)) == 0:
            column = draw(st.sampled_from([name for name in order if name in UNITS]))
            name = draw(st.sampled_from(sorted(UNITS[column])))
            header[order.index(column)], units[column] = name, UNITS[column][name]
    folders = ["", "IMG/", "/Users/driver/data/IMG/", "C:\\Users\\left turn\\IMG\\", "a b/", "Jos\xe9/", "/Doe, J/IMG/"]
    return Part(
        tuple(order),
        header,
        units,
        values,
        draw(image_names(start, size)),
        draw(st.sampled_from(folders)),
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
    chosen: list[Part] = []
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        chosen.append(draw(parts(sum(len(part.values) for part in chosen))))
    numbers: tuple[str, ...] = NUMBERS
    for part in chosen:
        own = tuple(name for name in part.order if name in NUMBERS)
        if part.header is not None:
            numbers = own
        elif own != numbers or numbers != NUMBERS:
            part.values[0]["steering"] = -0.25
            accelerate(part.values)
    for part, later in itertools.combinations(chosen, 2):  # in merged logs, some things leave no evidence
        if part.header and not later.header and len(part.order) > len(USUAL):  # rows that may seem meant by the header
            assume(len(later.order) == len(USUAL) and later.mark == ".")
        pedals = [[name for name in each.order if name in ("throttle", "brake")] for each in (part, later)]
        assume((part.header and later.header) or ["brake", "throttle"] not in pedals)
    return chosen


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
    encodings = ["utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"]
    return text.encode(draw(st.sampled_from(encodings))), truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("log")


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
    (folder / "driving_log.csv").write_bytes(content)
    try:
        recording = read_recording(folder)
    except RecordingError as error:
        assert str(error).startswith(f"{folder / 'driving_log.csv'}: ")
        event("the file is refused")
        return
    lines = recording.lines.tolist()
    assert not set(lines) & {row.line for row in recording.rejected}
    assert len(set(lines)) == len(lines)
    event("all rows are read" if len(lines) == len(truth) else "some rows are left out")
    numbers = np.column_stack([recording.steering, recording.throttle, recording.brake, recording.speed])
    for row, line in enumerate(lines):
        assert line in truth, f"line {line} is no row"
        assert [recording.name(row, camera) for camera in range(3)] == truth[line][0], f"line {line}"
        np.testing.assert_allclose(numbers[row], truth[line][1], rtol=1e-6, atol=1e-9, err_msg=f"line {line}")
