"""The connections of a server: how many there may be, what a request may take, and which sites it may come from.

Here, in server.py and in websocket.py a comment says what is worse without an override of what libraries do, as the
attacks of tools/attacks.py show; a time is that of the server's processor in a car's round trip, of which 99 of 100 are
shorter: 4.9 ms alone.
"""

import errno
import io
import ipaddress
import logging
import signal
import socket
from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import urlsplit
from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

from cloning.base.errors import UserError
from cloning.server.libraries import eventlet

MAX_CONNECTIONS = 192  # at once: macOS lets a process open 256 files
MAX_BODY = 1 << 17  # bytes of a request
TIMEOUT = 10.0  # s in which a client must send something of a request, or read something of an answer
# Errors of accept that pass: no more file handles (without: 128 of them and 200 connections end the server), or the
# client has broken the connection already.
PASSING = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM, errno.ECONNABORTED, errno.ECONNRESET, errno.EPROTO)
log = logging.getLogger(__name__)


class Listener:
    """A listening socket that survives any number of clients.

    When there are MAX_CONNECTIONS, a new one takes the place of the oldest that has not sent a request.
    """

    def __init__(self, sock: Any, pool: Any):
        """pool: an eventlet.GreenPool, in which each connection has a thread."""
        self.sock, self.pool = sock, pool
        self.family, self.getsockname, self.close = sock.family, sock.getsockname, sock.close
        self.idle: dict[Any, None] = {}  # connections without a whole request, the oldest first

    def accept(self) -> tuple[Any, Any]:
        """Return the next connection and the client's address."""
        while True:
            eventlet.sleep(0)  # without, a car's answer takes 7.2 ms instead of 4.7 beside three processes that connect
            try:
                client, address = self.sock.accept()
            except OSError as error:
                if error.errno not in PASSING:
                    raise
                self._hang_up_oldest()
                eventlet.sleep(0.05)
                continue
            if self.pool.running() < MAX_CONNECTIONS or self._hang_up_oldest():
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
    """eventlet's HTTP, where requests take turns."""

    one_at_a_time = eventlet.semaphore.Semaphore()

    # Without: http.server prints two lines with what the client sent, for each of any number of requests.
    def log_message(self, *_: Any) -> None:
        """Log that a request is no HTTP, without what the client sent."""
        log.warning("a request can't be read")

    # Without: 17 ms beside page_requests instead of 11, and 15 beside long_headers instead of 8.
    def parse_request(self) -> bool:
        """Read the headers, when the connections with clients had their turn, and no other request has this one.

        eventlet goes round all connections that have something to do: beside a hundred busy ones, a car would wait for
        each of them, several times for each telemetry.
        """
        with self.one_at_a_time:
            eventlet.sleep(0)
        return super().parse_request()

    def finish(self) -> None:
        """Close the connection."""
        self.server.socket.idle.pop(self.connection, None)
        try:
            super().finish()
        finally:
            self.rfile.close()  # without: 50 sockets stay open after pages


