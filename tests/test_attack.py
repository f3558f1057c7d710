"""drive.py under attack: every telemetry of a car beside it is answered, memory is bounded, and a new car can come."""

import json
import re
import socket
import sys
import time
import urllib.error
import urllib.request
from types import SimpleNamespace
from typing import Any

import pytest
from drive_process import serving

import drive
from cloning.network.network import Network
from cloning.server import page
from cloning.server.libraries import eventlet
from cloning.server.server import MAX_CLIENTS, QUIET
from cloning.server.turns import Account, Turns
from tools import attack
from tools.attacks import GET, all_attacks, frame
from tools.simulator_client import Simulator, telemetry

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory and open files are read from /proc")

SECONDS = 0.5  # of each attack; `python -m tools.attack` takes longer, and measures the round trips too


@pytest.fixture(scope="module")
def server(model_file):
    with attack.Target(model_file) as process:
        yield process


@pytest.fixture(scope="module")
def expected(server, jpegs) -> list[str]:
    car = attack.Car(server.port, jpegs)
    car.simulator.socket.close()
    return car.expected


@pytest.mark.parametrize("name", all_attacks())
def test_a_car_is_answered_beside_an_attack(server, jpegs, expected, name):
    report = attack.run(all_attacks()[name], server, jpegs, expected, SECONDS)
    assert report.faults(timely=False) == [], report


def test_the_attacks_find_a_fault(server, jpegs, expected):
    """What a car is told must be right: an answer that is not the expected one, and none at all, are found."""
    other = [expected[0]] * len(expected)
    assert "wrong" in attack.run(None, server, jpegs, other, SECONDS).faults()
    assert attack.Report(attack.Drive(asked=2, round_trips=[0.01]), 500.0, 9.0, 1).faults(timely=False) == [
        "lost",
        "memory",
        "new car",
        "left open",
    ]


def test_a_client_that_reads_nothing_is_disconnected(server):
    with Simulator(server.port) as stranger:
        stranger.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with pytest.raises(ConnectionError):
            for _ in range(10_000):
                stranger.socket.sendall(frame(b'42["telemetry",0]') * 100)


def test_a_long_ping_is_not_answered(server):
    with Simulator(server.port) as stranger:
        stranger.open()
        stranger.send("2" + "x" * 100_000)
        stranger.send("2")
        assert stranger.receive() == "3"


def test_one_client_too_many_waits_until_another_is_quiet(model_file, jpegs):
    with serving(model_file) as process:
        others = [Simulator(process.port) for _ in range(MAX_CLIENTS)]
        with Simulator(process.port) as refused:
            assert refused.status == 503
        until = time.monotonic() + QUIET + 1
        while time.monotonic() < until:
            for other in others[1:]:
                other.send("2")
            time.sleep(0.2)
        assert any("4 clients are connected already" in line for line in process.lines), "its user is told"
        with Simulator(process.port) as new:
            assert new.status == 101
            new.open()
            new.drive(telemetry(jpegs[0]))
        with pytest.raises(ConnectionError):
            others[0].open()
            others[0].receive()
        for other in others:
            other.socket.close()


def test_a_car_that_never_pings_is_answered(model_file, jpegs):
    """Two minutes pass in 1.2 seconds there, and a ping is due every 25 seconds."""
    fast = "import time; now = time.time; time.time = lambda: 100 * now()"
    with serving(model_file, first=fast) as process, Simulator(process.port) as simulator:
        simulator.open()
        until = time.monotonic() + 1.2
        while time.monotonic() < until:
            simulator.drive(telemetry(jpegs[0]))
            time.sleep(0.05)


@pytest.mark.parametrize(
    "query, reason",
    [
        ("EIO=9&transport=websocket", "EIO must be 3 or 4"),
        ("transport=polling", "EIO must be 3 or 4"),
        ("EIO=4", "transport must be"),
        ("EIO=4&transport=pigeon", "transport must be"),
        ("EIO=4&transport=websocket", "transport must be websocket, with the header Upgrade: websocket"),
        ("EIO=3&transport=polling&j=1", "JSONP"),
    ],
)
def test_an_odd_request_is_told_why_it_is_refused(server, query, reason):
    with pytest.raises(urllib.error.HTTPError, match="400") as error:
        urllib.request.urlopen(f"http://127.0.0.1:{server.port}/socket.io/?{query}", timeout=10)
    assert error.value.read().decode().startswith(reason)


