"""drive.py under attack: every telemetry of a car beside it is answered, memory is bounded, and a new car can come."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import DEFAULT, Mock

import pytest
import warm
from drive_process import ask, awaited, live, serving

import drive
from cloning.base.errors import UserError
from cloning.server import page
from cloning.server.connections import MAX_CONNECTIONS
from cloning.server.libraries import engineio
from cloning.server.server import MAX_CLIENTS, MAX_UNANSWERED, QUIET, Client, Server
from tools import attack, soak
from tools.attacks import GET, WEBSOCKET, all_attacks, frame
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


def test_a_server_leaves_the_sessions_of_others_in_its_process_as_they_are():
    own, other = Server().eio, engineio.Server(async_mode="threading")
    assert type(engineio.socket.Socket(own, "sid")) is Client
    assert type(engineio.socket.Socket(other, "sid")) is Client.__base__


@pytest.mark.parametrize("name", all_attacks())
def test_a_car_is_answered_beside_an_attack(server, jpegs, expected, name):
    report = attack.run(all_attacks()[name], server, jpegs, expected, SECONDS)
    assert report.faults(timely=False) == [], report


def test_the_attacks_find_a_fault(server, jpegs, expected):
    """What a car is told must be right: an answer that is not the expected one, and none at all, are found."""
    other = [expected[0]] * len(expected)
    assert "wrong" in attack.run(None, server, jpegs, other, SECONDS).faults()
    report = attack.Report(attack.Drive(asked=2, round_trips=[0.01]), 500.0, 100.0, 9.0, 1)
    assert report.faults(timely=False) == ["lost", "memory", "new car", "left open"]


def test_a_start_that_takes_long_leaves_the_car_its_time(server, jpegs, expected, monkeypatch):
    @contextmanager
    def slowly():
        time.sleep(0.2)
        yield

    monkeypatch.setattr(attack, "starting", slowly)
    assert attack.run(None, server, jpegs, expected, 0.1).drive.answered


def test_an_attack_that_fails_is_not_withstood(server, jpegs, expected):
    def broken(port: int, until: float) -> None:
        raise ValueError

    with pytest.raises(RuntimeError, match="the attack itself has failed"):
        attack.run(broken, server, jpegs, expected, SECONDS)


INTERRUPTED = """
import os, signal, time
from types import SimpleNamespace
from cloning.base import program
program.end_on_interrupt("test")
from tools import attack

def strike(port, until):
    print(os.getpid(), flush=True)
    os.killpg(0, signal.SIGINT)
    time.sleep(60)

