"""The server's end of the simulator's wire: a websocket fast enough to drive with and closed to other sites."""

import ipaddress
import json
import re
import socket
import time
import warnings
from collections.abc import Iterable
from typing import Any
from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

from cloning.wire.versions import check_versions

check_versions()  # before the imports, which fail with some versions

with warnings.catch_warnings():
    # eventlet advises against its use in new projects; of all servers it has the longest record with this simulator.
    warnings.simplefilter("ignore")
    import eventlet
    import eventlet.websocket
    import eventlet.wsgi
    import socketio
    from engineio.async_drivers import eventlet as driver

MAX_MESSAGE = 1 << 20  # bytes; a telemetry message has about 16,000
# First characters of a message: Engine.IO's packet types.
PACKET_TYPES: dict[type, str | bytes] = {str: "0123456", bytes: b"\0\1\2\3\4\5\6"}
MESSAGE = re.compile(r'2\d{0,9}\["|5[1-9]-\d{0,9}\["|[0134].{0,200}$')  # Socket.IO: event, with attachments, the rest
UNREADABLE = object()  # a handler gets this instead of a telemetry that is not JSON or too long
QUICKACK: int | None = getattr(socket, "TCP_QUICKACK", None)  # Linux only, which delays ACKs while the simulator waits


class QuickSocket:
    """What a websocket reads from: large reads, each acknowledged at once.

    The simulator sends a message as fragments of 1016 bytes without TCP_NODELAY: its next fragment waits for the
    ACK of the last one, which Linux delays by 40 ms unless TCP_QUICKACK is set again after each read.
    """

    def __init__(self, sock: socket.socket):
        """Wrap a connected socket."""
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock, self.buffer, self.at = sock, b"", 0
        self.sendall, self.settimeout = sock.sendall, sock.settimeout
        self.shutdown, self.close = sock.shutdown, sock.close

    def recv(self, size: int) -> bytes:
        """Up to `size` bytes; none at the connection's end."""
        if self.at == len(self.buffer):
            self.buffer, self.at = self.sock.recv(65536), 0
            if QUICKACK is not None:
                self.sock.setsockopt(socket.IPPROTO_TCP, QUICKACK, 1)
        start, self.at = self.at, min(self.at + size, len(self.buffer))
        return self.buffer[start : self.at]


class WebSocket(eventlet.websocket.RFC6455WebSocket):
    """eventlet's websocket with a fast mask, and a limit on whole messages rather than on fragments."""

    arrived = 0.0  # time.perf_counter() when the first fragment of the last message was read

    class Message(eventlet.websocket.RFC6455WebSocket.Message):
        """A message under assembly."""

        length = 0

        def push(self, data: bytes, final: bool = False) -> None:
            """Keep what fits. The cut message is answered like any other unreadable one, so that no token is lost."""
            self.finished = final
            self.length += len(data)
            if self.length <= MAX_MESSAGE:
                self.data.append(data)

    def __init__(self, sock: socket.socket, *args: Any, **kwargs: Any):
        """Take over a socket after the handshake."""
        super().__init__(QuickSocket(sock), *args, **kwargs)
        self.max_frame_length = float("inf")  # Message limits the length

    def wait(self) -> str | bytes | None:
        """The next message that python-engineio understands; None at the end."""
        while True:
            # Let the last answer leave and other clients have their turn, although more may be buffered here.
            eventlet.sleep(0)
            message = super().wait()
            # python-engineio breaks on some messages of other types.
            if message is None or message[:1] in PACKET_TYPES[type(message)]:
                return message

    def _recv_frame(self, message: Any = None) -> Any:
        frame = super()._recv_frame(message)
        if message is None:
            self.arrived = time.perf_counter()
        return frame

    @staticmethod
    def _apply_mask(data: bytes, mask: bytes, length: int | None = None, offset: int = 0) -> bytes:
        """XOR in one go where eventlet loops over the bytes in Python (3.5 ms a telemetry message)."""
        mask = bytes(mask[(offset + i) % 4] for i in range(4)) * (len(data) // 4 + 1)
        both = int.from_bytes(data, "little") ^ int.from_bytes(mask[: len(data)], "little")
        return both.to_bytes(len(data), "little")


class WebSocketWSGI(driver.WebSocketWSGI):
    """Opens a WebSocket and leaves it in the request's environment, as "drive.websocket"."""

    def _handle_hybi_request(self, environ: WSGIEnvironment) -> WebSocket:
        plain = super()._handle_hybi_request(environ)
        environ["drive.websocket"] = WebSocket(plain.socket, environ, plain.version, protocol=plain.protocol)
        return environ["drive.websocket"]

    def _negotiate_permessage_deflate(self, extensions: Any) -> None:
        """Decline: it would cost time on loopback, and allow small messages that unpack to huge ones."""


class Json:
    """The `json` of python-socketio: an unreadable telemetry still arrives, as UNREADABLE."""

    dumps = staticmethod(json.dumps)

    @staticmethod
    def loads(text: str) -> Any:
        """Decode JSON. Raises ValueError for anything unreadable that is not a telemetry."""
        try:
            return json.loads(text)
        except (ValueError, RecursionError) as error:
            if text.startswith('["telemetry"'):
                return ["telemetry", UNREADABLE]
            raise ValueError(f"not JSON: {type(error).__name__}") from None


class Server(socketio.Server):
    """python-socketio's server with what the simulator needs."""

    def __init__(self, **options: Any):
        """options: further ones of socketio.Server."""
        driver._async["websocket"] = WebSocketWSGI
        super().__init__(
            async_mode="eventlet",
            async_handlers=False,
            json=Json,
            max_http_buffer_size=MAX_MESSAGE,
            # The simulator pings every 25 s; waiting a minute longer survives a suspended laptop.
            ping_timeout=60,
            ping_interval=(25, 60),
            cookie=None,
            cors_allowed_origins=[],
            **options,
        )

    def _handle_eio_message(self, sid: str, data: str | bytes) -> None:
        # Drop everything else here: python-socketio takes quadratic time over the digits of a long header.
        if isinstance(data, bytes) or (isinstance(data, str) and MESSAGE.match(data)):
            super()._handle_eio_message(sid, data)


def refuse_other_sites(app: WSGIApplication) -> WSGIApplication:
    """A WSGI application that serves `app` to this machine's programs and to its own page, to no other page.

    A page of another origin names itself in Origin (websocket, fetch) or in Sec-Fetch-Site (image, script); a page
    whose own host name resolves to this machine (DNS rebinding) names that host in Host.
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
        return [b"This server drives for programs on its own machine and for its own page.\n"]

    return guard


def _is_address(host: str) -> bool:
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    if name in ("localhost", ""):
        return True
    try:
        return bool(ipaddress.ip_address(name.strip("[]")))
    except ValueError:
        return False


def listen(host: str, port: int) -> socket.socket:
    """A listening socket. Raises OSError if the port is taken (eventlet would share it by SO_REUSEPORT)."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return eventlet.listen((host, port), family, reuse_port=False)


def serve(listener: socket.socket, app: WSGIApplication) -> None:
    """Serve the application until this green thread is killed."""
    eventlet.wsgi.server(listener, app, log_output=False, debug=False)
