"""Rendered views of the tracks; a process builds each scene once for all its tests."""

import functools
from pathlib import Path

import cv2
import numpy as np

from cloning.road.track import Track
from simulator import scenery
from simulator.cameras import Cameras
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


def load(path: str | Path) -> np.ndarray:
    """A picture in a file: uint8, BGR."""
    picture = cv2.imread(str(path))
    assert picture is not None, path
    return picture
