"""drive.py without a network socket: speed controller, answers, status line, saved frames, attention."""

import base64
import logging
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from rendered import render_frame

import drive
from cloning.base.errors import UserError
from cloning.network import attention
from cloning.network.network import SHIPPED_MODEL, Network
from cloning.recordings import saved_frames as frames
from cloning.recordings.images import decode
from cloning.road.overlay import overlay


def jpeg_of(frame: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()


@pytest.fixture(scope="module")
def jpeg() -> bytes:
    return jpeg_of(render_frame(0.3, 0.5, np.random.default_rng(0)))


def telemetry(jpeg, speed="0.0000", **more):
    return {
        "steering_angle": "0.0000",
        "throttle": "0.0000",
        "speed": speed,
        "image": base64.b64encode(jpeg).decode(),
        **more,
    }


@pytest.fixture(scope="module")
def network() -> Network:
    torch.manual_seed(3)
    return Network().eval()


@pytest.fixture
def session(network) -> drive.Session:
    return drive.Session(drive.DriveServer(network), {})


class Car:
    """A car of mass 1 whose speed follows throttle, drag and slope, in the simulator's figures roughly."""

    def __init__(self):
        self.speed = 0.0

    def step(self, throttle: float, slope: float = 0.0):
        self.speed = max(0.0, self.speed + 0.067 * (13 * throttle - 0.1 * self.speed - 22 * slope))


def test_controller_begins_as_the_original():
    """0.1 e + 0.002 Σe by hand, at set speed 9."""
    controller = drive.SpeedController(9)
    assert controller.throttle(4) == pytest.approx(0.1 * 5 + 0.002 * 5)
    assert controller.throttle(8) == pytest.approx(0.1 * 1 + 0.002 * 6)
    assert controller.throttle(10) == pytest.approx(-0.1 + 0.002 * 5)


@pytest.mark.parametrize("set_speed", [9, 30])
def test_controller_is_not_wound_up_by_a_wait_or_a_hill(set_speed):
    controller, car, overshoot = drive.SpeedController(set_speed), Car(), 0.0
    for _ in range(2000):
        assert -1 <= controller.throttle(0) <= 1  # held by a wall for two minutes
    for frame in range(2000):
        car.step(controller.throttle(car.speed), slope=0.3 if 600 < frame < 1200 else 0)
        if frame < 600:
            overshoot = max(overshoot, car.speed - set_speed)
    assert overshoot < 2, "mph over the set speed after the wait"
    assert abs(car.speed - set_speed) < 0.5, "settled again after the hill"


def test_frames_are_seen_in_rgb_and_alike_on_disk_and_in_telemetry(session, network, tmp_path):
    path = tmp_path / "frame.jpg"
    path.write_bytes(jpeg_of(render_frame(0.3, 0.5, np.random.default_rng(0)) // np.array([1, 2, 4], np.uint8)))
    with torch.inference_mode():
        oracle = network(torch.from_numpy(np.array(Image.open(path)))[None])[0].item()  # Pillow decodes to RGB
        swapped = network(torch.from_numpy(np.array(Image.open(path))[..., ::-1].copy())[None])[0].item()
    answered = float(session.answer(telemetry(path.read_bytes()))["steering_angle"])
    assert abs(answered - oracle) < 0.02 * abs(answered - swapped)
    on_disk = drive.steer(network, decode(path.read_bytes()))
    assert np.float32(answered) == on_disk


def huge(jpeg: bytes) -> bytes:
    """The JPEG with 30,000 x 30,000 in its header."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + (30000).to_bytes(2, "big") * 2 + jpeg[at + 4 :]


def png(jpeg: bytes) -> bytes:
    return cv2.imencode(".png", cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))[1].tobytes()


BROKEN = {
    "no keys": lambda good: {},
    "a list": lambda good: [1, 2],
    "text": lambda good: "telemetry",
    "a number": lambda good: 7,
    "true": lambda good: True,
    "no image": lambda good: {key: value for key, value in good.items() if key != "image"},
    "no speed": lambda good: {key: value for key, value in good.items() if key != "speed"},
    "text for speed": lambda good: {**good, "speed": "fast"},
    "null for speed": lambda good: {**good, "speed": None},
    "NaN for speed": lambda good: {**good, "speed": "NaN"},
    "infinite speed": lambda good: {**good, "speed": "1e999"},
    "null for the image": lambda good: {**good, "image": None},
    "a number for the image": lambda good: {**good, "image": 5},
    "empty image": lambda good: {**good, "image": ""},
    "bad base64": lambda good: {**good, "image": "/9j/4AAQ*" + good["image"]},
    "letters beyond ASCII": lambda good: {**good, "image": "ärger"},
    "an image cut short": lambda good: {**good, "image": good["image"][:4000]},
    "a huge image": lambda good: {**good, "image": base64.b64encode(huge(base64.b64decode(good["image"]))).decode()},
    "a PNG": lambda good: {**good, "image": base64.b64encode(png(base64.b64decode(good["image"]))).decode()},
}


@pytest.mark.parametrize("kind", BROKEN)
def test_unusable_telemetry_gets_the_last_steering_and_no_throttle(session, jpeg, kind, caplog):
    good = telemetry(jpeg)
    before = session.answer(good)
    assert float(before["throttle"]) > 0
    with caplog.at_level(logging.WARNING, "drive"):
        assert session.answer(BROKEN[kind](good)) == {"steering_angle": before["steering_angle"], "throttle": "0"}
    assert "can't be used" in caplog.text
    assert (session.driven, session.unusable) == (1, 1)
    assert session.answer(good)["steering_angle"] == before["steering_angle"]


@pytest.mark.parametrize("failure", ["raises", "nan"])
def test_a_failing_network_is_answered(session, jpeg, failure):
    before = session.answer(telemetry(jpeg))

    class Failing(torch.nn.Module):
        def forward(self, frames):
            if failure == "raises":
                raise RuntimeError("out of memory")
            return torch.full((1,), float("nan"))

    session.server.network = Failing()
    assert session.answer(telemetry(jpeg)) == {"steering_angle": before["steering_angle"], "throttle": "0"}


NOT_NEEDED = {
    "a list for the angle": {"steering_angle": [0]},
    "text for the angle": {"steering_angle": "left"},
    "null for the throttle": {"throttle": None},
    "more than the simulator sends": {"cte": "-0.5", "hit": "none", "lap": 1},
}


@pytest.mark.parametrize("kind", [*NOT_NEEDED, "no angle", "no throttle"])
def test_only_the_image_and_the_speed_are_needed(session, jpeg, kind):
    expected = drive.Session(session.server, {}).answer(telemetry(jpeg))
    message = {**telemetry(jpeg), **NOT_NEEDED.get(kind, {})}
    if kind.startswith("no "):
        del message[{"no angle": "steering_angle", "no throttle": "throttle"}[kind]]
    assert session.answer(message) == expected
    assert (session.driven, session.unusable) == (1, 0)


def test_a_warning_is_logged_once_per_kind():
    once = drive.OncePerKind()

    def passes(message):
        return once.filter(logging.LogRecord("drive", logging.WARNING, "", 0, message, None, None))

    assert passes("30000x30000 pixels") and not passes("20000x100 pixels") and passes("not base64")


def test_each_session_logs_its_own_warnings(session, caplog):
    once, other = drive.OncePerKind(), drive.Session(session.server, {})
    with caplog.at_level(logging.WARNING, "drive"):
        for each in (session, other, session, other):
            each.answer({})
            each.answer([])
    assert len(caplog.records) == 8
    assert [once.filter(record) for record in caplog.records] == [True] * 4 + [False] * 4


def test_decimal_commas_are_read_and_answered_with_commas(session, jpeg):
    pointed = drive.Session(session.server, {}).answer(telemetry(jpeg, speed="6.5000"))
    answer = session.answer(telemetry(jpeg, speed="6,5000", steering_angle="0,0000", throttle="0,2000"))
    assert answer == {key: value.replace(".", ",") for key, value in pointed.items()}
    assert "," in answer["throttle"]
    assert "." not in session.answer({})["steering_angle"], "an unusable frame is answered in kind too"


@pytest.mark.parametrize(
    "angle, throttle, speed, separator",
    [
        ("12.3456-", "0.2000", "6.5000", "."),  # ar-SA
        ("- 12.3456", "0.2000", "6.5000", "."),  # km-KH
        ("- 12,3456", "0,2000", "6,5000", ","),  # hr-HR
        ("12/3456-", "0/2000", "6/5000", "/"),  # fa-IR
        ("\u221212,3456", "0,2000", "6,5000", ","),
        ("\u200e\u221212\u066b3456", "0\u066b2000", "6\u066b5000", "\u066b"),
    ],
)
def test_a_left_bend_is_driven_in_every_culture(session, jpeg, angle, throttle, speed, separator):
    expected = drive.Session(session.server, {}).answer(telemetry(jpeg, speed="6.5000"))
    answer = session.answer(telemetry(jpeg, speed=speed, steering_angle=angle, throttle=throttle))
    assert answer == {key: value.replace(".", separator) for key, value in expected.items()}
    assert separator in answer["throttle"]
    assert (session.driven, session.unusable) == (1, 0)


@pytest.mark.parametrize("bias", [-7, 7])
def test_steering_stays_within_its_range(jpeg, bias):
    network = Network().eval()
    torch.nn.init.constant_(network.dense[-1].bias, bias)
    answer = drive.Session(drive.DriveServer(network), {}).answer(telemetry(jpeg))
    assert answer["steering_angle"] == ("-1" if bias < 0 else "1")


# --------------------------------------------------------------------------------------------------
# Status line and command line


class Arrived:
    """A websocket whose message arrived `ms` milliseconds ago."""

    def __init__(self, ms: float):
        self.ms = ms

    @property
    def arrived(self) -> float:
        return time.perf_counter() - self.ms / 1000


def test_the_latency_is_the_time_in_the_server_however_many_frames_are_in_flight(session, jpeg):
    """Three telemetries circulate, and the simulator takes half a second to send the next one."""
    session.environ["drive.websocket"] = Arrived(ms=40)
    for _ in range(3):
        session.answer(telemetry(jpeg))
    status = drive.StatusLine(session.server, terminal=False)
    shown = [float(part.split()[1]) for part in status.text(session, time.perf_counter()).split(", ") if "ms" in part]
    on_the_page = [frame.latency for frame in session.history]
    assert shown == [pytest.approx(np.mean(on_the_page), abs=0.06)]
    assert all(40 <= latency < 540 for latency in on_the_page)


def test_the_first_rate_of_a_session_counts_from_its_start(session, jpeg, capsys):
    status = drive.StatusLine(session.server, terminal=False)
    status.time -= 3600  # an hour of waiting for a simulator
    session.server.sessions["sid"] = session
    session.answer(telemetry(jpeg))
    session.driven, session.started = 2000, time.perf_counter() - 200.0
    status.update()
    assert float(capsys.readouterr().err.split()[0]) == pytest.approx(10, rel=0.05)
    status.time, status.session = time.perf_counter() - 600, session  # the next line counts from the last one
    session.driven += 6000
    status.update()
    assert float(capsys.readouterr().err.split()[0]) == pytest.approx(10, rel=0.05)


def test_escape_sequences_are_for_terminals_only(session, jpeg, capsys):
    session.server.sessions["sid"] = session
    session.answer(telemetry(jpeg))
    for terminal in (True, False):
        status = drive.StatusLine(session.server, terminal)
        status.time -= 3600
        status.update()
        assert ("\033" in capsys.readouterr().err) is terminal


@pytest.mark.parametrize(
    "arguments",
    [["model.pt", "run1", "--port", "1"], ["model.pt", "--port", "1", "run1"], ["--port", "1", "model.pt", "run1"]],
)
def test_the_folder_may_follow_options(arguments):
    args = drive.parse_arguments(arguments)
    assert (str(args.model), str(args.folder), args.port) == ("model.pt", "run1", 1)


def test_which_model_drives(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert drive.choose_model(None, None) == SHIPPED_MODEL
    (tmp_path / "model.pt").touch()
    assert drive.choose_model(None, None) == Path("model.pt")
    assert drive.choose_model(Path("none.pt"), None) == Path("none.pt"), "whose loading tells that it is missing"
    (tmp_path / "run1").mkdir()
    for folder in ("run1", "run2"):
        with pytest.raises(UserError, match=f"`python drive.py model.pt {folder}`"):
            drive.choose_model(Path(folder), None)


# --------------------------------------------------------------------------------------------------
# Saved frames


def test_each_session_saves_in_a_folder_of_its_own(tmp_path):
    saver = frames.FrameSaver(tmp_path / "run1")
    first, second = saver.start_session(), saver.start_session()
    for n in range(300):  # many within one millisecond
        first.save(b"first %d" % n)
        second.save(b"second %d" % n)
    saver.close()
    for name, kind in (("run1", b"first"), ("run1-2", b"second")):
        paths = sorted((tmp_path / name).iterdir())
        assert [path.read_bytes() for path in paths] == [b"%s %d" % (kind, n) for n in range(300)]
        assert all(frames.taken_at(path.name) for path in paths)


def test_a_folder_is_emptied_of_frames_and_of_nothing_else(tmp_path):
    folder = tmp_path / "run1"
    folder.mkdir()
    (folder / "2018_07_16_17_11_43_382.jpg").write_bytes(b"old")
    frames.empty_folder(folder)
    assert list(folder.iterdir()) == []
    for foreign in ("notes.txt", "2018_13_40_17_11_43_382.jpg", "center_2018_07_16_17_11_43_382.jpg"):
        (folder / "2018_07_16_17_11_43_382.jpg").write_bytes(b"old")
        (folder / foreign).write_bytes(b"mine")
        with pytest.raises(frames.FolderError, match=foreign):
            frames.empty_folder(folder)
        assert len(list(folder.iterdir())) == 2
        (folder / foreign).unlink()
    with pytest.raises(frames.FolderError, match="not a folder"):
        frames.empty_folder(Path(__file__))


# --------------------------------------------------------------------------------------------------
# What the network looks at


def looking_at_what_is_bright() -> Network:
    """A network whose every layer passes on where the image is bright."""
    network = Network().eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        for layer in network.convolutions:
            layer.weight.fill_(1 / layer.weight[0].numel())
        network.convolutions[0].bias.fill_(0.9)  # black is -1: it falls below 0 and out of the positive part
    return network


def test_attention_to_an_even_image_has_no_grid():
    _, mask = attention.visual_backprop(looking_at_what_is_bright(), np.full((160, 320, 3), 255, np.uint8))
    middle = mask[60:135, 120:200]
    assert np.ptp(middle, axis=1).max() < 1e-4, "far from its sides, one column is like the other"
    rising = np.sign(np.diff(middle[:, 0][middle[:, 0] > 1e-4]))
    assert np.count_nonzero(np.diff(rising)) == 1, "from top to bottom it rises to one maximum, and falls"


def test_attention_is_where_the_network_can_see_anything():
    """A network that looks at what is bright looks at the bright spot, and nowhere else."""
    network = looking_at_what_is_bright()
    frame = np.zeros((160, 320, 3), np.uint8)
    frame[90:106, 200:216] = 255
    steering, mask = attention.visual_backprop(network, frame)
    assert steering == 0
    assert mask.shape == (160, 320) and mask.dtype == np.float32 and mask.max() == pytest.approx(1)
    assert not mask[:60].any() and not mask[135:].any(), "the rows that are cropped off"
    row, column = np.unravel_index(mask.argmax(), mask.shape)
    assert abs(row - 98) < 12 and abs(column - 208) < 12
    assert mask[:, :140].max() == 0


def middle(picture: np.ndarray) -> float:
    """The mean column of the line in an overlay, above the bonnet."""
    return (picture[..., 1] > 128)[:180].nonzero()[1].mean()


def test_the_line_bends_to_the_side_of_the_steering():
    frame = np.zeros((160, 320, 3), np.uint8)
    left, straight, right = (middle(overlay(frame, steering)) for steering in (-0.3, 0.0, 0.3))
    assert left < 300 < 340 < right
    assert abs(straight - 320) < 6  # the camera is turned by 0.7 degrees and rolled by 1.2


@pytest.mark.parametrize("output", [-4.9, 4.9])
def test_the_overlay_shows_the_steering_that_is_sent(output, jpeg):
    network = Network().eval()
    for parameter in network.dense[-1].parameters():
        torch.nn.init.zeros_(parameter)
    torch.nn.init.constant_(network.dense[-1].bias, output)
    sent = float(drive.Session(drive.DriveServer(network), {}).answer(telemetry(jpeg))["steering_angle"])
    frame = np.zeros((160, 320, 3), np.uint8)
    steering, _ = attention.visual_backprop(network, frame)
    assert steering == sent == np.sign(output)
    assert np.sign(middle(overlay(frame, steering)) - 320) == np.sign(output)
