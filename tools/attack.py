"""Attack a drive.py while a car drives, and tell what the car and the server's memory feel of it.

    python -m tools.attack                                  # every attack for 5 s: about five minutes
    python -m tools.attack --only unread_pongs idle_connections --seconds 10

Each attack comes from a process of its own, against a drive.py that may open 1,024 files. Beside it a car in lock-step,
one telemetry in flight, must get the right answer to each of its frames, and in time; afterwards a new car must be
answered, and the attack's connections must be closed. Needs Linux, because memory is read from /proc.
"""

import argparse
import itertools
import json
import multiprocessing
import os
import resource
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cloning.errors import UserError
from cloning.pilot.network import SHIPPED_MODEL
from cloning.recordings.format import FRAME
from cloning.recordings.images import encode
from tools.server_process import start_server
from tools.simulator_client import Simulator, fragments, telemetry

ROOT = Path(__file__).resolve().parent.parent
OPEN_FILES = 1024  # that the server may have: Linux's usual limit
MAX_MEMORY, MAX_P99, MIN_RATE = 450, 40, 15  # MB, ms, frames/s: beside an attack
NEW_CAR, LEFT_OPEN = 5.0, 10.0  # s after an attack until a new car is answered, and until its connections are closed
FRAME_INTERVAL = 1 / 60  # s: the simulator sends at most one telemetry in a frame of its own
PATIENCE = 20.0  # s for an answer
WEBSOCKET = (
    b"GET /socket.io/?EIO=4&transport=websocket%s HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n"
)
GET = b"GET %s HTTP/1.1\r\nHost: localhost\r\n\r\n"
POST = b"POST %s HTTP/1.1\r\nHost: localhost\r\n%s\r\n\r\n"
POLLING = b"/socket.io/?EIO=3&transport=polling"
T = TypeVar("T")


# ----------------------------------------------------------------------------------------------------------------------
# What an attacker sends


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
    connections: int = 1,
    read: bool = False,
    pause: float = 0.0,
    hold: bool = True,
) -> None:
    """Send `opening` once and `data` again and again on each connection; connect again where the server closes.

    until: time.monotonic(); read: whether to read what the server sends; pause: s between two bytes, 0 to send as much
    as the server takes; hold: whether to keep a connection, instead of closing it when `opening` is sent.
    """
    opened: dict[int, socket.socket] = {}
    rest: dict[int, bytes] = {}
    while time.monotonic() < until:
        moved = 0
        for n in range(connections):
            try:
                if n not in opened:
                    opened[n] = socket.create_connection(("127.0.0.1", port), 0.2)
                    opened[n].setblocking(False)
                    rest[n], moved = opening, 1
                if rest[n]:
                    sent = _unless_blocked(opened[n].send, rest[n][: 1 if pause else None]) or 0
                    rest[n], moved = rest[n][sent:], moved + sent
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


Attack = Callable[[int, float], None]  # takes the server's port and the time.monotonic() at which to stop


def websockets(data: bytes, **options: int) -> Attack:
    """Return the attack that floods an open websocket with frames."""
    return lambda port, until: flood(port, until, WEBSOCKET % b"", data, **options)  # type: ignore[arg-type]


def requests(data: bytes, **options: float) -> Attack:
    """Return the attack that floods a connection with HTTP requests."""
    return lambda port, until: flood(port, until, b"", data, **options)  # type: ignore[arg-type]


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
        flood(port, min(until, time.monotonic() + 0.02), WEBSOCKET % b"" + each)


def session_id(port: int) -> bytes:
    """Return the id of a new session over HTTP polling, or b"" if the server refuses one."""
    with socket.create_connection(("127.0.0.1", port), 2) as client:
        client.sendall(GET % POLLING)
        head = client.recv(65536)
    return head.split(b'"sid":"')[1][:32] if b'"sid":"' in head else b""


