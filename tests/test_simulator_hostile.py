"""The simulator's end of the wire against servers that break the protocol, flood it, or never answer."""

import contextlib
import gc
import socket
import socketserver
import struct
import threading
import time
import tracemalloc
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import steer_server
from steer_server import STEER, Blank, Server, accept_websocket, frame, lake

from cloning.base.errors import SimulatorError
from cloning.replay.server_driver import ServerDriver
from cloning.wire.client import Connection, ConnectionLost, parse_answer, parse_event
from simulator.client import RemoteDriver
from simulator.run import Run

WAIT = 0.2  # s of patience
TICK = 0.02  # s between a server's looks at the clock
SLACK = 8.0  # s: more than the client takes beyond its patience on a busy machine; then the server gives up
BINARY, CLOSE, PING = 2, 8, 9
OPENED = '0{"sid":"x","upgrades":[],"pingTimeout":60000,"pingInterval":25000}'
AHEAD = STEER % ("0.0", "1.0")


@dataclass
class Case:
    """What a server does to each client that connects: in the order of the fields; at last it closes the connection."""

    message: str  # what the client's error says, a regular expression
    accepts: bool = True  # the websocket, with these headers
    headers: bytes = b""
    packets: tuple[str, ...] | None = ("40",)  # that it sends then; None: none at all
    reads: bool = False  # before what follows
    once: bytes = b""  # that it sends, with a pause after each
    pause: float = 0.0
    flood: bytes = b""  # that it sends again and again
    holds: bool = False  # it reads until the client closes


class Hostile(socketserver.ThreadingTCPServer):
    """A server that does what a case says, for WAIT + SLACK seconds at most."""

    def __init__(self, case):
        super().__init__(("127.0.0.1", 0), socketserver.BaseRequestHandler)
        self.case, self.until, self.port = case, time.monotonic() + WAIT + SLACK, self.server_address[1]
        threading.Thread(target=self.serve_forever, args=(TICK,)).start()

    def __exit__(self, *_):
        self.until = 0
        self.shutdown()
        self.server_close()  # waits for its threads

    @property
    def open(self):
        return time.monotonic() < self.until

    def finish_request(self, client, _):
        """Serve a client, in a thread of its own."""
        client.settimeout(TICK)
        case = self.case
        with client, contextlib.suppress(OSError):
            if case.accepts:
                accept_websocket(client, case.headers)
                if case.packets is not None:
                    self.send(client, b"".join(map(frame, (OPENED, *case.packets))))
            if case.reads:
                client.recv(1 << 16)
            for part in map(bytes, zip(case.once)) if case.pause else [case.once]:
                self.send(client, part)
                time.sleep(case.pause)
            while case.flood:
                self.send(client, case.flood)
            while case.holds and self.open:
                with contextlib.suppress(TimeoutError):
                    if not client.recv(1 << 16):
                        return

    def send(self, client, data):
        """Send all bytes, unless the time is over."""
        while data:
            if not self.open:
                raise ConnectionError
            with contextlib.suppress(TimeoutError):
                data = data[client.send(data[: 1 << 16]) :]


