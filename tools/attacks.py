"""The attacks of `tools.attack`: what each sends to a drive.py, and how often."""

import functools
import itertools
import socket
import struct
import time
import urllib.request
import zlib
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from cloning.base.frame import FRAME
from cloning.recordings.images import encode
from cloning.wire.client import telemetry_packet
from tools.simulator_client import Simulator, fragments, telemetry

Attack = Callable[[int, float], None]  # takes the server's port and the time.monotonic() at which to stop
T = TypeVar("T")
WEBSOCKET = (
    b"GET /socket.io/?EIO=4&transport=websocket%s HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n"
)
GET = b"GET %s HTTP/1.1\r\nHost: localhost\r\n\r\n"
POST = b"POST %s HTTP/1.1\r\nHost: localhost\r\n%s\r\n\r\n"
POLLING = b"/socket.io/?EIO=3&transport=polling"


def frame(payload: bytes, first: int = 0x81, masked: int = 0x80, length: int | None = None) -> bytes:
    """Return a websocket frame with a mask of zeros.

    first: final bit, reserved bits and opcode; length: announced instead of the true one.
    """
    length = len(payload) if length is None else length
    if length < 126:
        size = struct.pack(">B", masked | length)
    elif length < 1 << 16:
        size = struct.pack(">BH", masked | 126, length)
    else:
        size = struct.pack(">BQ", masked | 127, length)
    return bytes([first]) + size + bytes(4 if masked else 0) + payload


def flood(
    port: int,
    until: float,
    opening: bytes,
    data: bytes = b"",
    *,
    then: bytes = b"",
    connections: int = 1,
    read: bool = False,
    pause: float = 0.0,
    hold: bool = True,
) -> None:
    """Send `opening` once and `data` again and again on each connection; connect again where the server closes.

    until: time.monotonic(); then: sent once, when the server has answered the opening; read: whether to read what the
    server sends; pause: s between two bytes, 0 to send as much as the server takes; hold: whether to keep a connection,
    instead of closing it when `opening` is sent.
    """
    opened: dict[int, socket.socket] = {}
    rest: dict[int, bytes] = {}
    unanswered: set[int] = set()
    while time.monotonic() < until:
        moved = 0
        for n in range(connections):
            try:
                if n not in opened:
                    opened[n] = socket.create_connection(("127.0.0.1", port), 0.2)
                    opened[n].setblocking(False)
                    rest[n], moved = opening, 1
                    unanswered.update({n} if then else ())
                if rest[n]:
                    sent = _unless_blocked(opened[n].send, rest[n][: 1 if pause else None]) or 0
                    rest[n], moved = rest[n][sent:], moved + sent
                if n in unanswered:
                    if not rest[n] and _unless_blocked(opened[n].recv, 1 << 20) is not None:
                        unanswered.remove(n)
                        rest[n] = then
                    continue
                if read or not (rest[n] or data):
                    received = _unless_blocked(opened[n].recv, 1 << 20, 0 if read else socket.MSG_PEEK)
                    if received == b"":
                        raise ConnectionError
                    moved += len(received or b"") if read else 0
                if not rest[n]:
                    rest[n] = data
                    if not hold:
                        raise ConnectionError
            except OSError:
                unanswered.discard(n)
                if n in opened:
                    opened.pop(n).close()
        if pause or not moved:
            time.sleep(pause or 0.002)
    for each in opened.values():
        each.close()


def _unless_blocked(call: Callable[..., T], *arguments: Any) -> T | None:
    """Return the result of a call on a socket, or None if it would have to wait."""
    try:
        return call(*arguments)
    except BlockingIOError:
        return None


def flooding(opening: bytes, data: bytes = b"", **options: Any) -> Attack:
    """Return the attack that is a flood."""
    return lambda port, until: flood(port, until, opening, data, **options)


# A flood of frames on an open websocket. What comes before the server's answer may be lost, and the rest not be
# understood: `then` comes after it.
websockets = functools.partial(flooding, WEBSOCKET % b"")


def bad_frames(port: int, until: float) -> None:
    """Break the websocket's rules, each rule on a connection of its own."""
    broken = [
        frame(b"2", masked=0),
        frame(b"2", 0xF1),  # reserved bits
        frame(b"2", 0xC1),  # compressed
        frame(b"2", 0x83),  # unknown opcode
        frame(b"x" * 126, 0x89),  # a control frame too long
        frame(b"", 0x09),  # a control frame in fragments
        frame(b"", 0x80),  # continues nothing
        frame(b"2", 0x01) + frame(b"2", 0x81),  # begins anew
        frame(b"\xff\xfe"),  # not UTF-8
        frame(b"\0\0", 0x88),
        frame(b"2", length=(1 << 64) - 1),
    ]
    for each in itertools.cycle(broken):
        if time.monotonic() > until:
            break
        flood(port, min(until, time.monotonic() + 0.02), WEBSOCKET % b"", then=each)