def in_sessions(data: Callable[[bytes], bytes], connections: int) -> Attack:
    """Return the attack that opens a session over HTTP polling every second, and sends `data(session id)` in it."""

    def attack(port: int, until: float) -> None:
        while (now := time.monotonic()) < until:
            try:
                sid = session_id(port)
            except OSError:
                sid = b""
            flood(port, min(until, now + 1), b"", data(b"&sid=" + sid), connections=connections, read=True)

    return attack


def post(path: bytes, body: bytes) -> bytes:
    """Return a POST request."""
    return POST % (path, b"Content-Length: %d" % len(body)) + body


def one_frame_of(jpeg: bytes) -> bytes:
    """Return a telemetry's websocket frames."""
    return b"".join(fragments("42" + json.dumps(["telemetry", telemetry(jpeg, speed="9.0000")])))


def frames(count: int = 8) -> list[bytes]:
    """Return JPEGs about as large as the simulator's, 12 kB: a sky, and a field of grains."""
    rng = np.random.default_rng(0)
    grains = rng.normal(0, 11, (count, *FRAME)) + np.linspace(200, 90, FRAME[0])[:, None, None]
    return [encode(image, 75) for image in np.clip(grains, 0, 255).astype(np.uint8)]


def all_attacks() -> dict[str, Attack]:
    """Return the attacks by name."""
    driving = one_frame_of(frames(1)[0])
    names = b"".join(frame(b"40/%d," % n) for n in range(50_000))
    return {
        # Answers that nobody reads
        "unread_pongs": websockets(frame(b"2" + b"x" * 1_000_000), connections=4),
        "unread_small_pongs": websockets(frame(b"2") * 1000),
        "unread_answers": websockets(driving),
        "unread_pages": requests(GET % b"/live?attention", connections=20),
        "connect_again": websockets(frame(b"40") * 1000),
        "namespaces": websockets(names, read=True),
        "upgrade_packets": websockets(frame(b"5") * 1000),
        "websocket_pings": websockets(frame(b"x" * 125, 0x89) * 1000),
        "websocket_pings_read": websockets(frame(b"", 0x89) * 1000, connections=8, read=True),
        # Messages that cost more than they should
        "cars": websockets(driving, connections=30, read=True),
        "attachments": websockets(frame(b'459-["telemetry"]') + 8 * frame(b"\x04" + bytes(1 << 20), 0x82), read=True),
        "json": websockets(frame(b'42["telemetry",' + b"[]," * 300_000 + b"0]"), connections=8, read=True),
        "empty_fragments": lambda port, until: flood(
            port, until, WEBSOCKET % b"" + frame(b"4", 0x01), frame(b"", 0x00) * 10_000, connections=8
        ),
        "endless_frame": lambda port, until: flood(
            port, until, WEBSOCKET % b"" + frame(b"4", length=1 << 40), bytes(1 << 20), connections=8
        ),
        "bad_frames": bad_frames,
        # HTTP
        "polling_sessions": requests(GET % POLLING, connections=50, read=True),
        "unfetched_answers": in_sessions(
            lambda sid: post(POLLING + sid, b'24:42["telemetry",{"a":"b"}]' * 16), connections=8
        ),
        "upgrade_probes": in_sessions(lambda sid: WEBSOCKET % sid + frame(b"2probe"), connections=100),
        "payload_lengths": in_sessions(lambda sid: post(POLLING + sid, b"\0" + b"\1" * 250_000), connections=8),
        "endless_body": lambda port, until: flood(
            port, until, POST % (b"/", b"Content-Length: 999999999999"), bytes(1 << 20), connections=20
        ),
        "endless_chunks": lambda port, until: flood(
            port, until, POST % (POLLING, b"Transfer-Encoding: chunked"), b"10000\r\n" + bytes(1 << 16) + b"\r\n"
        ),
        "long_headers": requests(b"GET / HTTP/1.1\r\n" + b"A: %s\r\n" % (b"b" * 600) * 99, connections=100, read=True),
        "slow_headers": requests(GET % b"/" + b"A: b\r\n" * 1000, connections=500, pause=0.001),
        "odd_versions": requests(GET % b"/socket.io/?EIO=9&transport=websocket", connections=50, read=True),
        "page_requests": requests(GET % b"/", connections=100, read=True),
        "reconnections": lambda port, until: flood(port, until, WEBSOCKET % b"", connections=50, hold=False),
        # Many at once
        "idle_connections": lambda port, until: flood(port, until, b"", connections=1500),
        "pages": lambda port, until: flood(port, until, GET % b"/live", connections=50, read=True),
        "pages_with_attention": lambda port, until: flood(
            port, until, GET % b"/live?attention", connections=50, read=True
        ),
    }


