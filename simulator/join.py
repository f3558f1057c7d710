"""The simulator joined to another program's server, in one of the dialects of `simulator.dialects`."""

import argparse
import contextlib
import math
import os
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from cloning.base import program
from cloning.base.errors import SimulatorError, UserError
from cloning.base.files import written_whole
from cloning.base.outputs import plural
from cloning.base.processes import PYTHON
from cloning.road.track import Track
from cloning.wire.client import ConnectionLost, parse_event
from cloning.wire.session import MAX_UNASKED, ClientSession
from simulator.car import STEP
from simulator.client import MAX_CATCH_UP
from simulator.dialects import DIALECTS, Dialect, Stage
from simulator.run import Run

ASK_AGAIN = 5.0  # s without an answer, after which the telemetry is sent again: programs drop some
SETTLE = 0.2  # s without a word from the server, after which its greeting is over, and the start of an episode
STILL = 1 / 15  # s of real time between two telemetries while simulated time stands still
# How long a driver in another thread than the program's answers is waited for, s: until one is known to be there, and
# then at first. Drivers may be in the same thread: after so many vain attempts none is waited for. Commands may be
# constant, and programs end long episodes: each vain attempt halves the patience, to a little more than a driver takes.
BRIEFLY, PATIENTLY, ATTEMPTS = 0.5, 2.0, 3
LAUNCHER = "#!/bin/sh\nPYTHONPATH="  # how one begins; another file of its name may be the real simulator
MAX_PACKET = 1 << 20  # characters of a message: a road of some kilometres has 200,000


class AwaitedDriver:
    """What is known of a program's driver: whether it is in another thread than the answers, and how long it takes."""

    def __init__(self, may_be_apart: bool):
        self.apart: bool | None = None if may_be_apart else False  # whether it is in another thread; None: unknown
        self.takes, self.patience = 0.02, PATIENTLY  # s for an answer; s that it is waited for
        self.vain = self.constant = 0  # attempts to find it in another thread; answers in a row that did not change

    def longest(self) -> float:
        """Return how long it may still answer otherwise than the program did at once, s; 0: it is not to be awaited."""
        if self.apart is None:
            return BRIEFLY if self.constant < ATTEMPTS else 0.0
        return max(self.patience, 3 * self.takes) if self.apart else 0.0

    def answered(self, seconds: float, at_once: bool) -> None:
        """Learn from an answer after so many seconds; at_once: it was there when it was first asked for."""
        self.apart = True
        self.patience = min(PATIENTLY, 1.05 * self.patience)
        if at_once:  # it may take less
            self.takes = max(0.005, 0.99 * self.takes)
        else:
            self.takes += 0.2 * (min(seconds, 0.2) - self.takes)

    def kept_silent(self, is_new: bool) -> None:
        """Learn from a vain wait; is_new: for the answer to a telemetry whose first answer was another than before."""
        self.constant += 1
        if self.apart:
            self.patience /= 2
        elif is_new:
            self.vain += 1
            self.apart = False if self.vain >= ATTEMPTS else None


