"""The simulator's end of the wire, against a server on a raw socket that follows the real client's transcript."""

import base64
import json
import os
import re
import select
import subprocess
import sys
from types import SimpleNamespace

import pytest
from steer_server import LAPS, STEER, Blank, Server, ahead, drive, lake, unused_port

from cloning.base import program
from cloning.base.errors import SimulatorError, printable
from cloning.recordings.images import decode
from cloning.wire.client import Answer, parse_answer
from cloning.wire.protocol import FRAGMENT
from simulator.__main__ import main
from simulator.client import Client, RemoteDriver
from simulator.report import lap_report
from simulator.run import Run


@pytest.mark.parametrize("realtime", [False, True])
def test_follows_the_transcript(realtime):
    with Server(ahead) as server:
        drive(server, realtime=realtime)
    request = server.requests[0]
    assert request.startswith("GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\n")
    assert "user-agent: websocket-sharp/1.0" in request.lower()
    assert not any(word in request.lower() for word in ("origin:", "extensions"))
    assert server.messages[0] == "2"
    assert not any(message.startswith("40") for message in server.messages)
    assert server.messages[-2:] == ["41", "1"]
    assert server.closed
    event, data = json.loads(server.messages[1][2:])
    assert event == "telemetry"
    assert set(data) == {"steering_angle", "throttle", "speed", "image", "stand_in"}
    assert [data[key] for key in ("steering_angle", "throttle")] == ["0.0000", "0.0000"]
    assert re.fullmatch(r"0\.0\d{3}", data["speed"])
    frame = decode(base64.b64decode(data["image"]))
    assert frame.shape == (160, 320, 3)
    for message, pieces in zip(server.messages, server.frames, strict=True):
        opcodes, sizes = map(list, zip(*pieces, strict=True))
        assert sum(sizes) == len(message)
        assert all(size == FRAGMENT == 1016 for size in sizes[:-1])
        expected = [0x01] + [0x00] * (len(pieces) - 1)  # text, then its continuations
        expected[-1] |= 0x80  # the end of the message
        assert opcodes == expected
    assert max(map(len, server.frames)) > 10


@pytest.mark.parametrize("realtime", [False, True])
@pytest.mark.parametrize("greet", [False, True])
def test_open_counts_twice_and_each_answer_once(realtime, greet):
    """Two or three frames are under way before any answer, and no more than that ever."""
    waiting = []

    def withhold(packet, n):
        waiting.append(packet)
        expected = 2 + greet
        if n == expected - 1:
            assert not select.select([server.client], [], [], 0.3)[0]  # nothing more comes by itself
            return [STEER % ("0", "1.0")] * expected
        return [] if n < expected else [STEER % ("0", "1.0")]

    with Server(withhold, greet) as server:
        drive(server, realtime=realtime)
    assert len(waiting) > 10


def test_answers_are_read():
    assert parse_answer(STEER % ("-0.05", "0.2")) == Answer(-0.05, 0.2)
    assert parse_answer(STEER % ("-7", "2")) == Answer(-1.0, 1.0)
    assert parse_answer('42["manual",{}]') == Answer()


def test_a_missing_server_is_waited_for_then_reported(capsys, monkeypatch):
    assert main(["drive", "--wait", "0.5", "--port", str(unused_port())]) == 2
    told = capsys.readouterr().err
    start = r"start `python drive.py --port \d+` in another terminal; trying again"
    assert re.search(rf"no server at 127\.0\.0\.1.*; {start}", told)
    assert re.search(r"^python: no server at 127\.0\.0\.1.*no usable answer in 0\.5 s.*drive\.py", told, re.MULTILINE)
    port = unused_port()
    assert main(["drive", "--wait", "0.1", "--host", "::1", "--port", str(port)]) == 2
    assert f"start `python drive.py --host ::1 --port {port}` in another terminal" in capsys.readouterr().err
    assert main(["join", "--dialect", "roads", "--wait", "0.5", "--port", str(port)]) == 2
    missing = rf"no server at 127\.0\.0\.1:{port} \(.*\); start the program, or name its --port; "
    assert re.search(f"{missing}trying again for 0.5 s\n.*: {missing}waited 0.5 s$", capsys.readouterr().err)
    monkeypatch.setattr(program, "installed", {"python drive.py": "bc drive"})
    assert main(["drive", "--wait", "0.5", "--port", str(port)]) == 2
    assert capsys.readouterr().err.count(f"start `bc drive --port {port}` in another terminal") == 2


