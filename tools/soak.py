"""Let cars drive with one drive.py for hours' worth of frames, and tell whether it stays as it was at the start.

    python -m tools.soak                        # a million frames: about two hours on two cores
    python -m tools.soak --frames 20000         # about three minutes

Beside a car in lock-step, which leaves and comes again, a second one comes at times, pages are opened and closed, and
the frames that drive.py saves are deleted. The table has a line for each tenth of the frames. At the end a car drives
in turns with this drive.py and with one just started, so that what else the machine does counts for both. The exit
status is 1 if an answer was lost or wrong, if memory grew by more than 20 MB after the first twentieth, if a file or
connection was left open, or if the 99th percentile of the round trips is 1.2 times the new drive.py's or more. Needs
Linux, because memory is read from /proc.
"""

import http.client
import itertools
import random
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Self

import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.progress import progress_bar
from cloning.network.network import SHIPPED_MODEL
from tools.attack import LEFT_OPEN, Car, Target
from tools.attacks import frames
from tools.command import head, row

TENTHS = 10
MAX_GROWTH = 20.0  # MB
VISIT, PAUSE = 5.0, 3.0  # s, mean: how long a second car or a page stays, and until the next one
STAY = 3000  # frames, mean: after these the car leaves, and comes again
KEPT = 2.0  # s: how long saved frames are left on the disk
SETTLE = 1.0  # s at the start, until what was closed is gone
PAGES = ("/", "/live")
TURNS = 10  # with each server, at the end
MAX_RATIO = 1.2  # of their 99th percentiles


class Reading:
    """A server at this moment: memory in MB, open files and sockets, its own processor time in s."""

    def __init__(self, server: Target):
        self.memory, self.files, self.seconds = server.memory(), server.open_files(), server.cpu_seconds()


class Company:
    """What goes on beside the car, in threads until the `with` statement ends; an error in one is raised there."""

    def __init__(self, port: int, car: Callable[[], Car], folder: Path):
        """port: of the server; car: makes another one; folder: the frames are saved in its folders."""
        self.port, self.car, self.folder = port, car, folder
        self.asked = self.answered = self.wrong = 0  # of the second car
        self._ended, self._pool, self._works = threading.Event(), ThreadPoolExecutor(), list[Future[None]]()

    def __enter__(self) -> Self:
        self._works = [self._pool.submit(self._repeat, work) for work in (self._visit, self._look, self._delete)]
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        with self._pool:
            for work in self._works:
                work.result()

    def _repeat(self, work: Callable[[float], None]) -> None:
        while not self._ended.wait(random.expovariate(1 / PAUSE)):
            work(time.monotonic() + random.expovariate(1 / VISIT))

    def _visit(self, until: float) -> None:
        car = self.car()
        drive = car.drive(until)
        car.simulator.socket.close()
        self.asked += drive.asked
        self.answered += drive.answered
        self.wrong += drive.wrong

    def _look(self, until: float) -> None:
        for path in PAGES:
            connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
            connection.request("GET", path)
            response = connection.getresponse()
            assert response.status == 200, f"{path}: {response.status}"
            while response.read1() and time.monotonic() < until:  # /live has no end
                pass
            response.close()
            connection.close()

    def _delete(self, until: float) -> None:
        for path in self.folder.glob("*/*.jpg"):
            if path.stat().st_mtime < time.time() - KEPT:
                path.unlink()


def timed(car: Car, n: int) -> tuple[bool, float]:
    """Let a car send its n-th frame; return whether the answer is right, and its time in ms. Raises OSError if lost."""
    began, k = time.perf_counter(), n % len(car.messages)
    answer = car.ask(car.messages[k])
    return answer == car.expected[k], 1000 * (time.perf_counter() - began)


def soak(server: Target, folder: Path, count: int) -> list[str]:
    """Drive this many frames, and print the table; return what was found wrong. Raises OSError."""
    jpegs = frames()
    expected = Car(server.port, jpegs).expected

    def new_car() -> Car:
        return Car(server.port, jpegs, expected)

    car, leaves, wrong, lost = new_car(), 0, 0, 0
    print(head("frames", "MB", "open files", "ms of processor time", "p50, ms", "p99, ms"), flush=True)
    car.ask(car.messages[0])  # so that its frames' file is open, too
    time.sleep(SETTLE)
    early = before = Reading(server)
    alone = before.files
    bar = progress_bar(count, "frame")
    with Company(server.port, new_car, folder) as company, bar:
        for tenth in range(TENTHS):
            times, others = [], company.answered
            for n in range(tenth * count // TENTHS, (tenth + 1) * count // TENTHS):
                if n == leaves:
                    car.simulator.socket.close()
                    car, leaves = new_car(), n + 1 + int(random.expovariate(1 / STAY))
                if n == count // (2 * TENTHS):
                    early = Reading(server)
                bar.update()
                try:
                    is_right, passed = timed(car, n)
                except OSError:  # it comes again
                    lost, leaves = lost + 1, n + 1
                    continue
                wrong += not is_right
                times.append(passed)
            now, answered = Reading(server), len(times) + company.answered - others
            spent = 1000 * (now.seconds - before.seconds) / answered
            p50, p99 = np.quantile(times, (0.5, 0.99))
            figures = f"{now.memory:.1f}", now.files, f"{spent:.2f}", f"{p50:.1f}", f"{p99:.1f}"
            with bar.external_write_mode():  # now: it may be interrupted before its end
                print(row((tenth + 1) * count // TENTHS, *figures), flush=True)
            before = now
    until = time.monotonic() + LEFT_OPEN
    while (files := server.open_files()) != alone and time.monotonic() < until:
        time.sleep(0.1)
    grown = before.memory - early.memory
    car.simulator.socket.close()
    lost, wrong = lost + company.asked - company.answered, wrong + company.wrong
    found = {
        f"{lost} answers lost": lost > 0,
        f"{wrong} answers wrong": wrong > 0,
        f"memory grew by {grown:.0f} MB": grown > MAX_GROWTH,
        f"{files} open files, {alone} at the start": files != alone,
    }
    return [what for what, is_so in found.items() if is_so]


def in_turns(servers: tuple[Target, ...], count: int) -> np.ndarray:
    """Drive this many frames a turn with each server; return their 99th percentiles in ms, the medians of the turns."""
    jpegs, p99 = frames(), np.empty((TURNS, len(servers)))
    for turn, server in itertools.product(range(TURNS), range(len(servers))):
        car = Car(servers[server].port, jpegs)
        times = [timed(car, n)[1] for n in range(count)]
        car.simulator.socket.close()
        p99[turn, server] = np.quantile(times, 0.99)
    return np.median(p99, 0)


def main(argv: list[str] | None = None) -> int:
    """Drive, and print the table; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.soak", __doc__)
    parser.add_argument("--model", default=SHIPPED_MODEL, help="a model file (default: the project's own)")
    parser.add_argument("--frames", type=number(int, 100, 10**9), default=10**6, help="default %(default)s")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder, Target(options.model, Path(folder) / "frames") as server:
        found = soak(server, Path(folder), options.frames)
        with Target(options.model, Path(folder) / "new") as new:
            aged, fresh = in_turns((server, new), max(10, options.frames // (50 * TURNS)))
    if aged >= MAX_RATIO * fresh:
        found.append(f"{aged / fresh:.1f} times as slow as a drive.py just started")
    print(f"\np99, in turns with a drive.py just started: {aged:.1f} ms, and {fresh:.1f} ms")
    print(f"\n{'; '.join(found) or 'as at the start'}")
    return program.INCOMPLETE if found else program.DONE


if __name__ == "__main__":
    program.run(main)
