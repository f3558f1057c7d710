"""The server's end of the wire: python-socketio with bounds for each client."""

import json
import logging
import time
from typing import Any
from urllib.parse import parse_qs
from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

from cloning.server.connections import refuse
from cloning.server.libraries import engineio, socketio
from cloning.server.telemetry import MAX_MESSAGE, UNREADABLE
from cloning.server.turns import TURNS, Account
from cloning.server.websocket import SOCKET_IO_PACKET, WebSocket, WebSocketWSGI
from cloning.wire.protocol import PING_INTERVAL, PONG_TIMEOUT

MAX_CLIENTS = 4  # at once: more could not be answered in time if all of them sent as much as they can
QUIET = 3.0  # s after which a client that has sent nothing gives its place to a new one, if there is no other
MAX_UNREAD = 64  # packets that wait for a client; the simulator has 3 telemetries in flight
log = logging.getLogger(__name__)


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


class Client(engineio.socket.Socket):
    """A client's session, which ends when the client does not read what it is sent, or sends nothing for too long."""

    def __init__(self, server: "Engine", sid: str):
        super().__init__(server, sid)
        self.account, self.polled = Account(), False
        self.websocket: WebSocket | None = None
        server.clients.add(self)

    def receive(self, packet: Any) -> None:
        """Handle a packet; whatever it is, the client is alive."""
        if self.closed:
            raise engineio.exceptions.SocketIsClosedError
        self.last_ping = time.time()
        if not self.upgraded:  # the websocket has taken a turn for its packet
            TURNS.take(self.account)
        if packet.packet_type == engineio.packet.PING and packet.data != "probe":
            packet.data = None  # else the pong would be as long as the ping
        super().receive(packet)

    def send(self, packet: Any) -> None:
        """Send a packet, unless too many of them wait already: then end the session."""
        if self.queue.qsize() < MAX_UNREAD:
            super().send(packet)
        else:
            self.hang_up()

    def poll(self) -> list[Any]:
        """Return the packets to send, at least one; none when the session has ended."""
        while True:
            try:
                return super().poll()
            except engineio.exceptions.QueueEmpty:  # for a minute
                if not self.upgraded:
                    raise

    def close(self, wait: bool = True, abort: bool = False) -> None:
        """End the session, and forget it; never wait until the client has read everything."""
        super().close(wait=False, abort=abort)
        self.server.sockets.pop(self.sid, None)
        if not self.websocket:  # else it counts as a client until its connection ends
            self.server.clients.discard(self)

    def hang_up(self) -> None:
        """End the session and its connection at once."""
        self.close(abort=True)
        if self.websocket:
            self.websocket.hang_up()

    def handle_get_request(self, environ: WSGIEnvironment, start_response: StartResponse) -> Any:
        """Answer a GET: open a websocket, or wait for packets; only one may do so at a time."""
        if "HTTP_UPGRADE" in environ:
            return super().handle_get_request(environ, start_response)
        if self.polled:
            raise engineio.exceptions.EngineIOError("two requests poll at once")
        self.polled = True
        try:
            return super().handle_get_request(environ, start_response)
        finally:
            self.polled = False

    def handle_post_request(self, environ: WSGIEnvironment) -> None:
        """Handle the packets of a POST."""
        body = environ["wsgi.input"].getvalue()
        if not _is_payload(body):
            raise engineio.exceptions.EngineIOError("not a payload")
        super().handle_post_request(environ)

    def _websocket_handler(self, ws: WebSocket) -> Any:
        if self.websocket or self.closed:
            return []
        self.websocket = ws
        try:
            return super()._websocket_handler(ws)
        finally:
            self.websocket = None
            if self.closed:
                self.server.clients.discard(self)