@pytest.mark.parametrize("realtime", [False, True])
@pytest.mark.parametrize("death", [None, "close", ["41"], ["1"]])
def test_reconnects_and_continues(realtime, death):
    deaths = iter([True])

    def dies_once(packet, n):
        return death if n == 12 and next(deaths, False) else ahead(packet, n)

    with Server(dies_once, sessions=2) as server:
        client = drive(server, realtime=realtime)
    assert (client.reconnections, len(server.requests)) == (1, 2)
    assert client.run.travelled >= LAPS * client.run.track.length


def test_the_window_sends_null_while_a_person_steers_and_is_never_held_up():
    """A server that answers at once must not keep the window from being rendered."""

    def reply(packet, n):
        return ['42["manual",{}]'] if packet.endswith("null]") else [STEER % ("0.5", "0.25")]

    with Server(reply) as server:
        remote, run = RemoteDriver("127.0.0.1", server.port, Blank()), Run(lake(), "autonomous")
        for by_hand in (False, True, False):
            before, ticks = len(server.messages), 0
            while len(server.messages) < before + 12:
                remote.poll(by_hand, run)
                ticks += 1
            assert ticks >= 4
        remote.close()
    assert (remote.steering, remote.throttle) == (0.5, 0.25)
    sent = [message for message in server.messages if message.startswith("42")]
    nulls = [message == '42["telemetry",null]' for message in sent]
    assert 8 <= sum(nulls) <= 16
    assert not any(nulls[:6] + nulls[-4:])


def test_pings_and_leaves_a_server_that_does_not_answer_them(monkeypatch):
    monkeypatch.setattr("cloning.wire.client.PING_INTERVAL", 0.2)
    monkeypatch.setattr("cloning.wire.client.PONG_TIMEOUT", 0.5)
    monkeypatch.setattr("cloning.wire.client.CONNECT_TIMEOUT", 0.5)

    class Mute(Server):
        def send(self, client, text):
            if text != "3":
                super().send(client, text)

    with Mute(ahead, sessions=2) as server, pytest.raises(SimulatorError):
        client = Client(Run(lake(), "autonomous"), Blank(), "127.0.0.1", server.port, 1.5, False)
        client.drive(1)
    assert client.reconnections >= 1
    assert server.messages.count("2") >= 3  # not the first alone


def test_a_car_that_is_never_driven_is_reported(monkeypatch):
    monkeypatch.setattr("simulator.client.STANDSTILL_TIME", 5.0)
    run = Run(lake(), "autonomous")
    with Server(lambda packet, n: [STEER % ("0", "0")]) as server:
        client = Client(run, Blank(), "127.0.0.1", server.port, 5.0, False)
        assert lap_report(run, client)["ended"] == "failed"
        with pytest.raises(SimulatorError, match="stood still"):
            client.drive(0.1)
    assert lap_report(run, client)["ended"] == "stood_still"


