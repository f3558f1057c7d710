"""The server's end of the wire: python-socketio with a faster websocket, closed to pages of other sites."""

import ipaddress
import json
import re
import socket
import time
import warnings
from collections.abc import Iterable
from typing import Any
from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

from cloning.wire.protocol import PING_INTERVAL, PONG_TIMEOUT
from cloning.wire.versions import check_versions

check_versions()  # before the imports below, which fail with some versions

with warnings.catch_warnings():
    # eventlet advises against using it in new projects, but no server has been used longer with this simulator.
    warnings.simplefilter("ignore")
    import eventlet
    import eventlet.websocket
    import eventlet.wsgi
    import socketio
    from engineio.async_drivers import eventlet as async_driver

MAX_MESSAGE = 1 << 20  # bytes; a telemetry message has about 16,000
# First characters of a message: Engine.IO's packet types.
PACKET_TYPES: dict[type, str | bytes] = {str: "0123456", bytes: b"\0\1\2\3\4\5\6"}
# The beginnings of Socket.IO's packets: an event, an event with attachments, any other.
SOCKET_IO_PACKET = re.compile(r'2\d{0,9}\["|5[1-9]-\d{0,9}\["|[0134].{0,200}$')
UNREADABLE = object()  # what a handler is given for a telemetry that is too long or not JSON
QUICKACK: int | None = getattr(socket, "TCP_QUICKACK", None)  # Linux only


class QuickSocket:
    """A socket for a websocket that reads much at a time and acknowledges it at once.

    The simulator sends a message in fragments without TCP_NODELAY: each waits for the ACK of the one before, which
    Linux delays by 40 ms unless TCP_QUICKACK is set again after each read.
    """

    def __init__(self, sock: socket.socket):
        """Wrap a connected socket."""
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock, self.buffer, self.at = sock, b"", 0
        self.sendall, self.settimeout = sock.sendall, sock.settimeout
        self.shutdown, self.close = sock.shutdown, sock.close

    def recv(self, size: int) -> bytes:
        """Return up to `size` bytes; none at the end of the connection."""
        if self.at == len(self.buffer):
            self.buffer, self.at = self.sock.recv(65536), 0
            if QUICKACK is not None:
                self.sock.setsockopt(socket.IPPROTO_TCP, QUICKACK, 1)
        start, self.at = self.at, min(self.at + size, len(self.buffer))
        return self.buffer[start : self.at]


