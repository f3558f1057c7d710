"""How a driver drives a road: a model file, an ONNX file or a server, as `simulator drive` does it, or one built in.

An ONNX file whose network does not take the simulator's frames as they are needs a file beside it, of the same name
with the ending .json, which says how its image is made of one; LEADERBOARD.md has its keys.
"""

import functools
import hashlib
import json
import math
import re
import threading
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, replace
from operator import index
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cloning.base.arguments import MAX_PORT
from cloning.base.errors import SimulatorError, UserError
from cloning.base.frame import FRAME
from cloning.base.outputs import as_typed
from cloning.lane.foretell import ALARM, Foreteller, Limits, Observer, limits_file, load_limits
from cloning.lane.pilot import Pilot
from cloning.network.compute import one_thread, onnx_runtime
from cloning.network.network import load_model, steer
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import decode
from cloning.recordings.writer import SampleClock
from cloning.road.autonomy import autonomy
from cloning.road.disturbances import Disturbance
from cloning.road.generated import PointRoad
from cloning.road.motion import MPH
from cloning.road.track import Track
from cloning.server.speed import SpeedController
from cloning.server.telemetry import format_number
from cloning.wire.client import Answer, ConnectionLost, telemetry_packet
from cloning.wire.session import ClientSession
from simulator.cameras import Cameras, jpeg
from simulator.expert import Expert
from simulator.run import Departure, Run
from simulator.workers import started_workers
from simulator.world import Scene

PATIENCE = 30.0  # s that a drive may take beyond twice the time at its set speed
WAIT = 60.0  # s for a server's answer
MOST = 3  # numbers in an ONNX network's answer, of which the steering is the first: throttle and brake may follow
BUILT_IN = ("straight", "expert")  # drivers that need no camera: steering 0, and the one that drives recordings
COLOURS = {
    "RGB": None,
    "BGR": cv2.COLOR_RGB2BGR,
    "YUV": cv2.COLOR_RGB2YUV,
    "HSV": cv2.COLOR_RGB2HSV,
    "GRAY": cv2.COLOR_RGB2GRAY,
}
NO_CHANGE = {"crop": [0, 0, 0, 0], "blur": 1, "colour": "RGB", "range": [0, 255]}  # for an ONNX file that says nothing
_ALONE = threading.Lock()  # drives of one process share its cameras; a Dask worker may have several threads
_cameras: list[Cameras] = []  # this process's, which move from road to road: new ones for each would add up
Steering = Callable[[np.ndarray], float]  # -1..1, from a frame, uint8 (160, 320, 3), RGB
Watch = Callable[[Run, Cameras | None], None]


class Conditions(NamedTuple):
    """How a road is driven."""

    driver: str  # a model file, an .onnx file, HOST:PORT of a server, or one of BUILT_IN
    speed: float  # mph
    look: int  # see README.md
    direction: str | None = None  # "ccw", "cw", or None for the real simulator's, or that in which points are listed
    metres: float | None = None  # to drive; None: the whole road
    # m along the track, m to the right and degrees turned to the right, at which the car starts at its set speed; None:
    # at rest where the autonomous mode starts.
    start: tuple[float, float, float] | None = None
    # After a departure the car is set back onto the lane's centre and goes on, until the time of so many interventions
    # is that of the whole drive; if not, the first departure ends it.
    set_back: bool = False
    own_throttle: bool = True  # a server's throttle counts; if not, the set speed is held as drive.py does it
    disturbance: Disturbance | None = None  # of the frames
    seed: int = 0  # the same disturbs them in the same way
    foretell: bool = False  # a model whose limits are known foretells its departures


@dataclass(frozen=True)
class Drive:
    """How a road was driven."""

    farthest: float  # m from the lane's centre
    seconds: float  # simulated, until the car arrived or failed
    ended: str  # "arrived", "left" or "right" for the side on which the car left the road for good, or "late"
    along: float  # m along the road where the drive ended
    path: tuple[tuple[float, float], ...]  # x, y of the car in m, one for each frame
    mean: float = 0.0  # m from the lane's centre, on average
    planned: float = 0.0  # s that it would have taken at its set speed
    departures: tuple[Departure, ...] = ()  # from the road
    alarms: tuple[float, ...] | None = None  # s, of the frames at which the model foretold one; None if it doesn't

    @property
    def failed(self) -> bool:
        """Whether the driver failed."""
        return self.ended != "arrived"

    @property
    def autonomy(self) -> float:
        """The share of the planned time without a human's help, 0..1; 0 if the car did not arrive."""
        return 0.0 if self.failed else max(0.0, autonomy(len(self.departures), self.planned))

    def figures(self) -> dict[str, str | float]:
        """Return what people want to know of it."""
        rounded = {"farthest_m": self.farthest, "seconds": self.seconds, "along_m": self.along}
        return {"ended": self.ended} | {name: round(value, 2) for name, value in rounded.items()}


