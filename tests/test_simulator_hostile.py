"""The simulator's end of the wire against servers that break the protocol, flood it, or never answer."""

import contextlib
import functools
import re
import socket
import struct
import threading
import time
import tracemalloc

import pytest
from steer_server import STEER, Blank, Server, accept_websocket

from cloning.base.errors import SimulatorError
from cloning.replay.server_driver import ServerDriver
from cloning.road.track import Track
from cloning.wire.client import parse_answer
from simulator.__main__ import main
from simulator.client import Client, RemoteDriver
from simulator.run import Run

WAIT = 0.3  # s of patience
SLACK = 8.0  # s: more than the client takes beyond its patience on a busy machine; then the server gives up
TEXT, BINARY, CLOSE, PING = 1, 2, 8, 9
OPENED = '0{"sid":"x","upgrades":[],"pingTimeout":60000,"pingInterval":25000}'
AHEAD = STEER % ("0.0", "1.0")


def frame(payload, opcode=TEXT, final=True):
    """A frame of a server, which is not masked."""
    payload = payload.encode() if isinstance(payload, str) else payload
    if len(payload) < 126:
        size = bytes([len(payload)])
    elif len(payload) < 1 << 16:
        size = b"\x7e" + struct.pack(">H", len(payload))
    else:
        size = b"\x7f" + struct.pack(">Q", len(payload))
    return bytes([0x80 * final | opcode]) + size + payload


class Hostile:
    """Does the same to each client that connects, in a thread, for WAIT + SLACK seconds at most."""

    def __init__(self, behave):
        self.behave, self.until = behave, time.monotonic() + WAIT + SLACK
        self.sent = self.connections = 0  # bytes, clients
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.threads = [threading.Thread(target=self.run)]
        self.threads[0].start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.until = 0
        for thread in self.threads:
            thread.join(20)
            assert not thread.is_alive()

    @property
    def open(self):
        return time.monotonic() < self.until

    def run(self):
        self.listener.settimeout(0.1)
        with self.listener:
            while self.open:
                with contextlib.suppress(TimeoutError):
                    client, _ = self.listener.accept()
                    self.connections += 1
                    self.threads.append(threading.Thread(target=self.serve, args=(client,)))
                    self.threads[-1].start()

    def serve(self, client):
        client.settimeout(0.1)
        with client, contextlib.suppress(OSError):
            self.behave(self, client)

    def send(self, client, data):
        """Send all bytes, unless the time is over."""
        while data:
            if not self.open:
                raise ConnectionError
            with contextlib.suppress(TimeoutError):
                sent = client.send(data[: 1 << 16])
                self.sent += sent
                data = data[sent:]

    def flood(self, client, data):
        while True:
            self.send(client, data)

    def hold(self, client):
        """Read until the client closes."""
        while self.open:
            with contextlib.suppress(TimeoutError):
                if not client.recv(1 << 16):
                    return


def handshake(server, client, *packets):
    accept_websocket(client)
    server.send(client, b"".join(map(frame, (OPENED, *packets))))


# Each is what a server does to one client. Afterwards its connection is closed.


def closes_at_once(server, client):
    pass


def never_answers(server, client):
    server.hold(client)


