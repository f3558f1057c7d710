"""The websocket of the server's end: eventlet's, made faster, and without a way to use much time or memory."""

import socket
import time
from typing import Any
from wsgiref.types import WSGIEnvironment

from cloning.server.libraries import engineio, eventlet
from cloning.server.telemetry import MAX_MESSAGE

UNREADABLE_LENGTH = 23  # bytes that are kept of a longer message: enough to see that it is a telemetry
SLICE = 0.0003  # s that a connection may work before others do
PACKET_TYPES = tuple("0123456")  # of Engine.IO, with which each text begins
QUICKACK: int | None = getattr(socket, "TCP_QUICKACK", None)  # Linux only


class QuickSocket:
    """A socket for a websocket that reads much at a time and acknowledges it at once.

    The simulator sends a message in fragments without TCP_NODELAY: each waits for the ACK of the one before, which
    Linux delays by 40 ms unless TCP_QUICKACK is set again after each read.
    """

    def __init__(self, sock: Any):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock, self.buffer, self.at = sock, b"", 0
        self.sendall, self.settimeout = sock.sendall, sock.settimeout
        self.shutdown, self.close = sock.shutdown, sock.close
        self.since = time.perf_counter()  # when others had their turn

    def recv(self, size: int) -> bytes:
        """Return up to `size` bytes; none at the end of the connection."""
        if time.perf_counter() > self.since + SLICE:
            # eventlet does not let others work while there is something to read: 468 ms beside websocket_pings_read.
            eventlet.sleep(0)
            self.since = time.perf_counter()
        if self.at == len(self.buffer):  # without a buffer: 27 ms beside websocket_pings_read, instead of 12
            self.buffer, self.at = self._read(), 0
            if QUICKACK is not None:
                self.sock.setsockopt(socket.IPPROTO_TCP, QUICKACK, 1)
        start, self.at = self.at, min(self.at + size, len(self.buffer))
        return self.buffer[start : self.at]

    def _read(self) -> bytes:
        try:
            return self.sock.fd.recv(65536)
        except BlockingIOError:
            data = self.sock.recv(65536)  # waits, while others work
            self.since = time.perf_counter()  # without: 9 of 10 within 41 ms beside three other cars, instead of 25
            return data


class WebSocket(eventlet.websocket.RFC6455WebSocket):
    """eventlet's websocket with faster unmasking, and a limit on whole messages rather than on fragments."""

    arrived = 0.0  # time.perf_counter() when the first fragment of the last message was read

    class Message(eventlet.websocket.RFC6455WebSocket.Message):
        """A message of which not all fragments have arrived."""

        data: list[bytes]
        length = 0

        def push(self, data: bytes, final: bool = False) -> None:
            """Append a fragment, unless it is empty; of a message that is too long, only the beginning is kept.

            Such a message is answered like any other unreadable one: without an answer the car would stand still.
            """
            self.finished, self.length = final, self.length + len(data)
            if self.length > MAX_MESSAGE:  # without: 883 MB more after 2 s of endless_frame
                self.data = [b"".join([*self.data, data])[:UNREADABLE_LENGTH]]
            elif data:  # without: 15 MB more after 2 s of empty_fragments
                self.data.append(data)

    def __init__(self, sock: Any, *args: Any, **options: Any):
        super().__init__(QuickSocket(sock), *args, **options)

    def wait(self) -> str | None:
        """Return the next packet that python-engineio can read, or None at the end of the connection.

        Without: an empty message, or one that does not begin with a digit, ends the session.
        """
        while (message := super().wait()) is not None:
            if isinstance(message, str) and message[:1] in PACKET_TYPES:
                break
        return message

    def _recv_frame(self, message: Any = None) -> Any:
        frame = super()._recv_frame(message)
        if message is None:
            self.arrived = time.perf_counter()
        return frame

    @staticmethod
    def _apply_mask(data: bytes, mask: bytes, length: int | None = None, offset: int = 0) -> bytes:
        """XOR all bytes at once. Without: 3.5 ms more for each telemetry, and 166 ms beside endless_frame."""
        mask = bytes(mask[(offset + i) % 4] for i in range(4)) * (len(data) // 4 + 1)
        both = int.from_bytes(data, "little") ^ int.from_bytes(mask[: len(data)], "little")
        return both.to_bytes(len(data), "little")

    def hang_up(self) -> None:
        """End the connection at once, also for a green thread that waits to read or write."""
        eventlet.greenio.shutdown_safe(self.socket)


class WebSocketWSGI(engineio.async_drivers.eventlet.WebSocketWSGI):
    """Opens a WebSocket, and tells the client's session of it."""

    def _handle_hybi_request(self, environ: WSGIEnvironment) -> WebSocket:
        plain = super()._handle_hybi_request(environ)
        environ["drive.client"].websocket = WebSocket(plain.socket, environ, plain.version, protocol=plain.protocol)
        return environ["drive.client"].websocket

    def _negotiate_permessage_deflate(self, extensions: Any) -> None:
        """Decline compression. Without: JavaScript's clients compress, and a WebSocket made as above refuses them."""