# ----------------------------------------------------------------------------------------------------------------------
# Drivers


def load_driver(driver: str) -> Steering:
    """Return what computes the steering, -1..1, from a frame, uint8 (160, 320, 3). Raises UserError."""
    return _load_driver(driver, digest_of(Path(driver)))


@functools.cache
def _load_driver(driver: str, digest: str) -> Steering:  # by its digest, since a file may be trained anew meanwhile
    if not driver.endswith(".onnx"):
        one_thread()
        network = load_model(driver)
        return lambda frame: float(steer(network, frame))
    try:
        onnxruntime = onnx_runtime()
    except ImportError as error:
        raise UserError(f"{error}; pip install onnxruntime") from None
    if not Path(driver).is_file():
        export = as_typed("python", "-m", "cloning.network.export", "model.pt", driver)
        raise UserError(f"{driver}: no such file; `{export}` writes one")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(driver, options)
        if len(inputs := session.get_inputs()) != 1:
            raise ValueError(f"its inputs are {', '.join(each.name for each in inputs) or 'none'}, not one image")
        taken, given = inputs[0], [each.name for each in session.get_outputs()]
        answer = next((name for name in given if re.search("steer|angle", name.lower())), given[0])
        prepare = preprocessing(Path(driver).with_suffix(".json"), taken.shape, taken.type == "tensor(uint8)")

        def steering(frame: np.ndarray) -> float:
            found = np.ravel(session.run([answer], {taken.name: prepare(frame)})[0])
            if not 1 <= len(found) <= MOST:
                raise ValueError(f"its output {answer} has {len(found)} numbers, not the steering")
            if not np.isfinite(found[0]):
                raise ArithmeticError("the network's steering is not finite")
            return float(np.clip(found[0], -1, 1))

        steering(np.resize(np.arange(256, dtype=np.uint8), FRAME))  # some divide by the deviation of a frame
    except UserError:
        raise
    except Exception as error:  # onnxruntime has its own, without a common class
        reason = " ".join(str(error).split())[-300:]  # which onnxruntime tells last
        raise UserError(f"{driver}: does not steer by a frame as LEADERBOARD.md says: {reason}") from None
    return steering


def refuse_replaced(driver: str, digest: object) -> None:
    """Raise UserError if a driver's file is another than before: what drove since is neither the one nor the other."""
    if digest and digest != digest_of(Path(driver)):
        raise UserError(f"{driver}: was replaced while it drove, as by a training; name a copy of it")


def load_limits_of(driver: str) -> tuple[Observer, Limits] | None:
    """Return what foretells that a model leaves the road, None if its limits are not known. Raises UserError."""
    if driver.endswith(".onnx"):
        return None
    return _load_limits_of(driver, digest_of(Path(driver)), digest_of(limits_file(Path(driver))))


@functools.cache
def _load_limits_of(driver: str, *digests: str) -> tuple[Observer, Limits] | None:
    network = load_model(driver)
    limits = load_limits(Path(driver), network)
    return (Observer(network), limits) if limits else None