class Joined(ClientSession):
    """Sends telemetry to a server and does what it says, until the server has gone for `wait` seconds.

    In lock-step simulated time waits for the answer to each telemetry; otherwise it follows the wall clock. Where a
    program may answer at once, with what its driver has commanded last, the same telemetry is sent again until the
    answer changes: then the driver has seen it.
    """

    remedy = "; start the program, or name its --port"
    connect_timeout = math.inf  # it may open a session only when its test begins

    def __init__(self, dialect: Dialect, host: str, port: int, wait: float, pace: float, rate: float):
        """wait: s to wait for a server; pace: simulated s a second, 0 for lock-step.

        rate: telemetries a simulated second, at most 50.
        """
        super().__init__(host, port, wait, max_packet=MAX_PACKET)
        self.dialect, self.pace, self.period = dialect, pace, max(STEP, 1 / rate)
        self.frames, self.time, self.due = 0, 0.0, 0.0  # sent; simulated s in all; when the next is due
        self.driver = AwaitedDriver(dialect.apart)
        self._is_puzzled = False  # whether the user knows that nothing usable has come
        self._origin = 0.0  # simulated s at time.perf_counter() 0, with a pace

    def run(self) -> None:
        """Join a server, again and again. Raises SimulatorError if there is none, UserError for an impossible wish."""
        while not self.dialect.over:
            try:
                self.connect()
                begin = time.monotonic()
                try:
                    self._exchange()
                except ConnectionLost as error:
                    if self._waiting_until:  # a server that has not answered yet is there all the same
                        self._waiting_until += time.monotonic() - begin
                    self.count_reconnection(error)
                finally:
                    self.close()
            except SimulatorError:
                if not self.time:  # nothing was driven
                    raise
                return

    def no_answer(self) -> SimulatorError:
        """Return the error for a server that is missing or has gone."""
        return SimulatorError(f"{self._lost or 'no answer'}{self._remedy_for(self._lost)}; waited {self.wait:g} s")

    def _exchange(self) -> None:
        """Send and receive until the program wants no more, or the connection is lost. Raises ConnectionLost."""
        self.dialect.replies.clear()  # what a program that has gone was to hear
        self.driver = AwaitedDriver(self.dialect.apart)  # and what was known of its driver
        self._start_clock()
        self._listen(SETTLE)
        self._start_clock()
        until = time.monotonic() + ASK_AGAIN
        while not self.dialect.ready:
            if time.monotonic() > until:
                self._tell_of_silence()
            self._listen(ASK_AGAIN)
        asked_again = False
        while not self.dialect.over:
            run, telemetry = self.dialect.run, self.dialect.telemetry()
            if self._ask(telemetry):
                if asked_again:  # what was late is answered twice, and the second answer is none to a later telemetry
                    self._listen(SETTLE)
                if not self.pace:
                    self._await_driver(run, telemetry)
                self._drive()
                asked_again = False
            else:
                asked_again = True
                self._tell_of_silence()

    def _tell_of_silence(self) -> None:
        """Say once that a program has not said a usable word, if nothing was driven."""
        if self.time or self._is_puzzled:
            return
        self._is_puzzled = True
        print(f"no usable word in {ASK_AGAIN:g} s; if none comes, the program may speak another --dialect", flush=True)

    def _ask(self, telemetry: str) -> bool:
        """Send a telemetry; return whether it was answered; if not, it has to be sent again."""
        self.connection.send(telemetry)
        self.frames += 1
        run, until = self.dialect.run, time.monotonic() + ASK_AGAIN
        while (left := until - time.monotonic()) > 0:
            if self._listen(min(left, STEP) if self.pace else left):
                self.progressed()
                return True
            if self.dialect.run is not run:  # a program may begin an episode instead of an answer, or before one
                run, until = self.dialect.run, time.monotonic() + SETTLE
            if self.pace:
                self._catch_up()
        return False

    def _await_driver(self, run: Run, telemetry: str) -> None:
        """Send a run's telemetry again until the answer changes, if the program's driver may be in another thread."""
        driver, is_new = self.driver, not self.dialect.same
        if is_new:
            driver.constant = 0
        longest = driver.longest()
        if self.dialect.still or not longest:
            return
        begin, pause = time.monotonic(), driver.takes
        while (left := begin + longest - time.monotonic()) > 0:
            self._listen(min(pause, left))
            if self.dialect.run is not run:  # another episode has begun
                return
            if self._ask(telemetry) and not self.dialect.same:
                driver.answered(time.monotonic() - begin, at_once=pause == driver.takes)
                return
            pause *= 1.5
        driver.kept_silent(is_new)

    def _listen(self, pause: float) -> bool:
        """Do what the server says, its first event within `pause` seconds; return whether it answered a telemetry."""
        answered = False
        for _ in range(MAX_UNASKED):
            packet = self.connection.receive(pause)
            if packet is None:
                break
            if event := parse_event(packet):
                if self.pace:
                    self._catch_up()
                answered = self.dialect.handle(*event) or answered
                self._reply()
                pause = self.dialect.more if answered else 0.0
        return answered

    def _reply(self) -> None:
        for reply in self.dialect.replies:
            self.connection.send(reply)
        self.dialect.replies.clear()

    def _drive(self) -> None:
        """Drive until the next telemetry is due."""
        if self.dialect.still:
            self._listen(STILL)
            self._start_clock()
            self.due = self.time
            return
        self.due += self.period
        if self.pace:
            while self.time < self.due - 1e-9 and not self.dialect.still:
                self._listen(max(0.0, min(STEP, (self.due - self._now()) / self.pace)))
                self._catch_up()
            self.due = max(self.due, self.time)
        while not self.pace and self.time < self.due - 1e-9 and not self.dialect.still:
            self._step()
        self._reply()

    def _step(self) -> None:
        self.dialect.step()
        self.time += STEP

    def _start_clock(self) -> None:
        """Let simulated time, with a pace, go on from here."""
        self._origin = self.time - self.pace * time.perf_counter()

    def _now(self) -> float:
        """Return the simulated time that it should be by the wall clock."""
        return self._origin + self.pace * time.perf_counter()

    def _catch_up(self) -> None:
        """Let simulated time follow the wall clock; what cannot be caught up at once is skipped."""
        behind = int((self._now() - self.time) / STEP + 1e-6)
        for _ in range(min(behind, MAX_CATCH_UP)):
            if not self.dialect.still:
                self._step()
        if behind > MAX_CATCH_UP or self.dialect.still:
            self._start_clock()


