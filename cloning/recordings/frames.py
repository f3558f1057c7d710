"""Keep decoded frames in memory, so that checking, estimating the lane and training decode each one only once."""

import itertools
import math
import mmap
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cloning.base.frame import FRAME, ROAD_ROWS

ROAD_SHAPE = (ROAD_ROWS.stop - ROAD_ROWS.start, *FRAME[1:])  # (90, 320, 3)
KEPT_FRAMES = 5_000  # by a training run: 432 MB


class FrameCache:
    """Keeps the `ROAD_ROWS` of the first `capacity` frames that it is given; recordings and threads may share it."""

    def __init__(self, capacity: int = 0):
        """Reserve memory, which the system provides as it is filled; capacity: frames."""
        shape = (capacity, *ROAD_SHAPE)
        # Not np.empty, which asks for huge pages: in a virtual machine their first use took four times as long.
        self._kept = np.frombuffer(mmap.mmap(-1, max(math.prod(shape), 1)), np.uint8, math.prod(shape)).reshape(shape)
        self._slots: dict[tuple[Path, int], int] = {}
        self._free = itertools.count()

    def get(self, key: tuple[Path, int], read: Callable[[], np.ndarray]) -> np.ndarray:
        """Return a frame's `ROAD_ROWS`: uint8 (90, 320, 3), RGB, not to be changed.

        key: of the frame: folder of the recording, index of the image; read: returns the whole frame, if it is not
        kept yet. If two threads request a new frame at once, both read it and keep equal copies.
        """
        if (slot := self._slots.get(key)) is not None:
            return self._kept[slot]
        return self.put(key, read())

    def put(self, key: tuple[Path, int], frame: np.ndarray) -> np.ndarray:
        """Keep a frame, uint8 (160, 320, 3), if there is room; return what `get` does."""
        road = frame[ROAD_ROWS]
        if len(self._slots) < len(self._kept) and (slot := next(self._free)) < len(self._kept):
            self._kept[slot] = road
            self._slots[key] = slot
        return road

    def __reduce__(self) -> tuple[type["FrameCache"], tuple[int]]:
        """Pickle the cache without its frames: in another process it is empty."""
        return FrameCache, (len(self._kept),)