CLOSED, ALIEN = "closed the connection|broke", "does not speak"
TOO_LONG, NONE = "more than 65536 characters", "no usable answer"
UPGRADE = b"HTTP/1.1 101 Switching Protocols\r\n"
OTHER_KEY = UPGRADE + b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: 0\r\n\r\n"
NUMBERS = frame("42[1]") + frame('42["steer",{"steering_angle":0,"throttle":1}]')
DEEP = ("40", "42" + "[" * 60_000, '42["steer",' * 5_000)
# In the first eight the websocket is not accepted, in the next three there is no session.
CASES = {
    "closes at once": Case(CLOSED, False),
    "never answers": Case("does not answer", False, holds=True),
    "sends a web page": Case("HTTP 200", False, once=b"HTTP/1.1 200 OK\r\n\r\n", flood=b"<p>Welcome</p>" * 1000),
    "has no such page": Case(
        "404: another program's", False, once=b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"
    ),
    "has no websocket": Case("400: .*engineio", False, once=b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n"),
    "sends no line end": Case(ALIEN, False, once=b"HTTP/1.1 101 ", flood=b"x" * 10000),
    "accepts another key": Case(ALIEN, False, reads=True, once=OTHER_KEY),
    "sends the handshake slowly": Case("does not", False, once=UPGRADE * 100, pause=0.05),
    "chooses a subprotocol": Case(ALIEN, headers=b"Sec-WebSocket-Protocol: \x1b[2J\r\n", packets=None),
    "opens no session": Case("does not speak Engine.IO", packets=None, holds=True),
    "speaks something else": Case(ALIEN, packets=None, once=frame("\x1b[2JHello" * 50), holds=True),
    "masks its frames": Case(ALIEN, once=b"\x81\x81\0\0\0\0x", holds=True),
    "sends broken UTF-8": Case(ALIEN, once=frame(b"42\xff\xfe"), holds=True),
    "closes with garbage": Case("WebSocket|closed|broke", once=frame(b"\x00", CLOSE)),
    "closes with a reason": Case(CLOSED, once=frame(struct.pack(">H", 1000) + b"\x1b[2Jbye", CLOSE)),
    "refuses the session": Case("refuses to connect", packets=("44\x1b[2Jno",), holds=True),
    "greets and closes": Case(CLOSED, packets=(AHEAD, "40", AHEAD)),
    "answers one of three and closes": Case(CLOSED, reads=True, once=frame(AHEAD)),
    "sends a gigabyte": Case(TOO_LONG, once=b"\x81\x7f" + struct.pack(">Q", 1 << 30), flood=b"4" * (1 << 16)),
    "fragments without end": Case(TOO_LONG, once=frame("42", final=False), flood=frame("[" * 9000, 0, final=False)),
    "empty fragments": Case(NONE, once=frame("42", final=False), flood=frame("", 0, final=False) * 1000),
    "sends its answers slowly": Case(NONE, once=frame(AHEAD) * 100, pause=0.05),
    "floods pings": Case(NONE, flood=frame(b"x" * 125, PING) * 100),  # and never reads what the client answers
    "floods Engine.IO pings": Case(NONE, flood=frame("2" + "x" * 1000) * 20),
    "floods what is no answer": Case("unusable answers", flood=NUMBERS * 100),
    "floods pongs before it greets": Case(NONE, packets=(), flood=frame("3") * 100),
    "floods binary": Case(NONE, flood=frame(b"\x04" * 1000, BINARY) * 20),
    "nests deep": Case("no usable answer|unusable", packets=DEEP, holds=True),
}
# The error names the last loss of the connection: an attempt that the end of the patience cut short, at times.
LATE = "|accepts connections but does not answer"
hostile = pytest.mark.parametrize("name", CASES)
WAITING, SILENT = "waiting for drive.py", ("never answers", "sends the handshake slowly", "opens no session")


@pytest.fixture(autouse=True)
def short_goodbye(monkeypatch):
    """A server that does not notice the end of a session is waited for 0.1 s, not 1 s."""
    monkeypatch.setattr("cloning.wire.client.CLOSE_TIMEOUT", 0.1)


drive = partial(steer_server.drive, laps=0.01, wait=WAIT)


@hostile
@pytest.mark.parametrize("realtime", [False, True])
def test_a_drive_ends_when_its_patience_does(name, realtime, capsys):
    with Hostile(CASES[name]) as server:
        with pytest.raises(SimulatorError, match=CASES[name].message + LATE) as caught:
            drive(server, realtime=realtime)
        assert server.open, "the client ended by itself"
    text = str(caught.value)
    assert f"no usable answer in {WAIT:g} s" in text and text.isprintable() and len(text) < 300
    assert "start `python drive.py" not in text  # something listens there
    assert capsys.readouterr().err.count("trying again") <= 1


@pytest.mark.parametrize(("name", "reason"), [("never answers", "not answer"), ("opens no session", "sent nothing")])
def test_how_far_a_server_that_says_nothing_came_is_told(name, reason):
    with Hostile(CASES[name]) as server, pytest.raises(ConnectionLost, match=reason):
        Connection("127.0.0.1", server.port, real_timing=False, timeout=5 * WAIT)


@pytest.mark.parametrize("name", ["sends a gigabyte", "fragments without end", "floods what is no answer"])
def test_what_a_server_sends_without_end_is_not_kept(name):
    tracemalloc.start()
    try:
        with Hostile(CASES[name]) as server, pytest.raises(SimulatorError):
            drive(server)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("realtime", [False, True])
def test_a_flood_of_answers_drives_on(realtime):
    """A server that answers without being asked, as fast as it can."""
    with Hostile(Case("", flood=frame(AHEAD) * 100)) as server:
        # What the client sends fills a small buffer at once, on any machine: nobody reads it.
        server.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
        # The server is slow where others need the cores.
        client = drive(server, laps=0.002, wait=3 * WAIT, realtime=realtime)
        assert server.open
    assert client.run.travelled >= 0.002 * client.run.track.length


@pytest.mark.parametrize("name", ["greets and closes", "floods what is no answer", "nests deep"])
def test_a_replay_over_the_wire_ends_as_well(name):
    frame_of_a_replay: Any = SimpleNamespace(speed=0.0, time=0.0, jpeg=lambda: b"a frame")
    with Hostile(CASES[name]) as server:
        driver = ServerDriver("127.0.0.1", server.port, WAIT)
        with pytest.raises(SimulatorError, match="no usable answer"):
            driver(frame_of_a_replay)
        driver.close()
        assert server.open


def test_a_replay_tells_drive_py_its_time():
    """Else frames that come late, or are noisy, would be corrected by the time that computing them takes."""
    with Server(lambda packet, n: [AHEAD]) as server:
        driver = ServerDriver("127.0.0.1", server.port, WAIT)
        for told_time in (0.0, 0.067):
            frame_of_a_replay: Any = SimpleNamespace(speed=9.0, time=told_time, jpeg=lambda: b"a frame")
            driver(frame_of_a_replay)
        driver.close()
    told = [(parse_event(message) or ("", {}))[1] for message in server.messages if message.startswith("42")]
    assert [each["stand_in"] for each in told] == [*[{"time": 0.0}] * 3, {"time": 0.067}]


@pytest.fixture
def own_garbage():
    """Garbage is looked for among what a test makes, not among all that others have left: that takes up to 0.4 s."""
    gc.freeze()
    yield
    gc.unfreeze()


@hostile
def test_the_window_is_not_held_up(own_garbage, name):
    """No server can end the window, or hold up a picture for as long as it takes to connect or to give up."""
    run = Run(lake(), "autonomous")
    with Hostile(CASES[name]) as server:
        remote, slowest, busiest = RemoteDriver("127.0.0.1", server.port, Blank()), 0.0, 0.0
        begun = time.monotonic()
        while time.monotonic() < begun + 0.4 or (remote.state == WAITING and name not in SILENT and server.open):
            begin, busy = time.monotonic(), time.thread_time()
            remote.poll(False, run)
            slowest = max(slowest, time.monotonic() - begin)
            busiest = max(busiest, time.thread_time() - busy)
            time.sleep(0.01)
        assert remote.state != WAITING or name in SILENT
        remote.close()
    assert busiest < 0.25  # s of this thread's computing, whatever else the machine does
    assert slowest < 2
    assert remote.state.isprintable()


# What the real client ignores
NO_NUMBERS = ["1" * 5000, "1e999", "-1e999", "nan", "left", "-Infinity", "0_1", "\u0661", "0x1p-2", "", " "]
NO_ANSWERS = [
    *("", "3", "40", "42", "42[", "42null", "42[1,2,3]", '42{"a":1}', '42["telemetry",{}]', '42["steer"]'),
    *('42["steer",{}]', '42["steer",null]', "42" + "[" * 100_000),
    '42["steer",{"steering_angle":0.1,"throttle":0.2}]',
    '42["steer",{"steering_angle":"0.1","throttle":0.2}]',
    '42["steer",' + '{"steering_angle":' * 100_000,
    '42["steer",{"steering_angle":' + "1" * 1_000_000 + ',"throttle":"0"}]',
    '42["steer",{"steering_angle":1e999,"throttle":NaN}]',
    '42["steer",{"steering_angle":["0"],"throttle":{"a":"0"}}]',
    '42["steer",[["steering_angle","0"],["throttle","0"]]]',
    '42[["steer"],{"steering_angle":"0","throttle":"0"}]',
    '42/other,["steer",{"steering_angle":"0","throttle":"0"}]',
    *(STEER % pair for text in NO_NUMBERS for pair in ((text, "0.5"), ("0.5", text))),
]


@pytest.mark.parametrize("packet", NO_ANSWERS, ids=range(len(NO_ANSWERS)))
def test_what_the_real_client_ignores_is_no_answer(packet):
    assert parse_answer(packet) is None
