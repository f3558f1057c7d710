"""Rendered views of the tracks; a process builds each scene once for all its tests."""

import functools
from concurrent.futures import Executor, Future
from pathlib import Path

import cv2
import numpy as np
import pytest

from cloning.recordings.log import Recording, read_recording
from cloning.road.track import Track
from simulator import record, scenery
from simulator.cameras import Cameras
from simulator.car import STEP
from simulator.run import Run
from simulator.world import Scene


@functools.cache
def cameras(track: str, look: int) -> Cameras:
    return Cameras(Scene(scenery.build(track, look)))


def view(track: str, look: int, s: float = 300.0, offset: float = 0.0) -> np.ndarray:
    """What the three cameras see from the lane's centre or `offset` m right of it, s metres along: int, RGB."""
    run = Run(Track(track))
    run.s = s
    run.set_back(offset)
    return cameras(track, look).frames(run.car.node.get_transform()).astype(int)


class Here(Executor):
    """Does in this process at once what is submitted."""

    def __init__(self, *_, **__):
        pass

    def submit(self, function, /, *arguments, **more):
        done: Future = Future()
        done.set_result(function(*arguments, **more))
        return done


def recorded(
    folder: Path, track: Track, laps: float, speed: float, seed: int = 3, look: int = 0
) -> tuple[Recording, np.ndarray]:
    """What the expert drives, and the true lateral offset of each row, m; rendered with this process's own scenes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record, "started_workers", Here)
        patch.setattr(record, "_cameras", lambda view: cameras(*view[:2]))
        run, _ = record.record(folder, track, laps, speed, seed, look)
    recording = read_recording(folder)
    steps = np.round((recording.time - recording.time[0]) / STEP).astype(int)
    return recording, np.array(run.trajectory.offset)[steps]


def load(path: str | Path) -> np.ndarray:
    """A picture in a file: uint8, BGR."""
    picture = cv2.imread(str(path))
    assert picture is not None, path
    return picture
