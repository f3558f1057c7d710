"""The connections of a server: how many there may be, what a request may take, and which sites it may come from."""

import errno
import io
import ipaddress
import signal
import socket
from collections.abc import Callable, Iterable
from typing import Any
from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

from cloning.base.errors import UserError
from cloning.server.libraries import eventlet
from cloning.server.turns import STRANGERS, TURNS

MAX_CONNECTIONS = 192  # at once: macOS lets a process open 256 files
MAX_BODY = 1 << 17  # bytes of a request: over HTTP polling, about 8 telemetries
REQUEST_TIMEOUT = 5.0  # s from one answer to the end of the next request, or from the beginning
WRITE_TIMEOUT = 10.0  # s in which a client must read something of an answer
NO_HANDLES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
BROKEN = (errno.ECONNABORTED, errno.ECONNRESET, errno.EPROTO)  # by the client, before it was accepted


class Listener:
    """A listening socket that survives any number of clients.

    When there are MAX_CONNECTIONS, a new one takes the place of the oldest that has not sent a request.
    """

    def __init__(self, sock: Any):
        self.sock = sock
        self.family, self.getsockname, self.close = sock.family, sock.getsockname, sock.close
        self.idle: dict[Any, None] = {}  # connections without a whole request, the oldest first
        self.busy = 0  # number of the others

    def accept(self) -> tuple[Any, Any]:
        """Return the next connection and the client's address."""
        while True:
            TURNS.take(STRANGERS)
            try:
                client, address = self.sock.accept()
            except OSError as error:
                if error.errno in NO_HANDLES:
                    self._hang_up_oldest()
                    eventlet.sleep(0.05)
                elif error.errno not in BROKEN:
                    raise
                continue
            if len(self.idle) + self.busy < MAX_CONNECTIONS or self._hang_up_oldest():
                self.idle[client] = None
                return client, address
            client.close()

    def _hang_up_oldest(self) -> bool:
        """Hang up on the oldest connection without a request, whose thread then closes it; return whether one is."""
        if not self.idle:
            return False
        oldest = next(iter(self.idle))
        del self.idle[oldest]
        eventlet.greenio.shutdown_safe(oldest)
        return True


class Protocol(eventlet.wsgi.HttpProtocol):
    """eventlet's HTTP, where a request must arrive in time, and takes a turn."""

    is_busy = False

    def handle_one_request(self) -> None:
        """Read a request and answer it."""
        self.deadline = eventlet.Timeout(REQUEST_TIMEOUT)
        try:
            super().handle_one_request()
        except eventlet.Timeout:
            self.close_connection = True
        finally:
            self.deadline.cancel()
            listener = self.server.socket
            if self.is_busy:
                self.is_busy, listener.busy = False, listener.busy - 1
                listener.idle[self.connection] = None

    def parse_request(self) -> bool:
        """Read the headers."""
        TURNS.take(STRANGERS)
        return super().parse_request()

    def get_environ(self) -> WSGIEnvironment:
        """Return the request's WSGI environment, with this object as "drive.protocol"."""
        return {**super().get_environ(), "drive.protocol": self}

    def received(self) -> None:
        """Note that the request is there: the connection is no longer an idle one."""
        self.deadline.cancel()
        listener = self.server.socket
        if self.connection in listener.idle:  # else it was hung up on
            del listener.idle[self.connection]
            self.is_busy, listener.busy = True, listener.busy + 1

    def finish(self) -> None:
        """Close the connection."""
        self.server.socket.idle.pop(self.connection, None)
        try:
            super().finish()
        finally:
            self.rfile.close()  # which keeps the socket open if the client did not read its last answer


def whole_requests(app: WSGIApplication) -> WSGIApplication:
    """Return a WSGI application that gives `app` a request when all of it has been read, unless it is too long."""

    def read(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        protocol, length = environ["drive.protocol"], int(environ.get("CONTENT_LENGTH", 0))
        if "HTTP_TRANSFER_ENCODING" in environ or length > MAX_BODY:
            protocol.close_connection = True  # rather than read the rest
            text = f"A request's body has a Content-Length, of {MAX_BODY} bytes at most."
            return refuse(start_response, "413 Content Too Large", text)
        environ["wsgi.input"] = io.BytesIO(environ["wsgi.input"].read(length))
        protocol.received()
        TURNS.take(STRANGERS)
        return app(environ, start_response)

    return read


def refuse(start_response: StartResponse, status: str, reason: str) -> list[bytes]:
    """Answer a request with an error status and one sentence, and end the connection."""
    start_response(status, [("Content-Type", "text/plain"), ("Connection", "close")])
    return [f"{reason}\n".encode()]


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
        reason = "This server answers programs and its own page, but no page of another site."
        return refuse(start_response, "403 Forbidden", reason)

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


def claim_port(host: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 chooses a free one. Raises UserError, with the remedy, if the port is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return eventlet.listen((host, port), family, reuse_port=False)  # else it would share a taken port
    except OSError as error:
        raise UserError(
            f"can't listen on {host}:{port} ({error.strerror or error}); is another server running? Stop it, or "
            "choose another --port"
        ) from None


def serve_until_stopped(
    listener: socket.socket, app: WSGIApplication, update: Callable[[], None] = lambda: None
) -> None:
    """Serve the application until Ctrl-C or a signal that asks to terminate; update: called ten times a second."""
    stopped: list[int] = []
    for name in ("SIGINT", "SIGTERM", "SIGBREAK"):  # the last one exists on Windows only
        if hasattr(signal, name):
            # The handler only notes the signal: python-engineio would catch an exception raised here.
            signal.signal(getattr(signal, name), lambda number, _: stopped.append(number))
    serving = eventlet.spawn(
        eventlet.wsgi.server,
        Listener(listener),
        whole_requests(refuse_other_sites(app)),
        protocol=Protocol,
        minimum_chunk_size=1,  # so that each event of the page is sent at once
        socket_timeout=WRITE_TIMEOUT,
        log_output=False,
        debug=False,
    )
    while not stopped and not serving.dead:
        eventlet.sleep(0.1)
        update()
    if serving.dead:
        serving.wait()  # raises the exception that ended it
