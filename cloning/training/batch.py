"""Batches: the random choices from which one is made, and its images and labels."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cloning.training.observations import Views


class Choices(NamedTuple):
    """The random choices for one batch: n observations, from which m images are made.

    observation  int (n,): indices of the observations
    camera       int (n,): the camera whose image is used, 0 centre, 1 left, 2 right
    slots        int (n, augmentations): where in the batch each image is, -1 if it is not made
    keep         bool (m, 4224): the units of the flattened layer that dropout keeps; None: all
    augmenting   each augmentation's choices: arrays of n entries each
    views        the images before augmentation, and the labels
    """

    observation: np.ndarray
    camera: np.ndarray
    slots: np.ndarray
    keep: np.ndarray | None
    augmenting: list[tuple[np.ndarray, ...]]
    views: Views


@dataclass
class Batch:
    """One process's share of a batch.

    images  uint8 (n, 75, 320, 3), RGB, cropped
    labels  float32 (n,): steering, -1..1
    keep    bool (n, units): the units of the flattened layer that dropout keeps; None: all
    total   images in the whole batch, of all processes
    """

    images: np.ndarray
    labels: np.ndarray
    keep: np.ndarray | None
    total: int

    def part(self, piece: slice) -> "Batch":
        """Return some of the images."""
        keep = None if self.keep is None else self.keep[piece]
        return Batch(self.images[piece], self.labels[piece], keep, self.total)