def _is_payload(body: bytes) -> bool:
    """Return whether a POST's body has the lengths of its packets where python-engineio looks for them.

    It takes quadratic time to read a long number in the binary format, and to take apart a long form.
    """
    if body[:1].isdigit():
        return True
    at = 0
    while at < len(body):
        digits = body[at + 1 : at + 9].partition(b"\xff")
        if body[at] > 1 or not digits[1]:
            return False
        at += 2 + len(digits[0])
        length = 0
        for digit in digits[0]:
            length = 10 * length + digit
        at += length
    return True


def _opens_websocket(environ: WSGIEnvironment) -> bool:
    """Return whether a request with the header Upgrade has all that python-engineio and eventlet look for.

    With a part of it, they would take it for a poll, or fail on it.
    """
    options = [option.strip() for option in environ.get("HTTP_CONNECTION", "").lower().split(",")]
    return (
        environ["HTTP_UPGRADE"].lower() == "websocket"
        and "upgrade" in options
        and environ.get("HTTP_SEC_WEBSOCKET_VERSION") == "13"
        and "HTTP_SEC_WEBSOCKET_KEY" in environ
    )


class Engine(engineio.Server):
    """python-engineio's server for a few clients, which refuses requests that it would fail on."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self._async: dict[str, Any] = {**engineio.async_drivers.eventlet._async, "websocket": WebSocketWSGI}
        engineio.socket.Socket = Client  # of which python-engineio makes one for each session
        # Those with a session or a websocket. python-engineio's own table forgets a session that has ended, but the
        # websocket of such a session may still be open, and take time.
        self.clients: set[Client] = set()

    def handle_request(self, environ: WSGIEnvironment, start_response: StartResponse) -> Any:
        """Answer a request."""
        query = parse_qs(environ.get("QUERY_STRING", ""))
        upgrade = "HTTP_UPGRADE" in environ
        if query.get("EIO") not in (["3"], ["4"]):
            reason = "EIO must be 3 or 4, the version of Engine.IO."
        elif query.get("transport") != ["websocket" if upgrade else "polling"]:
            reason = "transport must be websocket, with the header Upgrade: websocket, or polling, without it."
        elif upgrade and not _opens_websocket(environ):
            reason = (
                "A websocket needs the headers Upgrade: websocket, Connection: Upgrade, Sec-WebSocket-Version: 13 "
                "and Sec-WebSocket-Key."
            )
        elif "j" in query:
            reason = "JSONP is not supported."
        elif environ["REQUEST_METHOD"] == "GET" and "sid" not in query and not self._make_room():
            reason = f"{MAX_CLIENTS} clients are connected already."
            log.warning(f"a further client is refused: {reason}")
            return refuse(start_response, "503 Service Unavailable", reason)
        else:
            return super().handle_request(environ, start_response)
        return refuse(start_response, "400 Bad Request", reason)

    def _make_room(self) -> bool:
        """Return whether there is room for another client; end the quietest one's session for that."""
        if len(self.clients) < MAX_CLIENTS:
            return True
        quietest = min(self.clients, key=lambda client: client.last_ping)
        if time.time() < quietest.last_ping + QUIET:
            return False
        quietest.hang_up()
        return True


class Server(socketio.Server):
    """python-socketio's server with the settings and filters that the simulator needs."""

    def __init__(self) -> None:
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
        )

    def application(self, page: WSGIApplication) -> WSGIApplication:
        """Return the application that answers simulators itself, and all else with `page`."""
        return socketio.WSGIApp(self, page)

    def _engineio_server_class(self) -> type[Engine]:
        return Engine

    def _handle_eio_message(self, sid: str, data: str | bytes) -> None:
        """Handle a Socket.IO packet, if it is one that the simulator may send.

        python-socketio takes quadratic time to read the digits of a long header, keeps every namespace that a client
        names, and waits for the attachments that are announced: these are not, and the event is unreadable.
        """
        if isinstance(data, str) and SOCKET_IO_PACKET.match(data):
            super()._handle_eio_message(sid, data if data[0] != "5" else f"2{data[data.index('[') :]}!")
