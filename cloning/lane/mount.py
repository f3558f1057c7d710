"""Finds out in a drive how its camera is turned and shifted, and moves the frames back to how the networks know them.

A camera that is rolled by 14 degrees, or looks 20 pixels to the side, leads a network off the road that drives well
through the same frames moved back. How it is mounted shows in what all frames of a drive share, so the mean of the last
frames is read, in which rain and the roadside's details blur. A small network is given the directions of the edges
there (by the structure tensor: Bigun and Granlund, "Optimal orientation detection of linear symmetry", 1987), and
tells the mounting, and how sure it is. `python -m tools.train_mount` trained it, on rendered frames only.

A mounting is (right, down, turn): by how many pixels the picture is further to the right and down, after it was turned
about its middle, in degrees anticlockwise; 0, 0, 0 is the simulator's.
"""

import functools
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from cloning.base.errors import ModelError
from cloning.base.frame import FRAME
from cloning.network import tensors
from cloning.road.disturbances import moved

WEIGHTS = Path(__file__).with_name("mount.pt")
REMEDY = "train the network anew with `python -m tools.train_mount`"
PICTURE = FRAME[0] // 2, FRAME[1] // 2  # rows and columns of the mean picture
MEMORY = 24  # frames of which it is the mean
CELLS = 10, 20  # rows and columns of the cells in which directions are told
SCALES = 3  # of the picture, each half as large as the one before
ODD = (-1.0, 1.0, 1.0)  # factors of `directions` in the mirror image
# Pixels, pixels and degrees. UNITS: in which the network computes; LEAST: from which a mounting counts, if it is also
# greater than CERTAIN standard deviations; once it counts, half of both is enough.
UNITS, LEAST, CERTAIN = (10.0, 10.0, 8.0), np.array([12.0, 9.0, 6.0]), 2.0
WORDS = ("pixels to the right", "pixels to the left"), ("pixels down", "pixels up"), ("° anticlockwise", "° clockwise")
FIRST, EVERY = 6, 3  # frames before the first reading, and from one to the next
FADING = 0.95  # of a reading's weight until the next
NOISE = 1.0  # squared gradient, grey levels a pixel, that has no direction


class MeanPicture:
    """The mean of a drive's last frames, in grey and half as large."""

    def __init__(self) -> None:
        self.grey, self.frames = np.zeros(PICTURE, np.float32), 0

    def add(self, frame: np.ndarray) -> None:
        """Add the next frame, uint8 (160, 320, 3) RGB."""
        self.frames += 1
        small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), PICTURE[::-1], interpolation=cv2.INTER_AREA)
        cv2.accumulateWeighted(small, self.grey, 1 / min(self.frames, MEMORY))

    def directions(self) -> np.ndarray:
        """Return how strong its edges are and where they point, in cells: float32 (3 SCALES, 10, 20).

        For each scale the sine and cosine of the doubled angle, shorter where directions differ, and the logarithm of
        the squared gradient.
        """
        found = list[np.ndarray]()
        grey: np.ndarray = self.grey
        for _ in range(SCALES):
            across, down = (
                cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8),
                cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8),
            )
            products = across * across, down * down, across * down
            xx, yy, xy = (cv2.resize(each, CELLS[::-1], interpolation=cv2.INTER_AREA) for each in products)
            total = xx + yy + NOISE
            found += [2 * xy / total, (xx - yy) / total, np.log(total) / 4]
            grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return np.stack(found)


class MountNetwork(nn.Module):
    """Tells mountings from directions; the mirror image gives the mirrored mounting."""

    def __init__(self, hidden: int = 96, dropout: float = 0.1):
        super().__init__()
        inputs = SCALES * len(ODD) * CELLS[0] * CELLS[1]
        into, out = nn.Linear(inputs, hidden), nn.Linear(hidden, 2 * len(UNITS))
        self.dense = nn.Sequential(nn.Dropout(dropout), into, nn.ReLU(), nn.Dropout(dropout), out)

    def forward(self, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mountings and their standard deviations, both float32 (n, 3), in UNITS.

        directions: float32 (n, 3 SCALES, 10, 20).
        """
        odd = directions.new_tensor(ODD * SCALES)[:, None, None]
        seen, mirrored = (self.dense(each.flatten(1)) for each in (directions, directions.flip(-1) * odd))
        mounts = (seen[:, :3] + mirrored[:, :3] * directions.new_tensor((-1, 1, -1))) / 2
        return mounts, ((seen[:, 3:] + mirrored[:, 3:]) / 2).clamp(-4, 3).exp()


def save_network(path: Path, network: MountNetwork) -> None:
    """Write the network's weights to a file, in half precision, which is enough. Raises OSError."""
    tensors.save(path, {name: value.half() for name, value in network.state_dict().items()})


@functools.cache
def load_network(path: Path = WEIGHTS) -> MountNetwork:
    """Return the network with the weights of a file. Raises ModelError."""
    weights, network = tensors.load(path, REMEDY), MountNetwork()
    del weights["digest"]
    try:
        network.load_state_dict(tensors.matching(weights, network.state_dict()))
    except ValueError as error:
        raise ModelError(f"{path}: holds no weights of the network for mountings: {error}; {REMEDY}") from None
    return network.eval()


class Mount:
    """How the camera of one drive is mounted, whose frames it is given one after the other."""

    def __init__(self, network: MountNetwork | None = None):
        """network: None: the one that comes with the project. Raises ModelError."""
        self.network = network or load_network()
        self.picture, self.frame = MeanPicture(), np.empty(0, np.uint8)
        self.sums = np.zeros((3, 3))  # over the readings: their weights, weighted mountings, and numbers
        self.found = np.zeros(3)  # the mounting; 0 for each of the three that is not certain

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """Return the next frame, uint8 (160, 320, 3) RGB, as the simulator's camera would see it."""
        if not np.array_equal(frame, self.frame):  # one that repeats tells nothing new
            self.frame = frame
            self.picture.add(frame)
            if self.picture.frames >= FIRST and self.picture.frames % EVERY == 0:
                self._read()
        return moved(frame, self.found, back=True) if self.found.any() else frame

    def __str__(self) -> str:
        """Say how the picture is moved."""
        moves = zip(self.found.tolist(), WORDS, strict=True)
        return ", ".join(f"{abs(move):.0f} {words[move < 0]}" for move, words in moves if move).replace(" °", "°")

    def _read(self) -> None:
        """Read the mean picture, and weigh what it tells with the readings before."""
        with torch.inference_mode():
            mount, deviation = self.network(torch.from_numpy(self.picture.directions())[None])
        mount, deviation = (each[0].numpy().astype(float) * UNITS for each in (mount, deviation))
        weight = 1 / deviation**2
        self.sums = np.stack([weight, weight * mount, np.ones(3)]) + FADING * self.sums
        weights, weighted, readings = self.sums
        # Successive readings err alike: the mean is no more certain than a single one.
        mount, deviation = weighted / weights, np.sqrt(readings / weights)
        counts = np.abs(mount) > np.maximum(CERTAIN * deviation, LEAST) * np.where(self.found, 0.5, 1)
        self.found = np.where(counts, mount, 0)
