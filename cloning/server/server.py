"""The server's end of the wire: python-socketio, made to understand the simulator, with bounds for each client."""

import json
import logging
import time
from typing import Any
from urllib.parse import parse_qs
from wsgiref.types import StartResponse, WSGIEnvironment

from cloning.server.connections import refuse
from cloning.server.libraries import engineio, eventlet, socketio
from cloning.server.telemetry import UNREADABLE
from cloning.server.websocket import WebSocket, WebSocketWSGI
from cloning.wire.protocol import PING_INTERVAL, PONG_TIMEOUT

MAX_CLIENTS = 4  # at once: more could not be answered in time if all of them sent as much as they can
QUIET = 3.0  # s after which a client that has sent nothing gives its place to a new one, if there is no other
OPENING_INTERVAL = 0.005  # s between two new clients; without: 23 ms beside reconnections
MAX_UNREAD = 64  # packets that wait for a client; the simulator has 3 telemetries in flight
# The packets that open a session and refuse its connection to Socket.IO, but for the message.
NO_SESSION = '0{"sid":"none","upgrades":[],"pingInterval":25000,"pingTimeout":60000}\x1e44'
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


class Packet(socketio.packet.Packet):
    """A packet without attachments, of which python-socketio keeps any number: 88 MB after 3 s of `attachments`."""

    def decode(self, encoded_packet: str) -> int:
        """Read a packet; an event that announces attachments is an unreadable telemetry."""
        if encoded_packet[:1] in ("5", "6"):
            encoded_packet = '2["telemetry"'
        return super().decode(encoded_packet)


class Client(engineio.socket.Socket):
    """A client's session: it may send pings, as in Engine.IO 3, and must read what it is sent."""

    def __init__(self, server: "Engine", sid: str):
        super().__init__(server, sid)
        self.websocket: WebSocket | None = None
        self.heard = time.monotonic()  # when it last sent something
        self.last_ping = None  # so that python-engineio neither pings nor takes a changed clock for silence
        self.expects_pings = False

    def receive(self, packet: Any) -> None:
        """Handle a packet."""
        self.heard = time.monotonic()
        if packet.packet_type == engineio.packet.PING:
            self.send(engineio.packet.Packet(engineio.packet.PONG))
        else:
            super().receive(packet)

    def send(self, packet: Any) -> None:
        """Send a packet, unless too many of them wait already: then end the session."""
        if self.queue.qsize() < MAX_UNREAD:  # without: a client that reads nothing keeps its place, and the queue grows
            super().send(packet)
        else:
            self.hang_up()

    def hang_up(self) -> None:
        """End the session and its connection at once."""
        self.close(wait=False, abort=True)
        if self.websocket:  # without: the client keeps its place while an answer waits for it
            self.websocket.hang_up()


class Engine(engineio.Server):
    """python-engineio's server for a few clients, which refuses requests that it would fail on."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self._async: dict[str, Any] = {**engineio.async_drivers.eventlet._async, "websocket": WebSocketWSGI}
        engineio.socket.Socket = Client  # of which python-engineio makes one for each session
        self.clients: set[Client] = set()
        self.opening = eventlet.semaphore.Semaphore()

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
            is_first_poll = query.get("transport") == ["polling"] and "sid" not in query and query["EIO"] == ["4"]
            if not is_first_poll:
                return refuse(start_response, "400 Bad Request", reason)
            # Socket.IO's clients show a message that comes in a session, and not one that comes with an error status.
            return refuse(start_response, "200 OK", reason, NO_SESSION + json.dumps({"message": reason}))
        with self.opening:
            eventlet.sleep(OPENING_INTERVAL)
        if not self._make_room():
            return refuse(start_response, "503 Service Unavailable", f"{MAX_CLIENTS} clients are connected already.")
        environ["QUERY_STRING"] = "EIO=4&transport=websocket"  # python-engineio knows no version 3; no other session
        try:
            return super().handle_request(environ, start_response)
        finally:
            if client := environ.get("drive.client"):
                client.close(wait=False, abort=True)
                self.sockets.pop(client.sid, None)
                self.clients.discard(client)

    def _make_room(self) -> bool:
        """Return whether there is room for another client; end the quietest one's session for that."""
        if len(self.clients) < MAX_CLIENTS:
            return True
        quietest = min(self.clients, key=lambda client: client.heard)
        if time.monotonic() < quietest.heard + QUIET:
            return False
        quietest.hang_up()
        return True


class Server(socketio.Server):
    """python-socketio's server with the settings and overrides that the simulator needs."""

    def __init__(self) -> None:
        super().__init__(
            async_mode="eventlet",
            async_handlers=False,
            transports=["websocket"],
            json=Json,
            serializer=Packet,
            logger=log,
            engineio_logger=log,
            ping_timeout=PONG_TIMEOUT,
            ping_interval=PING_INTERVAL,
            monitor_clients=False,
            cors_allowed_origins=[],
        )
        eventlet.spawn(self._ping)

    def arrived(self, sid: str) -> float:
        """Return the time.perf_counter() at which the first fragment of a client's last message was read."""
        return self.get_environ(sid)["drive.client"].websocket.arrived

    def _engineio_server_class(self) -> type[Engine]:
        return Engine

    def _ping(self) -> None:
        """Ping the clients that expect it."""
        while True:
            eventlet.sleep(PING_INTERVAL)
            for client in list(self.eio.clients):
                if client.expects_pings:
                    client.send(engineio.packet.Packet(engineio.packet.PING))

    def _handle_eio_connect(self, eio_sid: str, environ: WSGIEnvironment) -> None:
        """Connect a new client at once, as the simulator expects: it never asks for it."""
        super()._handle_eio_connect(eio_sid, environ)
        environ["drive.client"] = self.eio.sockets[eio_sid]
        self.eio.clients.add(environ["drive.client"])
        super()._handle_connect(eio_sid, "/", None)

    def _handle_connect(self, eio_sid: str, namespace: str | None, data: Any) -> None:
        """Connect a client that asks for it: one of Engine.IO 4, which is connected already, and expects pings."""
        self.eio.sockets[eio_sid].expects_pings = True
        if not self.manager.sid_from_eio_sid(eio_sid, namespace or "/"):
            super()._handle_connect(eio_sid, namespace, data)
