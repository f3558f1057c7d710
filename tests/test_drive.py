"""drive.py without a network socket: answers, status line, attention."""

import base64
import io
import json
import logging
import os
import time
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from browser import decoded
from PIL import Image
from rendered import render_frame
from torch import nn

import drive
from cloning.network import attention
from cloning.network.network import Network
from cloning.recordings.images import decode
from cloning.road.camera import project_ground
from cloning.road.overlay import overlay
from cloning.road.points import make_road
from cloning.road.track import Track
from cloning.server.status_line import StatusLine
from cloning.server.telemetry import parse_place
from cloning.server.terminal import MAX_PER_MINUTE, Few, Unblocked
from cloning.wire.client import telemetry_packet
from cloning.wire.protocol import Place
from simulator.run import Run
from tools.simulator_client import telemetry


def jpeg_of(frame: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()


@pytest.fixture(scope="module")
def jpeg() -> bytes:
    return jpeg_of(render_frame(0.3, 0.5, np.random.default_rng(0)))


@pytest.fixture
def session(network) -> drive.Session:
    return drive.Session(drive.DriveServer(network))


def steering_always(output: float) -> Network:
    """A network whose output is the same for all frames."""
    network = Network().eval()
    nn.init.zeros_(network.get_parameter("dense.3.weight"))
    nn.init.constant_(network.get_parameter("dense.3.bias"), output)
    return network


# ----------------------------------------------------------------------------------------------------------------------
# Answers


def test_frames_are_seen_in_rgb_and_alike_on_disk_and_in_telemetry(session, network, tmp_path):
    path = tmp_path / "frame.jpg"
    path.write_bytes(jpeg_of(render_frame(0.3, 0.5, np.random.default_rng(0)) // np.array([1, 2, 4], np.uint8)))
    with torch.inference_mode():
        oracle = network(torch.from_numpy(np.array(Image.open(path)))[None])[0].item()  # Pillow decodes to RGB
        swapped = network(torch.from_numpy(np.array(Image.open(path))[..., ::-1].copy())[None])[0].item()
    answered = float(session.answer(telemetry(path.read_bytes()))["steering_angle"])
    assert abs(answered - oracle) < 0.02 * abs(answered - swapped)
    assert np.float32(answered) == drive.steer(network, decode(path.read_bytes()))


def huge(jpeg: bytes) -> bytes:
    """The JPEG with 30,000 x 30,000 in its header."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + (30000).to_bytes(2, "big") * 2 + jpeg[at + 4 :]


def test_unusable_telemetry_gets_the_last_steering_and_no_throttle_and_its_reason_is_logged(session, jpeg, caplog):
    good: dict[str, Any] = telemetry(jpeg)
    before = session.answer(good)
    assert float(before["throttle"]) > 0
    png = cv2.imencode(".png", decoded(jpeg))[1].tobytes()
    images = (None, 5, "", "/9j/4AAQ*" + good["image"], "ärger")
    missing = "is missing, which the simulator of term 1 sends"
    broken: list[tuple[object, str]] = [
        *((message, "not a JSON object") for message in ([1, 2], "telemetry", 7, True)),
        *(({key: good[key] for key in good if key != lost}, f"{lost} {missing}") for lost in ("image", "speed")),
        *(({**good, "speed": speed}, "speed is not a number") for speed in ("fast", None, "NaN", "1e999", np.inf)),
        *(({**good, "image": image}, "image") for image in images),
        ({**good, "image": good["image"][:4000]}, "cut short"),
        *(({**good, "image": base64.b64encode(image).decode()}, "image") for image in (huge(jpeg), png)),
    ]
    for message, reason in broken:
        with caplog.at_level(logging.WARNING, "drive"):
            assert session.answer(message) == {"steering_angle": before["steering_angle"], "throttle": "0"}
        assert "can't be used" in caplog.text and reason in session.reason and session.reason in caplog.text
        caplog.clear()
    assert (session.driven, session.unusable) == (1, len(broken))
    assert session.answer(good)["steering_angle"] == before["steering_angle"]


def test_a_car_that_is_to_stop_brakes_even_if_no_image_can_be_used(session, jpeg):
    blind: dict[str, Any] = {**telemetry(jpeg, speed="12.0000"), "image": ""}
    assert session.answer(blind)["throttle"] == "0"
    session.drive_at(0.0)
    slower = [session.answer({**blind, "speed": speed})["throttle"] for speed in ("12", "6", "0", "fast")]
    assert slower == ["-1", "-1", "0", "0"] and session.unusable == 5


@pytest.mark.parametrize("failing", [torch.nn.Module(), steering_always(np.nan)], ids=["raises", "nan"])
def test_a_failing_network_is_answered(session, jpeg, failing):
    before = session.answer(telemetry(jpeg))
    session.server.network = failing
    assert session.answer(telemetry(jpeg)) == {"steering_angle": before["steering_angle"], "throttle": "0"}


def test_only_the_image_and_the_speed_are_needed(session, jpeg):
    expected, good = drive.Session(session.server).answer(telemetry(jpeg)), telemetry(jpeg)
    others: tuple[dict, ...] = ({"steering_angle": [0]}, {"steering_angle": "left"}, {"throttle": None}, {"lap": 1})
    messages = [{**good, **other} for other in others]
    messages += [{key: good[key] for key in good if key != lost} for lost in ("steering_angle", "throttle")]
    for message in messages:
        session.controller.error_sum = 0.0
        assert session.answer(message) == expected
    assert (session.driven, session.unusable) == (6, 0)


@pytest.mark.parametrize(
    "sent, cte", [("-0.5000", -0.5), (1.5, 1.5), ("0.0000", 0.0), ("NaN", None), ("9" * 100, None)]
)
def test_the_distance_from_the_centre_is_shown_or_ignored(session, jpeg, sent, cte):
    plain = drive.Session(session.server).answer(telemetry(jpeg))
    assert session.answer({**telemetry(jpeg), "cte": sent}) == plain
    assert session.history[-1].cte == cte and session.unusable == 0


def test_the_place_that_the_stand_in_tells_is_shown_and_any_other_ignored(session, jpeg):
    place: dict[str, Any] = {"track": "lake", "x": 1, "y": -2.5, "offset": 0.25, "departures": 3, "time": 7.5}
    packet = telemetry_packet(0, 0, 5, b"", Place(**place))
    assert json.loads(packet[2:])[1]["stand_in"] == place
    plain = session.answer(telemetry(jpeg))
    wrong = (("x", "1"), ("y", None), ("offset", True), ("time", 1e300), ("x", np.nan), ("departures", 10**999))
    for told in (*({**place, key: value} for key, value in (*wrong, ("z", 0), ("track", "x" * 99))), {}, [], "here"):
        assert session.answer({**telemetry(jpeg), "stand_in": told})["steering_angle"] == plain["steering_angle"]
        assert session.place is None and session.history[-1].cte is None and session.unusable == 0
    run = Run(Track(make_road([(0, 0), (60, 0)], name="a road whose name is much longer than others")))
    assert parse_place(vars(run.place)) and run.place.track.startswith("--road a road"), "no name of a known track"
    session.answer({**telemetry(jpeg), "stand_in": place})
    assert session.place == Place(**place) and session.history[-1][-4:] == (0.25, 1, -2.5, None)
    session.answer({**telemetry(jpeg), "stand_in": {"time": 8.25}})  # as in a replay
    assert session.place is None and session.pilot.predictor.time == 8.25


def test_another_culture_is_answered_in_kind(session, jpeg):
    """As in Iran; test_telemetry.py has the numbers of the others."""
    expected = drive.Session(session.server).answer(telemetry(jpeg, speed="6.5000"))
    answer = session.answer(telemetry(jpeg, "12/3456-", "0/2000", "6/5000"))
    assert answer == {key: value.replace(".", "/") for key, value in expected.items()}
    assert "/" in answer["throttle"] and session.unusable == 0
    assert session.answer({})["steering_angle"] == answer["steering_angle"], "an unusable frame is answered in kind too"


# ----------------------------------------------------------------------------------------------------------------------
# Status line and log


def printed(status: StatusLine) -> str:
    """The line, now that it is due."""
    stream = io.StringIO()
    status.stderr.stream = stream
    status.update()
    status.stderr.finish()
    return stream.getvalue()


def logged(few: Few, messages: list[str], level: int = logging.WARNING) -> list[str]:
    """The messages that pass, as they are logged."""
    records = [logging.LogRecord("drive", level, "", 0, message, None, None) for message in messages]
    return [record.getMessage() for record in records if few.filter(record)]


def test_each_session_logs_each_kind_of_warning_once(session, caplog):
    once, other = Few(), drive.Session(session.server)
    with caplog.at_level(logging.WARNING, "drive"):
        for each in (session, other, session, other):
            each.answer({})
            each.answer([])
    assert [once.filter(record) for record in caplog.records] == [True] * 4 + [False] * 4
    assert logged(once, ["30000x30000 pixels", "20000x100 pixels", "5 x"]) == ["30000x30000 pixels", "5 x"]
    assert logged(once, ["5 x"] * 99) == ["5 x (10 times so far)", "5 x (100 times so far)"]


def test_the_log_is_short_whatever_clients_do(monkeypatch):
    few, now = Few(), [0.0]
    monkeypatch.setattr("cloning.server.terminal.time", SimpleNamespace(monotonic=lambda: now[0]))
    letters = ["".join(chr(97 + n // 26**at % 26) for at in range(3)) for n in range(10_000)]
    assert len(logged(few, letters)) == 50, "kinds"
    assert len(logged(few, ["session ended"] * 10_000, logging.INFO)) == MAX_PER_MINUTE - 50
    now[0] = 60
    assert logged(few, ["session ended"] * 2, logging.INFO) == ["session ended"] * 2
    assert logged(few, ["in\nno\x1b[2J" + 2000 * "!"], logging.INFO) == ["in no\\x1b[2J" + 988 * "!"]


def test_a_terminal_that_nobody_reads_costs_lines_and_no_time():
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    with os.fdopen(writing, "w") as stream, os.fdopen(reading, "rb") as reader:
        unread, started = Unblocked(stream), time.monotonic()
        for n in range(5000):
            unread.write(f"{n:1000}")
        unread.finish()
        assert time.monotonic() - started < 5
        text = b""
        while unread.texts.unfinished_tasks:  # now somebody reads
            text += reader.read() or b""
        text += reader.read() or b""
    numbers = [int(number) for number in text.split()]
    assert numbers[:100] == list(range(100)) and numbers == sorted(set(numbers)) and len(numbers) < 300, "some are lost"


def test_the_latency_is_the_time_in_the_server_however_many_frames_are_in_flight(session, jpeg):
    """Three telemetries circulate, which arrived 0.04 s ago."""
    begin = time.perf_counter()
    for _ in range(3):
        session.answer(telemetry(jpeg), time.perf_counter() - 0.04)
    longest = 1000 * (time.perf_counter() - begin + 0.04)
    status = StatusLine(session.server, Unblocked(io.StringIO()))
    shown = [float(part.split()[0]) for part in status.text(session, time.perf_counter()).split(", ") if "ms" in part]
    on_the_page = [frame.latency for frame in session.history]
    assert shown == [pytest.approx(np.mean(on_the_page), abs=0.06)]
    assert all(40 <= latency < longest for latency in on_the_page)


def test_the_rate_counts_from_the_sessions_start_or_the_last_line(session, jpeg):
    status = StatusLine(session.server, Unblocked(io.StringIO()))
    status.time -= 3600  # an hour of waiting for a simulator
    session.server.sessions["sid"] = session
    session.answer(telemetry(jpeg))
    session.driven, session.started = 2000, time.perf_counter() - 200.0
    assert float(printed(status).split()[0]) == pytest.approx(10, rel=0.05)
    status.time, status.session = time.perf_counter() - 600, session
    session.driven += 6000
    assert float(printed(status).split()[0]) == pytest.approx(10, rel=0.05)
    later = drive.Session(session.server)
    session.server.sessions["sid"], later.heard = later, time.monotonic()  # of which no frame is driven at first
    for driven in (0, 6000):
        status.time, later.driven = time.perf_counter() - 600, driven
        later.history.extend(session.history)
        line = printed(status)
    assert float(line.split()[0]) == pytest.approx(10, rel=0.05)


def test_escape_sequences_are_for_terminals_only(session, jpeg):
    session.server.sessions["sid"] = session
    session.answer(telemetry(jpeg))
    for is_terminal in (True, False):
        status = StatusLine(session.server, Unblocked(io.StringIO()))
        status.stderr.is_terminal = is_terminal
        status.time -= 3600
        assert ("\033" in printed(status)) is is_terminal


# ----------------------------------------------------------------------------------------------------------------------
# What the network looks at


class OfOtherLayers(Network):
    """A network with padding and pooling, which NVIDIA's does not have."""

    units = 24 * 10 * 40

    def layers(self) -> Any:
        block = nn.Sequential(nn.Conv2d(3, 8, 5, padding="same"), nn.MaxPool2d(2))
        return [nn.AvgPool2d(2, ceil_mode=True), block, nn.Conv2d(8, 24, 3, 2, padding=1)], [nn.Linear(self.units, 1)]


def looking_at_what_is_bright(kind: type[Network] = Network) -> Network:
    """A network whose every layer passes on where the image is bright."""
    network = kind().eval()
    for name, parameter in network.named_parameters():
        average = 1 / parameter[0].numel() if name.startswith("convolutions") and name.endswith("weight") else 0
        # Black is -1: it falls below 0 and out of the positive part.
        torch.nn.init.constant_(parameter, 0.9 if name == "convolutions.0.bias" else average)
    return network


def test_attention_to_an_even_image_has_no_grid():
    _, mask = attention.visual_backprop(looking_at_what_is_bright(), np.full((160, 320, 3), 255, np.uint8))
    middle = mask[60:135, 120:200]
    assert np.ptp(middle, axis=1).max() < 1e-4, "far from its sides, one column is like the other"
    rising = np.sign(np.diff(middle[:, 0][middle[:, 0] > 1e-4]))
    assert np.count_nonzero(np.diff(rising)) == 1, "from top to bottom it rises to one maximum, and falls"


@pytest.mark.parametrize("kind", [Network, OfOtherLayers])
def test_attention_is_where_the_network_can_see_anything(kind):
    """A network that looks at what is bright looks at the bright spot, and nowhere else."""
    frame = np.zeros((160, 320, 3), np.uint8)
    frame[90:106, 200:216] = 255
    steering, mask = attention.visual_backprop(looking_at_what_is_bright(kind), frame)
    assert steering == 0
    assert mask.shape == (160, 320) and mask.dtype == np.float32 and mask.max() == pytest.approx(1)
    assert not mask[:60].any() and not mask[135:].any(), "the rows that are cropped off"
    row, column = np.unravel_index(mask.argmax(), mask.shape)
    assert abs(row - 98) < 12 and abs(column - 208) < 12
    assert mask[:, :140].max() == 0


def middle(picture: np.ndarray) -> float:
    """The mean column of the line in an overlay, above the bonnet."""
    return (picture[..., 1] > 128)[:270].nonzero()[1].mean()


@pytest.mark.parametrize("steering", [-1.0, 0.05, 0.4])
def test_the_line_is_where_the_car_goes(steering):
    """The wheels, 2.87 m apart, are turned by up to 25 degrees; the camera is 2.6 m before the rear ones."""
    turned = np.arange(1, 4000) * 0.005 * np.tan(np.radians(25 * steering)) / 2.87  # the heading every 5 mm
    right, forward = (np.cumsum(0.005 * function(turned)) for function in (np.sin, np.cos))
    right, forward = right + 1.6 * np.sin(turned), forward + 1.6 * np.cos(turned) - 2.6  # of the car's middle
    ahead, until = np.array([3.0, 0.85 * min(forward.max(), 15)]), 1 + forward.argmax()
    column, row = project_ground(np.interp(ahead, forward[:until], right[:until]), ahead).T
    picture = overlay(np.zeros((160, 320, 3), np.uint8), steering)
    assert all(picture[2 * round(y), 2 * round(x), 1] > 128 for x, y in zip(column, row, strict=True))


@pytest.mark.parametrize("output", [-4.9, 4.9])
def test_the_steering_stays_within_its_range_and_the_overlay_shows_what_is_sent(output, jpeg):
    network, frame = steering_always(output), np.zeros((160, 320, 3), np.uint8)
    answer = drive.Session(drive.DriveServer(network)).answer(telemetry(jpeg))
    assert answer["steering_angle"] == ("-1" if output < 0 else "1")
    steering, _ = attention.visual_backprop(network, frame)
    assert steering == np.sign(output) == np.sign(middle(overlay(frame, steering)) - 320)
