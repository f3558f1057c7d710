"""The page of drive.py: what it says goes on, the set speed that it changes, and its looks in a real Chromium."""

import json
import mimetypes
import subprocess
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from browse_process import LATE
from browser import LOOKS, decoded, needs_chromium
from drive_process import ask, live, serving

import drive
from cloning.base import program
from cloning.road.track import centre_line
from cloning.server import page as drive_page
from tools import bench_driving
from tools.simulator_client import Simulator, telemetry


@pytest.fixture(scope="module")
def server(model_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    (folder / "numpy.py").write_text("raise SystemExit", encoding="utf-8")  # someone else's file, which nothing runs
    with serving(model_file, "run1", "--speed", "9", cwd=folder) as process:
        yield process


# ----------------------------------------------------------------------------------------------------------------------
# The set speed


def change_set_speed(server, body: object, **headers: str) -> tuple[int, bytes]:
    return ask(server.port, "/set-speed", "POST", body, **headers)[:2]


def shown(server, query: str = "") -> dict:
    """The figures that a page is given first."""
    time.sleep(2 * drive_page.UPDATE_INTERVAL)  # all pages get the same in an interval
    return live(server.port, query)


def test_a_page_is_given_what_was_driven(server, jpegs):
    with Simulator(server.port).open() as simulator:
        for _ in range(3):
            simulator.drive(telemetry(jpegs[0], speed="8.5000"))
        for query in ("", "?attention"):
            figures = shown(server, query)
            time_stamp, _, speed, throttle, latency, *_ = figures["rows"][-1]
            assert abs(time_stamp - time.monotonic()) < 60 and speed == 8.5 and throttle > 0 and 0 < latency < 10_000
            assert figures["image"].startswith("/9j/")


def test_an_interrupted_benchmark_closes_its_page(server, monkeypatch):
    started, start = [], subprocess.Popen

    def noted(*command, **options):
        started.append(start(*command, **options))
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", noted)
    with pytest.raises(KeyboardInterrupt), bench_driving.open_page(server.port):
        raise KeyboardInterrupt
    assert started[0].poll() is not None


def test_any_road_that_the_stand_in_names_is_drawn(server, jpegs):
    with Simulator(server.port).open() as simulator:
        for track in ("mountain-7", "nowhere", "a\0b", "\ud800", "lake"):
            simulator.drive({**telemetry(jpegs[0]), "stand_in": {**PLACE, "track": track}})
            status, body, _ = ask(server.port, "/road")
            expected: Any = centre_line(track)[:, :2] if track in ("mountain-7", "lake") else []
            found = json.loads(body)
            assert status == 200 and (found["track"], len(found["points"])) == (track, len(expected))
            assert np.abs(np.array(found["points"]) - expected).max(initial=0) < 0.051


def test_scripts_are_scripts_whatever_the_machine_calls_them(network, monkeypatch):
    """Windows' registry may say text/plain, which no browser runs."""
    monkeypatch.setattr(mimetypes, "_db", mimetypes.MimeTypes())
    mimetypes.add_type("text/plain", ".js")
    app = drive_page.create_app(drive.DriveServer(network), time.sleep)
    for name, kind in (("drive.js", "text/javascript"), ("style.css", "text/css")):
        assert app.test_client().get(f"/site/{name}").content_type.startswith(kind)


def test_the_benchmark_answers_a_ping_and_waits_for_the_answer():
    packets, sent = ["first", "2", "second"], list[str]()
    telemetries = SimpleNamespace(sendall=lambda data: None)
    client = SimpleNamespace(socket=telemetries, receive=lambda: packets.pop(0), send=sent.append)
    measured: Any = SimpleNamespace(client=client, cpu_seconds=float)
    bench_driving.Server.drive(measured, [[b"1"], [b"2"]], count=False)
    assert not packets and sent == ["3"]


def test_the_page_changes_the_set_speed_of_a_car_that_drives(server, jpegs):
    """The sum of its controller stays, and the next simulator is driven at the new speed, too."""
    usual = telemetry(jpegs[0], speed="9.0000")
    with Simulator(server.port).open() as simulator:
        for set_speed in (11.5, 9.0):
            own = {"Origin": f"http://127.0.0.1:{server.port}", "Sec_Fetch_Site": "same-origin"}
            status, answer = change_set_speed(server, {"set_speed": f"{set_speed}"}, **own)
            assert (status, json.loads(answer)) == (200, {"set_speed": set_speed})
            throttle = float(simulator.drive(usual)["throttle"])
            assert throttle == pytest.approx(0.102 * (set_speed - 9) + 0.002 * 2.5 * (set_speed == 9), abs=1e-6)
            with Simulator(server.port).open() as other:
                assert float(other.drive(usual)["throttle"]) == pytest.approx(0.102 * (set_speed - 9), abs=1e-6)
            assert shown(server)["set_speed"] == set_speed


@pytest.mark.parametrize(
    "headers, status",
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Host": "localhost.evil.example:80"}, 403),
        ({"Host": "0.0.0.0:80"}, 403),  # to which browsers send no Sec-Fetch-Site
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
        ({"Content_Type": "text/plain"}, 415),  # what a form of another site can send
        ({"Content_Type": "application/x-www-form-urlencoded"}, 415),
    ],
)
def test_no_other_site_changes_the_set_speed(server, headers, status):
    assert change_set_speed(server, {"set_speed": "20"}, **headers)[0] == status
    if status == 403 and "Sec_Fetch_Site" not in headers:
        for path in ("/", "/live", "/socket.io/?EIO=3&transport=polling"):
            assert ask(server.port, path, **headers)[0] == 403
    assert shown(server)["set_speed"] == 9


