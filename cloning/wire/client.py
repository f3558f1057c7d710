"""The simulator's end of the wire: Engine.IO over a WebSocket, with the real client's peculiarities.

The real client announces Engine.IO 4 but speaks version 3: it sends the pings, and no CONNECT packet. It sends
long messages in fragments. A server that says nothing after its open packet is spoken to in version 4.
"""

import base64
import contextlib
import json
import math
import select
import socket
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from wsproto import ConnectionType, WSConnection
from wsproto.connection import ConnectionState
from wsproto.events import CloseConnection, Event, Ping, RejectConnection, Request, TextMessage
from wsproto.utilities import ProtocolError

from cloning.base.errors import printable
from cloning.road.motion import FULL_LOCK
from cloning.wire.protocol import FRAGMENT, PING_INTERVAL, PONG_TIMEOUT, STAND_IN, Place

PATH = "/socket.io/?EIO=4&transport=websocket"
# Engine.IO's packet types, with which each packet begins; a message (4) goes on with Socket.IO's type.
OPEN, CLOSE, PING, PONG, MESSAGE = "0", "1", "2", "3", "4"
CONNECT, DISCONNECT, EVENT, REFUSAL = "40", "41", "42", "44"
GREETING_TIMEOUT = 1.0  # s for a server to send its first command, or its first answer
CONNECT_TIMEOUT = 10.0  # s to reach a server and for it to open a session
SEND_TIMEOUT = 5.0  # s for a server to take a packet; one that reads takes it at once
CLOSE_TIMEOUT = 1.0  # s for a server to notice that the session is over
READ_BYTES = 4096  # at a time: enough for 40 answers, and few enough to decode before the next picture is due
MAX_WAITING = 100  # packets that are kept while a first message is waited for
MAX_PACKET = 1 << 16  # characters; an answer has about 80
REFUSALS = {  # what they mean, by HTTP status
    400: ": no WebSocket, or no EIO=4, which python-socketio 4 has with python-engineio 3.13.2, not with 3.14",
    401: ": its handler of `connect` refuses or fails; see its output",
    404: ": another program's server has the port",
}
USABLE = '"steering_angle" and "throttle", as texts, such as "0.1"'  # what a command must have


class ConnectionLost(Exception):
    """The server closed the connection, or was never there; the message says which, perhaps in the server's words."""

    def __init__(self, message: str):
        super().__init__(printable(message))


class NoServer(ConnectionLost):
    """Nothing listens at the server's address."""


@dataclass(frozen=True)
class Answer:
    """The server's answer to a telemetry: steering and throttle, -1..1, or None for "manual", which changes nothing."""

    steering: float | None = None
    throttle: float | None = None


class Driven:
    """What a server has a car do: steering and throttle as last commanded, -1..1."""

    steering = throttle = 0.0

    def apply(self, answer: Answer) -> None:
        """Use the steering and throttle of an answer from now on, if it has any."""
        if answer.steering is not None and answer.throttle is not None:
            self.steering, self.throttle = answer.steering, answer.throttle


def parse_event(packet: str) -> tuple[str, Any] | None:
    """Return the name and the data of the event in an Engine.IO packet, or None if it holds no event."""
    if not packet.startswith(EVENT):
        return None
    try:
        contents = json.loads(packet[len(EVENT) :])
    except (ValueError, RecursionError):  # not JSON, or nested too deep
        return None
    if not isinstance(contents, list) or not contents or not isinstance(contents[0], str):
        return None
    return contents[0], contents[1] if len(contents) > 1 else None


def parse_answer(packet: str) -> Answer | None:
    """Return the answer in an Engine.IO packet, or None if the simulator could not use it."""
    name, data = parse_event(packet) or ("", None)
    if name == "manual":
        return Answer()
    return parse_commands(data) if name == "steer" else None


def parse_commands(data: Any) -> Answer | None:
    """Return the steering and throttle in an event's data, or None if the simulator could not use them.

    The numbers must be strings: the real simulator silently ignores anything else. They are clipped to -1..1.
    """
    if not isinstance(data, dict):
        return None
    steering, throttle = (_number(data.get(key)) for key in ("steering_angle", "throttle"))
    if steering is None or throttle is None:
        return None
    return Answer(steering, throttle)


def _number(text: object) -> float | None:
    if not isinstance(text, str) or not text.isascii() or "_" in text:  # float() reads 1_0, and Arabic digits
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return max(-1.0, min(1.0, value)) if math.isfinite(value) else None


