"""The simulator's end of the wire: Engine.IO over a WebSocket as the real client speaks it, odd as that is.

It announces Engine.IO 4 but speaks version 3: its own pings, no CONNECT packet. Messages go out as fragments
of 1016 bytes.
"""

import base64
import json
import math
import select
import socket
import time
from dataclasses import dataclass

from wsproto import ConnectionType, WSConnection
from wsproto.events import CloseConnection, Ping, RejectConnection, Request, TextMessage
from wsproto.utilities import ProtocolError

from cloning.road.motion import FULL_LOCK

PATH = "/socket.io/?EIO=4&transport=websocket"
FRAGMENT = 1016  # bytes
PING_EVERY, PONG_WITHIN = 25.0, 60.0  # s
ANSWERS_WITHIN = 10.0  # s for a server to open a session
LEAVE_WITHIN = 1.0  # s for a server to hear that the session is over
RETRY = 0.1  # s between two attempts to connect; the real client makes thousands a second


class Gone(Exception):
    """The server went away, or was never there; the message says how."""


@dataclass(frozen=True)
class Answer:
    """What the server sent in answer: a command (-1..1 each), or "manual", which sets nothing."""

    steering: float | None = None
    throttle: float | None = None


def read(packet: str) -> Answer | None:
    """The answer in an Engine.IO packet, or None if it holds none that the simulator could use.

    As in the real one the numbers must be strings; anything else is dropped.
    """
    if not packet.startswith("42"):
        return None
    try:
        event, data, *_ = [*json.loads(packet[2:]), None]
    except (ValueError, TypeError):
        return None
    if event == "manual":
        return Answer()
    if event != "steer" or not isinstance(data, dict):
        return None
    values = []
    for key in ("steering_angle", "throttle"):
        if not isinstance(data.get(key), str):
            return None
        try:
            value = float(data[key])
        except ValueError:
            return None
        if not math.isfinite(value):
            return None
        values.append(max(-1.0, min(1.0, value)))
    return Answer(*values)


def telemetry(steering: float, throttle: float, speed: float, jpeg: bytes) -> str:
    """The packet for a frame: steering and throttle -1..1 as last commanded, speed in mph; degrees on the
    wire."""
    values = {
        "steering_angle": f"{FULL_LOCK * steering:.4f}",
        "throttle": f"{throttle:.4f}",
        "speed": f"{speed:.4f}",
        "image": base64.b64encode(jpeg).decode(),
    }
    return "42" + json.dumps(["telemetry", values], separators=(",", ":"))


MANUAL = '42["telemetry",null]'  # a person is steering


class Connection:
    """One connection. Packets are Engine.IO's, as text."""

    def __init__(self, host: str, port: int, patient: bool):
        """patient: write each fragment by itself and leave Nagle's algorithm on, as the real client does.

        Raises Gone.
        """
        try:
            self.socket = socket.create_connection((host, port), timeout=10)
        except OSError as error:
            raise Gone(f"no server at {host}:{port} ({error.strerror or error})") from error
        self.patient = patient
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0 if patient else 1)
        self.protocol = WSConnection(ConnectionType.CLIENT)
        self.packets: list[str] = []
        self.partial = ""
        self.pinged, self.waiting = time.monotonic(), None  # of the last ping; since when a pong is due
        agent = [(b"user-agent", b"websocket-sharp/1.0")]
        request = Request(host=f"{host}:{port}", target=PATH, extra_headers=agent)
        try:
            self.socket.sendall(self.protocol.send(request))
            self._begin(f"{host}:{port}", time.monotonic() + ANSWERS_WITHIN)
        except OSError as error:
            self.socket.close()
            raise Gone(f"{host}:{port} broke off ({error.strerror or error})") from error
        except BaseException:
            self.socket.close()
            raise

    def _begin(self, address: str, until: float) -> None:
        """Wait for the server's open packet, then ping, as the real client does before anything else."""
        while not self.packets:
            self._pump(max(0.0, until - time.monotonic()))
            if time.monotonic() > until:
                raise Gone(f"{address} accepts connections but does not answer")
        packet = self.packets.pop(0)
        if not packet.startswith("0"):
            raise Gone(f"{address} does not speak Engine.IO (it sent {packet!r:.60})")
        self.ping()

    def _pump(self, timeout: float) -> None:
        """Wait up to `timeout` seconds for bytes, and take out of them what they hold."""
        if not select.select([self.socket], [], [], timeout)[0]:
            return
        try:
            data = self.socket.recv(65536)
        except OSError as error:
            raise Gone(f"the connection broke ({error.strerror or error})") from error
        if not data:
            raise Gone("the server closed the connection")
        try:
            self.protocol.receive_data(data)
            for event in self.protocol.events():
                self._take(event)
        except ProtocolError as error:
            raise Gone(f"the server does not speak WebSocket ({error})") from error

    def _take(self, event) -> None:
        if isinstance(event, RejectConnection):
            raise Gone(f"the server refuses the connection (HTTP {event.status_code})")
        elif isinstance(event, CloseConnection):
            raise Gone("the server closed the connection")
        elif isinstance(event, Ping):
            self.socket.sendall(self.protocol.send(event.response()))
        elif isinstance(event, TextMessage):
            self.partial += event.data
            if event.message_finished:
                self.packets.append(self.partial)
                self.partial = ""

    def send(self, packet: str) -> None:
        """Raises Gone."""
        data = packet.encode()
        pieces = [data[i : i + FRAGMENT].decode() for i in range(0, len(data), FRAGMENT)]
        last = len(pieces) - 1
        try:
            frames = [
                self.protocol.send(TextMessage(piece, message_finished=i == last)) for i, piece in enumerate(pieces)
            ]
            for frame in frames if self.patient else [b"".join(frames)]:
                self.socket.sendall(frame)
        except OSError as error:
            raise Gone(f"the connection broke ({error.strerror or error})") from error
        except ProtocolError as error:
            raise Gone("the server closed the connection") from error

    def receive(self, timeout: float) -> str | None:
        """The next packet, or None after `timeout` seconds without one; pings meanwhile. Raises Gone."""
        until = time.monotonic() + timeout
        self.keep_alive()
        while not self.packets:
            left = until - time.monotonic()
            self._pump(max(0.0, min(left, 1.0)))
            if left <= 0:
                break
            self.keep_alive()
        if not self.packets:
            return None
        packet = self.packets.pop(0)
        if packet == "3":
            self.waiting = None
        elif packet.startswith("2"):
            self.send("3" + packet[1:])
        elif packet in ("1", "41"):
            raise Gone("the server ended the session")
        return packet

    def keep_alive(self) -> None:
        now = time.monotonic()
        if self.waiting is not None and now - self.waiting > PONG_WITHIN:
            raise Gone(f"the server did not answer a ping within {PONG_WITHIN:.0f} s")
        if now - self.pinged > PING_EVERY:
            self.ping()

    def ping(self) -> None:
        self.send("2")
        self.pinged = time.monotonic()
        if self.waiting is None:
            self.waiting = self.pinged

    def close(self) -> None:
        """Take leave as the real client does, and let the server finish what it is sending."""
        try:
            self.send("41")
            self.send("1")
            self.socket.sendall(self.protocol.send(CloseConnection(code=1000)))
            self.socket.shutdown(socket.SHUT_WR)
            self.socket.settimeout(LEAVE_WITHIN)
            while self.socket.recv(65536):
                pass
        except (Gone, OSError, ProtocolError):
            return  # it is gone already
        finally:
            self.socket.close()