def test_what_is_no_set_speed_is_refused(server):
    for text in ("", "fast", "-0.1", "-9", "30.1", "1000", "nan", "inf", "1e999", "9,5", "0x10"):
        with pytest.raises(SystemExit):
            drive.parse_arguments([f"--speed={text}"])
        status, answer = change_set_speed(server, {"set_speed": text})
        assert status == 400 and "of at least 0 and at most 30" in json.loads(answer)["message"]
    bodies: list[object] = [{}, [], "20", {"set_speed": 20}, {"set_speed": None}, {"set_speed": "20", "more": "1"}]
    for body in (*bodies, b"null", b"", b"{", b"[" * 180):
        assert change_set_speed(server, body)[0] == 400
        assert ask(server.port, "/record", "POST", body)[0] == 400
    assert change_set_speed(server, b" " * 1000)[0] == 413
    assert ask(server.port, "/set-speed")[0] == 405
    assert shown(server)["set_speed"] == 9


# ----------------------------------------------------------------------------------------------------------------------
# What is shown


def test_the_state_is_what_happens(network, jpegs, monkeypatch):
    server = drive.DriveServer(network)
    monkeypatch.setattr(server.socket, "emit", lambda *_, **__: None)
    monkeypatch.setattr(server.socket, "arrived", lambda _: time.perf_counter())

    def state(later: float = 0.0) -> str:
        return drive_page.state_of(server.watched_session(), time.monotonic() + later)

    assert state() == "waiting"
    server.connect("sid")
    assert state() == "waiting", "nothing has come yet"
    for message, wanted in (
        ({}, "unusable"),
        (telemetry(jpegs[0]), "driving"),
        ({}, "driving"),  # one frame in between
        (None, "manual"),
        (telemetry(jpegs[0]), "driving"),
    ):
        server.telemetry("sid", message)
        assert state() == wanted
    assert state(3 * drive_page.SILENCE) == "silent"
    server.disconnect("sid")
    assert state() == state(1000) == "gone"
    figures = drive_page.figures(server, server.watched_session(), time.monotonic())
    assert (figures["frames"], figures["unusable"]) == (2, 2) and figures["reason"].startswith("speed is missing")