# ----------------------------------------------------------------------------------------------------------------------
# What the car and the server feel of it


@dataclass
class Drive:
    """What a car met: its telemetries, the answers to them, and how long each took, in s."""

    asked: int = 0
    answered: int = 0
    wrong: int = 0
    seconds: float = 0.0
    round_trips: list[float] = field(default_factory=list)

    def milliseconds(self) -> list[float]:
        """Return the median, the 99th percentile and the largest of the round trips, in ms."""
        times = self.round_trips or [PATIENCE]
        return [1000 * float(each) for each in (np.median(times), np.quantile(times, 0.99), max(times))]

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.answered / self.seconds if self.seconds else 0.0


class Car:
    """A car in lock-step: it sends a frame, and waits for the answer before the next one."""

    def __init__(self, port: int, jpegs: list[bytes], expected: list[str] | None = None):
        """expected: the answer to each frame; those of a first, undisturbed drive if None."""
        until = time.monotonic() + PATIENCE
        while (simulator := Simulator(port, timeout=PATIENCE)).status != 101:
            simulator.socket.close()
            if time.monotonic() > until:
                raise ConnectionError("the server refuses a new car")
            time.sleep(0.1)
        self.simulator = simulator
        self.simulator.open()
        self.messages = ["42" + json.dumps(["telemetry", telemetry(jpeg, speed="9.0000")]) for jpeg in jpegs]
        self.expected = expected or [self.ask(message) for message in self.messages]

    def ask(self, message: str) -> str:
        """Send a telemetry, and return its answer."""
        self.simulator.send(message)
        return self.simulator.receive()

    def drive(self, goes_on: Callable[[], bool]) -> Drive:
        """Drive as long as `goes_on()`; a lost connection ends it, and leaves its last telemetry unanswered."""
        drive, started = Drive(), time.perf_counter()
        try:
            for n in itertools.count():
                due = time.perf_counter()
                if not goes_on():
                    break
                drive.asked += 1
                answer = self.ask(self.messages[n % len(self.messages)])
                drive.round_trips.append(time.perf_counter() - due)
                drive.answered += 1
                drive.wrong += answer != self.expected[n % len(self.messages)]
                time.sleep(max(0.0, due + FRAME_INTERVAL - time.perf_counter()))
            drive.wrong += self.ask("2") != "3"  # else an answer has come twice
        except OSError:
            pass  # what is not answered is counted
        drive.seconds = time.perf_counter() - started
        return drive


class Target:
    """A drive.py process under attack."""

    def __init__(self, model: str | Path):
        """Start it."""
        self.process, self.port = start_server((ROOT / "drive.py", model, "--port", "0"))
        resource.prlimit(self.process.pid, resource.RLIMIT_NOFILE, (OPEN_FILES, OPEN_FILES))

    def alive(self) -> bool:
        """Return whether it still runs."""
        return self.process.poll() is None

    def open_files(self) -> int:
        """Return the number of files and sockets that it has open."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def forget_peak(self) -> None:
        """Let `peak_memory` count from now on."""
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5", encoding="ascii")

    def peak_memory(self) -> float:
        """Return its largest resident memory, in MB."""
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
        return int(status.split("VmHWM:")[1].split()[0]) / 1024

    def stop(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()


@contextmanager
def target(model: str | Path) -> Iterator[Target]:
    """Run a drive.py for the block."""
    started = Target(model)
    try:
        yield started
    finally:
        started.stop()


@dataclass
class Report:
    """What an attack did: to the car, to the server's memory in MB, and afterwards."""

    drive: Drive
    memory: float
    new_car: float  # s until a new car was answered
    left_open: int  # connections of the attack that the server has not closed

    def faults(self, timely: bool = True) -> list[str]:
        """Return what the server promised and did not keep; timely: whether the round trips count."""
        found = {
            "the server ended": self.memory == 0,
            "lost": self.drive.answered != self.drive.asked or not self.drive.asked,
            "wrong": self.drive.wrong > 0,
            "memory": self.memory > MAX_MEMORY,
            "new car": self.new_car > NEW_CAR,
            "left open": self.left_open > 0,
            "slow": timely and (self.drive.milliseconds()[1] > MAX_P99 or self.drive.rate < MIN_RATE),
        }
        return [name for name, is_so in found.items() if is_so]


