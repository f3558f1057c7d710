"""The simulator's end of the wire: Engine.IO over a WebSocket, with the real client's peculiarities.

The real client announces Engine.IO 4 but speaks version 3: it sends the pings, and no CONNECT packet. It sends
long messages in fragments.
"""

import base64
import json
import math
import select
import socket
import time
from dataclasses import dataclass

from wsproto import ConnectionType, WSConnection
from wsproto.events import CloseConnection, Event, Ping, RejectConnection, Request, TextMessage
from wsproto.utilities import ProtocolError

from cloning.road.motion import FULL_LOCK
from cloning.wire.protocol import FRAGMENT, PING_INTERVAL, PONG_TIMEOUT

PATH = "/socket.io/?EIO=4&transport=websocket"
# Engine.IO's packet types, with which each packet begins; a message (4) goes on with Socket.IO's type.
OPEN, CLOSE, PING, PONG, MESSAGE = "0", "1", "2", "3", "4"
CONNECT, DISCONNECT, EVENT = "40", "41", "42"
CONNECT_TIMEOUT = 10.0  # s to reach a server, and again for it to open a session
CLOSE_TIMEOUT = 1.0  # s for a server to notice that the session is over


class ConnectionLost(Exception):
    """The server closed the connection, or was never there; the message says which."""


@dataclass(frozen=True)
class Answer:
    """The server's answer to a telemetry: steering and throttle, -1..1, or None for "manual", which changes nothing."""

    steering: float | None = None
    throttle: float | None = None


def parse_answer(packet: str) -> Answer | None:
    """Return the answer in an Engine.IO packet, or None if the simulator could not use it.

    The numbers must be strings: the real simulator silently ignores anything else. They are clipped to -1..1.
    """
    if not packet.startswith(EVENT):
        return None
    try:
        contents = json.loads(packet[len(EVENT) :])
    except ValueError:
        return None
    if not isinstance(contents, list) or not contents:
        return None
    event, data = contents[0], contents[1] if len(contents) > 1 else None
    if event == "manual":
        return Answer()
    if event != "steer" or not isinstance(data, dict):
        return None
    steering, throttle = (_number(data.get(key)) for key in ("steering_angle", "throttle"))
    if steering is None or throttle is None:
        return None
    return Answer(steering, throttle)


def _number(text: object) -> float | None:
    if not isinstance(text, str):
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return max(-1.0, min(1.0, value)) if math.isfinite(value) else None


def telemetry_packet(steering: float, throttle: float, speed: float, jpeg: bytes) -> str:
    """Return the telemetry packet for a frame.

    steering, throttle: as last commanded, -1..1 (the packet has the steering in degrees); speed: mph.
    """
    values = {
        "steering_angle": f"{FULL_LOCK * steering:.4f}",
        "throttle": f"{throttle:.4f}",
        "speed": f"{speed:.4f}",
        "image": base64.b64encode(jpeg).decode(),
    }
    return EVENT + json.dumps(["telemetry", values], separators=(",", ":"))


MANUAL_TELEMETRY = f'{EVENT}["telemetry",null]'  # while the human driver holds W or S


