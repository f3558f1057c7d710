"""The autonomous mode: the car sends its centre camera's frames and drives as the server answers."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Literal

from tqdm import tqdm

from cloning.base.errors import SimulatorError
from cloning.base.progress import progress_bar
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.writer import SampleClock
from cloning.wire.client import (
    CONNECT,
    MANUAL_TELEMETRY,
    Connection,
    ConnectionLost,
    Driven,
    parse_answer,
    telemetry_packet,
)
from cloning.wire.session import OPENS, ClientSession
from simulator.cameras import Cameras, jpeg
from simulator.car import STEP
from simulator.run import Run

STANDSTILL_TIME = 60.0  # simulated seconds within which the car must move by a metre
MAX_CATCH_UP = 25  # physics steps to catch up with real time, before the next look for an answer
ANSWERS_PER_STEP = 6  # 300 per second in real time; the real simulator's client took at most 264
RECONNECT_INTERVAL = 1.0  # s between two attempts of the window to connect
WINDOW_SEND_TIMEOUT = 0.1  # s that the window waits for a server that does not read


# Why a drive ended: its laps were driven; the server answers, but the car stays where it is; another error, or Ctrl-C.
DriveEnd = Literal["laps", "stood_still", "failed"]


def current_telemetry(run: Run, cameras: Cameras, steering: float, throttle: float) -> str:
    """Return the telemetry packet for the present state; steering and throttle: as last commanded, -1..1."""
    frame = cameras.frames(run.car.node.get_transform())[0]
    return telemetry_packet(steering, throttle, run.speed_mph, jpeg(frame), run.place)


class Client(Driven, ClientSession):
    """Drives the car as a server answers, and connects again when the connection is lost."""

    def __init__(self, run: Run, cameras: Cameras, host: str, port: int, wait: float, realtime: bool):
        """realtime: simulated time follows the wall clock instead of the answers; wait: see ClientSession."""
        super().__init__(host, port, wait, real_timing=realtime)
        self.run, self.cameras, self.realtime = run, cameras, realtime
        self.watch: Callable[[], None] | None = None  # called after each physics step
        self.frames = 0  # number of frames sent
        self.ended: DriveEnd = "failed"  # until it has ended in another way
        self.own_time = 0.0  # s of wall time that the simulator itself used, in lock-step
        self._moved_at, self._moved_to = 0.0, 0.0  # s and m travelled when the car had last moved by a metre

    def next_frame(self) -> str:
        """Return the telemetry packet for the present state, and count it."""
        self.frames += 1
        return current_telemetry(self.run, self.cameras, self.steering, self.throttle)

    def step(self) -> None:
        """Drive for one physics step. Raises SimulatorError if the car stands still."""
        self.run.step(self.steering, self.throttle)
        if self.watch:
            self.watch()
        if abs(self.run.travelled - self._moved_to) > 1:
            self._moved_at, self._moved_to = self.run.time, self.run.travelled
        elif self.run.time - self._moved_at > STANDSTILL_TIME:
            self.ended = "stood_still"
            raise SimulatorError(
                f"the car has stood still for {STANDSTILL_TIME:.0f} s (throttle {self.throttle:g}, "
                f"{self.unusable} unusable answers)"
            )

    def drive(self, laps: float) -> None:
        """Drive this number of laps. Raises SimulatorError."""
        goal = laps * self.run.track.length
        drive = self._drive_in_real_time if self.realtime else self._drive_in_lockstep
        with progress_bar(round(goal), "m") as bar:
            while True:
                self.connect()
                try:
                    drive(goal, bar)
                    self.ended = "laps"
                    return
                except ConnectionLost as error:
                    self.count_reconnection(error)
                finally:
                    self.close()

    def _show(self, bar: tqdm) -> None:
        bar.update(round(max(0.0, self.run.travelled)) - bar.n)

    def _drive_in_lockstep(self, goal: float, bar: tqdm) -> None:
        """Drive to the goal, in m travelled; simulated time waits for the answer to each of 15 frames per second."""
        self.receive_greeting()
        clock = SampleClock(self.run.time + 1 / SAMPLE_RATE)
        while self.run.travelled < goal:
            self.apply(self.receive_unasked())
            begin = time.perf_counter()
            packet = self.next_frame()
            self.own_time += time.perf_counter() - begin
            answer = self.request_answer(packet)
            begin = time.perf_counter()
            self.apply(answer)
            self.step()
            while not clock.due(self.run.time) and self.run.travelled < goal:
                self.step()
            self.own_time += time.perf_counter() - begin
            self._show(bar)

    def _drive_in_real_time(self, goal: float, bar: tqdm) -> None:
        """Drive to the goal, in m travelled, while simulated time follows the wall clock.

        A frame is sent for each "open" event and for each answer. So, as in the real simulator, each lost answer leaves
        one frame less in flight. More answers than ANSWERS_PER_STEP wait for the next physics step: otherwise a server
        that floods the client gets frames until its buffers are full, before the car has moved.
        """
        sent: list[float] = []  # when each telemetry that has no answer yet was sent
        greeted = answered = False  # commands that arrive before CONNECT answer no telemetry
        for _ in range(OPENS):
            self.connection.send(self.next_frame())
            sent.append(time.perf_counter())
        begin, origin, until = time.perf_counter(), self.run.time, self.first_answer_due()
        taken = 0  # answers since the last physics step
        while self.run.travelled < goal:
            due = int((time.perf_counter() - begin) / STEP) * STEP + origin
            for _ in range(min(MAX_CATCH_UP, round((due - self.run.time) / STEP))):
                self.step()
                taken = 0
                if answered:
                    self.progressed()
            pause = max(0.0, begin + self.run.time - origin + STEP - time.perf_counter())
            if taken == ANSWERS_PER_STEP:
                time.sleep(pause)
                continue
            packet = self.connection.receive(pause)
            self._show(bar)
            answer = self.parse(packet) if packet else None
            greeted = greeted or bool(packet and packet.startswith(CONNECT))
            if answer is None:
                if time.monotonic() > until:
                    raise self.no_answer()
                continue
            taken += 1
            until = time.monotonic() + self.wait
            if sent and greeted:
                self.round_trips.append(time.perf_counter() - sent.pop(0))
                answered = True
            self.apply(answer)
            self.connection.send(self.next_frame())
            sent.append(time.perf_counter())


class RemoteDriver(Driven):
    """drive.py as the window's driver; while it cannot be reached, it is tried again every second.

    It never holds the window up: connecting, which can take long, is done in a thread.
    """

    def __init__(self, host: str, port: int, cameras: Cameras):
        self.address, self.cameras = (host, port), cameras
        self.connection: Connection | None = None
        self.state, self.next_try = "waiting for drive.py", 0.0
        self._connecting: Future[Connection] | None = None  # of the thread

    def poll(self, by_hand: bool, run: Run) -> None:
        """Use the answers that have arrived, without waiting, and send a telemetry for each.

        by_hand: a person steers, so the telemetry is null. Call this once per window frame.
        """
        try:
            connection = self.connection or self._connect(run)
            if connection is None:
                return
            for _ in range(OPENS + 1):  # not until no answer is left: the window must be rendered, too
                packet = connection.receive(0)
                answer = parse_answer(packet) if packet else None
                if answer is None:
                    continue
                self.apply(answer)
                connection.send(
                    MANUAL_TELEMETRY if by_hand else current_telemetry(run, self.cameras, self.steering, self.throttle)
                )
        except ConnectionLost as error:
            self.connection, self.state = None, f"waiting for drive.py: {error}"
            self.steering = self.throttle = 0.0
            self.next_try = time.monotonic() + RECONNECT_INTERVAL

    def _connect(self, run: Run) -> Connection | None:
        """Return a connection that the thread has made, or None; start the thread if it is time."""
        if self._connecting is None and time.monotonic() >= self.next_try:
            self._connecting = Future()
            # A daemon, so that it does not keep a closed window's process.
            threading.Thread(target=self._open_connection, args=[self._connecting], daemon=True).start()
        if self._connecting is None or not self._connecting.done():
            return None
        opened, self._connecting = self._connecting, None
        made = opened.result()
        self.connection, self.state = made, "drive.py drives"
        for _ in range(OPENS):
            made.send(current_telemetry(run, self.cameras, 0.0, 0.0))
        return made

    def _open_connection(self, opened: Future[Connection]) -> None:
        try:
            opened.set_result(Connection(*self.address, real_timing=True, send_timeout=WINDOW_SEND_TIMEOUT))
        except ConnectionLost as error:
            opened.set_exception(error)

    def close(self) -> None:
        """Close the connection, if one is open."""
        if self.connection:
            self.connection.close()
            self.connection = None