def run(attack: Attack | None, server: Target, jpegs: list[bytes], expected: list[str], seconds: float) -> Report:
    """Attack a server beside a car for some seconds; None: only drive."""
    car = Car(server.port, jpegs, expected)
    server.forget_peak()
    before, until = server.open_files(), time.monotonic() + seconds
    attacker = multiprocessing.get_context("fork").Process(target=_attack, args=(attack, server.port, until))
    attacker.start()
    drive = car.drive(lambda: time.monotonic() < until)
    attacker.kill()
    attacker.join()
    if not server.alive():
        return Report(drive, 0.0, PATIENCE, 0)
    ended = time.monotonic()
    try:
        new = Car(server.port, jpegs[:1], expected[:1])
        drive.wrong += new.ask(new.messages[0]) != expected[0]
        answered_after = time.monotonic() - ended
        new.simulator.socket.close()
    except OSError:
        answered_after = PATIENCE
    while (left := server.open_files() - before) > 0 and time.monotonic() < ended + LEFT_OPEN:
        time.sleep(0.05)
    car.simulator.socket.close()
    return Report(drive, server.peak_memory(), answered_after, max(left, 0))


def _attack(attack: Attack | None, port: int, until: float) -> None:
    os.nice(10)  # what comes over a network does not compete with the server for a processor
    if attack:
        attack(port, until)


def main() -> None:
    """Run the attacks and print a table."""
    attacks = all_attacks()
    parser = argparse.ArgumentParser(
        prog="attack", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default=SHIPPED_MODEL, help="a model file (default: the project's own)")
    parser.add_argument("--seconds", type=float, default=5, help="for each attack (default %(default)s)")
    parser.add_argument("--only", nargs="+", choices=attacks, metavar="ATTACK", help=f"of {', '.join(attacks)}")
    args = parser.parse_args()
    if not Path("/proc/self/status").exists():
        parser.error("needs Linux, because memory is read from /proc")
    raise_limit()
    chosen: Iterable[str] = args.only or attacks
    jpegs, broken = frames(), 0
    print(f"{'':22} asked   got wrong  fps  p50 ms p99 ms max ms  peak MB  new car s  left open")
    for name in ("nobody", *chosen):
        try:
            with target(args.model) as server:
                expected = Car(server.port, jpegs).expected
                report = run(attacks.get(name), server, jpegs, expected, args.seconds)
        except UserError as error:
            sys.exit(f"attack: {error}")
        faults, drive = report.faults(), report.drive
        median, p99, largest = drive.milliseconds()
        broken += bool(faults)
        print(
            f"{name:22} {drive.asked:5} {drive.answered:5} {drive.wrong:5} {drive.rate:4.0f} {median:7.1f} {p99:6.1f} "
            f"{largest:6.0f} {report.memory:8.0f} {report.new_car:10.2f} {report.left_open:10}  "
            f"{', '.join(faults) or 'ok'}",
            flush=True,
        )
    sys.exit(1 if broken else 0)


def raise_limit() -> None:
    """Let this process open as many files as the system allows: an attack needs more than a server."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


if __name__ == "__main__":
    main()