def test_a_long_ping_has_a_short_pong_over_polling(server):
    def request(query="", body=None):
        address = f"http://127.0.0.1:{server.port}/socket.io/?EIO=3&transport=polling{query}"
        with urllib.request.urlopen(urllib.request.Request(address, body), timeout=10) as answer:
            return answer.read()

    [sid] = re.findall(r'"sid":"(\w+)"', request().decode("latin-1"))
    assert request(f"&sid={sid}", b"100001:2" + b"x" * 100_000) == b"OK"
    assert request(f"&sid={sid}") == b"\0\1\xff3"
    assert request(f"&sid={sid}", b"6:2probe") == b"OK"
    assert request(f"&sid={sid}").endswith(b"3probe")


@pytest.fixture
def work(monkeypatch):
    """What takes so many seconds of the server's one thread; nothing else does."""
    now = [0.0]
    monkeypatch.setattr("cloning.server.turns.time", SimpleNamespace(thread_time=lambda: now[0]))

    def work(seconds):
        now[0] += seconds

    return work


def test_work_is_charged_after_another_has_given_up(work):
    turns, account = Turns(), Account()

    def work_twice():
        with pytest.raises(eventlet.Timeout), eventlet.Timeout(0):
            turns.take(Account())
        turns.take(account)
        assert turns.working is account
        work(0.05)

    eventlet.spawn(work_twice).wait()
    eventlet.sleep(0.01)
    assert account.used == 0.05


def test_closed_pages_are_noticed_while_nobody_drives(server):
    def open_page():
        opened = socket.create_connection(("127.0.0.1", server.port))
        opened.sendall(GET % b"/live")
        assert opened.recv(12) == b"HTTP/1.1 200"
        return opened

    with open_page():
        before = server.open_files()
        for opened in [open_page() for _ in range(20)]:
            opened.close()
        until = time.monotonic() + 20
        while server.open_files() > before and time.monotonic() < until:
            time.sleep(0.05)
        assert server.open_files() <= before


def test_all_pages_share_a_picture(jpegs, monkeypatch):
    server, drawn, now = drive.DriveServer(Network().eval()), list[float](), [0.0]
    session = server.sessions["sid"] = drive.Session(server, {})

    def image(*_):
        drawn.append(now[0])
        return "picture"

    monkeypatch.setattr(page, "image", image)
    monkeypatch.setattr(page, "time", SimpleNamespace(monotonic=lambda: now[0], time=time.time))
    monkeypatch.setattr(page, "UPDATE_INTERVAL", 2**-10)
    pages = page.Pages(server, with_attention=True, pause=time.sleep)
    readers: list[Any] = [pages.events() for _ in range(50)]
    for interval in range(1, 4):
        now[0] = interval * 2**-10
        for _ in range(2):
            session.answer(telemetry(jpegs[0]))
        texts = {next(reader) for reader in readers}
        assert len(texts) == 1 and len(drawn) == interval
        event = json.loads(texts.pop()[6:])
        assert event["image"] == "picture" and [tuple(row) for row in event["rows"]] == list(session.history)[-2:]
    for reader in readers:
        reader.close()
    assert pages.open == 0


def test_a_new_page_gets_the_last_minute_in_as_many_rows_as_it_can_show(jpegs, monkeypatch):
    server, now = drive.DriveServer(Network().eval()), time.time()
    session = server.sessions["sid"] = drive.Session(server, {})
    session.answer(telemetry(jpegs[0]))
    session.history.extend(page.DrivenFrame(now - 50 + at / 120, 0, 9, 0.5, 3) for at in range(5 * page.SHOWN_FRAMES))
    monkeypatch.setattr(page, "image", lambda *_: "picture")
    pages = page.Pages(server, with_attention=False, pause=time.sleep)
    times = [row[0] for row in json.loads(next(pages.events())[6:])["rows"]]
    assert len(times) <= page.SHOWN_FRAMES and times == sorted(times)
    assert times[-1] == session.history[-1].time and times[-1] - times[0] > 49


def test_who_has_worked_least_goes_first(work):
    turns, order = Turns(), []

    def drive(account, seconds):
        for _ in range(30):
            turns.take(account)
            order.append(account)
            work(seconds)

    busy = [eventlet.spawn(drive, Account(), 0.001 + 1e-5 * n) for n in range(20)]
    seldom = Account()
    for _ in range(5):
        until = len(order) + 60
        while len(order) < until:
            eventlet.sleep(0)
        turns.take(seldom)
        assert len(order) - until <= 2, "one that is at work, and one that was about to be"
    for thread in busy:
        thread.wait()
    assert len(order) == 600
