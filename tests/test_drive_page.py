"""The page of drive.py: what it says goes on, the set speed that it changes, and its looks in a real Chromium."""

import http.client
import json
import re
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import CHROMIUM, chromium
from drive_process import serving
from test_drive import Car

import drive
from cloning.network.network import Network
from cloning.server import page as drive_page
from tools import bench_driving
from tools.simulator_client import Simulator, telemetry

needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")


@pytest.fixture(scope="module")
def network() -> Network:
    torch.manual_seed(3)
    return Network().eval()


@pytest.fixture(scope="module")
def server(model_file, tmp_path_factory):
    with serving(model_file, "run1", "--speed", "9", cwd=tmp_path_factory.mktemp("drive")) as process:
        yield process


# --------------------------------------------------------------------------------------------------
# The set speed


def test_a_change_of_the_set_speed_leaves_the_integral_as_it_is(network, jpegs):
    server = drive.DriveServer(network, 9)
    session = server.sessions["sid"] = drive.Session(server, {})
    for _ in range(50):
        session.answer(telemetry(jpegs[0], speed="8.0000"))
    assert session.controller.error_sum == pytest.approx(50)
    server.change_set_speed(12.0)
    answer = session.answer(telemetry(jpegs[0], speed="8.0000"))
    assert float(answer["throttle"]) == pytest.approx(0.1 * 4 + 0.002 * (50 + 4))
    assert drive.Session(server, {}).controller.set_speed == 12, "the next simulator is driven at it, too"


def test_the_car_settles_at_each_set_speed():
    controller, car = drive.SpeedController(9), Car()
    for set_speed in (9, 25, 12):
        before, controller.set_speed, speeds = car.speed, set_speed, []
        for _ in range(1500):
            car.step(controller.throttle(car.speed))
            speeds.append(car.speed)
        assert abs(car.speed - set_speed) < 0.2
        beyond = max(speeds) - set_speed if set_speed > before else set_speed - min(speeds)
        assert beyond < 2, "mph"


def ask(port: int, body: object, method: str = "POST", path: str = "/set-speed", **headers) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    connection.request(method, path, data, {"Content-Type": "application/json", **headers})
    answer = connection.getresponse()
    try:
        return answer.status, answer.read()
    finally:
        connection.close()


def shown(port: int) -> dict:
    """The figures that a page is told first."""
    time.sleep(2 * drive_page.UPDATE_INTERVAL)  # all pages are told the same in an interval
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("GET", "/live")
    try:
        return json.loads(connection.getresponse().readline()[6:])
    finally:
        connection.close()


def test_the_benchmark_finds_the_latencies_in_what_a_page_is_told(server, jpegs):
    with Simulator(server.port) as simulator:
        simulator.open()
        for _ in range(3):
            simulator.drive(telemetry(jpegs[0], speed="9.0000"))
        time.sleep(2 * drive_page.UPDATE_INTERVAL)
        told = SimpleNamespace(port=server.port, latencies=[])
        bench_driving.Server.read_latencies(told, 2)
    assert len(told.latencies) == 2 and all(0 < seconds < 60 for seconds in told.latencies)


def test_the_page_changes_the_set_speed_of_a_car_that_drives(server, jpegs):
    with Simulator(server.port) as simulator:
        simulator.open()
        for set_speed in (9.0, 11.5):
            origin = f"http://127.0.0.1:{server.port}"
            status, answer = ask(
                server.port, {"set_speed": f"{set_speed}"}, Origin=origin, Sec_Fetch_Site="same-origin"
            )
            assert (status, json.loads(answer)) == (200, {"set_speed": set_speed})
            throttle = float(simulator.drive(telemetry(jpegs[0], speed="9.0000"))["throttle"])
            assert throttle == pytest.approx(0.102 * (set_speed - 9), abs=1e-6)
            assert shown(server.port)["set_speed"] == set_speed
    assert ask(server.port, {"set_speed": "9"})[0] == 200


@pytest.mark.parametrize(
    "headers, status",
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Host": "evil.example"}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
        ({"Content_Type": "text/plain"}, 415),  # what a form of another site can send
        ({"Content_Type": "application/x-www-form-urlencoded"}, 415),
    ],
)
def test_no_other_site_changes_the_set_speed(server, headers, status):
    for path in ("/set-speed", "/") if status == 403 and "Sec_Fetch_Site" not in headers else ("/set-speed",):
        assert ask(server.port, {"set_speed": "20"}, path=path, **headers)[0] == status
    assert shown(server.port)["set_speed"] == 9


BODIES = [
    {},
    [],
    None,
    "20",
    {"set_speed": 20},
    {"set_speed": None},
    {"set_speed": "20", "more": "1"},
    b"",
    b"{",
    b"[" * 180,
]
WRONG = ["", "fast", "0", "0.05", "-9", "1001", "nan", "inf", "1e999", "9,5", "0x10"]