# A drive.py as other people have it, for python-socketio 4 and 5 alike; and with Flask-SocketIO.
CLASSIC = """
import importlib.metadata, warnings
warnings.simplefilter("ignore")
import eventlet, eventlet.wsgi, flask, socketio
server = socketio.Server()
@server.on("connect")
def connect(sid, environ, auth=None):
    server.emit("steer", {"steering_angle": "0", "throttle": "1"}, room=sid)
@server.on("telemetry")
def telemetry(sid, data):
    assert set(data) == {"steering_angle", "throttle", "speed", "image", "stand_in"}
    server.emit("steer", {"steering_angle": "0", "throttle": "1"}, room=sid)
listener = eventlet.listen(("127.0.0.1", 0))
print(importlib.metadata.version("python-socketio"), listener.getsockname()[1], flush=True)
eventlet.wsgi.server(listener, socketio.WSGIApp(server, flask.Flask("classic")), log_output=False)
"""
FLASK_SOCKETIO = """
import socket
import flask, flask_socketio
app = flask.Flask("other")
server = flask_socketio.SocketIO(app, async_mode="threading", allow_upgrades=False)
@server.on("connect")
def connect():
    flask_socketio.emit("steer", {"steering_angle": "0", "throttle": "1"})
@server.on("telemetry")
def telemetry(data):
    flask_socketio.emit("steer", {"steering_angle": "0", "throttle": "1"})
with socket.create_server(("127.0.0.1", 0)) as taken:
    port = taken.getsockname()[1]
print("flask", port, flush=True)
server.run(app, "127.0.0.1", port, allow_unsafe_werkzeug=True)
"""
OTHER_SERVERS = {
    "python-socketio 4": (CLASSIC, ["python-socketio==4.6.1", "python-engineio==3.13.2", "six==1.17.0"], False),
    "python-socketio 5": (CLASSIC, [], True),
    "Flask-SocketIO": (FLASK_SOCKETIO, ["flask-socketio==5.6.1"], True),
}


@pytest.mark.parametrize("name", OTHER_SERVERS)
def test_drives_with_other_peoples_servers(name, tmp_path, capsys, monkeypatch):
    program, packages, asks = OTHER_SERVERS[name]
    if packages:
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(tmp_path)]
        try:
            subprocess.run([*pip, *packages], check=True, timeout=60)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            pytest.skip(f"pip can't install {packages} here")
    monkeypatch.setattr("cloning.wire.client.PING_INTERVAL", 0.3)
    monkeypatch.setattr("cloning.wire.client.PONG_TIMEOUT", 1.0)  # a drive takes longer than both
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout
            version, port = server.stdout.readline().split()
            assert version[0] in (name[-1], "f")
            for realtime in (False, True):
                client = drive(SimpleNamespace(port=int(port)), laps=LAPS if realtime else 0.01, realtime=realtime)
                assert client.reconnections == client.unusable == 0
                assert client.frames > (5 if realtime else 20)  # a busy machine has few frames in real time
                assert ("would get no answer (python-socketio 4.6.1 gives it one)" in capsys.readouterr().err) is asks
        finally:
            server.kill()


def test_a_server_that_bears_no_ping_of_a_client_is_asked_to_connect():
    """Socket.IO 3 and 4 in JavaScript; the real simulator could not drive with it."""

    class JavaScript(Server):
        def send(self, client, text):
            if text == "3":
                raise ConnectionError
            if text != "40":
                super().send(client, text)

    with JavaScript(ahead, greet=False) as server:
        assert drive(server).reconnections == 0
    assert server.messages[0] == "40"


@pytest.mark.parametrize("steering", ["0,1", "[0.1]", "nan", "\x1b[2J"])
def test_an_answer_that_cannot_be_used_is_shown_while_the_next_is_waited_for(steering, capsys):
    def reply(packet, n):
        return ['42["other",{}]', STEER % (steering, "1.0"), *ahead(packet, n)]

    with Server(reply) as server:
        drive(server)
    told = capsys.readouterr().err
    assert told.count("cannot be used") == 1
    assert f'"steering_angle":"{printable(steering)}"' in told and 'texts, such as "0.1"' in told


def test_a_server_that_is_silent_is_told_from_a_missing_one():
    silent = "a server is there, but is silent.*its output"
    with Server(lambda packet, n: []) as server, pytest.raises(SimulatorError, match=silent):
        drive(server, wait=1.5)
