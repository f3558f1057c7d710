"""How a driver drives a road until it fails: a model file, an ONNX file or a server, as `simulator drive` does it."""

import functools
import re
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cloning.base.errors import SimulatorError, UserError
from cloning.network.compute import one_thread
from cloning.network.network import load_model, steer
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.writer import SampleClock
from cloning.road.generated import PointRoad
from cloning.road.motion import MPH
from cloning.road.track import Track
from cloning.server.speed import SpeedController
from cloning.server.telemetry import format_number, parse_telemetry
from cloning.wire.client import Answer, ConnectionLost, parse_event
from cloning.wire.session import ClientSession
from simulator import scenery
from simulator.cameras import Cameras
from simulator.client import Driven, current_telemetry
from simulator.run import Run
from simulator.world import Scene, free_unused

PATIENCE = 30.0  # s that a drive may take beyond twice the time at its set speed
WAIT = 60.0  # s for a server's answer


class Conditions(NamedTuple):
    """What all drives of a search have in common; driver: a file or HOST:PORT; speed: mph; look: see README.md."""

    driver: str
    speed: float
    look: int


@dataclass(frozen=True)
class Drive:
    """How a road was driven.

    farthest  m from the lane's centre
    seconds   simulated, until the car arrived or failed
    ended     "arrived", "left" or "right" for the side on which the car left the road, or "late"
    along     m along the road where the drive ended
    path      x, y of the car in m, one for each frame
    """

    farthest: float
    seconds: float
    ended: str
    along: float
    path: tuple[tuple[float, float], ...]

    @property
    def failed(self) -> bool:
        """Whether the driver failed."""
        return self.ended != "arrived"

    def figures(self) -> dict[str, str | float]:
        """Return what people want to know of it."""
        rounded = {"farthest_m": self.farthest, "seconds": self.seconds, "along_m": self.along}
        return {"ended": self.ended} | {name: round(value, 2) for name, value in rounded.items()}


@functools.cache
def load_driver(driver: str) -> Callable[[np.ndarray], float]:
    """Return what computes the steering, -1..1, from a frame, uint8 (160, 320, 3). Raises UserError."""
    if not driver.endswith(".onnx"):
        one_thread()
        network = load_model(driver)
        return lambda frame: float(steer(network, frame))
    try:
        import onnxruntime  # an optional library
    except ImportError as error:
        raise UserError(f"{error}; pip install onnxruntime") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(driver, options)
    except Exception as error:  # onnxruntime has its own, without a common class
        raise UserError(f"{driver}: {str(error)[:200]}") from None
    name = session.get_inputs()[0].name
    return lambda frame: float(np.clip(session.run(None, {name: frame[None]})[0].flat[0], -1, 1))


def server_address(driver: str) -> tuple[str, int] | None:
    """Return the host and port that a driver is, None if it is a file."""
    match = re.fullmatch(r"([\w.-]+):(\d{1,5})", driver)
    return (match[1], int(match[2])) if match else None


def check_driver(driver: str) -> None:
    """Raise UserError if there is no such file or server."""
    if address := server_address(driver):
        with closing(ClientSession(*address, WAIT)) as session:
            session.connect()
    else:
        load_driver(driver)


def drive(conditions: Conditions, road: PointRoad) -> Drive:
    """Drive a road as `python -m simulator drive` and drive.py do, until the first failure. Raises UserError."""
    address = server_address(conditions.driver)
    if address is None:
        steering, controller = load_driver(conditions.driver), SpeedController(conditions.speed)

        def answer(packet: str) -> Answer:
            _, message = parse_event(packet) or ("", None)
            telemetry = parse_telemetry(message)
            commands = steering(telemetry.image), controller.throttle(telemetry.speed)
            return Answer(*(float(format_number(value)) for value in commands))

        try:
            return _drive(conditions, road, answer)
        except ArithmeticError as error:
            raise SimulatorError(f"{conditions.driver}: {error}; train the model again") from None
    with closing(ClientSession(*address, WAIT)) as session:
        try:
            session.connect()
            session.receive_greeting()
            return _drive(conditions, road, session.request_answer)
        except ConnectionLost as error:
            raise SimulatorError(f"{conditions.driver}: {error}; restart the server") from None


@functools.cache
def _cameras() -> list[Cameras]:
    """Return the list for this process's cameras, which move from road to road: new ones for each would add up."""
    return []


def _drive(conditions: Conditions, road: PointRoad, answer: Callable[[str], Answer]) -> Drive:
    run, scene, kept = Run(Track(road), "autonomous"), Scene(scenery.build(road, conditions.look)), _cameras()
    if kept:
        kept[0].move(scene)
        free_unused()
    else:
        kept.append(Cameras(scene, ("center",)))
    length, driven, clock = run.track.length, Driven(), SampleClock(1 / SAMPLE_RATE)
    position = run.car.node.get_pos()
    path = [(position.x, position.y)]
    late, ended = PATIENCE + 2 * length / (conditions.speed * MPH), ""
    while not ended:
        driven.apply(answer(current_telemetry(run, kept[0], driven.steering, driven.throttle)))
        due = False
        while not (due or ended):
            if not run.advance(driven.steering, driven.throttle):
                ended = run.departures[0].side
            elif run.travelled >= length:
                ended = "arrived"
            elif run.time > late:
                ended = "late"
            due = clock.due(run.time)
        path.append((run.trajectory.x[-1], run.trajectory.y[-1]))
    return Drive(float(np.abs(run.trajectory.offset).max()), run.time, ended, float(run.s), tuple(path))