def sends_a_web_page(server, client):
    server.send(client, b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n")
    server.flood(client, b"<p>Welcome</p>" * 1000)


def sends_no_line_end(server, client):
    server.flood(client, b"HTTP/1.1 101 " + b"x" * 10000)


def accepts_another_key(server, client):
    client.recv(1 << 16)
    upgrade = b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    server.send(client, upgrade + b"Sec-WebSocket-Accept: 0\r\n\r\n")


def chooses_a_subprotocol_in_latin_1(server, client):
    accept_websocket(client, b"Sec-WebSocket-Protocol: \xe9\r\n")


def speaks_something_else(server, client):
    accept_websocket(client)
    server.send(client, frame("\x1b[2JHello" * 50))
    server.hold(client)


def sends_a_masked_frame(server, client):
    handshake(server, client, "40")
    server.send(client, b"\x81\x81\0\0\0\0x")
    server.hold(client)


def sends_broken_utf_8(server, client):
    handshake(server, client, "40")
    server.send(client, frame(b"42\xff\xfe"))
    server.hold(client)


def closes_with_garbage(server, client):
    handshake(server, client, "40")
    server.send(client, frame(b"\x00", CLOSE))


def closes_with_a_reason(server, client):
    handshake(server, client, "40")
    server.send(client, frame(struct.pack(">H", 1000) + b"\x1b[2Jbye", CLOSE))


def greets_and_closes(server, client):
    handshake(server, client, STEER % ("0", "1"), "40", STEER % ("0", "1"))


def answers_one_of_three_and_closes(server, client):
    handshake(server, client, "40")
    client.recv(1 << 16)
    server.send(client, frame(AHEAD))


def sends_a_gigabyte(server, client):
    handshake(server, client, "40")
    server.send(client, b"\x81\x7f" + struct.pack(">Q", 1 << 30))
    server.flood(client, b"4" * (1 << 16))


def sends_endless_fragments(server, client):
    handshake(server, client, "40")
    server.send(client, frame("42", TEXT, final=False))
    server.flood(client, frame("[" * 1000, 0, final=False) * 10)


def sends_endless_empty_fragments(server, client):
    handshake(server, client, "40")
    server.send(client, frame("42", TEXT, final=False))
    server.flood(client, frame("", 0, final=False) * 1000)


def sends_a_byte_at_a_time(server, client):
    handshake(server, client, "40")
    for byte in frame(AHEAD) * 100:
        server.send(client, bytes([byte]))
        time.sleep(0.05)


def sends_the_handshake_a_byte_at_a_time(server, client):
    for byte in b"HTTP/1.1 101 Switching Protocols\r\n" * 100:
        server.send(client, bytes([byte]))
        time.sleep(0.05)


def floods_pings(server, client):
    handshake(server, client, "40")
    server.flood(client, frame(b"x" * 125, PING) * 100)  # and never reads what the client answers


def floods_engine_io_pings(server, client):
    handshake(server, client, "40")
    server.flood(client, frame("2" + "x" * 1000) * 20)


def floods_what_is_no_answer(server, client):
    handshake(server, client, "40")
    server.flood(client, (frame("42[1]") + frame('42["steer",{"steering_angle":0,"throttle":1}]')) * 100)


def floods_pongs_before_it_greets(server, client):
    handshake(server, client)
    server.flood(client, frame("3") * 100)


def floods_binary(server, client):
    handshake(server, client, "40")
    server.flood(client, frame(b"\x04" * 1000, BINARY) * 20)


def nests_deep(server, client):
    handshake(server, client, "40", "42" + "[" * 60_000, '42["steer",' * 5_000)
    server.hold(client)


HOSTILE = [
    (closes_at_once, "closed the connection|broke"),
    (never_answers, "does not answer"),
    (sends_a_web_page, "HTTP 200"),
    (sends_no_line_end, "does not speak WebSocket"),
    (accepts_another_key, "does not speak WebSocket"),
    (chooses_a_subprotocol_in_latin_1, "does not speak WebSocket"),
    (speaks_something_else, "does not speak Engine.IO"),
    (sends_a_masked_frame, "does not speak WebSocket"),
    (sends_broken_utf_8, "does not speak WebSocket"),
    (closes_with_garbage, "WebSocket|closed|broke"),
    (closes_with_a_reason, "closed the connection|broke"),
    (greets_and_closes, "closed the connection|broke"),
    (answers_one_of_three_and_closes, "closed the connection|broke"),
    (sends_a_gigabyte, "more than 65536 characters"),
    (sends_endless_fragments, "more than 65536 characters"),
    (sends_endless_empty_fragments, "no usable answer"),
    (sends_a_byte_at_a_time, "no usable answer"),
    (sends_the_handshake_a_byte_at_a_time, "does not"),
    (floods_pings, "no usable answer"),
    (floods_engine_io_pings, "no usable answer"),
    (floods_what_is_no_answer, "unusable answers"),
    (floods_pongs_before_it_greets, "no usable answer"),
    (floods_binary, "no usable answer"),
    (nests_deep, "no usable answer|unusable"),
]
# The error names the last loss of the connection: an attempt that the end of the patience cut short, at times.
LATE = "|accepts connections but does not answer"
hostile = pytest.mark.parametrize(
    ("behave", "message"), [pytest.param(each, words + LATE, id=each.__name__) for each, words in HOSTILE]
)


@functools.cache
def lake():
    return Track("lake")


def drive(server, realtime, laps=0.01):
    client = Client(Run(lake(), "autonomous"), Blank(), "127.0.0.1", server.port, WAIT, realtime)
    client.drive(laps)
    return client


@hostile
def test_a_drive_ends_when_its_patience_does(behave, message, capsys):
    with Hostile(behave) as server:
        with pytest.raises(SimulatorError, match=message) as caught:
            drive(server, realtime=False)
        assert server.open, "the client ended by itself"
    text = str(caught.value)
    assert f"no usable answer in {WAIT:g} s" in text and text.isprintable() and len(text) < 300
    assert capsys.readouterr().err.count("trying again") <= 1


@hostile
def test_so_does_a_drive_in_real_time(behave, message):
    with Hostile(behave) as server:
        with pytest.raises(SimulatorError, match=message):
            drive(server, realtime=True)
        assert server.open


@pytest.mark.parametrize("behave", [sends_a_gigabyte, sends_endless_fragments, floods_what_is_no_answer])
def test_what_a_server_sends_without_end_is_not_kept(behave):
    tracemalloc.start()
    try:
        with Hostile(behave) as server, pytest.raises(SimulatorError):
            drive(server, realtime=False)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("realtime", [False, True])
def test_a_flood_of_answers_drives_on(realtime):
    """A server that answers without being asked, as fast as it can."""

    def floods_answers(server, client):
        handshake(server, client, "40")
        server.flood(client, frame(AHEAD) * 100)

    with Hostile(floods_answers) as server:
        # What the client sends fills a small buffer at once, on any machine: nobody reads it.
        server.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
        client = drive(server, realtime, laps=0.002)
        assert server.open
    assert client.run.travelled >= 0.002 * client.run.track.length


@pytest.mark.parametrize("realtime", [False, True])
def test_answers_given_twice_drive_on(realtime):
    with Server(lambda packet, n: [AHEAD, AHEAD]) as server:
        assert drive(server, realtime).run.travelled > 10


@pytest.mark.parametrize("behave", [greets_and_closes, floods_what_is_no_answer, nests_deep])
def test_a_replay_over_the_wire_ends_as_well(behave):
    class Frame:
        speed = 0.0

        def jpeg(self):
            return b"a frame"

    driver = ServerDriver("127.0.0.1", 0, WAIT)
    with Hostile(behave) as server:
        driver.address = "127.0.0.1", server.port
        with pytest.raises(SimulatorError, match="no usable answer"):
            driver(Frame())
        driver.close()
        assert server.open


def test_the_command_ends_with_status_2(capsys):
    with Hostile(closes_at_once) as server:
        assert main(["drive", "--wait", str(WAIT), "--port", str(server.port)]) == 2
    printed = capsys.readouterr().err
    assert re.search(r"^simulator: .*no usable answer in 0\.3 s", printed, re.MULTILINE) and "Traceback" not in printed


@hostile
def test_the_window_is_not_held_up(behave, message):
    """No server can end the window, or hold up a picture for as long as it takes to connect or to give up."""
    run = Run(lake(), "autonomous")
    with Hostile(behave) as server:
        remote, slowest, busiest = RemoteDriver("127.0.0.1", server.port, Blank()), 0.0, 0.0
        until = time.monotonic() + 0.5
        while time.monotonic() < until:
            begin, busy = time.monotonic(), time.thread_time()
            remote.poll(False, run)
            slowest = max(slowest, time.monotonic() - begin)
            busiest = max(busiest, time.thread_time() - busy)
            time.sleep(0.01)
        assert remote.state != "not connected" or behave in (never_answers, sends_the_handshake_a_byte_at_a_time)
        remote.close()
    assert busiest < 0.25  # s of this thread's computing, whatever else the machine does
    assert slowest < 2
    assert remote.state.isprintable()


@pytest.mark.parametrize(
    "number",
    ["1" * 50_000, "9" * 5000, "1e999", "-1e999", "nan", "inf", "-Infinity", "0_1", "\u0661", "0x1p-2", "", " "],
)
def test_numbers_that_the_real_client_cannot_read_are_no_answer(number):
    assert parse_answer(STEER % (number, "0.5")) is None
    assert parse_answer(STEER % ("0.5", number)) is None


@pytest.mark.parametrize(
    "packet",
    [
        "42" + "[" * 100_000,
        '42["steer",' + '{"steering_angle":' * 100_000,
        '42["steer",{"steering_angle":' + "1" * 1_000_000 + ',"throttle":"0"}]',
        '42["steer",{"steering_angle":1e999,"throttle":NaN}]',
        '42["steer",{"steering_angle":["0"],"throttle":{"a":"0"}}]',
        '42["steer",null]',
        '42["steer",[["steering_angle","0"],["throttle","0"]]]',
        '42[["steer"],{"steering_angle":"0","throttle":"0"}]',
        '42/other,["steer",{"steering_angle":"0","throttle":"0"}]',
    ],
    ids=range(9),
)
def test_other_json_is_no_answer(packet):
    assert parse_answer(packet) is None
