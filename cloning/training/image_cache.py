"""Keep decoded images in memory: reading and decoding them is half of the generator's work."""

import itertools
from collections.abc import Callable, Hashable

import numpy as np

from cloning.recordings.format import FRAME

CACHED_IMAGES = 5_000  # 360 MB of cropped images


class ImageCache:
    """Keeps the first `capacity` images that are requested; threads may share it."""

    def __init__(self, rows: int, capacity: int = CACHED_IMAGES):
        """Reserve memory, which the system provides as it is filled; rows: of each image; capacity: images."""
        self._images = np.empty((capacity, rows, *FRAME[1:]), np.uint8)
        self._slots: dict[Hashable, int] = {}
        self._free = itertools.count()

    def get(self, key: Hashable, read: Callable[[], np.ndarray]) -> np.ndarray:
        """Return the image stored under `key`, else what `read` returns: uint8 (rows, 320, 3), not to be changed.

        If two threads request the same new key at once, both read the image and store equal copies.
        """
        if (slot := self._slots.get(key)) is not None:
            return self._images[slot]
        image = read()
        if (slot := next(self._free)) < len(self._images):
            self._images[slot] = image
            self._slots[key] = slot
        return image

    def __reduce__(self) -> tuple[type["ImageCache"], tuple[int, int]]:
        """Pickle the cache without its images: in another process it is empty."""
        return ImageCache, (self._images.shape[1], len(self._images))
