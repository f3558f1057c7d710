"""Attack a drive.py while a car drives, and tell what the car and the server's memory feel of it.

    python -m tools.attack                                  # every attack for 5 s: about five minutes
    python -m tools.attack --only unread_pongs idle_connections --seconds 10

Each attack comes from a process of its own, against a drive.py that may open 1,024 files. Beside it a car in lock-step,
one telemetry in flight, must get the right answer to each of its frames, and in time; afterwards a new car must be
answered, and the attack's connections must be closed. Needs Linux, because memory is read from /proc.
"""

import itertools
import multiprocessing
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import UserError
from cloning.base.processes import starting
from cloning.network.network import SHIPPED_MODEL
from cloning.wire.client import telemetry_packet
from tools.attacks import Attack, all_attacks, frames
from tools.command import ROOT, ServerProcess
from tools.simulator_client import Simulator

OPEN_FILES = 1024  # that the server may have: Linux's usual limit
MAX_GROWTH, MAX_P99, MIN_RATE = 60, 40, 15  # MB, ms, frames/s: beside an attack
NEW_CAR, LEFT_OPEN = 5.0, 10.0  # s after an attack until a new car is answered, and until its connections are closed
FRAME_INTERVAL = 1 / 60  # s: the simulator sends at most one telemetry in a frame of its own
PATIENCE = 20.0  # s for an answer


@dataclass
class Drive:
    """What a car met: its telemetries, the answers to them, and how long each took, in s."""

    asked: int = 0
    wrong: int = 0
    seconds: float = 0.0
    round_trips: list[float] = field(default_factory=list)

    @property
    def answered(self) -> int:
        """How many telemetries were answered."""
        return len(self.round_trips)

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
        self.simulator = simulator.open()
        self.messages = [telemetry_packet(0, 0, 9, jpeg) for jpeg in jpegs]
        self.expected = expected or [self.ask(message) for message in self.messages]

    def ask(self, message: str) -> str:
        """Send a telemetry, and return its answer."""
        self.simulator.send(message)
        return self.simulator.receive()

    def drive(self, until: float) -> Drive:
        """Drive until this time.monotonic(); a lost connection ends it, and leaves its last telemetry unanswered."""
        drive, started = Drive(), time.monotonic()
        try:
            for message, expected in itertools.cycle(zip(self.messages, self.expected, strict=True)):
                if (sent := time.monotonic()) >= until:
                    break
                drive.asked += 1
                answer = self.ask(message)
                drive.round_trips.append(time.monotonic() - sent)
                drive.wrong += answer != expected
                time.sleep(max(0.0, sent + FRAME_INTERVAL - time.monotonic()))
            drive.wrong += self.ask("2") != "3"  # else an answer has come twice
        except OSError:
            pass  # what is not answered is counted
        drive.seconds = time.monotonic() - started
        return drive


class Target(ServerProcess):
    """A drive.py process under attack."""

    def __init__(self, model: str | Path, *folder: Path):
        """Start it; folder: for its frames. Raises UserError where the system is not Linux."""
        if not Path("/proc/self/status").exists():
            raise UserError("needs Linux, because memory is read from /proc")
        import resource  # missing on Windows

        super().__init__(ROOT / "drive.py", model, *folder, "--port", 0)
        resource.prlimit(self.process.pid, resource.RLIMIT_NOFILE, (OPEN_FILES, OPEN_FILES))

    def open_files(self) -> int:
        """Return how many files and sockets it has open."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def forget_peak(self) -> None:
        """Let `memory("VmHWM")`, its peak, count from now on."""
        Path(f"/proc/{self.process.pid}/clear_refs").write_text("5", encoding="ascii")


@dataclass
class Report:
    """What an attack did: to the car, to the server's memory in MB (its peak, and above its start), and afterwards."""

    drive: Drive
    memory: float
    growth: float
    new_car: float  # s until a new car was answered
    left_open: int  # connections of the attack that the server has not closed

    def faults(self, timely: bool = True) -> list[str]:
        """Return what the server promised and did not keep; timely: whether the round trips count."""
        found = {
            "the server ended": self.memory == 0,
            "lost": self.drive.answered != self.drive.asked or not self.drive.asked,
            "wrong": self.drive.wrong > 0,
            "memory": self.growth > MAX_GROWTH,
            "new car": self.new_car > NEW_CAR,
            "left open": self.left_open > 0,
            "slow": timely and (self.drive.milliseconds()[1] > MAX_P99 or self.drive.rate < MIN_RATE),
        }
        return [name for name, is_so in found.items() if is_so]


def run(attack: Attack | None, server: Target, jpegs: list[bytes], expected: list[str], seconds: float) -> Report:
    """Attack a server beside a car for some seconds; None: only drive."""
    car = Car(server.port, jpegs, expected)
    server.forget_peak()
    memory = server.memory()
    before = server.open_files()
    attacker = multiprocessing.get_context("fork").Process(target=_attack, args=(attack, server.port, seconds))
    try:
        with starting():
            attacker.start()
        drive = car.drive(time.monotonic() + seconds)  # however long the start took
    finally:
        attacker.kill()
        attacker.join()
    if (attacker.exitcode or 0) > 0:  # otherwise it was killed, or has ended
        raise RuntimeError("the attack itself has failed, with the error above")
    if server.process.poll() is not None:
        return Report(drive, 0.0, 0.0, PATIENCE, 0)
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
    peak = server.memory("VmHWM")
    return Report(drive, peak, peak - memory, answered_after, max(left, 0))


def _attack(attack: Attack | None, port: int, seconds: float) -> None:
    import resource

    os.nice(10)  # what comes over a network does not compete with the server for a processor
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    if attack:
        attack(port, time.monotonic() + seconds)


def main(argv: list[str] | None = None) -> int:
    """Run the attacks and print a table; return the exit status. Raises UserError."""
    attacks = all_attacks()
    parser = command_line("python -m tools.attack", __doc__)
    add = parser.add_argument
    add("--model", default=SHIPPED_MODEL, help="a model file (default: the project's own)")
    add("--seconds", type=number(float, 0.1, 3600), default=5, help="for each attack (default %(default)s)")
    add("--only", nargs="+", choices=attacks, metavar="ATTACK", help=f"of {', '.join(attacks)} (default: all)")
    options = parser.parse_args(argv)
    jpegs, broken = frames(), 0
    print(f"{'':22} asked   got wrong  fps  p50 ms p99 ms max ms  peak MB  new car s  left open")
    for name in ("nobody", *(options.only or attacks)):
        with Target(options.model) as server:
            expected = Car(server.port, jpegs).expected
            report = run(attacks.get(name), server, jpegs, expected, options.seconds)
        faults, drive = report.faults(), report.drive
        median, p99, largest = drive.milliseconds()
        broken += bool(faults)
        print(
            f"{name:22} {drive.asked:5} {drive.answered:5} {drive.wrong:5} {drive.rate:4.0f} {median:7.1f} {p99:6.1f} "
            f"{largest:6.0f} {report.memory:8.0f} {report.new_car:10.2f} {report.left_open:10}  "
            f"{', '.join(faults) or 'ok'}",
            flush=True,
        )
    return program.INCOMPLETE if broken else program.DONE


if __name__ == "__main__":
    program.run(main)
