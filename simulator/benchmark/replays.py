"""The benchmark's replays of real recordings: see `cloning.replay`."""

from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError, SimulatorError
from cloning.base.frame import FRAME
from cloning.network.compute import one_thread
from cloning.recordings.format import DRIVING_LOG
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import Driver, ReplayFrame, drive, load_recording, reference_lines
from cloning.replay.server_driver import ServerDriver
from cloning.road.autonomy import LIMITS
from simulator.benchmark.scores import Driven, percent
from simulator.benchmark.tasks import RECORDINGS
from simulator.driving import WAIT, load_driver, server_address


def folders(parent: Path) -> list[Path]:
    """Return the folders of the recordings, which are in this one. Raises RecordingError."""
    found = [parent / name for name in RECORDINGS]
    for folder in found:
        if not (folder / DRIVING_LOG).is_file():
            raise RecordingError(f"{folder}: no {DRIVING_LOG}; data/README.md says where this recording is from")
    return found


def replay(driver: str, folder: Path) -> Driven:
    """Let a driver, as in `Conditions`, drive a recording at the limit that is near the road's edge. Raises UserError.

    In any process, it gives the same.
    """
    one_thread()
    recording = load_recording(folder)
    done = drive(recording, reference_lines(recording), LIMITS[1], driver_of(driver))
    offset, passed = np.abs(done.offset), np.cumsum(done.seconds)
    return {
        "group": "replays",
        "name": folder.name,
        "score": percent(done.autonomy()),
        "departures": [round(float(passed[entry]), 2) for entry in done.interventions],
        "ended": "arrived",
        "mean_m": round(float(offset.mean()), 3),
        "farthest_m": round(float(offset.max()), 3),
        "alarms": None,
    }


def driver_of(driver: str) -> Driver:
    """Return a driver, as in `Conditions`, of replays; the expert is the recovery steering. Raises UserError.

    A model's steering is corrected as in drives.
    """
    if driver == "straight":
        return lambda frame: 0.0
    if driver == "expert":
        return ReplayFrame.recovery_steering
    if address := server_address(driver):
        return ServerDriver(*address, WAIT)
    if not driver.endswith(".onnx"):
        one_thread()
        return ModelDriver(driver)
    steering, rows = load_driver(driver), slice(0, FRAME[0])

    def steer(frame: ReplayFrame) -> float:
        try:
            return steering(frame.received(rows))
        except ArithmeticError as error:
            raise SimulatorError(f"{driver}: {error}; train the model again") from None

    return steer
