"""The simulator's end of the wire, against a server on a raw socket that follows the real client's transcript."""

import base64
import contextlib
import hashlib
import json
import re
import select
import socket
import struct
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest

from cloning.errors import OutputError, SimulatorError
from cloning.outputs import write_json
from cloning.road.track import Track
from cloning.wire.client import Answer, parse_answer
from cloning.wire.protocol import FRAGMENT
from simulator import report
from simulator.__main__ import main
from simulator.client import Client, RemoteDriver, Standstill
from simulator.run import Run

STEER = '42["steer",{"steering_angle":"%s","throttle":"%s"}]'


class Server:
    """Speaks the server's part of the transcript; `reply(packet, n)` gives the packets to answer the nth
    telemetry with."""

    def __init__(self, reply, greet=True, sessions=1):
        self.reply, self.greet, self.sessions = reply, greet, sessions
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.requests, self.messages, self.frames, self.error = [], [], [], None
        self.closed = False
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.listener.close()
        self.thread.join(20)
        assert not self.thread.is_alive()
        if self.error:
            raise self.error

    def run(self):
        try:
            for _ in range(self.sessions):
                client, _ = self.listener.accept()
                client.settimeout(20)
                with client, contextlib.suppress(ConnectionError):
                    self.session(client)
        except Exception as error:
            self.error = error

    def send(self, client, text):
        data = text.encode()
        size = bytes([len(data)]) if len(data) < 126 else b"\x7e" + struct.pack(">H", len(data))
        client.sendall(b"\x81" + size + data)

    def exactly(self, client, n):
        data = b""
        while len(data) < n:
            data += client.recv(n - len(data)) or self.lost()
        return data

    def lost(self):
        raise ConnectionError

    def session(self, client):
        request = b""
        while not request.endswith(b"\r\n\r\n"):
            request += client.recv(1) or self.lost()
        self.requests.append(request.decode())
        key = re.search(rb"(?i)sec-websocket-key: (.*)\r", request)[1]
        accept = base64.b64encode(hashlib.sha1(key + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11").digest())
        client.sendall(
            b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Accept: " + accept + b"\r\n\r\n"
        )
        self.send(client, '0{"sid":"x","upgrades":[],"pingTimeout":60000,"pingInterval":25000}')
        if self.greet:
            self.send(client, STEER % ("0", "0"))
        self.send(client, "40")
        message, answered, pieces = b"", 0, []
        while True:
            first, second = self.exactly(client, 2)
            assert second & 0x80, "a client masks its frames"
            size = second & 0x7F
            if size == 126:
                size = struct.unpack(">H", self.exactly(client, 2))[0]
            mask = self.exactly(client, 4)
            data = bytes(a ^ mask[i % 4] for i, a in enumerate(self.exactly(client, size)))
            if first & 0x0F == 8:
                self.closed = True
                return
            message += data
            pieces.append((first, size))
            if first & 0x80:
                text, message = message.decode(), b""
                self.messages.append(text)
                self.frames.append(pieces)
                pieces = []
                if text == "2":
                    self.send(client, "3")
                elif text.startswith("42"):
                    replies = self.reply(text, answered)
                    answered += 1
                    if replies is None:
                        return
                    if replies == "close":
                        client.sendall(b"\x88\x02\x03\xe8")
                        return
                    for packet in replies:
                        self.send(client, packet)


class Blank:
    """Cameras that see grey noise, so that frames are as large as real ones."""

    noise = np.random.default_rng(0).integers(60, 190, (160, 320, 3), np.uint8)

    def frames(self, transform):
        return self.noise[None]


def drive(server, laps=0.02, wait=5.0, realtime=False):
    run = Run(Track("lake"), "autonomous")
    client = Client(run, Blank(), "127.0.0.1", server.port, wait, realtime)
    client.drive(laps)
    return client


def ahead(packet, n):
    return [STEER % ("0.0", "1.0")]


def contents(message):
    event, data = json.loads(message[2:])
    assert event == "telemetry"
    return data


@pytest.mark.parametrize("realtime", [False, True])
def test_follows_the_transcript(realtime):
    with Server(ahead) as server:
        drive(server, realtime=realtime)
    request = server.requests[0]
    assert request.startswith("GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\n")
    assert "user-agent: websocket-sharp/1.0" in request.lower()
    assert "origin:" not in request.lower()
    assert "extensions" not in request.lower()
    assert server.messages[0] == "2"
    assert not any(message.startswith("40") for message in server.messages)
    assert server.messages[-2:] == ["41", "1"]
    assert server.closed
    data = contents(server.messages[1])
    assert set(data) == {"steering_angle", "throttle", "speed", "image"}
    assert [data[key] for key in ("steering_angle", "throttle")] == ["0.0000", "0.0000"]
    assert re.fullmatch(r"0\.0\d{3}", data["speed"])
    frame = cv2.imdecode(np.frombuffer(base64.b64decode(data["image"]), np.uint8), cv2.IMREAD_COLOR)
    assert frame.shape == (160, 320, 3)


def test_sends_fragments_of_1016_bytes():
    with Server(ahead) as server:
        drive(server)
    for message, pieces in zip(server.messages, server.frames, strict=True):
        sizes = [size for _, size in pieces]
        assert sum(sizes) == len(message)
        assert all(size == FRAGMENT == 1016 for size in sizes[:-1])
        opcodes = [first for first, _ in pieces]
        if len(pieces) == 1:
            assert opcodes == [0x81]
        else:
            assert opcodes == [0x01] + [0x00] * (len(pieces) - 2) + [0x80]
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
            assert not select.select([server_socket[0]], [], [], 0.3)[0]  # nothing more comes by itself
            return [STEER % ("0", "1.0")] * expected
        return [] if n < expected else [STEER % ("0", "1.0")]

    server_socket = []
    server = Server(withhold, greet)
    session = server.session
    server.session = lambda client: (server_socket.append(client), session(client))
    with server:
        drive(server, realtime=realtime)
    assert len(waiting) > 10


def test_steering_goes_out_in_degrees_and_the_car_obeys():
    with Server(lambda packet, n: [STEER % ("-0.2" if n > 60 else "0", "0.5")]) as server:
        client = drive(server, laps=0.05)
    angles = {contents(message)["steering_angle"] for message in server.messages if message.startswith("42")}
    assert angles == {"0.0000", "-5.0000"}
    assert client.run.departures[0].side == "left"


@pytest.mark.parametrize(
    "packet",
    [
        "",
        "3",
        "40",
        "42",
        "42[",
        '42["steer"]',
        '42["steer",{}]',
        '42["steer",{"steering_angle":0.1,"throttle":0.2}]',
        '42["steer",{"steering_angle":"0.1","throttle":0.2}]',
        '42["steer",{"steering_angle":"nan","throttle":"0.2"}]',
        '42["steer",{"steering_angle":"left","throttle":"0.2"}]',
        '42["telemetry",{}]',
        "42[1,2,3]",
        '42{"a":1}',
        "42null",
    ],
)
def test_what_the_real_client_drops_is_dropped(packet):
    assert parse_answer(packet) is None


def test_answers_are_read():
    assert parse_answer(STEER % ("-0.05", "0.2")) == Answer(-0.05, 0.2)
    assert parse_answer(STEER % ("-7", "2")) == Answer(-1.0, 1.0)
    assert parse_answer('42["manual",{}]') == Answer()


def test_a_lost_reply_is_said_with_what_came_instead():
    numbers = '42["steer",{"steering_angle":0.0,"throttle":0.5}]'
    with Server(lambda packet, n: [numbers]) as server, pytest.raises(SimulatorError, match="3 unusable"):
        drive(server, wait=0.5)


def test_a_report_that_cannot_be_written_is_said_before_the_drive(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "simulator", "drive", "--report", str(tmp_path / "no" / "report.json")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "no such folder" in done.stderr


def test_a_missing_server_is_waited_for_then_said():
    closed = socket.create_server(("127.0.0.1", 0))
    port = closed.getsockname()[1]
    closed.close()
    run = Run(Track("lake"), "autonomous")
    with pytest.raises(SimulatorError, match=r"no server at 127\.0\.0\.1.*drive\.py"):
        Client(run, Blank(), "127.0.0.1", port, 0.5, False).drive(1)


def test_a_server_that_is_no_websocket_is_said():
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def refuse():
            client, _ = listener.accept()
            with client:
                client.recv(4096)
                client.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")

        thread = threading.Thread(target=refuse)
        thread.start()
        run = Run(Track("lake"), "autonomous")
        with pytest.raises(SimulatorError, match="404"):
            Client(run, Blank(), "127.0.0.1", listener.getsockname()[1], 0.0, False).drive(1)
        thread.join(5)


@pytest.mark.parametrize("realtime", [False, True])
@pytest.mark.parametrize("death", [None, "close", ["41"], ["1"]])
def test_reconnects_and_drives_on(realtime, death):
    deaths = iter([True])

    def dies_once(packet, n):
        return death if n == 20 and next(deaths, False) else ahead(packet, n)

    with Server(dies_once, sessions=2) as server:
        client = drive(server, realtime=realtime)
    assert client.reconnections == 1
    assert client.run.travelled >= 0.02 * client.run.track.length
    assert len(server.requests) == 2


def test_the_window_sends_null_while_a_person_steers_and_is_never_held_up():
    """A server that answers at once must not keep the window from being drawn."""

    def reply(packet, n):
        return ['42["manual",{}]'] if packet.endswith("null]") else [STEER % ("0.5", "0.25")]

    with Server(reply) as server:
        remote, run = RemoteDriver("127.0.0.1", server.port, Blank()), Run(Track("lake"), "autonomous")
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
    assert not any(nulls[:6])
    assert not any(nulls[-4:])


def test_the_window_looks_for_a_server_without_waiting():
    closed = socket.create_server(("127.0.0.1", 0))
    port = closed.getsockname()[1]
    closed.close()
    remote = RemoteDriver("127.0.0.1", port, Blank())
    remote.poll(False, Run(Track("lake"), "autonomous"))
    assert "no server" in remote.state
    assert (remote.steering, remote.throttle) == (0, 0)


def test_pings_and_leaves_a_server_that_does_not_answer_them(monkeypatch):
    monkeypatch.setattr("cloning.wire.client.PING_INTERVAL", 0.2)
    monkeypatch.setattr("cloning.wire.client.PONG_TIMEOUT", 0.5)
    monkeypatch.setattr("cloning.wire.client.CONNECT_TIMEOUT", 0.5)

    server = Server(ahead, sessions=2)
    send = server.send
    server.send = lambda client, text: None if text == "3" else send(client, text)
    with server, pytest.raises(SimulatorError):
        client = Client(Run(Track("lake"), "autonomous"), Blank(), "127.0.0.1", server.port, 1.5, False)
        client.drive(1)
    assert client.reconnections >= 1
    assert server.messages.count("2") >= 3  # not the first alone


def test_a_car_that_is_never_driven_is_said(monkeypatch):
    monkeypatch.setattr("simulator.client.STANDSTILL_TIME", 5.0)
    with (
        Server(lambda packet, n: [STEER % ("0", "0")]) as server,
        pytest.raises(Standstill, match="stood still"),
    ):
        drive(server)


def test_lockstep_repeats_to_the_last_digit():
    runs = []
    for _ in range(2):
        with Server(lambda packet, n: [STEER % (f"{0.02 * ((n * 7919) % 5 - 2):.3f}", "0.7")]) as server:
            runs.append(drive(server, laps=0.05).run)
    assert runs[0].trajectory == runs[1].trajectory
    assert report.lap_report(runs[0]) == report.lap_report(runs[1])


def test_report_says_what_happened(tmp_path):
    with Server(lambda packet, n: [STEER % ("0.3" if n > 30 else "0", "1")]) as server:
        client = drive(server, laps=0.05)
    figures = report.lap_report(client.run, client)
    assert figures["departures"]
    assert figures["autonomy"] == pytest.approx(
        1 - 6 * len(figures["departures"]) / figures["simulated_seconds"], abs=1e-3
    )
    assert figures["frames_per_simulated_second"] == pytest.approx(15, abs=0.5)
    said = report.report_text(figures)
    assert f"departures: {len(figures['departures'])}" in said
    write_json(tmp_path / "report.json", figures)
    assert json.loads((tmp_path / "report.json").read_text()) == figures
    report.write_picture(tmp_path / "way.png", client.run)
    assert cv2.imread(tmp_path / "way.png").std() > 10
    with pytest.raises(OutputError, match="nowhere"):
        write_json(tmp_path / "nowhere" / "report.json", figures)


def test_a_round_trip_in_real_time_is_that_of_the_telemetry_that_is_answered():
    """The greeting answers no telemetry, though it comes while the first two are in flight."""
    pause = 0.05

    def slowly(packet, n):
        time.sleep(pause)
        return ahead(packet, n)

    with Server(slowly) as server:
        client = drive(server, realtime=True)
    # Three telemetries circulate, and the server answers one at a time.
    assert min(client.round_trips) >= 0.9 * pause
    assert np.median(client.round_trips) == pytest.approx(3 * pause, rel=0.2)


@pytest.mark.parametrize(("steering", "status"), [("0", 0), ("1", 1)])
def test_the_exit_status_tells_whether_the_car_left_the_road(steering, status, capsys):
    with Server(lambda packet, n: [STEER % (steering if n > 15 else "0", "1")]) as server:
        assert main(["drive", "--laps", "0.03", "--port", str(server.port)]) == status
    departures = int(re.search(r"departures: (\d+)", capsys.readouterr().out)[1])
    assert bool(departures) == bool(status)


def test_the_exit_status_of_a_drive_without_a_server_is_2(capsys):
    closed = socket.create_server(("127.0.0.1", 0))
    port = closed.getsockname()[1]
    closed.close()
    assert main(["drive", "--wait", "0.1", "--port", str(port)]) == 2
    assert "simulator: no server" in capsys.readouterr().err


def test_a_full_disk_costs_the_film_alone(tmp_path, capsys):
    resource = pytest.importorskip("resource", reason="this system has no limit on the size of files")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fills_up(packet, n):
        # The first frames of the film fit, then nothing does, until the drive is over.
        resource.setrlimit(resource.RLIMIT_FSIZE, (10 if 20 < n < 90 else before[0], before[1]))
        return [STEER % ("0", "0.3")]

    names = [tmp_path / name for name in ("x.mp4", "report.json", "above.png")]
    outputs = [str(word) for pair in zip(("--film", "--report", "--picture"), names, strict=True) for word in pair]
    try:
        with Server(fills_up) as server:
            assert main(["drive", "--laps", "0.03", "--port", str(server.port), *outputs]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    printed = capsys.readouterr()
    assert re.search(r"simulator: \S+x\.mp4: .*no film was written", printed.err)
    assert "departures: 0" in printed.out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["above.png", "report.json"]
    assert json.loads((tmp_path / "report.json").read_text())["distance_m"] > 30
    assert cv2.imread(tmp_path / "above.png").std() > 10
