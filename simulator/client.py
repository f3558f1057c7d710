"""The autonomous mode: the car sends what its centre camera sees and drives as the server answers."""

import time

from cloning.errors import SimulatorError
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.writer import Clock
from cloning.wire.client import MANUAL, Answer, Connection, Gone, read, telemetry
from cloning.wire.session import OPENS, ClientSession
from simulator.cameras import Cameras, jpeg
from simulator.car import STEP
from simulator.progress import Progress
from simulator.run import Run

STANDS_STILL = 60.0  # simulated seconds in which the car has to get on by a metre


class Standstill(SimulatorError):
    """The server answers, but the car does not move."""


def picture(run: Run, cameras: Cameras, steering: float, throttle: float) -> str:
    """The telemetry packet of this moment; steering and throttle as last commanded, -1..1."""
    frame = cameras.frames(run.car.node.get_transform())[0]
    return telemetry(steering, throttle, run.speed_mph, jpeg(frame))


class Client(ClientSession):
    """Drives a run by a server's answers, connecting again when it goes away."""

    def __init__(self, run: Run, cameras: Cameras, host: str, port: int, wait: float, realtime: bool):
        """wait: seconds of patience with a server that is not there or does not answer usably."""
        super().__init__(host, port, wait, patient=realtime)
        self.run, self.cameras, self.realtime = run, cameras, realtime
        self.watch = None  # called after each physics step, if set
        self.steering = self.throttle = 0.0
        self.frames = 0
        self.own_time = 0.0  # s of wall time not spent waiting for the server
        self.moved = (0.0, 0.0)

    def picture(self) -> str:
        """The telemetry packet of this moment."""
        self.frames += 1
        return picture(self.run, self.cameras, self.steering, self.throttle)

    def obey(self, answer: Answer) -> None:
        if answer.steering is not None:
            self.steering, self.throttle = answer.steering, answer.throttle

    def step(self) -> None:
        self.run.step(self.steering, self.throttle)
        if self.watch:
            self.watch()
        since, at = self.moved
        if abs(self.run.travelled - at) > 1:
            self.moved = (self.run.time, self.run.travelled)
        elif self.run.time - since > STANDS_STILL:
            raise Standstill(
                f"the car has stood still for {STANDS_STILL:.0f} s (throttle {self.throttle:g}, "
                f"{self.dropped} unusable answers)"
            )

    def drive(self, laps: float, progress: Progress) -> None:
        """Drive the laps. Raises SimulatorError."""
        goal = laps * self.run.track.length
        drive = self._in_real_time if self.realtime else self._in_lockstep
        while True:
            self.wire = self.connect()
            try:
                drive(goal, progress)
                return
            except Gone as error:
                self.reconnect(error)
            finally:
                self.close()

    def _in_lockstep(self, goal: float, progress: Progress) -> None:
        """Simulated time waits for each answer: 15 frames a simulated second."""
        self.listen()
        clock = Clock(self.run.time + 1 / SAMPLE_RATE)
        while self.run.travelled < goal:
            self.obey(self.early())
            begin = time.perf_counter()
            packet = self.picture()
            self.own_time += time.perf_counter() - begin
            answer = self.exchange(packet)
            begin = time.perf_counter()
            self.obey(answer)
            self.step()
            while not clock.due(self.run.time) and self.run.travelled < goal:
                self.step()
            self.own_time += time.perf_counter() - begin
            progress.show(max(0.0, self.run.travelled) / self.run.track.length, self.run.time)

    def _in_real_time(self, goal: float, progress: Progress) -> None:
        """Simulated time is the wall's. Each open and each answer makes one frame, and a lost answer is a
        lost frame."""
        sent: list[float] = []
        for _ in range(OPENS):
            self.wire.send(self.picture())
            sent.append(time.perf_counter())
        begin, origin, usable = time.perf_counter(), self.run.time, time.monotonic()
        while self.run.travelled < goal:
            due = int((time.perf_counter() - begin) / STEP) * STEP + origin
            for _ in range(min(25, round((due - self.run.time) / STEP))):
                self.step()
            packet = self.wire.receive(max(0.0, begin + self.run.time - origin + STEP - time.perf_counter()))
            progress.show(max(0.0, self.run.travelled) / self.run.track.length, self.run.time)
            answer = self.usable(packet) if packet else None
            if answer is None:
                if time.monotonic() - usable > self.wait:
                    raise SimulatorError(f"no usable answer in {self.wait:.0f} s ({self.dropped} unusable ones so far)")
                continue
            usable = time.monotonic()
            if sent:
                self.round_trips.append(time.perf_counter() - sent.pop(0))
            self.obey(answer)
            self.wire.send(self.picture())
            sent.append(time.perf_counter())


class Remote:
    """drive.py as the window sees it: never waited for, looked for each second while it is away."""

    def __init__(self, host: str, port: int, cameras: Cameras):
        self.address, self.cameras = (host, port), cameras
        self.steering = self.throttle = 0.0
        self.wire: Connection | None = None
        self.state, self.next_try = "not connected", 0.0

    def answer(self, by_hand: bool, run: Run) -> None:
        """Obey what has arrived, and send a frame for each, or null while a person steers."""
        try:
            if self.wire is None:
                self._connect(run)
            for _ in range(OPENS + 1):  # not for as long as answers come: the window has to be drawn as well
                packet = self.wire.receive(0) if self.wire else None
                answer = read(packet) if packet else None
                if answer is None:
                    continue
                if answer.steering is not None:
                    self.steering, self.throttle = answer.steering, answer.throttle
                self.wire.send(MANUAL if by_hand else picture(run, self.cameras, self.steering, self.throttle))
        except Gone as error:
            self.wire, self.state = None, str(error)
            self.steering = self.throttle = 0.0

    def _connect(self, run: Run) -> None:
        if time.monotonic() < self.next_try:
            return
        self.next_try = time.monotonic() + 1
        self.wire = Connection(*self.address, patient=True)
        self.state = "drives"
        for _ in range(OPENS):
            self.wire.send(picture(run, self.cameras, 0.0, 0.0))

    def close(self) -> None:
        if self.wire:
            self.wire.close()
            self.wire = None