class WebSocket(eventlet.websocket.RFC6455WebSocket):
    """eventlet's websocket with faster unmasking, and a limit on whole messages rather than on fragments."""

    arrived = 0.0  # time.perf_counter() when the first fragment of the last message was read

    class Message(eventlet.websocket.RFC6455WebSocket.Message):
        """A message of which not all fragments have arrived."""

        length = 0

        def push(self, data: bytes, final: bool = False) -> None:
            """Append a fragment, unless the message is then too long.

            Such a message is answered like any other unreadable one: without an answer the car would stand still.
            """
            self.finished = final
            self.length += len(data)
            if self.length <= MAX_MESSAGE:
                self.data.append(data)

    def __init__(self, sock: socket.socket, *args: Any, **kwargs: Any):
        """Take over a socket after the handshake."""
        super().__init__(QuickSocket(sock), *args, **kwargs)
        self.max_frame_length = float("inf")  # Message limits the length

    def wait(self) -> str | bytes | None:
        """Return the next message that python-engineio understands; None at the end of the connection."""
        while True:
            # Let the last answer be sent and other clients be served, even if more messages are buffered here.
            eventlet.sleep(0)
            message = super().wait()
            # python-engineio fails on some messages of other types.
            if message is None or message[:1] in PACKET_TYPES[type(message)]:
                return message

    def _recv_frame(self, message: Any = None) -> Any:
        frame = super()._recv_frame(message)
        if message is None:
            self.arrived = time.perf_counter()
        return frame

    @staticmethod
    def _apply_mask(data: bytes, mask: bytes, length: int | None = None, offset: int = 0) -> bytes:
        """XOR all bytes at once: eventlet's loop over them takes 3.5 ms a telemetry message."""
        mask = bytes(mask[(offset + i) % 4] for i in range(4)) * (len(data) // 4 + 1)
        both = int.from_bytes(data, "little") ^ int.from_bytes(mask[: len(data)], "little")
        return both.to_bytes(len(data), "little")


class WebSocketWSGI(async_driver.WebSocketWSGI):
    """Opens a WebSocket and leaves it in the request's environment, as "drive.websocket"."""

    def _handle_hybi_request(self, environ: WSGIEnvironment) -> WebSocket:
        plain = super()._handle_hybi_request(environ)
        environ["drive.websocket"] = WebSocket(plain.socket, environ, plain.version, protocol=plain.protocol)
        return environ["drive.websocket"]

    def _negotiate_permessage_deflate(self, extensions: Any) -> None:
        """Decline compression: it would cost time, and a small message could unpack to a huge one."""


class Json:
    """The JSON module for python-socketio: an unreadable telemetry still arrives, as UNREADABLE."""

    dumps = staticmethod(json.dumps)

    @staticmethod
    def loads(text: str) -> Any:
        """Decode JSON. Raises ValueError if it is unreadable and not a telemetry."""
        try:
            return json.loads(text)
        except (ValueError, RecursionError) as error:
            if text.startswith('["telemetry"'):
                return ["telemetry", UNREADABLE]
            raise ValueError(f"not JSON: {type(error).__name__}") from None


class Server(socketio.Server):
    """python-socketio's server with the settings and filters that the simulator needs."""

    def __init__(self, **options: Any):
        """options: further options of socketio.Server."""
        async_driver._async["websocket"] = WebSocketWSGI
        super().__init__(
            async_mode="eventlet",
            async_handlers=False,
            json=Json,
            max_http_buffer_size=MAX_MESSAGE,
            # The second interval is how much later than due a ping may come: a suspended laptop stays connected.
            ping_timeout=PONG_TIMEOUT,
            ping_interval=(PING_INTERVAL, 60),
            cookie=None,
            cors_allowed_origins=[],
            **options,
        )

    def _handle_eio_message(self, sid: str, data: str | bytes) -> None:
        # Drop other text: python-socketio takes quadratic time to read the digits of a long header.
        if isinstance(data, bytes) or (isinstance(data, str) and SOCKET_IO_PACKET.match(data)):
            super()._handle_eio_message(sid, data)


def refuse_other_sites(app: WSGIApplication) -> WSGIApplication:
    """Return a WSGI application that serves `app` to programs and to its own page, but to no page of another site.

    A browser names another site's page in Origin (websocket, fetch) or Sec-Fetch-Site (image, script); if that page's
    host name resolves to this machine (DNS rebinding), in Host.
    """

    def guard(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        host, origin = environ.get("HTTP_HOST", ""), environ.get("HTTP_ORIGIN")
        site = environ.get("HTTP_SEC_FETCH_SITE", "none")
        if (
            _is_address(host)
            and origin in (None, f"http://{host}")
            and (site in ("none", "same-origin") or environ["PATH_INFO"] == "/")
        ):
            return app(environ, start_response)
        start_response("403 Forbidden", [("Content-Type", "text/plain"), ("Connection", "close")])
        return [b"This server answers programs and its own page, but no page of another site.\n"]

    return guard


def _is_address(host: str) -> bool:
    """Return whether a Host header names an IP address, localhost, or nothing."""
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    if name in ("localhost", ""):
        return True
    try:
        return bool(ipaddress.ip_address(name.strip("[]")))
    except ValueError:
        return False


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 chooses a free one. Raises OSError if the port is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return eventlet.listen((host, port), family, reuse_port=False)  # eventlet's default would share a taken port


def serve(listener: socket.socket, app: WSGIApplication) -> None:
    """Serve the application until this green thread is killed."""
    eventlet.wsgi.server(listener, app, log_output=False, debug=False)