def whole_requests(app: WSGIApplication, listener: Listener, most: int = MAX_BODY) -> WSGIApplication:
    """Return a WSGI application that gives `app` a request when all of it has been read; most: bytes of its body."""

    def read(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        length = int(environ.get("CONTENT_LENGTH", 0))
        if "HTTP_TRANSFER_ENCODING" in environ or length > most:
            text = f"A request's body has a Content-Length, of {most} bytes at most."
            return refuse(start_response, "413 Content Too Large", text)
        # Without: 192 connections that send slow bodies keep every new car out.
        environ["wsgi.input"] = io.BytesIO(environ["wsgi.input"].read(length))
        listener.idle.pop(environ["eventlet.input"].get_socket(), None)
        return app(environ, start_response)

    return read


def refuse(start_response: StartResponse, status: str, reason: str, body: str = "") -> list[bytes]:
    """Answer a request with a status and one sentence, or a body that has it, and log it.

    That the connection ends keeps an unread rest of the request from being taken for the next one.
    """
    log.warning(f"a request is refused: {reason}")
    start_response(status, [("Content-Type", "text/plain"), ("Connection", "close")])
    return [(body or f"{reason}\n").encode()]


def has_left(environ: WSGIEnvironment) -> bool:
    """Return whether the client of a request that has been read has closed its connection."""
    try:
        return not environ["eventlet.input"].get_socket().fd.recv(1, socket.MSG_PEEK)
    except BlockingIOError:  # it waits for the answer
        return False
    except OSError:
        return True


def refuse_other_sites(app: WSGIApplication) -> WSGIApplication:
    """Return a WSGI application that serves `app` to programs and to its own page, but to no page of another site.

    A browser names another site's page in Origin (each websocket, fetch) or Sec-Fetch-Site (image, script); if that
    page's host name resolves to this machine (DNS rebinding), in Host. So a websocket without Origin is a program's.
    """

    def guard(environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        host, origin = environ.get("HTTP_HOST", ""), environ.get("HTTP_ORIGIN")
        site = environ.get("HTTP_SEC_FETCH_SITE", "none")
        is_program = origin is None and environ.get("HTTP_UPGRADE", "").lower() == "websocket"
        if not (is_program or _is_address(host)):
            reason = "A browser must use this server's IP address, since any site can give it a name."
        elif origin not in (None, f"http://{host}") or (
            site not in ("none", "same-origin") and environ["PATH_INFO"] != "/"
        ):
            reason = "This server answers programs and its own page, but no page of another site."
        else:
            return app(environ, start_response)
        return refuse(start_response, "403 Forbidden", reason)

    return guard


def _is_address(host: str) -> bool:
    """Return whether a Host header names an IP address of a machine, localhost, or nothing."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name in ("localhost", "") or not ipaddress.ip_address(name).is_unspecified
    except ValueError:
        return False


def claim_port(host: str, port: int, where_taken: str = "choose another --port") -> socket.socket:
    """Return a listening socket; port 0 chooses a free one. Raises UserError, with the remedy.

    where_taken: the remedy for a port that another server has, besides to stop that.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return eventlet.listen((host, port), family, reuse_port=False)  # else it would share a taken port
    except OSError as error:
        remedies = {
            errno.EADDRINUSE: f"stop the other server that uses it, or {where_taken}",
            errno.EACCES: "choose another --port",
        }
        remedy = remedies.get(error.errno or 0, "--host must be an address of this machine, such as 127.0.0.1")
        raise UserError(f"can't listen on {host}:{port} ({error.strerror or error}): {remedy}") from None


def noted_signals() -> list[int]:
    """Return a list to which Ctrl-C and the signals that ask to terminate are added from now on, but for ignored ones.

    python-engineio would catch an exception raised in their handler. `nohup` ignores SIGHUP.
    """
    noted: list[int] = []
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):  # the third is missing on Windows, the last elsewhere
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda received, _: noted.append(received))
    return noted


def serve(
    listener: socket.socket,
    app: WSGIApplication,
    stopped: list[int],
    *updates: Callable[[], None],
    most: int = MAX_BODY,
) -> None:
    """Serve the application until `stopped` has a signal; updates: called ten times a second; most: bytes of a body."""
    pool = eventlet.GreenPool(MAX_CONNECTIONS + 1)  # one more, which takes the place of one that has been hung up
    patient = Listener(listener, pool)
    serving = eventlet.spawn(
        eventlet.wsgi.server,
        patient,
        whole_requests(refuse_other_sites(app), patient, most),
        protocol=Protocol,
        custom_pool=pool,
        keepalive=False,  # so that an answered connection is not kept from others
        minimum_chunk_size=1,  # so that each event of the page is sent at once
        socket_timeout=TIMEOUT,
        log_output=False,
        debug=False,
    )
    while not stopped and not serving.dead:
        eventlet.sleep(0.1)
        for update in updates:
            update()
    if serving.dead:
        serving.wait()  # raises the exception that ended it