attack.Car = lambda *_: SimpleNamespace(drive=lambda until: time.sleep(60))
server = SimpleNamespace(port=0, forget_peak=int, memory=int, open_files=int)
program.run(lambda: attack.run(strike, server, [], [], 60))
"""


def test_ctrl_c_ends_an_attack_too():
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = warm.Popen([sys.executable, "-c", INTERRUPTED], text=True, start_new_session=True, **pipes)
    attacker, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, "test: stopped\n")
    with pytest.raises(ProcessLookupError):
        os.kill(int(attacker), 0)


TERMINATED = """
import os, signal, sys, time
sys.argv[0] = "-m"
from tools.command import ServerProcess
with ServerProcess("-c", "import sys, time; print('Listening on 0:1', file=sys.stderr); time.sleep(60)") as server:
    print(server.process.pid, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(60)
"""


def test_a_tool_that_is_ended_ends_its_server():
    ended = subprocess.run([sys.executable, "-c", TERMINATED], capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGTERM, "")
    with pytest.raises(ProcessLookupError):
        os.kill(int(ended.stdout), 0)


def test_a_client_that_reads_nothing_is_disconnected(server):
    with socket.socket() as stranger:
        stranger.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stranger.settimeout(20)
        stranger.connect(("127.0.0.1", server.port))
        stranger.sendall(WEBSOCKET % b"")
        assert stranger.recv(13) == b"HTTP/1.1 101 "
        with pytest.raises(ConnectionError):
            for _ in range(1000):
                stranger.sendall(frame(b"x" * 125, 0x89) * 1000)  # pings, whose answers fill the system's buffers soon


@pytest.mark.parametrize("text", [b"42[", b"7", b"3", b"", b'42["other",1]'])
def test_a_client_whose_messages_have_no_answer_is_disconnected(server, text):
    """So that the server does not work for long on what is left of a client that has gone."""
    with Simulator(server.port).open() as stranger:
        for _ in range(20):
            stranger.socket.sendall(frame(text) * 90)
            stranger.send("2")
            assert stranger.receive() == "3"
        stranger.socket.sendall(frame(text) * (MAX_UNANSWERED + 1))
        with pytest.raises(ConnectionError):
            stranger.receive()


def test_a_long_ping_is_not_answered(server):
    with Simulator(server.port).open() as stranger:
        stranger.send("2" + "x" * 100_000)
        stranger.send("2")
        assert stranger.receive() == "3"


def test_one_client_too_many_waits_until_another_ends_or_is_quiet(model_file, jpegs):
    with serving(model_file) as process, ExitStack() as stack:
        first, quiet, *others = [stack.enter_context(Simulator(process.port)) for _ in range(MAX_CLIENTS)]
        first.open()
        with Simulator(process.port) as refused:
            assert refused.status == 503
        awaited(lambda: any("4 clients are connected already" in line for line in process.lines))
        first.drive(telemetry(jpegs[0]))
        first.socket.close()
        others.append(attack.Car(process.port, jpegs[:1]).simulator)
        until = time.monotonic() + QUIET + 1
        while time.monotonic() < until:
            for other in others:
                other.send("2")
            time.sleep(0.2)
        attack.Car(process.port, jpegs[:1]).simulator.socket.close()
        with pytest.raises(ConnectionError):
            quiet.open()
            quiet.receive()
        others[-1].socket.close()


def test_a_client_that_says_nothing_for_long_is_disconnected(model_file):
    soon = "import cloning.wire.protocol as protocol; protocol.PING_INTERVAL = protocol.PONG_TIMEOUT = 0.2"
    with serving(model_file, first=soon) as process, Simulator(process.port) as silent, pytest.raises(ConnectionError):
        for _ in range(4):
            silent.receive()


def test_a_failed_handshake_takes_no_place(server, jpegs):
    for _ in range(2 * MAX_CLIENTS):
        with socket.create_connection(("127.0.0.1", server.port), 10) as stranger:
            stranger.sendall(WEBSOCKET.replace(b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n", b"") % b"")
            assert stranger.recv(12) == b"HTTP/1.1 400"
    attack.Car(server.port, jpegs[:1]).simulator.socket.close()


def test_a_new_car_takes_the_place_of_a_connection_without_a_request(server, jpegs):
    with ExitStack() as stack:
        for n in range(MAX_CONNECTIONS + 20):
            idle = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), 10))
            if n >= 20:
                idle.sendall(b"POST /set-speed HTTP/1.1\r\nContent-Length: 99\r\n\r\n{")
        stack.enter_context(Simulator(server.port).open()).drive(telemetry(jpegs[0]))


def test_clients_that_have_left_cost_a_new_car_no_time(model_file):
    """Each would cost it 5 ms, and their requests, of which 192 are kept, could have no place left for it."""
    slowly = "import cloning.server.server as server; server.OPENING_INTERVAL = 1.0"
    with serving(model_file, first=slowly) as process:
        for _ in range(40):
            with socket.create_connection(("127.0.0.1", process.port), 10) as stranger:
                stranger.sendall(WEBSOCKET % b"")
        Simulator(process.port, timeout=20).open().socket.close()


@pytest.mark.parametrize("clock", ["100 * now()", "now() + 3600 * next(hours)"])
def test_no_change_of_the_clock_costs_an_answer(model_file, jpegs, clock):
    """Two minutes pass in 1.2 seconds there, or an hour forwards or back, beside a car that never pings."""
    first = f"import itertools, time; now, hours = time.time, itertools.cycle([0, 1, -1]); time.time = lambda: {clock}"
    with serving(model_file, first=first) as process, Simulator(process.port).open() as simulator:
        until = time.monotonic() + 1.2
        while time.monotonic() < until:
            simulator.drive(telemetry(jpegs[0]))
            time.sleep(0.05)
        shown = live(process.port)
        assert shown["state"] == "driving" and 5 < shown["rate"] < 20


def test_only_a_client_that_asks_for_a_connection_is_pinged(model_file, jpegs):
    often = "import cloning.wire.protocol as protocol; protocol.PING_INTERVAL = 0.2"
    with (
        serving(model_file, first=often) as process,
        Simulator(process.port).open() as simulator,
        Simulator(process.port).open() as other,
    ):
        other.send("40")
        for _ in range(3):
            assert other.receive() == "2"
            other.send("3")
        for jpeg in jpegs:
            simulator.drive(telemetry(jpeg))


@pytest.mark.parametrize(
    "query, reason",
    [
        ("EIO=9&transport=websocket", "EIO must be 3 or 4"),
        ("transport=polling", "EIO must be 3 or 4"),
        ("EIO=4", "Only the websocket transport"),
        ("EIO=4&transport=pigeon", "Only the websocket transport"),
        ("EIO=4&transport=websocket", "Only the websocket transport"),
        ("EIO=3&transport=polling&j=1", "Only the websocket transport"),
    ],
)
def test_an_odd_request_is_told_why_it_is_refused(server, query, reason):
    status, body, _ = ask(server.port, f"/socket.io/?{query}")
    assert status == 400 and body.decode().startswith(reason)


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
        awaited(lambda: server.open_files() <= before, 20)


def test_all_pages_share_a_picture(network, jpegs, monkeypatch):
    server, image, now = drive.DriveServer(network), Mock(return_value="picture"), [0.0]
    session = server.sessions["sid"] = drive.Session(server)
    monkeypatch.setattr(page, "image", image)
    monkeypatch.setattr(page, "time", SimpleNamespace(monotonic=lambda: now[0], perf_counter=lambda: now[0]))
    monkeypatch.setattr(page, "UPDATE_INTERVAL", 2**-10)
    pages = page.Pages(server, with_attention=True, pause=time.sleep)
    readers: list[Any] = [pages.events() for _ in range(50)]
    for interval in range(1, 4):
        now[0] = interval * 2**-10
        for _ in range(2):
            session.answer(telemetry(jpegs[0]))
        texts = {next(reader) for reader in readers}
        assert len(texts) == 1 and image.call_count == interval
        event = json.loads(texts.pop()[6:])
        assert event["image"] == "picture" and [tuple(row) for row in event["rows"]] == list(session.history)[-2:]
    for reader in readers:
        reader.close()
    assert pages.open == 0


def test_a_new_page_gets_the_last_minute_in_as_many_rows_as_it_can_show(network, jpegs, monkeypatch):
    server, now = drive.DriveServer(network), time.monotonic()
    session = server.sessions["sid"] = drive.Session(server)
    session.answer(telemetry(jpegs[0]))
    session.history.extend(page.DrivenFrame(now - 50 + at / 120, 0, 9, 0.5, 3) for at in range(5 * page.SHOWN_FRAMES))
    monkeypatch.setattr(page, "image", lambda *_: "picture")
    pages = page.Pages(server, with_attention=False, pause=time.sleep)
    times = [row[0] for row in json.loads(next(pages.events())[6:])["rows"]]
    assert len(times) <= page.SHOWN_FRAMES and times == sorted(times)
    assert times[-1] == session.history[-1].time and times[-1] - times[0] > 49


def test_other_systems_are_told_before_a_server_starts(monkeypatch):
    monkeypatch.setattr(attack, "Path", lambda _: SimpleNamespace(exists=bool))
    for tool in (attack, soak):
        with pytest.raises(UserError, match="needs Linux"):
            tool.main([])


def test_a_soak_finds_what_does_not_stay_as_it_was(server, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(soak, "VISIT", 0.1)
    monkeypatch.setattr(soak, "PAUSE", 0.1)
    assert soak.soak(server, tmp_path, 40) == []
    table = capsys.readouterr().out.splitlines()
    assert len(table) == 2 + 10 and table[-1].startswith("| 40 |")
    monkeypatch.setattr(soak, "MAX_GROWTH", -1000.0)
    (fault,) = soak.soak(server, tmp_path, 10)
    assert re.fullmatch(r"memory grew by -?\d+ MB", fault)


def test_a_soak_counts_an_answer_that_a_car_does_not_get_and_goes_on(server, tmp_path, monkeypatch):
    timed = Mock(wraps=soak.timed, side_effect=[*[DEFAULT] * 20, ConnectionError, *[DEFAULT] * 19])
    monkeypatch.setattr(soak, "timed", timed)
    assert soak.soak(server, tmp_path, 40) == ["1 answers lost"]
