"""A server for the simulator's end of the wire, on a raw socket, that follows the real client's transcript."""

import base64
import contextlib
import functools
import hashlib
import re
import socket
import struct
import threading

import numpy as np

from cloning.road.track import Track
from simulator.cameras import Cameras
from simulator.client import Client
from simulator.run import Run
from tools import attacks

STEER = '42["steer",{"steering_angle":"%s","throttle":"%s"}]'


def unused_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        return closed.getsockname()[1]


def lost():
    raise ConnectionError


def exactly(stream, n):
    """Read n bytes, unless the connection ends before."""
    data = stream.read(n)
    return data if len(data) == n else lost()


def accept_websocket(client, headers=b""):
    """Read a client's request, accept it, and return it; headers: additional ones, each with its line end."""
    request = b""
    while not request.endswith(b"\r\n\r\n"):
        request += client.recv(1) or lost()
    key = re.findall(rb"(?i)sec-websocket-key: (.*)\r", request)[0]
    accept = base64.b64encode(hashlib.sha1(key + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11").digest())
    client.sendall(
        b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"%sSec-WebSocket-Accept: %s\r\n\r\n" % (headers, accept)
    )
    return request.decode()


def frame(payload, opcode=1, final=True):
    """A websocket frame of a server, which is not masked; opcode: 1 text."""
    payload = payload.encode() if isinstance(payload, str) else payload
    return attacks.frame(payload, 0x80 * final | opcode, masked=0)


class Server:
    """Speaks the server's part of the transcript; `reply(packet, n)` returns the answers to telemetry n."""

    def __init__(self, reply, greet=True, sessions=1):
        self.reply, self.greet, self.sessions = reply, greet, sessions
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.requests, self.messages, self.frames, self.error = [], [], [], None
        self.closed = False
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.listener.close()
        self.thread.join(20)
        assert not self.thread.is_alive()
        if self.error:
            raise self.error

    def run(self):
        try:
            for _ in range(self.sessions):
                self.client, _ = self.listener.accept()
                self.client.settimeout(20)
                with self.client, contextlib.suppress(ConnectionError):
                    self.session(self.client)
        except Exception as error:
            self.error = error

    def send(self, client, text):
        client.sendall(frame(text))

    def session(self, client):
        self.requests.append(accept_websocket(client))
        self.send(client, '0{"sid":"x","upgrades":[],"pingTimeout":60000,"pingInterval":25000}')
        if self.greet:
            self.send(client, STEER % ("0", "0"))
        self.send(client, "40")
        message, answered, pieces, stream = b"", 0, [], client.makefile("rb")
        while True:
            first, second = exactly(stream, 2)
            assert second & 0x80, "a client masks its frames"
            size = second & 0x7F
            if size == 126:
                size = struct.unpack(">H", exactly(stream, 2))[0]
            mask = exactly(stream, 4)
            masked = np.frombuffer(exactly(stream, size), np.uint8)
            data = (masked ^ np.resize(np.frombuffer(mask, np.uint8), size)).tobytes()
            if first & 0x0F == 8:
                self.closed = True
                return
            message += data
            pieces.append((first, size))
            if first & 0x80:
                text, message = message.decode(), b""
                self.messages.append(text)
                self.frames.append(pieces)
                pieces = []
                if text == "2":
                    self.send(client, "3")
                elif text.startswith("42"):
                    replies = self.reply(text, answered)
                    answered += 1
                    if replies is None:
                        return
                    if replies == "close":
                        client.sendall(b"\x88\x02\x03\xe8")
                        return
                    for packet in replies:
                        self.send(client, packet)


class Blank(Cameras):
    """Cameras that see grey noise, so that frames are as large as real ones."""

    def __init__(self):
        self.disturbance = None

    noise = np.random.default_rng(0).integers(60, 190, (160, 320, 3), np.uint8)

    def frames(self, transform):
        return self.noise[None]


LAPS = 0.004  # a drive of 1.4 s


lake = functools.cache(lambda: Track("lake"))


def drive(server, laps=LAPS, wait=5.0, realtime=False):
    client = Client(Run(lake(), "autonomous"), Blank(), "127.0.0.1", server.port, wait, realtime)
    client.drive(laps)
    return client


def ahead(packet, n):
    return [STEER % ("0.0", "1.0")]