@pytest.mark.parametrize("tick", [1e-9, 1 / 64])  # s: of the clock; up to Python 3.12 the latter on Windows
def test_a_page_is_told_of_a_change_at_once_and_else_once_a_second(network, monkeypatch, tick):
    server, pause = drive.DriveServer(network), Mock(side_effect=time.sleep)
    clocks = SimpleNamespace(monotonic=lambda: time.monotonic() // tick * tick, perf_counter=time.perf_counter)
    monkeypatch.setattr(drive_page, "time", clocks)
    monkeypatch.setattr(drive_page, "UPDATE_INTERVAL", 2**-10)
    events = drive_page.Pages(server, with_attention=False, pause=pause).events()
    quiet = {"state": "waiting", "set_speed": 9.0, "go_speed": 9.0, "recording": False}
    assert json.loads(next(events)[6:]) == quiet
    next(events)
    assert pause.call_count == 1 + drive_page.QUIET_INTERVALS
    session = server.sessions["sid"] = drive.Session(server)
    session.heard, session.manual = time.monotonic(), True
    assert json.loads(next(events)[6:])["state"] == "manual"
    assert pause.call_count <= drive_page.QUIET_INTERVALS + 3


def test_commands_are_the_installed_projects_and_lead_to_the_server(network, monkeypatch):
    server = drive.DriveServer(network)
    browser = drive_page.create_app(server, time.sleep).test_client()
    assert f"<code>{program.ACTIVATE}</code>" in browser.get("/").text
    monkeypatch.setattr(program, "installed", {"python video.py": "bc video", "python -m simulator": "bc simulator"})
    session: Any = drive.Session(server)
    session.folder = SimpleNamespace(path=Path("run1"), progress=str)
    assert drive_page.figures(server, session, 0.0)["film"] == "bc video run1"
    assert drive_page.stand_in("drive", "127.0.0.1", "4567") == "bc simulator drive"
    assert drive_page.stand_in("drive", "::1", "4568") == "bc simulator drive --host ::1 --port 4568"
    page = browser.get("/", base_url="http://[::1]").text  # a browser does not name port 80
    assert "<code>bc simulator drive --realtime --track jungle --host ::1 --port 80<" in page and "activate" not in page


def test_frames_per_second_are_those_of_the_last_two(network):
    server, now = drive.DriveServer(network), time.monotonic()
    session = drive.Session(server)
    session.history.extend(drive_page.DrivenFrame(now - 10 + at / 20, 0, 9, 0.5, 3) for at in range(200))
    assert drive_page.figures(server, session, now)["rate"] == pytest.approx(20, rel=0.05)
    assert drive_page.figures(server, session, now + 1)["rate"] == pytest.approx(10, rel=0.1)
    assert drive_page.figures(server, session, now + 9)["rate"] == 0


# ----------------------------------------------------------------------------------------------------------------------
# In a browser


@contextmanager
def feeding(port: int, message: object):
    """A simulator that sends `message` one time after the other, until it is set to another one or `going` to False."""
    feeder = SimpleNamespace(message=message, going=True)

    def feed():
        while feeder.going:
            simulator.send("42" + json.dumps(["telemetry", feeder.message]))
            simulator.receive()
            time.sleep(0.02)

    with Simulator(port).open() as simulator:
        thread = threading.Thread(target=feed)
        thread.start()
        try:
            yield feeder
        finally:
            feeder.going = False
            thread.join()


STARTS = ("drive --realtime --track jungle", "window --autonomous")  # the stand-in simulator, of which the page tells
PLACE = {"track": "jungle", "x": 3.0, "y": 4.5, "offset": 0.5, "departures": 2, "time": 12.0}
PLOTS = "[...document.querySelectorAll('#plots figure')].filter(each => !each.hidden).length"


@needs_chromium
def test_a_drive_is_watched_and_its_set_speed_changed_with_the_keyboard_alone(model_file, jpegs, page, tmp_path):
    sky = cv2.resize(decoded(jpegs[0]), None, fx=2, fy=2)[:130]  # the upper part of the image has no line

    def shows_the_sky() -> bool:
        return cv2.matchTemplate(page.screenshot(), sky, cv2.TM_SQDIFF_NORMED).min() < 0.01

    with serving(model_file, "run 1", cwd=tmp_path) as server:
        own = f"http://127.0.0.1:{server.port}/"
        page.look(687, 800)  # where the image is as wide as its pixels
        page.open(own)
        page.shows("#state", "Waiting for a simulator")
        assert page.run("document.title") == "Waiting for a simulator"
        assert page.run("document.querySelector('#camera').hidden && document.querySelector('#plots').hidden")
        commands = page.run("[...document.querySelectorAll('#start code')].map(each => each.innerText)")
        assert [f"python -m simulator {words} --port {server.port}" for words in STARTS] == commands[1:]
        assert "connects to port 4567 only" in page.text("#start")
        assert str(model_file) in page.text() and "begins with the first frame" in page.text()
        usual = telemetry(jpegs[0], speed="9.0000")
        with feeding(server.port, usual) as feeder:
            page.shows("#state", "Driving")
            page.shows("#saving", "frames saved in run 1")
            page.wait("document.querySelector('#rate').textContent > 0")
            page.until(shows_the_sky)
            assert page.run(PLOTS) == 4, "no distance from the centre"
            assert page.text("#unusable") == "0"
            for keys, answer in (
                (("Tab", " "), "the car stops"),  # the first control
                ((" ",), "drives at 9 mph"),
                (("Tab", "ArrowRight"), "drives at 9.5 mph"),
                (("Tab", " "), "recording has ended"),
            ):
                for key in keys:
                    page.press(key)
                page.shows("#answer", answer)
                page.shows("#stop", "Go" if "stops" in answer else "Stop")
                page.shows("#state", "Stopping" if "stops" in answer else "Driving")
            page.shows("#plots", "set speed 9.5 mph")
            page.shows("#record", "Record")
            page.press(" ")
            page.shows("#record", "Stop recording")
            assert page.run("record.ariaPressed") is None, "else one might take it for having stopped"
            page.shows("#saving", "frames saved in run 1-2")
            page.shows("#film", "python video.py 'run 1-2'")
            page.shows("#convert", "python -m cloning.lerobot 'run 1-2' --output 'run 1-2-recording'")
            page.shows("#browse", "python -m cloning.browse 'run 1-2-recording'")
            for key in ("Tab", " "):
                page.press(key)
            page.wait("document.querySelector('#attention').checked")
            feeder.message = {**usual, "cte": "-0.7500"}
            page.shows("#plots", "-0.75 m")
            assert page.run(PLOTS) == 5 and "0.75 m from the lane's centre" in page.text("#now")
            page.run("own = fetch; fetch = async () => { fetch = own; throw new Error('cut off'); }; 0")
            feeder.message = {**usual, "stand_in": {**PLACE, "offset": 1.2}}
            page.shows("#now-distance", "1.20 m right of the lane's centre")
            page.shows("#now-departures", "2 departures")
            assert page.run("document.querySelector('#now-distance').className") == "off"
            page.shows("#plots", "dashed: 1 and 2.5 m")
            page.wait("document.querySelector('#map .road').getAttribute('d')?.length > 1000")
            feeder.message = {**usual, "stand_in": {**PLACE, "offset": -2.6, "track": "nowhere"}}
            page.shows("#now-distance", "2.60 m left of")
            page.wait("document.querySelector('#map').hidden")
            assert page.run("document.querySelector('#now-distance').className") == "far"
            page.drag("#speed", 0.3, 0.8)  # while the page is told of the speed before
            page.shows("#answer", "drives at 2")
            feeder.message = {**usual, "speed": "fast"}
            page.shows("#state", "No frame can be used")
            page.shows("#unusable", "speed is not a number")
            feeder.message = None
            page.shows("#state", "A person drives")
            feeder.going = False
            page.shows("#state", "The simulator is silent")
        page.shows("#state", "The simulator has gone")
        assert not page.run("document.querySelector('#camera').hidden")
        assert page.complaints() == []
        assert all(address.startswith((own, "data:", "about:")) for address in page.addresses()), "no outside host"
        assert not any(address.startswith("data:image") for address in page.addresses()), "the browser would keep them"
        status, body, _ = ask(server.port, "/browse")
        assert (status, b"does not run" in body) in ((503, True), (302, False)), "a browser of recordings may run here"
    page.shows("#state", "drive.py does not answer")
    page.click("#stop")
    page.shows("#answer", "drive.py does not answer")
    with serving(model_file, "--speed", "12", port=server.port, cwd=tmp_path):
        page.shows("#state", "Waiting for a simulator")
        page.wait("document.querySelector('#speed').value == 12")
        assert page.text("#answer") == ""


@needs_chromium
def test_each_key_on_the_slider_counts_and_a_stopped_car_stays_until_go(model_file, jpegs, page, tmp_path):
    """Over a slow connection, while the server tells of the speed before; and after the page was loaded again."""
    with serving(model_file, cwd=tmp_path) as server, feeding(server.port, telemetry(jpegs[0], speed="9.0000")):
        page.open(own := f"http://127.0.0.1:{server.port}/")
        page.shows("#set-speed", "9 mph")
        wait = "await new Promise(go => setTimeout(go, 3000))"  # 0.3 s
        page.run(f"own = fetch; fetch = async (...what) => {{ {wait}; return own(...what); }}; speed.focus()")
        for _ in range(4):
            page.press("ArrowRight")
            page.run("new Promise(go => setTimeout(go, 2000))")
        page.shows("#answer", "drives at 11 mph")
        page.click("#stop")
        page.shows("#set-speed", "11 mph, stopped")
        page.open(own)
        page.shows("#set-speed", "11 mph, stopped")
        page.run("speed.focus()")
        page.press("ArrowLeft")
        page.shows("#answer", "Go drives at 10.5 mph")
        assert shown(server)["set_speed"] == 0
        page.click("#stop")
        page.shows("#answer", "drives at 10.5 mph")


@needs_chromium
def test_the_road_on_the_map_is_the_one_that_the_car_drives_on(server, jpegs, page):
    """Also if the answer about another one comes later, or the server knew of none yet."""
    road = "document.querySelector('#map .road').getAttribute('d')?.length"
    page.open(f"http://127.0.0.1:{server.port}/")
    page.run("own = fetch; fetch = async () => { fetch = own; return new Response('{}'); }; 0")
    message = telemetry(jpegs[0], speed="9.0000")
    with feeding(server.port, {**message, "stand_in": {**PLACE, "track": "lake"}}) as feeder:
        page.wait(f"{road} > 1000")
        long = page.run(road)
        page.run(LATE % "/road")
        feeder.message = {**message, "stand_in": {**PLACE, "track": "jungle"}}
        page.wait("late.go")
        feeder.message = {**message, "stand_in": {**PLACE, "track": "lake"}}
        page.wait(f"{road} == {long}")
        page.run("late.go(); new Promise(done => setTimeout(done, 5000))")
        page.wait(f"{road} == {long}")


@needs_chromium
def test_a_page_that_nobody_sees_asks_for_nothing_and_another_for_one_stream(server, page):
    """Also one in a tab behind, its attention chosen before, and where a closed stream comes back, as in Safari."""
    own = f"http://127.0.0.1:{server.port}/"
    code = """hidden = true, streams = [];
        Object.defineProperty(document, 'hidden', {get: () => hidden});
        EventSource = class extends EventSource { constructor(...all) { streams.push(super(...all)); } };"""
    script = page.send("Page.addScriptToEvaluateOnNewDocument", source=code)
    try:
        page.open(own)
        turn = "document.dispatchEvent(new Event('visibilitychange'))"
        page.wait("document.readyState == 'complete'")
        assert page.run("streams.length") == 0
        page.run(f"attention.checked = true; hidden = false; {turn}; hidden = true; {turn}; hidden = false; {turn}")
        page.wait("streams[1].readyState == 1 && streams[1].url.endsWith('/live?attention') && !magenta.hidden")
        page.run("streams[0].dispatchEvent(new Event('error')); new Promise(done => setTimeout(done, 20000))")  # 2 s
        assert page.run("streams.map(each => each.readyState)") == [2, 1], "closed, open"
    finally:
        page.send("Page.removeScriptToEvaluateOnNewDocument", **script)


@needs_chromium
def test_a_spike_does_not_squash_the_rest(server, jpegs, page):
    page.open(f"http://127.0.0.1:{server.port}/")
    with Simulator(server.port).open() as simulator:
        for n in range(30):
            simulator.drive(telemetry(jpegs[n % 8], speed="300.0000" if n == 20 else f"{8 + n / 30:.4f}"))
        page.shows("#plots", "beyond the scale: 300.0 mph")
        # All but the spike take up most of the height: the curve's pixels, by row, from the plot's own canvas.
        lines = page.run("""(() => {
          const canvas = document.querySelectorAll('#plots figure')[2].querySelector('canvas');
          const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
          const blue = [];
          for (let at = 0; at < data.length; at += 4) {
            if (data[at + 3] > 100 && data[at + 2] - data[at] > 100) blue.push(Math.floor(at / 4 / canvas.width));
          }
          return blue.map(row => row / canvas.height);
        })()""")
    assert np.mean(lines) < 0.35, "at 8 to 9 mph on a scale from 0 to 10"


@needs_chromium
@pytest.mark.parametrize("width, dark", LOOKS)
def test_the_page_fits_every_screen_and_bars_nobody(server, jpegs, page, width, dark):
    page.look(width, 900, dark)
    page.open(f"http://127.0.0.1:{server.port}/")
    with feeding(server.port, {**telemetry(jpegs[0], speed="8.5000"), "cte": "0.2500"}):
        page.shows("#state", "Driving")
        page.wait(f"{PLOTS} == 5")
        page.check_look(width, dark)
        figures = "[...document.querySelectorAll('#plots figure')]"
        high = f"Math.max(...{figures}.map(each => each.getBoundingClientRect().bottom))"
        page.wait(f"{width} < 900 || {high} <= 900")  # all curves on one screen, once their sizes fit
        right = f"Math.max(...{figures}.map(each => each.getBoundingClientRect().right))"
        assert page.run(f"{right} / innerWidth") > 0.93, "the whole width is used"