def roads(port: int, until: float) -> None:
    """Name another generated road with each telemetry, and ask for its centre line: to generate one takes seconds."""
    place, seen = {"x": 0.0, "y": 0.0, "offset": 0.0, "departures": 0, "time": 1.0}, telemetry(frames(1)[0])
    with Simulator(port).open() as simulator:
        for number in itertools.count(1):
            simulator.drive(seen | {"stand_in": place | {"track": f"mountain-{number}"}})
            urllib.request.urlopen(f"http://127.0.0.1:{port}/road").read()
            if time.monotonic() > until:
                break


def frames(count: int = 8) -> list[bytes]:
    """Return JPEGs about as large as the simulator's, 12 kB: a sky, and a field of grains."""
    rng = np.random.default_rng(0)
    grains = rng.normal(0, 11, (count, *FRAME)) + np.linspace(200, 90, FRAME[0])[:, None, None]
    return [encode(image, 75) for image in np.clip(grains, 0, 255).astype(np.uint8)]


def all_attacks() -> dict[str, Attack]:
    """Return the attacks by name."""
    driving = b"".join(fragments(telemetry_packet(0, 0, 9, frames(1)[0])))
    pressed = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    bomb = frame((pressed.compress(b"4" + bytes(8_000_000)) + pressed.flush(zlib.Z_SYNC_FLUSH))[:-4], 0xC1)
    nested = b'42["telemetry",' + b"[]," * 300_000 + b"0]"
    names = b"".join(frame(b"40/%d," % n) for n in range(50_000))
    return {
        # Answers that nobody reads
        "unread_pongs": websockets(frame(b"2" + b"x" * 1_000_000), connections=4),
        "unread_small_pongs": websockets(frame(b"2") * 1000),
        "unread_answers": websockets(driving, then=driving),
        "unread_pages": flooding(b"", GET % b"/live?attention", connections=20),
        "connect_again": websockets(frame(b"40") * 1000),
        "namespaces": websockets(names, read=True),
        "upgrade_packets": websockets(frame(b"5") * 1000),
        "websocket_pings": websockets(frame(b"x" * 125, 0x89) * 1000),
        "websocket_pings_read": websockets(frame(b"", 0x89) * 1000, connections=8, read=True),
        # Messages that cost more than they should
        "cars": websockets(driving, then=driving, connections=30, read=True),
        "attachments": websockets(frame(b"4" + b"x" * 100_000), then=frame(b'4599999999-["telemetry"]'), read=True),
        "compressed": websockets(bomb, then=bomb, connections=4, read=True),
        "garbage": websockets(frame(b"42[") + frame(b"4b") + frame(b"b!") + frame(b"\0") + frame(b"7"), read=True),
        "json": websockets(frame(nested), connections=8, read=True),
        "empty_fragments": websockets(frame(b"", 0x00) * 10_000, then=frame(b"4", 0x01), connections=8),
        "endless_fragments": websockets(frame(b"x" * 1000, 0x00) * 100, then=frame(b"4", 0x01)),
        "endless_frame": websockets(bytes(1 << 20), then=frame(b"4", length=1 << 40), connections=8),
        "bad_frames": bad_frames,
        # HTTP
        "roads": roads,
        "polling_sessions": flooding(b"", GET % POLLING, connections=50, read=True),
        "ended_sessions": websockets(frame(b"", 0x89) * 1000, then=frame(b"1"), connections=50, read=True),
        "half_upgrades": flooding(
            b"", WEBSOCKET.replace(b"Connection: Upgrade\r\n", b"") % b"", connections=100, read=True
        ),
        "upgrades": flooding(b"", WEBSOCKET % b"&sid=0", connections=100, read=True),
        "endless_body": flooding(POST % (b"/", b"Content-Length: 999999999999"), bytes(1 << 20), connections=20),
        "endless_chunks": flooding(
            POST % (POLLING, b"Transfer-Encoding: chunked"), b"10000\r\n" + bytes(1 << 16) + b"\r\n"
        ),
        "long_headers": flooding(
            b"", b"GET / HTTP/1.1\r\n" + b"A: %s\r\n" % (b"b" * 600) * 99, connections=100, read=True
        ),
        "slow_bodies": flooding(
            POST % (b"/set-speed", b"Content-Length: 100"), b"x" * 99, connections=500, pause=0.001
        ),
        "odd_requests": flooding(b"", b"G\r\n\r\n", connections=50, read=True, hold=False),
        "slow_headers": flooding(b"", GET % b"/" + b"A: b\r\n" * 1000, connections=500, pause=0.001),
        "odd_versions": flooding(b"", GET % b"/socket.io/?EIO=9&transport=websocket", connections=50, read=True),
        "page_requests": flooding(b"", GET % b"/", connections=100, read=True),
        "reconnections": flooding(WEBSOCKET % b"", connections=50, hold=False),
        "short_sessions": websockets(then=frame(b"2"), connections=50, hold=False),
        # Many at once
        "idle_connections": flooding(b"", connections=1500),
        "pages": flooding(GET % b"/live", connections=50, read=True),
        "pages_with_attention": flooding(GET % b"/live?attention", connections=50, read=True),
    }