def preprocessing(file: Path, shape: list, whole: bool) -> Callable[[np.ndarray], np.ndarray]:
    """Return what makes an ONNX network's input of a frame; file: see above, may be missing.

    shape: of the input, (n, rows, columns, 3) or (n, 3, rows, columns), with 1 in place of 3 for gray ones; texts or
    None for sizes that are free; whole: it takes uint8, else float32. Raises UserError, ValueError if it is no image.
    """
    try:
        said = json.loads(file.read_text(encoding="utf-8-sig")) if file.exists() else {}
        crop, blur, colour, ends = ({**NO_CHANGE, **said}[name] for name in NO_CHANGE)
        if unknown := set(said) - set(NO_CHANGE):
            raise ValueError(f"it has {', '.join(sorted(unknown))}")
        top, bottom, left, right = map(index, crop if len(crop) == 4 else (*crop, 0, 0))  # rows alone are enough
        if not (0 <= top < FRAME[0] - bottom <= FRAME[0] and 0 <= left < FRAME[1] - right <= FRAME[1]):
            raise ValueError(f"a frame has {FRAME[0]} rows and {FRAME[1]} columns")
        if (side := index(blur)) < 1 or side % 2 == 0:
            raise ValueError("a blur has an odd number of pixels")
        conversion, channels = COLOURS[colour], 1 if colour == "GRAY" else 3
        low, high = (np.broadcast_to(np.multiply(end, 1.0), channels) for end in ends)
        if whole and ends != NO_CHANGE["range"]:
            raise ValueError("the network takes uint8, whose range is 0 to 255")
    except (ValueError, TypeError, LookupError, OSError) as error:
        wanted = f"it may have {json.dumps(NO_CHANGE)} with other values, and colours {', '.join(COLOURS)}"
        raise UserError(f"{file}: does not tell how frames become the network's input ({error!r}); {wanted}") from None
    if len(shape) != 4 or channels not in (shape[1], shape[3]):
        wanted = f"(1, rows, columns, {channels}) or (1, {channels}, rows, columns), as for {colour}"
        raise ValueError(f"its input is {shape}, not {wanted}")
    last = shape[-1] == channels
    rows, columns = shape[1:3] if last else shape[2:]
    size = (columns, rows) if type(rows) is type(columns) is int else None
    scale = (high - low) / 255

    def prepare(frame: np.ndarray) -> np.ndarray:
        image = np.ascontiguousarray(frame[top : FRAME[0] - bottom, left : FRAME[1] - right])
        image = cv2.GaussianBlur(image, (side, side), 0)
        image = cv2.resize(image, size) if size and size != (image.shape[1], image.shape[0]) else image
        image = image if conversion is None else cv2.cvtColor(image, conversion)
        image = image.reshape(*image.shape[:2], channels)
        image = image if whole else (image * scale + low).astype(np.float32)
        return np.ascontiguousarray(image if last else image.transpose(2, 0, 1))[None]

    return prepare


def digest_of(file: Path) -> str:
    """Return a digest of a driver's file, and of those beside an ONNX file: how frames become its input, its weights.

    The weights may be in files that the ONNX file names.
    """
    parts, names = [file.read_bytes()] if file.is_file() else [], set[str]()
    if parts and file.suffix == ".onnx":
        # In its protobuf: the key "location", then a file's name after its length, in one or two bytes of 7 bits each.
        for key in re.finditer(rb"\n\x08location\x12([\x80-\xff]?[\0-\x7f])", parts[0]):
            low, high = (key[1] + b"\0")[:2]
            names.add(parts[0][key.end() : key.end() + low % 128 + 128 * high].decode(errors="replace"))
        beside = (file.with_suffix(".json"), *(file.parent / name for name in sorted(names)))
        parts += [each.read_bytes() for each in beside if each.is_file()]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def server_address(driver: str) -> tuple[str, int] | None:
    """Return the host and port that a driver is, None if it is a file or built in."""
    match = re.fullmatch(r"([\w.-]+|\[[\da-fA-F:.]+\]):(\d{1,5})", driver)  # in brackets: an IPv6 address
    return (match[1].strip("[]"), int(match[2])) if match and int(match[2]) <= MAX_PORT else None


def workers_for(driver: str, processes: int, scheduler: str | None) -> AbstractContextManager[Executor]:
    """Return `started_workers` for drives of a driver, one for a server. Raises UserError, also if there is no such.

    A server may take the cars that it drives for one and the same.
    """
    if address := server_address(driver):
        with closing(ClientSession(*address, WAIT)) as session:
            session.connect()
        if scheduler:
            raise UserError(f"{driver}: a server drives one car at a time; leave out --scheduler")
        return started_workers(1)
    if driver not in BUILT_IN:
        load_driver(driver)
    return started_workers(processes, scheduler)


# ----------------------------------------------------------------------------------------------------------------------
# Driving


