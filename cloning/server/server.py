"""The server's end of the wire: python-socketio, made to understand the simulator, with bounds for each client."""

import json
import logging
import time
from typing import Any
from urllib.parse import parse_qs
from wsgiref.types import StartResponse, WSGIEnvironment

from cloning.server.connections import has_left, refuse
from cloning.server.libraries import engineio, eventlet, socketio
from cloning.server.telemetry import UNREADABLE
from cloning.server.websocket import WebSocket
from cloning.wire.protocol import PING_INTERVAL, PONG_TIMEOUT

ARRIVAL = 0.002  # s within which a simulator sends the rest of a message, if it is read at once
MAX_CLIENTS = 4  # at once: more could not be answered in time if all of them sent as much as they can
HASTE = 0.1  # s by which the turn of a message comes later if it was sent before the last answer
QUIET = 3.0  # s after which a client that has sent nothing gives its place to a new one, if there is no other
MAX_UNANSWERED = 1000  # texts of a client since it was last sent one; without: 10 s of work when `garbage` has gone
OPENING_INTERVAL = 0.005  # s between two new clients; without: at times 56 ms beside upgrades instead of 16
PACKET_TYPES = ("1", "3", "4", "5")  # of Engine.IO, besides pings, that a client may send
# Events that announce attachments count as unreadable: python-socketio keeps any number, 88 MB in 3 s of `attachments`.
BINARY, UNREADABLE_TEXT = ("45", "46"), '42["telemetry"'
# The packet that opens a session, in which a message can be sent that refuses it.
NO_SESSION = '0{"sid":"none","upgrades":[],"pingInterval":25000,"pingTimeout":60000}'
log = logging.getLogger(__name__)


class Json:
    """The JSON module for python-socketio: an unreadable telemetry still arrives, as UNREADABLE, and is answered."""

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
    """A client's session on its websocket: it may send pings, as in Engine.IO 3, and must read what it is sent."""

    def __init__(self, server: "Engine", sid: str):
        super().__init__(server, sid)
        self.websocket: WebSocket | None = None
        self.is_old = False  # of Engine.IO 3, unlike the simulator
        self.served = time.perf_counter()  # when its last message was handled
        self.waits = False  # for a message to be handled
        self.last_ping = None  # without: threads that would ping; 23 MB more after 20 s of short_sessions
        self.expects_pings = False
        self.unanswered = 0  # texts since it was last sent one

    def handle_get_request(self, environ: WSGIEnvironment, start_response: StartResponse) -> Any:
        """Open the websocket, and serve the client until it ends."""
        environ["drive.client"], self.is_old = self, environ["drive.query"]["EIO"] == ["3"]
        environ.pop("HTTP_SEC_WEBSOCKET_EXTENSIONS", None)  # without: JavaScript's clients compress
        try:
            return eventlet.websocket.WebSocketWSGI(self._serve)(environ, start_response)
        finally:  # without: a handshake that fails takes a place for ever
            self.close(wait=False, abort=True)
            self.server.sockets.pop(self.sid, None)
            self.websocket = None  # without: 40 MB of what was read last beside upgrades, till the collector comes

    def _serve(self, opened: Any) -> None:
        self.websocket = WebSocket(opened.socket)
        for packet in self.poll():
            self.send(packet)
        pinged = time.perf_counter()
        while self.unanswered <= MAX_UNANSWERED and not self.closed and (text := self.websocket.receive()) is not None:
            self.unanswered += 1
            now = time.perf_counter()
            if self.expects_pings and now > pinged + PING_INTERVAL:
                pinged = now
                self.send(engineio.packet.Packet(engineio.packet.PING))
            if text:
                self._handle(text)
                self.served = time.perf_counter()
            elif now > self.served + PING_INTERVAL + PONG_TIMEOUT:
                break

    def _handle(self, text: str) -> None:
        if text[0] == "2":  # a ping
            self.send(engineio.packet.Packet(engineio.packet.PONG))
        elif text[0] in PACKET_TYPES:  # without: a text that begins with no digit ends the session
            self._take_turn()
            self.receive(engineio.packet.Packet(encoded_packet=UNREADABLE_TEXT if text[:2] in BINARY else text))
            self.server.served = time.perf_counter()

    def _take_turn(self) -> None:
        """Wait while another client with an earlier turn has sent a message, or its beginning just now.

        So a car that waits for its answer goes before those that send without waiting. Without: a round trip of 24 ms
        beside three such cars instead of 9, in the median.
        """
        self.waits, seen, others = True, 0.0, self.server.sockets.values()
        while seen < self.server.served or any(each.turn() < self.turn() and each.has_message() for each in others):
            seen = self.server.served  # what arrived before it has yet to be read
            eventlet.sleep(0)
        self.waits = False

    def turn(self) -> float:
        """Return the time of the turn, in s: when it was served last, or HASTE later if it sends without waiting."""
        return self.served + (0.0 if self.websocket and self.websocket.waited else HASTE)

    def hang_up(self) -> None:
        """Give the place back at once, and end the connection."""
        self.server.sockets.pop(self.sid, None)
        if self.websocket:
            self.websocket.hang_up()

    def has_message(self) -> bool:
        """Return whether a message waits to be handled, or its rest will arrive at once."""
        arriving = self.websocket and self.websocket.parts and time.perf_counter() < self.websocket.arrived + ARRIVAL
        return self.waits or bool(arriving)

    def send(self, packet: Any) -> None:
        """Send a packet, as soon as the websocket is open."""
        self.unanswered = 0
        if self.websocket:
            text = packet.encode()
            # Without: JavaScript's clients before 2.2 take what tells the name of a session for an error.
            self.websocket.send("40" if self.is_old and text.startswith("40") else text)
        else:
            self.queue.put(packet)