def event_packet(name: str, data: Any) -> str:
    """Return the packet of an event with its data."""
    return EVENT + json.dumps([name, data], separators=(",", ":"))


def telemetry_packet(
    steering: float, throttle: float, speed: float, jpeg: bytes, place: Place | None = None, time: float | None = None
) -> str:
    """Return the telemetry packet for a frame.

    steering, throttle: as last commanded, -1..1 (the packet has the steering in degrees); speed: mph; place: of the
    stand-in's car, for drive.py; time: without a place, s by its clock. Other servers ignore a field that they do not
    know.
    """
    values: dict[str, object] = {
        "steering_angle": f"{FULL_LOCK * steering:.4f}",
        "throttle": f"{throttle:.4f}",
        "speed": f"{speed:.4f}",
        "image": base64.b64encode(jpeg).decode(),
    }
    if place or time is not None:
        told = vars(place) if place else {"time": time}
        values[STAND_IN] = {name: round(v, 3) if isinstance(v, float) else v for name, v in told.items()}
    return event_packet("telemetry", values)


MANUAL_TELEMETRY = f'{EVENT}["telemetry",null]'  # while the human driver holds W or S


class Connection:
    """A connection to the server; sends and receives Engine.IO packets, as text.

    Whatever the server sends, it takes no more memory than a packet of `max_packet` and READ_BYTES. When the connection
    is lost, its socket is closed.
    """

    def __init__(
        self,
        host: str,
        port: int,
        real_timing: bool,
        timeout: float = CONNECT_TIMEOUT,
        send_timeout: float = SEND_TIMEOUT,
        max_packet: int = MAX_PACKET,
    ):
        """Connect, and wait until the server has opened a session.

        real_timing: write as the real client does, each fragment on its own and with Nagle's algorithm; otherwise
        a whole packet at once. timeout: s until the session is open; send_timeout: s for the server to take a packet;
        max_packet: characters that a packet of the server may have.
        Raises ConnectionLost.
        """
        until = time.monotonic() + timeout
        address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        try:
            self.socket = socket.create_connection((host, port), timeout=timeout)
        except (OSError, UnicodeError) as error:  # UnicodeError: a name that no host can have
            raise NoServer(f"no server at {address} ({getattr(error, 'strerror', None) or error})") from error
        self.real_timing, self.send_timeout, self.max_packet = real_timing, send_timeout, max_packet
        self.protocol = WSConnection(ConnectionType.CLIENT)
        self.packets: deque[str] = deque()  # received, but not yet returned by `receive`
        self.partial = ""  # message of which not all fragments have arrived
        self.last_ping = time.monotonic()
        self.pong_due_since: float | None = None
        self.asked = False  # whether the server was asked to connect
        agent = [(b"user-agent", b"websocket-sharp/1.0")]
        with self._closed_if_lost():
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0 if real_timing else 1)
            self._write(self.protocol.send(Request(host=address, target=PATH, extra_headers=agent)))
            self._open_session(address, until)

    @contextlib.contextmanager
    def _closed_if_lost(self) -> Iterator[None]:
        """Close the socket after an error that the server can cause, and raise it as ConnectionLost."""
        try:
            yield
        except (ConnectionLost, OSError, ProtocolError, UnicodeError) as error:
            self.socket.close()
            if isinstance(error, ConnectionLost):
                raise
            reason = f"the server does not speak WebSocket ({error!s:.100})"  # UnicodeError: in a header
            if isinstance(error, TimeoutError):
                reason = f"the server has read nothing for {self.send_timeout:g} s"
            elif isinstance(error, OSError):
                reason = f"the connection broke ({error.strerror or error})"
            raise ConnectionLost(reason) from error

    def _open_session(self, address: str, until: float) -> None:
        """Wait for the server's open packet and greeting, and ping, as the real client does; ask a silent server."""
        while not self.packets:
            if time.monotonic() > until:
                opened = self.protocol.state is ConnectionState.OPEN
                silent = "accepts connections but does not answer"
                mute = "does not speak Engine.IO (it sent nothing, as servers for the term-2 simulator do)"
                raise ConnectionLost(f"{address} {mute if opened else silent}")
            self._read_socket(max(0.0, until - time.monotonic()))
        packet = self.packets.popleft()
        if not packet.startswith(OPEN):
            raise ConnectionLost(f"{address} does not speak Engine.IO (it sent {packet[:60]!r})")
        until = min(until, time.monotonic() + GREETING_TIMEOUT)
        while not any(packet.startswith(MESSAGE) for packet in self.packets):
            if (left := until - time.monotonic()) <= 0 or len(self.packets) >= MAX_WAITING:
                # A server of Socket.IO 3 or later waits for CONNECT, sends the pings, and may bear none of a client.
                self._send(CONNECT)
                self.asked, self.last_ping = True, math.inf
                return
            self._read_socket(left)
        self._send(PING)
        self.last_ping = self.pong_due_since = time.monotonic()

    def _read_socket(self, timeout: float) -> None:
        """Wait up to `timeout` seconds for bytes, and decode them."""
        if not select.select([self.socket], [], [], timeout)[0]:
            return
        data = self.socket.recv(READ_BYTES)
        if not data:
            raise ConnectionLost("the server closed the connection")
        self.protocol.receive_data(data)
        for event in self.protocol.events():
            self._handle(event)

    def _handle(self, event: Event) -> None:
        if isinstance(event, RejectConnection):
            raise ConnectionLost(
                f"the server refuses the connection (HTTP {event.status_code}{REFUSALS.get(event.status_code, '')})"
            )
        elif isinstance(event, CloseConnection):
            if self.protocol.state is ConnectionState.OPEN:  # not a closing frame, but bytes that are no frame at all
                raise ConnectionLost(f"the server does not speak WebSocket ({event.reason!s:.100})")
            raise ConnectionLost("the server closed the connection")
        elif isinstance(event, Ping):
            self._write(self.protocol.send(event.response()))
        elif isinstance(event, TextMessage):
            self.partial += event.data
            if len(self.partial) > self.max_packet:
                raise ConnectionLost(f"the server sent a message of more than {self.max_packet} characters")
            if event.message_finished:
                self.packets.append(self.partial)
                self.partial = ""

    def _write(self, *frames: bytes) -> None:
        """Write frames to the socket, each by itself."""
        until = time.monotonic() + self.send_timeout
        for frame in frames:
            self.socket.settimeout(max(1e-3, until - time.monotonic()))
            self.socket.sendall(frame)

    def _send(self, packet: str) -> None:
        data, frames = packet.encode(), []
        for start in range(0, len(data), FRAGMENT):
            fragment, is_last = data[start : start + FRAGMENT].decode(), start + FRAGMENT >= len(data)
            frames.append(self.protocol.send(TextMessage(fragment, message_finished=is_last)))
        self._write(*(frames if self.real_timing else [b"".join(frames)]))

    def send(self, packet: str) -> None:
        """Send a packet in fragments. Raises ConnectionLost."""
        with self._closed_if_lost():
            self._send(packet)

    def receive(self, timeout: float) -> str | None:
        """Return the next packet, None after `timeout` s without one; answer and send pings. Raises ConnectionLost."""
        until = time.monotonic() + timeout
        with self._closed_if_lost():
            self._keep_alive()
            while not self.packets:
                left = until - time.monotonic()
                self._read_socket(max(0.0, min(left, 1.0)))
                if left <= 0:
                    break
                self._keep_alive()
            if not self.packets:
                return None
            packet = self.packets.popleft()
            if packet == PONG:
                self.pong_due_since = None
            elif packet.startswith(PING):
                self._send(PONG + packet[1:])
            elif packet in (CLOSE, DISCONNECT):
                raise ConnectionLost("the server ended the session")
            elif packet.startswith(REFUSAL):
                raise ConnectionLost(f"the server refuses to connect ({packet[len(REFUSAL) :]!s:.100})")
            return packet

    def _keep_alive(self) -> None:
        now = time.monotonic()
        if self.pong_due_since is not None and now - self.pong_due_since > PONG_TIMEOUT:
            raise ConnectionLost(f"the server did not answer a ping within {PONG_TIMEOUT:.0f} s")
        if now - self.last_ping > PING_INTERVAL:
            self._send(PING)
            self.last_ping = now
            self.pong_due_since = self.pong_due_since or now

    def close(self) -> None:
        """End the session as the real client does, and let the server finish sending, for a second at most."""
        self.send_timeout = CLOSE_TIMEOUT
        until = time.monotonic() + CLOSE_TIMEOUT
        with contextlib.suppress(ConnectionLost), self._closed_if_lost():  # the server may have closed already
            self._send(DISCONNECT)
            self._send(CLOSE)
            self._write(self.protocol.send(CloseConnection(code=1000)))
            self.socket.shutdown(socket.SHUT_WR)
            while (left := until - time.monotonic()) > 0:
                self.socket.settimeout(left)
                if not self.socket.recv(READ_BYTES):
                    break
        self.socket.close()