def join(arguments: argparse.Namespace, track: Track, own: dict[str, Any]) -> int:
    """Let a server drive, print what was driven, into `arguments.log` if that is given, and return the exit status.

    track: the first; own: options of a road of one's own, for sent roads, too. Raises UserError, OSError.
    """
    name = None if arguments.log == "-" else arguments.log  # as Unity takes it: the terminal
    with open(name or os.devnull, "w", encoding="utf-8", buffering=1) as log, contextlib.ExitStack() as stack:
        if name:
            stack.enter_context(contextlib.redirect_stdout(log))
            stack.enter_context(contextlib.redirect_stderr(log))
        stage = Stage(track.source, arguments.direction, arguments.look, own, arguments.disturb)
        dialect = DIALECTS[arguments.dialect](stage)
        joined = Joined(dialect, arguments.host, arguments.port, arguments.wait, arguments.pace, arguments.fps)
        begin = time.perf_counter()
        try:
            joined.run()
        except UserError as error:
            return program.failed(error)
        finally:
            seconds = time.perf_counter() - begin
            print(
                f"{plural(dialect.episodes, 'episode')}, {plural(joined.frames, 'telemetry', 'telemetries')}, "
                f"{joined.time:.0f} simulated seconds in {seconds:.0f} s"
            )
    return program.DONE


def write_launcher(arguments: argparse.Namespace) -> None:
    """Write `arguments.launcher`, a program that runs `join` with these options and its own. Raises SimulatorError."""
    if sys.platform == "win32":
        raise SimulatorError("--launcher writes a shell script, which Windows can't start; use it on Linux, as in WSL")
    options = ["join", "--dialect", arguments.dialect]
    road = ("track", "road", "width", "marking", "land", "direction", "look", "disturb")
    for name in ("host", "port", "wait", *road, "pace", "fps"):
        value = getattr(arguments, name)
        if value is not None:
            options += [f"--{name}", os.path.abspath(value) if name == "road" else str(value)]
    command = shlex.join([*PYTHON, "-m", "simulator", *options])
    here = f'{LAUNCHER}{shlex.quote(str(Path(__file__).parents[1]))}"${{PYTHONPATH:+:$PYTHONPATH}}"'
    path = Path(arguments.launcher)
    try:
        if path.is_file():
            with open(path, "rb") as file:
                if file.read(len(LAUNCHER)) != LAUNCHER.encode():
                    raise SimulatorError(f"{path}: exists already, and is no launcher; name another file")
        with written_whole(path) as temporary:
            temporary.write_text(f'{here} exec {command} "$@"\n', encoding="utf-8")
            temporary.chmod(0o755)
    except OSError as error:
        raise SimulatorError(f"{path}: {error.strerror}; name a file in a folder that can be written") from error
