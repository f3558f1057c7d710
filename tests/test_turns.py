"""Whose turn it is among the clients of drive.py: a car that waits for its answer goes before those that never wait."""

import socket
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cloning.server import server
from cloning.server.libraries import engineio, eventlet
from cloning.server.server import HASTE, Client, Server
from cloning.server.websocket import WebSocket
from tools.attacks import frame


class Turns:
    """Clients that are served in turn; their websockets are made up."""

    def __init__(self):
        self.engine, self.served, self.websockets = Server().eio, list[str](), dict[str, Any]()

    def add(self, sid, ago, waited, waits=True):
        """Add a client that was served `ago` seconds before; waited, waits: for its message, and with it."""
        client = self.engine.sockets[sid] = Client(self.engine, sid)
        client.served, client.waits = time.perf_counter() - ago, waits
        client.websocket = self.websockets[sid] = cast(Any, SimpleNamespace(parts=[], waited=waited))

    def serve(self, sid, also=lambda: None):
        client = self.engine.sockets[sid]
        client._take_turn()
        self.served.append(sid)
        also()
        client.served = self.engine.served = time.perf_counter()


def test_the_client_that_was_served_longest_ago_goes_first():
    """So a car that waits for its answer waits for one other at most, however many never wait."""
    turns, now = Turns(), time.perf_counter()
    for sid, ago in {"fourth": 6.0, "fifth": 5.0, "second": 9.0, "third": 8.0, "hasty": 6.0 + HASTE / 2}.items():
        turns.add(sid, ago, waited=sid not in ("hasty", "third"))
    for sid, ago, arrived in (("first", 10.0, now + 60), ("slow", 20.0, now - 1)):
        turns.add(sid, ago, waited=True, waits=False)
        turns.websockets[sid].parts, turns.websockets[sid].arrived = ["a message arrives"], arrived
    threads = [eventlet.spawn(turns.serve, sid) for sid in ("fourth", "fifth", "second", "third", "hasty")]
    eventlet.sleep(0)
    eventlet.sleep(0)
    assert not turns.served, "the rest of a message of the one before all is about to arrive"
    for thread in (*threads, eventlet.spawn(turns.serve, "first")):
        thread.wait()
    # Not those that need too long for a message, and one that sends without waiting only if it waits for long, too.
    assert turns.served == ["first", "second", "third", "fourth", "hasty", "fifth"]


def test_a_message_that_arrives_while_another_is_handled_goes_before_hasty_ones():
    turns = Turns()
    for sid, ago in (("hasty", 3.0), ("hasty too", 2.0)):
        turns.add(sid, ago, waited=False)
    turns.add("patient", 2.5, waited=True, waits=False)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        green = eventlet.greenio.GreenSocket(ours)
        arriving = eventlet.spawn(lambda: green.recv(1) and turns.serve("patient"))
        threads = (
            eventlet.spawn(turns.serve, "hasty", lambda: theirs.send(b"x")),
            eventlet.spawn(turns.serve, "hasty too"),
        )
        for thread in (*threads, arriving):
            thread.wait()
    assert turns.served == ["hasty", "patient", "hasty too"]


def test_pings_take_no_turn(monkeypatch):
    """Those of a client that sends nothing else kept a car waiting for seconds."""
    turns, pongs = Turns(), list[str]()
    turns.add("pings", 1.0, waited=False)
    turns.add("car", 1.0, waited=True)
    pings = SimpleNamespace(receive=lambda: eventlet.sleep(0) or "2", send=pongs.append, waited=False, parts=[])
    monkeypatch.setattr(server, "WebSocket", lambda _: pings)
    client = turns.engine.sockets["pings"]
    client.waits = False
    client.queue.put(engineio.packet.Packet(engineio.packet.OPEN))
    pinging = eventlet.spawn(client._serve, SimpleNamespace(socket=None))
    while len(pongs) < 10:
        eventlet.sleep(0)
    with eventlet.Timeout(10):
        turns.serve("car")
    pinging.kill()


@pytest.mark.parametrize("early", [False, True])
def test_a_message_that_was_sent_before_the_answer_is_known(early):
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as theirs,
        eventlet.greenio.GreenSocket(listener.accept()[0]) as ours,
    ):
        websocket = WebSocket(ours)
        texts = [frame(b"40"), frame(b"41")]
        reading = eventlet.spawn(websocket.receive)
        eventlet.sleep(0)
        theirs.sendall(texts[0] + (texts[1] if early else b""))
        assert reading.wait() == "40"
        assert websocket.waited
        reading = eventlet.spawn(websocket.receive)
        eventlet.sleep(0)
        if not early:
            theirs.sendall(texts[1])
        assert reading.wait() == "41"
        assert websocket.waited != early


def test_what_has_arrived_of_a_client_is_left_once_it_is_hung_up_on():
    """So those that wait for its place do not wait for all that it has sent."""
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as theirs,
        eventlet.greenio.GreenSocket(listener.accept()[0]) as ours,
    ):
        websocket = WebSocket(ours)
        theirs.sendall(3 * frame(b"40"))
        assert websocket.receive() == "40"
        websocket.hang_up()
        assert websocket.receive() is None