class Connection:
    """A connection to the server; sends and receives Engine.IO packets, as text."""

    def __init__(self, host: str, port: int, real_timing: bool):
        """Connect, and wait until the server has opened a session.

        real_timing: write as the real client does, each fragment on its own and with Nagle's algorithm; otherwise
        a whole packet at once. Raises ConnectionLost.
        """
        address = f"{host}:{port}"
        try:
            self.socket = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT)
        except OSError as error:
            raise ConnectionLost(f"no server at {address} ({error.strerror or error})") from error
        self.real_timing = real_timing
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0 if real_timing else 1)
        self.protocol = WSConnection(ConnectionType.CLIENT)
        self.packets: list[str] = []  # received, but not yet returned by `receive`
        self.partial = ""  # message of which not all fragments have arrived
        self.last_ping = time.monotonic()
        self.pong_due_since: float | None = None
        agent = [(b"user-agent", b"websocket-sharp/1.0")]
        request = Request(host=address, target=PATH, extra_headers=agent)
        try:
            self.socket.sendall(self.protocol.send(request))
            self._open_session(address)
        except OSError as error:
            self.socket.close()
            raise ConnectionLost(f"the connection to {address} broke ({error.strerror or error})") from error
        except BaseException:
            self.socket.close()
            raise

    def _open_session(self, address: str) -> None:
        """Wait for the server's open packet, then ping at once, as the real client does."""
        until = time.monotonic() + CONNECT_TIMEOUT
        while not self.packets:
            self._read_socket(max(0.0, until - time.monotonic()))
            if time.monotonic() > until:
                raise ConnectionLost(f"{address} accepts connections but does not answer")
        packet = self.packets.pop(0)
        if not packet.startswith(OPEN):
            raise ConnectionLost(f"{address} does not speak Engine.IO (it sent {packet!r:.60})")
        self.ping()

    def _read_socket(self, timeout: float) -> None:
        """Wait up to `timeout` seconds for bytes, and decode them."""
        if not select.select([self.socket], [], [], timeout)[0]:
            return
        try:
            data = self.socket.recv(65536)
        except OSError as error:
            raise ConnectionLost(f"the connection broke ({error.strerror or error})") from error
        if not data:
            raise ConnectionLost("the server closed the connection")
        try:
            self.protocol.receive_data(data)
            for event in self.protocol.events():
                self._handle(event)
        except ProtocolError as error:
            raise ConnectionLost(f"the server does not speak WebSocket ({error})") from error

    def _handle(self, event: Event) -> None:
        if isinstance(event, RejectConnection):
            raise ConnectionLost(f"the server refuses the connection (HTTP {event.status_code})")
        elif isinstance(event, CloseConnection):
            raise ConnectionLost("the server closed the connection")
        elif isinstance(event, Ping):
            self.socket.sendall(self.protocol.send(event.response()))
        elif isinstance(event, TextMessage):
            self.partial += event.data
            if event.message_finished:
                self.packets.append(self.partial)
                self.partial = ""

    def send(self, packet: str) -> None:
        """Send a packet in fragments. Raises ConnectionLost."""
        data = packet.encode()
        fragments = [data[i : i + FRAGMENT].decode() for i in range(0, len(data), FRAGMENT)]
        last = len(fragments) - 1
        try:
            frames = [
                self.protocol.send(TextMessage(fragment, message_finished=i == last))
                for i, fragment in enumerate(fragments)
            ]
            for frame in frames if self.real_timing else [b"".join(frames)]:
                self.socket.sendall(frame)
        except OSError as error:
            raise ConnectionLost(f"the connection broke ({error.strerror or error})") from error
        except ProtocolError as error:
            raise ConnectionLost("the server closed the connection") from error

    def receive(self, timeout: float) -> str | None:
        """Return the next packet, or None if none comes within `timeout` seconds; answer and send pings meanwhile.

        Raises ConnectionLost.
        """
        until = time.monotonic() + timeout
        self._keep_alive()
        while not self.packets:
            left = until - time.monotonic()
            self._read_socket(max(0.0, min(left, 1.0)))
            if left <= 0:
                break
            self._keep_alive()
        if not self.packets:
            return None
        packet = self.packets.pop(0)
        if packet == PONG:
            self.pong_due_since = None
        elif packet.startswith(PING):
            self.send(PONG + packet[1:])
        elif packet in (CLOSE, DISCONNECT):
            raise ConnectionLost("the server ended the session")
        return packet

    def _keep_alive(self) -> None:
        now = time.monotonic()
        if self.pong_due_since is not None and now - self.pong_due_since > PONG_TIMEOUT:
            raise ConnectionLost(f"the server did not answer a ping within {PONG_TIMEOUT:.0f} s")
        if now - self.last_ping > PING_INTERVAL:
            self.ping()

    def ping(self) -> None:
        """Send a ping. Raises ConnectionLost."""
        self.send(PING)
        self.last_ping = time.monotonic()
        if self.pong_due_since is None:
            self.pong_due_since = self.last_ping

    def close(self) -> None:
        """End the session as the real client does, and let the server finish sending."""
        try:
            self.send(DISCONNECT)
            self.send(CLOSE)
            self.socket.sendall(self.protocol.send(CloseConnection(code=1000)))
            self.socket.shutdown(socket.SHUT_WR)
            self.socket.settimeout(CLOSE_TIMEOUT)
            while self.socket.recv(65536):
                pass
        except (ConnectionLost, OSError, ProtocolError):
            return  # the server has already closed the connection
        finally:
            self.socket.close()