@pytest.mark.parametrize("text", WRONG)
def test_a_set_speed_that_the_command_line_refuses_is_refused(server, text):
    with pytest.raises(SystemExit):
        drive.parse_arguments([f"--speed={text}"])
    status, answer = ask(server.port, {"set_speed": text})
    assert status == 400 and "of at least 0.1 and at most 1000" in json.loads(answer)["message"]
    assert shown(server.port)["set_speed"] == 9


@pytest.mark.parametrize("body", BODIES, ids=lambda body: str(body)[:20])
def test_what_is_no_set_speed_is_refused(server, body):
    assert ask(server.port, body)[0] == 400
    assert ask(server.port, b" " * 1000)[0] == 413
    assert ask(server.port, b"", "GET")[0] == 405
    assert shown(server.port)["set_speed"] == 9


# --------------------------------------------------------------------------------------------------
# What is told


@pytest.mark.parametrize(
    "sent, cte",
    [
        *(("-0.5000", -0.5), ("0,2500", 0.25), ("12.3456-", -12.3456), (1.5, 1.5), ("0.0000", 0.0)),
        *((wrong, None) for wrong in ("NaN", "fast", "", None, [1], True, {}, "1e999", "9" * 100)),
    ],
)
def test_the_distance_from_the_centre_is_shown_or_ignored(network, jpegs, sent, cte):
    session = drive.Session(drive.DriveServer(network), {})
    plain = session.answer(telemetry(jpegs[0], speed="9.0000"))
    assert session.history[-1].cte is None
    assert session.answer({**telemetry(jpegs[0], speed="9.0000"), "cte": sent}) == plain
    assert session.history[-1].cte == cte and session.unusable == 0


def test_the_state_is_what_happens(network, jpegs, monkeypatch):
    server = drive.DriveServer(network)
    monkeypatch.setattr(server.socket, "emit", lambda *_, **__: None)
    monkeypatch.setitem(server.socket.environ, "sid", {})

    def state(later: float = 0.0) -> str:
        return drive_page.state_of(server.watched_session(), time.time() + later)

    assert state() == "waiting"
    server.connect("sid")
    assert state() == "waiting", "nothing has come yet"
    server.telemetry("sid", {})
    assert state() == "unusable" and server.watched_session().reason == "speed is missing"
    server.telemetry("sid", telemetry(jpegs[0]))
    assert state() == "driving"
    server.telemetry("sid", {})
    assert state() == "driving", "one frame in between"
    server.telemetry("sid", None)
    assert state() == "manual"
    server.telemetry("sid", telemetry(jpegs[0]))
    assert state() == "driving"
    assert state(3 * drive_page.SILENCE) == "silent"
    server.disconnect("sid")
    assert state() == state(1000) == "gone"
    figures = drive_page.figures(server, server.watched_session(), time.time())
    assert (figures["frames"], figures["unusable"], figures["reason"]) == (2, 2, "speed is missing")


def test_a_page_is_told_of_a_change_at_once_and_else_once_a_second(network, monkeypatch):
    server, naps = drive.DriveServer(network), []

    def pause(seconds):
        naps.append(seconds)
        time.sleep(seconds)

    monkeypatch.setattr(drive_page, "UPDATE_INTERVAL", 2**-10)
    events = drive_page.Pages(server, with_attention=False, pause=pause).events()
    assert json.loads(next(events)[6:]) == {"state": "waiting", "set_speed": 9.0, "saving": "", "saver": False}
    next(events)
    assert len(naps) == 1 + drive_page.QUIET_INTERVALS
    session = server.sessions["sid"] = drive.Session(server, {})
    session.heard, session.manual = time.time(), True
    assert json.loads(next(events)[6:])["state"] == "manual"
    assert len(naps) <= drive_page.QUIET_INTERVALS + 3
    events.close()


def test_frames_per_second_are_those_of_the_last_two(network):
    server, now = drive.DriveServer(network), time.time()
    session = drive.Session(server, {})
    session.history.extend(drive_page.DrivenFrame(now - 10 + at / 20, 0, 9, 0.5, 3) for at in range(200))
    assert drive_page.figures(server, session, now)["rate"] == pytest.approx(20, rel=0.05)
    assert drive_page.figures(server, session, now + 1)["rate"] == pytest.approx(10, rel=0.1)
    assert drive_page.figures(server, session, now + 9)["rate"] == 0


# --------------------------------------------------------------------------------------------------
# In a browser


class Feeder:
    """A simulator that sends one message after the other, until it is told to send another one."""

    def __init__(self, port: int, message: object):
        self.message, self.going = message, True
        self.simulator = Simulator(port)
        self.simulator.open()
        self.thread = threading.Thread(target=self.feed)
        self.thread.start()

    def feed(self):
        while self.going:
            self.simulator.send("42" + json.dumps(["telemetry", self.message]))
            self.simulator.receive()
            time.sleep(0.02)

    def stop(self):
        self.going = False
        self.thread.join()


@contextmanager
def feeding(port: int, message: object):
    feeder = Feeder(port, message)
    try:
        yield feeder
    finally:
        feeder.stop()
        feeder.simulator.socket.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page


