"""A client on a raw socket that sends the same bytes as the Udacity simulator, for tests and the benchmark."""

import base64
import json
import os
import socket
import struct
from typing import Self

from cloning.wire.protocol import FRAGMENT


class Simulator:
    """The simulator's end of the websocket: blocking, without TCP_NODELAY, each fragment masked with a random key."""

    def __init__(self, port: int, host: str = "127.0.0.1", headers: str = "", timeout: float = 20):
        """Connect, and send the opening handshake; headers: more of HTTP, with line ends; timeout: s, for each wait."""
        self.socket = socket.create_connection((host, port), timeout)
        self.socket.settimeout(timeout)
        self._buffer = b""
        self.socket.sendall(
            f"GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\nUser-Agent: websocket-sharp/1.0\r\n"
            f"Host: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}\r\nSec-WebSocket-Version: 13\r\n"
            f"{headers}\r\n".encode()
        )
        while b"\r\n\r\n" not in self._buffer:
            self._fill()
        head, self._buffer = self._buffer.split(b"\r\n\r\n", 1)
        self.status = int(head.split()[1])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def _fill(self) -> None:
        data = self.socket.recv(65536)
        if not data:
            raise ConnectionError("the server has closed the connection")
        self._buffer += data

    def _take(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._fill()
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken

    def send(self, message: str | bytes, opcode: int = 1) -> None:
        """Send a message in fragments, with one system call for each, like the simulator."""
        for fragment in fragments(message, opcode):
            self.socket.sendall(fragment)

    def receive(self) -> str:
        """Return the next text message. Raises ConnectionError if the server closes, TimeoutError if none arrives."""
        opcode, length = self._take(2)
        if opcode == 0x88:
            raise ConnectionError("the server has closed the websocket")
        assert opcode == 0x81, f"the simulator expects unfragmented text, not {opcode:#x}"
        if length == 126:
            (length,) = struct.unpack(">H", self._take(2))
        return self._take(length).decode()

    def open(self) -> Self:
        """Receive the server's first three packets: 0{…}, the first steer, 40."""
        for _ in range(3):
            self.receive()
        return self

    def drive(self, telemetry: object) -> dict[str, str]:
        """Send a telemetry and return its answer, the data of `steer`."""
        self.send("42" + json.dumps(["telemetry", telemetry], separators=(",", ":")))
        event, data = json.loads(self.receive()[2:])
        assert event == "steer", event
        return data


def fragments(message: str | bytes, opcode: int = 1) -> list[bytes]:
    """Return a message as masked websocket frames of at most FRAGMENT bytes; opcode: 1 text, 2 binary, 8 close."""
    payload = message.encode() if isinstance(message, str) else message
    frames = []
    for at in range(0, max(len(payload), 1), FRAGMENT):
        part = payload[at : at + FRAGMENT]
        final = 0x80 if at + FRAGMENT >= len(payload) else 0
        size = struct.pack(">B", 0x80 | len(part)) if len(part) < 126 else struct.pack(">BH", 0x80 | 126, len(part))
        key = os.urandom(4)
        mask = (key * (len(part) // 4 + 1))[: len(part)]
        masked = (int.from_bytes(part, "big") ^ int.from_bytes(mask, "big")).to_bytes(len(part), "big")
        frames.append(bytes([final | (opcode if at == 0 else 0)]) + size + key + masked)
    return frames


def telemetry(
    jpeg: bytes, steering_angle: str = "0.0000", throttle: str = "0.0000", speed: str = "0.0000"
) -> dict[str, str]:
    """Return the data of a telemetry message; steering_angle in degrees, throttle -1..1, speed in mph."""
    return {
        "steering_angle": steering_angle,
        "throttle": throttle,
        "speed": speed,
        "image": base64.b64encode(jpeg).decode(),
    }