def drive(conditions: Conditions, road: str | PointRoad, watch: Watch | None = None) -> Drive:
    """Drive a road as `python -m simulator drive` and drive.py do; road: as `Track` takes it. Raises UserError.

    A driver is sent the frame, steering, throttle, speed and time, and not where the car is. watch: called after each
    physics step with the run, and the cameras if the driver needs them.
    """
    with _ALONE:
        return _drive_with(conditions, road, watch)


def _drive_with(conditions: Conditions, road: str | PointRoad, watch: Watch | None) -> Drive:
    address = server_address(conditions.driver)
    if conditions.driver in BUILT_IN:
        return _drive(conditions, road, None, watch)
    if address is None:
        steering, known = load_driver(conditions.driver), conditions.foretell and load_limits_of(conditions.driver)
        alarms = list[float]()
        pilot = None if conditions.driver.endswith(".onnx") else Pilot(steering, Foreteller(*known) if known else None)

        def answer(image: bytes, run: Run) -> Answer:
            frame = decode(image)
            if not pilot:
                return Answer(float(format_number(steering(frame))))
            found, risk = pilot(frame, run.time, run.speed_mph * MPH)  # as in drive.py
            if risk is not None and risk >= ALARM:
                alarms.append(run.time)
            return Answer(float(format_number(float(found))))

        try:
            done = _drive(conditions, road, answer, watch)
            return replace(done, alarms=tuple(alarms)) if known else done
        except ArithmeticError as error:
            raise SimulatorError(f"{conditions.driver}: {error}; train the model again") from None
    with closing(ClientSession(*address, WAIT)) as session:

        def request(image: bytes, run: Run) -> Answer:
            session.receive_unasked()  # a server may answer twice
            packet = telemetry_packet(run.steering, run.throttle, run.speed_mph, image, time=run.time)
            answer = session.request_answer(packet)
            return answer if conditions.own_throttle else Answer(answer.steering)

        try:
            session.connect()
            session.receive_greeting()
            return _drive(conditions, road, request, watch)
        except ConnectionLost as error:
            raise SimulatorError(f"{conditions.driver}: {error}; restart the server") from None


@functools.lru_cache(maxsize=1)  # of several drives of a road one after another
def scene_of(road: str | PointRoad, look: int) -> Scene:
    """Return a road's scene; the same as for the last call, if that was for the same one."""
    return Scene.of(road, look)


def cameras_at(road: str | PointRoad, look: int) -> Cameras:
    """Return this process's cameras, on the car in this scene."""
    scene = scene_of(road, look)
    if not _cameras:
        _cameras.append(Cameras(scene, ("center",)))
    elif _cameras[0].scene is not scene:
        _cameras[0].move(scene)
    return _cameras[0]


def _drive(
    conditions: Conditions, road: str | PointRoad, answer: Callable[[bytes, Run], Answer] | None, watch: Watch | None
) -> Drive:
    track = Track(road, conditions.direction)
    run, clock = Run(track, "autonomous"), SampleClock(1 / SAMPLE_RATE)
    length = conditions.metres or track.length
    planned = length / (conditions.speed * MPH)
    if conditions.start:
        run.s, offset, turn = conditions.start
        run.set_back(offset, conditions.speed * MPH, math.radians(turn))
    cameras = cameras_at(road, conditions.look) if answer else None
    if cameras:
        cameras.disturb(conditions.disturbance, conditions.seed)
    expert = Expert(track, top_speed=conditions.speed * MPH, wander=0) if conditions.driver == "expert" else None
    controller, steering, throttle = SpeedController(conditions.speed), 0.0, 0.0
    position = run.car.node.get_pos()
    path = [(position.x, position.y)]
    late, ended = PATIENCE + 2 * planned, ""
    while not ended:
        command = Answer()
        if answer and cameras:
            command = answer(jpeg(cameras.frames(run.car.node.get_transform())[0]), run)
            steering = steering if command.steering is None else command.steering
        throttle = controller.throttle(run.speed_mph) if command.throttle is None else command.throttle
        due = False
        while not (due or ended):
            if not run.advance(expert.drive(run)[0] if expert else steering, throttle):
                if conditions.set_back and autonomy(len(run.departures), planned) > 0:
                    run.set_back()
                else:
                    ended = run.departures[-1].side
            elif run.travelled >= length or (run.at_end and conditions.metres is None):
                ended = "arrived"
            elif run.time > late:
                ended = "late"
            if watch:
                watch(run, cameras)
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
