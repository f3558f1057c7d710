"""Logs in every shape that programs give them, written by hypothesis: read right, or refused, never silently wrong."""

import math
import os
import random
import re

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from test_recordings import NUMBERS as PLAIN
from test_recordings import SPACED, usual

from cloning.base.errors import RecordingError
from cloning.recordings import rows
from cloning.recordings.format import CAMERAS, NUMBERS
from cloning.recordings.log import read_recording

HEADER_NAMES = {
    "center": ["center", "Center", "camera_center", "ct_path", "centre image", "img_center"],
    "left": ["left", "Left", "camera_left", "lt_path"],
    "right": ["right", "Right", "camera_right", "rt_path"],
    "steering": ["steering", "SteeringAngle", "steer", "angle"],
    "throttle": ["throttle", "Throttle"],
    "brake": ["brake", "Brake", "Break", "reverse"],
    "speed": ["speed", "Speed"],
}
OTHERS = ["lap", "predicted_steering", "steering_error", "angle_of_car", "target_speed", "throttle_limit", "left_wheel"]
# Names of columns with another sign, range or unit: column -> name -> factor and summand of what is written.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "steering": {"steering_ccw": (-1, 0), "-steering": (-1, 0), "steering 0..1": (0.5, 0.5), "steering/4": (0.25, 0)},
    "throttle": {"throttle_pct": (100, 0), "throttle/2": (0.5, 0)},
    "brake": {"no brake": (-1, 1)},
    "speed": {"speed_m_s": (0.447, 0), "speed (metres/second)": (0.447, 0), "speed ft/s": (1.467, 0)},
}
EXTRAS = [math.sin, lambda at: at, lambda at: at / 3, lambda at: -0.5, lambda at: 1e5 + at, lambda at: 0, lambda at: 19]
EXTRAS += [lambda at: "Lake: left", lambda at: ""]
IMAGES = ["{camera}_{stamp}.jpg", "{camera}_{stamp}.JPG", "{Camera}_{at}.jpg", "{camera} {at}.jpeg"]
# Names that say the camera, but not as a whole, in another language, or not at all.
UNCLEAR_IMAGES = ["a_{camera}_{stamp}.jpg", "{camera}cam_{at}.jpg", "{letter}_{at}.jpg", "{german}_{stamp}.jpg"]
UNCLEAR_IMAGES += ["{stamp}-{camera}.jpg", "{camera}/{at}.jpg"]
GERMAN = {"center": "mitte", "left": "links", "right": "rechts"}
FOLDERS = ["", "IMG/", "/Users/driver/data/IMG/", "C:\\Users\\left turn\\IMG\\", "a b/", "Jos\xe9/", "/Doe, J/IMG/"]
Line = tuple[str, tuple[list[str], list[float]] | None]  # its text; its row's images and numbers
EXAMPLES = int(os.environ.get("LOG_EXAMPLES", 200))  # CONTRIBUTING.md says when to try 10,000


@st.composite
def number_rows(draw, size):
    """Numbers as the simulator writes them: the pedals are never pressed together."""
    rows = []
    steering = st.one_of(st.sampled_from([0.0, -1.0, -0.05, 0.25, 1.0]), st.floats(-1, 1, width=32))
    speed = st.one_of(st.sampled_from([0.0, 30.19, 6.9e-05]), st.floats(0, draw(st.sampled_from([1, 31])), width=32))
    for _ in range(size):
        pedal = draw(st.one_of(st.sampled_from([0.0, 1.0, 0.3]), st.floats(-1, 1, width=32)))
        brake = max(-pedal, 0.0) if draw(st.booleans()) else 0.0
        rows.append({"steering": draw(steering), "throttle": max(pedal, 0.0), "brake": brake, "speed": draw(speed)})
    return rows


@st.composite
def image_rows(draw, start, size):
    """The images of each row: camera -> file name. Time stamps count on from `start`."""
    form = draw(st.sampled_from(IMAGES if draw(st.integers(0, 9)) else UNCLEAR_IMAGES))

    def image(camera: str, at: int) -> str:
        words = {"camera": camera, "Camera": camera.title(), "letter": camera[0], "german": GERMAN[camera]}
        return form.format(**words, stamp=f"2018_07_16_17_11_{at % 60:02d}_{at:03d}", at=at)

    return [{camera: image(camera, at) for camera in CAMERAS} for at in range(start, start + size)]


@st.composite
def orders(draw, is_headed):
    """The columns' names in their order; one may be missing, and others than the simulator's are called extra."""
    order = [*CAMERAS, *NUMBERS]
    if is_headed:
        order = [*draw(st.permutations(CAMERAS)), *draw(st.permutations(NUMBERS))]
        order = draw(st.sampled_from([order, draw(st.permutations(order))]))
    extras = draw(st.sampled_from([0, 0, 0, 1, 2]))
    if draw(st.integers(0, 9)) == 0 and (is_headed or not extras):
        order.remove(draw(st.sampled_from(order)))
    for number in range(extras):
        order.insert(draw(st.integers(0, len(order))), f"extra{number}")
    return order