SPEED = "document.querySelectorAll('#plots figure')[1].textContent"
PLOTS = "[...document.querySelectorAll('#plots figure')].filter(each => !each.hidden).length"


@needs_chromium
def test_a_drive_is_watched_and_its_set_speed_changed_with_the_keyboard_alone(model_file, jpegs, page, tmp_path):
    state = "document.querySelector('#state').textContent"
    with serving(model_file, "run1", cwd=tmp_path) as server:
        page.look(1280, 800)
        page.open(f"http://127.0.0.1:{server.port}/")
        page.wait("document.querySelector('#state')?.textContent == 'Waiting for a simulator'")
        assert page.run("document.title") == "Waiting for a simulator"
        assert page.run("document.querySelector('#image').hidden && document.images.length == 1")
        assert str(model_file) in page.text() and "begins with the first frame" in page.text()
        usual = telemetry(jpegs[0], speed="9.0000")
        with feeding(server.port, usual) as feeder:
            page.wait(f"{state} == 'Driving'")
            page.wait("document.querySelector('#image').naturalWidth == 640")
            page.wait("document.querySelector('#saving').textContent.endsWith('frames saved in run1')")
            page.wait("document.querySelector('#rate').textContent > 0")
            assert page.run(PLOTS) == 4, "no distance from the centre"
            assert page.run("document.querySelector('#unusable').textContent") == "0"
            for key in ("Tab", *"21", "Enter"):  # the first control is the set speed; Tab selects what is in it
                page.press(key)
            page.wait("document.querySelector('#answer').textContent == 'drives at 21 mph'")
            page.wait(f"{SPEED}.includes('set speed 21 mph')")
            for key in (*"9999", "Enter"):
                page.press(key)
            assert page.run("document.querySelector('#speed').matches(':invalid')")
            for key in ("Tab", "Tab", " "):
                page.press(key)
            page.wait("document.querySelector('#attention').checked")
            feeder.message = {**usual, "cte": "-0.7500"}
            page.wait(f"{PLOTS} == 5 && document.querySelector('#plots').textContent.includes('-0.75 m')")
            feeder.message = {**usual, "speed": "fast"}
            page.wait(f"{state} == 'No frame can be used'")
            page.wait("document.querySelector('#unusable').textContent.endsWith('speed is not a number')")
            feeder.message = None
            page.wait(f"{state} == 'A person drives'")
            feeder.stop()
            page.wait(f"{state} == 'The simulator is silent'")
        page.wait(f"{state} == 'The simulator has gone'")
        assert not page.run("document.querySelector('#image').hidden")
        assert page.complaints() == []
        own = (f"http://127.0.0.1:{server.port}/", "data:", "about:")
        assert all(address.startswith(own) for address in page.addresses()), "no outside host"
    page.wait(f"{state} == 'drive.py does not answer'")


@needs_chromium
def test_a_spike_does_not_squash_the_rest(server, jpegs, page):
    assert ask(server.port, {"set_speed": "9"})[0] == 200
    page.open(f"http://127.0.0.1:{server.port}/")
    with Simulator(server.port) as simulator:
        simulator.open()
        for n in range(30):
            simulator.drive(telemetry(jpegs[n % 8], speed="300.0000" if n == 20 else f"{8 + n / 30:.4f}"))
        page.wait(f"window.uPlot && {SPEED}.includes('beyond the scale: 300.0 mph')")
        # All but the spike take up most of the height: the curve's pixels, by row, from the plot's own canvas.
        lines = page.run("""(() => {
          const canvas = document.querySelectorAll('#plots figure')[1].querySelector('canvas');
          const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
          const blue = [];
          for (let at = 0; at < data.length; at += 4) {
            if (data[at + 3] > 100 && data[at + 2] - data[at] > 100) blue.push(Math.floor(at / 4 / canvas.width));
          }
          return blue.map(row => row / canvas.height);
        })()""")
    assert np.mean(lines) < 0.35, "at 8 to 9 mph on a scale from 0 to 10"


LOOKS = [(width, dark) for width in (390, 1280, 2200) for dark in (False, True)]


@needs_chromium
@pytest.mark.parametrize("width, dark", LOOKS)
def test_the_page_fits_every_screen_and_bars_nobody(server, jpegs, page, width, dark):
    page.look(width, 900, dark)
    page.open(f"http://127.0.0.1:{server.port}/")
    with feeding(server.port, {**telemetry(jpegs[0], speed="8.5000"), "cte": "0.2500"}):
        page.wait("document.querySelector('#state')?.textContent == 'Driving'")
        page.wait(f"{PLOTS} == 5")
        assert page.run("document.documentElement.scrollWidth <= innerWidth")
        ink, paper = page.run(
            "[getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor]"
        )
        level = [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in (ink, paper)]
        assert (level[0] > level[1]) == dark and abs(level[0] - level[1]) > 400
        assert page.barriers() == []