class Engine(engineio.Server):
    """python-engineio's server for a few clients, which refuses requests that it would fail on."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        engineio.socket.Socket = make_session  # which python-engineio calls for each session of any server
        self.opening = eventlet.semaphore.Semaphore()
        self.served = time.perf_counter()  # when a client had its turn last

    def handle_request(self, environ: WSGIEnvironment, start_response: StartResponse) -> Any:
        """Serve a client until its websocket ends, or tell it why not."""
        query = parse_qs(environ.get("QUERY_STRING", ""))
        if query.get("EIO") not in (["3"], ["4"]):
            return refuse(start_response, "400 Bad Request", "EIO must be 3 or 4, the version of Engine.IO.")
        if (
            query.get("transport") != ["websocket"]
            or environ.get("HTTP_UPGRADE", "").lower() != "websocket"
            or environ.get("HTTP_SEC_WEBSOCKET_VERSION") != "13"
        ):
            reason = "Only the websocket transport is served: connect with transports=['websocket']."
            if query.get("transport") != ["polling"] or query.keys() & {"sid", "j"}:  # j: as a script
                return refuse(start_response, "400 Bad Request", reason)
            # Socket.IO's clients show a message that comes in a session, and not one that comes with an error status.
            is_old = query["EIO"] == ["3"]
            refusal = "44" + json.dumps(reason if is_old else {"message": reason})
            both = (NO_SESSION, refusal)
            body = "".join(f"{len(each)}:{each}" for each in both) if is_old else "\x1e".join(both)
            return refuse(start_response, "200 OK", reason, body)
        with self.opening:
            if has_left(environ):  # without: those that connect and leave at once take all places for a second
                start_response("400 Bad Request", [])
                return []
            eventlet.sleep(OPENING_INTERVAL)
        if not self._make_room():
            return refuse(start_response, "503 Service Unavailable", f"{MAX_CLIENTS} clients are connected already.")
        environ["drive.query"] = query
        environ["QUERY_STRING"] = "EIO=4&transport=websocket"  # without: clients of Engine.IO 3 are refused
        return super().handle_request(environ, start_response)

    def _make_room(self) -> bool:
        """Return whether there is room for another client; end the quietest one's session for that.

        Without: four connections that say nothing keep every car out for 85 s.
        """
        if len(self.sockets) < MAX_CLIENTS:
            return True
        quietest = min(self.sockets.values(), key=lambda client: client.served)
        if time.perf_counter() < quietest.served + QUIET:
            return False
        quietest.hang_up()
        return True


def make_session(server: engineio.Server, sid: str, usual: type = engineio.socket.Socket) -> Any:
    """Return a new session of a server: a Client of an Engine, the usual one of any other in this process."""
    return (Client if isinstance(server, Engine) else usual)(server, sid)


class Server(socketio.Server):
    """python-socketio's server with the settings and overrides that the simulator needs."""

    def __init__(self) -> None:
        super().__init__(
            async_mode="eventlet",
            async_handlers=False,
            transports=["websocket"],
            json=Json,
            logger=log,
            engineio_logger=log,
            ping_timeout=PONG_TIMEOUT,
            ping_interval=PING_INTERVAL,
            monitor_clients=False,
            cors_allowed_origins=[],
        )

    def arrived(self, sid: str) -> float:
        """Return the time.perf_counter() at which the first fragment of a client's last message was read."""
        return self.get_environ(sid)["drive.client"].websocket.arrived

    def _engineio_server_class(self) -> type[Engine]:
        return Engine

    def _handle_eio_connect(self, eio_sid: str, environ: WSGIEnvironment) -> None:
        """Connect a new client at once, as the simulator expects: it never asks for it."""
        super()._handle_eio_connect(eio_sid, environ)
        # Python's clients, which send a time, are connected before they are greeted: their handlers can't answer else.
        self.always_connect = "t" in environ["drive.query"]
        super()._handle_connect(eio_sid, "/", None)

    def _handle_connect(self, eio_sid: str, namespace: str | None, data: Any) -> None:
        """Connect a client that asks for it: one of Engine.IO 4, which is connected already, and expects pings.

        Without: JavaScript's clients 3 and 4 and Python's 5 fail to connect.
        """
        self.eio.sockets[eio_sid].expects_pings = True
        if not self.manager.sid_from_eio_sid(eio_sid, namespace or "/"):
            super()._handle_connect(eio_sid, namespace, data)