@st.composite
def programs(draw, start, is_headed):
    """The lines that one program writes: the text of each, and the images and numbers of its row or None."""
    order, size = draw(orders(is_headed)), draw(st.integers(2, 12))
    separator, trailing = draw(st.sampled_from([",", ",", ",", ", ", ";", "\t"])), draw(st.sampled_from(["", "", ",,"]))
    mark, quote = draw(st.sampled_from([".", ".", ","])), draw(st.sampled_from(["", "", "", '"']))
    form = draw(st.sampled_from(["{:.7G}", "{:.7G}", "{!r}", "{:.4f}"]))  # C#'s, Python's, fixed
    folder, end = (draw(st.sampled_from(FOLDERS)), draw(st.sampled_from(["\n", "\n", "\r\n"])))
    extras = {name: draw(st.sampled_from(EXTRAS)) for name in order if name.startswith("extra")}
    units: dict[str, tuple[float, float]] = {}
    lines: list[Line] = []

    def joined(fields):
        return separator.join(f"{quote}{field}{quote}" for field in fields) + trailing + end

    if is_headed:
        header = [draw(st.sampled_from(HEADER_NAMES.get(name, OTHERS))) for name in order]
        if draw(st.integers(0, 5)) == 0:
            column = draw(st.sampled_from([name for name in order if name in UNITS]))
            header[order.index(column)], units[column] = draw(st.sampled_from(sorted(UNITS[column].items())))
        lines.append((joined(header), None))
    images = draw(image_rows(start, size))
    for at, (names, numbers) in enumerate(zip(images, draw(number_rows(size)), strict=True)):
        fields = []
        for column in order:
            if column in CAMERAS:
                fields.append(folder + names[column])
                continue
            value = extras[column](at) if column in extras else numbers[column]
            factor, summand = units.get(column, (1, 0))
            is_text = isinstance(value, str)
            fields.append(value if is_text else form.format(value * factor + summand).replace(".", mark))
        files = [names[camera].rpartition("/")[2] for camera in CAMERAS]
        lines.append((joined(fields), (files, [float(form.format(numbers[n])) for n in NUMBERS])))
    return lines


@st.composite
def files(draw):
    """The bytes of a driving_log.csv, and of each line's row: the names of the images and the numbers.

    Several programs' logs may be merged; below a header, all have one: rows without leave no evidence of their order.
    """
    lines: list[Line] = []
    is_headed = draw(st.booleans())
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        lines += draw(programs(len(lines), is_headed))
        is_headed = is_headed or draw(st.booleans())
    for _ in range(draw(st.sampled_from([0, 0, 1, 3]))):
        at = draw(st.integers(0, len(lines) - 1))
        text, row = lines[at]
        damage = draw(st.sampled_from(["cut", "twice", "between"]))
        if damage == "cut" and row is not None:  # before the numbers end, so that it shows
            lines[at] = text[: draw(st.integers(0, max(0, text.lower().rfind(".jp"))))] + "\n", None
        elif damage == "twice":
            lines.insert(at, (text, row))
        else:
            between = ["\n", ",,,,,,\n", "=======\n", "\0\0\n", "\x1a\n", "a, b\n"]
            lines.insert(at, (draw(st.sampled_from(between)), None))
    text = "".join(text for text, _ in lines)
    if draw(st.integers(0, 4)) == 0:
        text = text.rstrip("\r\n")
    truth = {number: row for number, (_, row) in enumerate(lines, 1) if row is not None}
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"]))), truth


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


def test_plain_rows_are_read_as_all_others(folder, monkeypatch):
    """Lines with other characters are read in the same way with and without the fast path."""
    rng = random.Random(0)
    odd = [*' ",;\t._-+/\\eE0123456789acJ%\0\x0b\xa0\u0660\ufeff\udcff', ".jpg", "1_0", "nan", "1e400", "True", "-0"]

    def outcome(content: bytes) -> tuple:
        (folder / "driving_log.csv").write_bytes(content)
        try:
            found = read_recording(folder)
        except RecordingError as error:
            return (str(error),)
        names = [found.path(row, camera) for row in range(len(found)) for camera in range(3)]
        columns = [getattr(found, name).tobytes() for name in NUMBERS]
        return names, columns, found.lines.tolist(), found.repairs, found.rejected

    for _ in range(500):
        line = rng.choice(usual(rng.choice(["", "IMG/", "C:\\a b\\", " /IMG/"]), rng.choice([PLAIN, SPACED])))
        for _ in range(rng.randrange(3)):
            at = rng.randrange(len(line))
            line = line[:at] + rng.choice(odd) + line[at + rng.randrange(3) :]
        content = "\n".join([*usual(first=10), line, *usual(first=20)]).encode(errors="surrogateescape")
        fast = outcome(content)
        with monkeypatch.context() as patch:
            patch.setattr(rows, "PLAIN_ROW", re.compile("(?!)"))
            assert outcome(content) == fast, line
