"""The websocket of the server's end: wsproto's, on a socket of eventlet's, without a way to use much time or memory."""

import socket
import time
from typing import Any

from wsproto.connection import Connection, ConnectionType
from wsproto.events import CloseConnection, Event, Ping, TextMessage

from cloning.server.libraries import eventlet
from cloning.server.telemetry import MAX_MESSAGE
from cloning.wire.protocol import PING_INTERVAL

MAX_FRAGMENTS = 1000  # of a message; the simulator sends 1016 bytes in each
UNREADABLE_LENGTH = 23  # characters that are kept of a longer message: enough to see that it is a telemetry
SLICE = 0.0003  # s that a connection may work before others do
SEND_TIMEOUT = 1.0  # s in which a client must read: before it has to, the system keeps thousands of answers for it
QUICKACK: int | None = getattr(socket, "TCP_QUICKACK", None)  # Linux only


class WebSocket:
    """A client's websocket, when it is open.

    The simulator sends a message in fragments without TCP_NODELAY: each waits for the ACK of the one before, which
    Linux delays by 40 ms unless TCP_QUICKACK is set again after each read.
    """

    def __init__(self, sock: Any):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock, self.protocol = sock, Connection(ConnectionType.SERVER)
        self.events = self.protocol.events()
        self.parts: list[str] = []  # of the message of which not all fragments have arrived
        self.length = 0  # of that message, in characters
        self.arrived = 0.0  # time.perf_counter() when the first fragment of the last message was read
        self.ended = False  # by this end
        self.waited = False  # for the first byte of this message, which was thus not sent before the last answer
        self.since = time.perf_counter()  # when others had their turn

    def receive(self) -> str | None:
        """Return the next text, "" after PING_INTERVAL without a byte, or None at the end of the connection.

        Of a text longer than MAX_MESSAGE it is only the beginning, which is answered like any other unreadable
        telemetry: without an answer the car would stand still.
        """
        self.waited = False
        while True:
            for event in self.events:
                if self.ended:  # without: a new car waits 0.8 s after websocket_pings_read
                    return None
                if time.perf_counter() > self.since + SLICE:
                    # Nobody else works while there is something to read. Without: 468 ms beside websocket_pings_read.
                    eventlet.sleep(0)
                    self.since = time.perf_counter()
                if isinstance(event, TextMessage):
                    self._add(event.data)
                    if event.message_finished:
                        text, self.parts, self.length = "".join(self.parts), [], 0
                        return text
                    if len(self.parts) > MAX_FRAGMENTS:  # else 15 MB more after 2 s of empty_fragments
                        return None
                elif isinstance(event, Ping):
                    self._send(event.response())
                elif isinstance(event, CloseConnection):  # also for what breaks the rules
                    return None
            try:
                data = self._read()
            except TimeoutError:
                return ""
            except OSError:
                return None
            if not data:
                return None
            self.protocol.receive_data(data)
            self.events = self.protocol.events()

    def _add(self, part: str) -> None:
        if not self.parts:
            self.arrived = time.perf_counter()
        self.length += len(part)
        self.parts.append(part)
        if self.length > MAX_MESSAGE:  # without: 883 MB more after 2 s of endless_frame
            self.parts = ["".join(self.parts)[:UNREADABLE_LENGTH]]

    def _read(self) -> bytes:
        try:
            data = self.sock.fd.recv(65536)
        except BlockingIOError:
            self.waited = self.waited or not self.parts
            self.sock.settimeout(PING_INTERVAL)
            data = self.sock.recv(65536)  # waits, while others work
            self.since = time.perf_counter()
        if QUICKACK is not None:
            self.sock.setsockopt(socket.IPPROTO_TCP, QUICKACK, 1)
        return data

    def send(self, text: str) -> None:
        """Send a text; a client that does not read it has its connection closed."""
        self._send(TextMessage(text))

    def _send(self, event: Event) -> None:
        try:
            self.sock.settimeout(SEND_TIMEOUT)
            self.sock.sendall(self.protocol.send(event))
        except OSError:
            self.hang_up()

    def hang_up(self) -> None:
        """End the connection at once, so that `receive` finds the end, whatever has arrived before."""
        self.ended = True
        eventlet.greenio.shutdown_safe(self.sock)
