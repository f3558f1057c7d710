"""Decoded images kept in memory, because reading and decoding them is half the generator's work."""

import itertools
from collections.abc import Callable, Hashable

import numpy as np

from cloning.recordings.format import FRAME

CACHED_IMAGES = 5_000  # 360 MB of cropped images


class ImageCache:
    """Keeps the first `capacity` images that are asked for; the threads of a pool may share it."""

    def __init__(self, rows: int, capacity: int = CACHED_IMAGES):
        """Reserve room for images of so many rows; the system takes memory only as it is filled."""
        self._images = np.empty((capacity, rows, *FRAME[1:]), np.uint8)
        self._slots: dict[Hashable, int] = {}
        self._free = itertools.count()

    def get(self, key: Hashable, read: Callable[[], np.ndarray]) -> np.ndarray:
        """The image stored under `key`, or else the one that `read` returns: uint8 (rows, 320, 3), not to be changed.

        Two threads that miss the same key at once both read it and store equal copies.
        """
        if (slot := self._slots.get(key)) is not None:
            return self._images[slot]
        image = read()
        if (slot := next(self._free)) < len(self._images):
            self._images[slot] = image
            self._slots[key] = slot
        return image

    def __reduce__(self) -> tuple[type["ImageCache"], tuple[int, int]]:
        """Pickle no images: another process begins with an empty cache."""
        return ImageCache, (self._images.shape[1], len(self._images))
