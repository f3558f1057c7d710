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
from cloning.road.autonomy import autonomy
from cloning.road.disturbances import Disturbance
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
from simulator.run import Departure, Run
from simulator.world import Scene, free_unused

PATIENCE = 30.0  # s that a drive may take beyond twice the time at its set speed
WAIT = 60.0  # s for a server's answer


class Conditions(NamedTuple):
    """How a road is driven.

    driver       a model file, an .onnx file, or HOST:PORT of a server
    speed, look  mph; see README.md
    direction    "ccw", "cw", or None for that of the real simulator, or in which the road's points are listed
    metres       to drive; None: the whole road
    set_back     after a departure the car is set back onto the lane's centre and goes on, until the time of so many
                 interventions is that of the whole drive; if not, the first departure ends it
    disturbance  of the frames, or None; seed: the same disturbs them in the same way
    """

    driver: str
    speed: float
    look: int
    direction: str | None = None
    metres: float | None = None
    set_back: bool = False
    disturbance: Disturbance | None = None
    seed: int = 0


@dataclass(frozen=True)
class Drive:
    """How a road was driven.

    farthest    m from the lane's centre
    seconds     simulated, until the car arrived or failed
    ended       "arrived", "left" or "right" for the side on which the car left the road for good, or "late"
    along       m along the road where the drive ended
    path        x, y of the car in m, one for each frame
    mean        m from the lane's centre, on average
    planned     s that it would have taken at its set speed
    departures  from the road
    """

    farthest: float
    seconds: float
    ended: str
    along: float
    path: tuple[tuple[float, float], ...]
    mean: float = 0.0
    planned: float = 0.0
    departures: tuple[Departure, ...] = ()

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


def drive(conditions: Conditions, road: str | PointRoad) -> Drive:
    """Drive a road as `python -m simulator drive` and drive.py do; road: as `Track` takes it. Raises UserError."""
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


@functools.lru_cache(maxsize=1)  # of several drives of a road one after another
def _scene(road: str | PointRoad, look: int) -> Scene:
    return Scene(scenery.build(road, look))


def cameras_at(road: str | PointRoad, look: int) -> Cameras:
    """Return this process's cameras, on the car in this scene."""
    scene, kept = _scene(road, look), _cameras()
    if not kept:
        kept.append(Cameras(scene, ("center",)))
    elif kept[0].scene is not scene:
        kept[0].move(scene)
        free_unused()
    return kept[0]


def _drive(conditions: Conditions, road: str | PointRoad, answer: Callable[[str], Answer]) -> Drive:
    run, cameras = Run(Track(road, conditions.direction), "autonomous"), cameras_at(road, conditions.look)
    cameras.disturb(conditions.disturbance, conditions.seed)
    driven, clock = Driven(), SampleClock(1 / SAMPLE_RATE)
    length = conditions.metres or run.track.length
    planned = length / (conditions.speed * MPH)
    position = run.car.node.get_pos()
    path = [(position.x, position.y)]
    late, ended = PATIENCE + 2 * planned, ""
    while not ended:
        driven.apply(answer(current_telemetry(run, cameras, driven.steering, driven.throttle)))
        due = False
        while not (due or ended):
            if not run.advance(driven.steering, driven.throttle):
                if conditions.set_back and autonomy(len(run.departures), planned) > 0:
                    run.set_back()
                else:
                    ended = run.departures[-1].side
            elif run.travelled >= length:
                ended = "arrived"
            elif run.time > late:
                ended = "late"
            due = clock.due(run.time)
        path.append((run.trajectory.x[-1], run.trajectory.y[-1]))
    offsets = np.abs(run.trajectory.offset)
    return Drive(
        farthest=float(offsets.max()),
        seconds=run.time,
        ended=ended,
        along=float(run.s),
        path=tuple(path),
        mean=float(offsets.mean()),
        planned=planned,
        departures=tuple(run.departures),
    )
