"""Finds out in a drive how its camera is turned and shifted, and moves the frames back to how the networks know them.

A network that drives well leaves the road if the camera is rolled by 14 degrees, or looks 20 pixels to the side; with
the frames moved back it does not. How the camera is mounted shows in what all frames of a drive share, so the mean of
the last ones is read, in which rain and the roadside's details blur. A small network is given the directions of the
edges there (by the structure tensor: Bigun and Granlund, "Optimal orientation detection of linear symmetry", 1987), and
tells the mounting and how sure it is. `python -m tools.train_mount` trained it, on rendered frames only.

A mounting is (right, down, turn): the picture is turned about its middle by so many degrees anticlockwise, then moved
by so many pixels to the right and down. That of the simulator's camera is (0, 0, 0).
"""

import functools
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from cloning.base.frame import FRAME
from cloning.network import tensors
from cloning.road.disturbances import moved

WEIGHTS = Path(__file__).with_name("mount.pt")
REMEDY = "train the network anew with `python -m tools.train_mount`"
PICTURE = FRAME[0] // 2, FRAME[1] // 2  # rows and columns of the mean picture
MEMORY = 24  # frames in which it forgets
CELLS = 10, 20  # rows and columns of the cells in which directions are told
SCALES = 3  # of the picture, each half as large as the one before
DROPOUT = 0.2  # in training
NOISE = 1.0  # added to the squared gradient, (grey levels a pixel)²: weaker edges tell no direction
# Factors by which sine, cosine and strength of a direction, and a mounting, differ in the mirror image.
MIRRORED_DIRECTION, MIRRORED_MOUNT = (-1.0, 1.0, 1.0), (-1.0, 1.0, -1.0)
UNITS = np.array([10.0, 10.0, 8.0])  # of a mounting, pixels, pixels and degrees, in which the network computes
LEAST = np.array([12.0, 9.0, 6.0])  # likewise: a smaller mounting does not count
CERTAIN = 2.0  # standard deviations: nor does one that is smaller than these
HELD = 0.5  # share of either that is enough for what counts already
FIRST, EVERY = 12, 3  # frames before the first reading, and from one to the next
FADING = 0.95  # share of a reading's weight that is left at the next
WORDS = (
    (" pixels to the right", " pixels to the left"),
    (" pixels down", " pixels up"),
    ("° anticlockwise", "° clockwise"),
)


class MeanPicture:
    """The mean of a drive's last frames, in grey and half as large."""

    def __init__(self) -> None:
        self.grey, self.frames, self.last = np.zeros(PICTURE, np.float32), 0, np.empty(0, np.uint8)

    def add(self, frame: np.ndarray) -> bool:
        """Add the next frame, uint8 (160, 320, 3) RGB; return False for one that repeats, which tells nothing new."""
        if np.array_equal(frame, self.last):
            return False
        self.last, self.frames = frame, self.frames + 1
        small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), PICTURE[::-1], interpolation=cv2.INTER_AREA)
        cv2.accumulateWeighted(small, self.grey, 1 / min(self.frames, MEMORY))
        return True

    def directions(self) -> np.ndarray:
        """Return how strong its edges are and where they point, in cells: float32 (3 SCALES, 10, 20).

        For each scale the sine and cosine of the doubled angle, shorter where directions differ, and the logarithm of
        the squared gradient.
        """
        found = list[np.ndarray]()
        grey: np.ndarray = self.grey
        for _ in range(SCALES):
            across, down = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
            products = across * across, down * down, across * down
            xx, yy, xy = (cv2.resize(each, CELLS[::-1], interpolation=cv2.INTER_AREA) for each in products)
            total = xx + yy + NOISE
            found += [2 * xy / total, (xx - yy) / total, np.log(total) / 4]
            grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return np.stack(found)


class MountNetwork(nn.Module):
    """Tells mountings from directions; the mirror image gives the mirrored mounting."""

    def __init__(self, hidden: int = 96):
        super().__init__()
        inputs = SCALES * len(MIRRORED_DIRECTION) * CELLS[0] * CELLS[1]
        into, out = nn.Linear(inputs, hidden), nn.Linear(hidden, 2 * len(UNITS))
        self.dense = nn.Sequential(nn.Dropout(DROPOUT), into, nn.ReLU(), nn.Dropout(DROPOUT), out)

    def forward(self, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mountings and their standard deviations, both float32 (n, 3), in UNITS.

        directions: float32 (n, 3 SCALES, 10, 20).
        """
        mirrored = directions.flip(-1) * directions.new_tensor(MIRRORED_DIRECTION * SCALES)[:, None, None]
        seen, other = self.dense(directions.flatten(1)), self.dense(mirrored.flatten(1))
        mounts = (seen[:, :3] + other[:, :3] * directions.new_tensor(MIRRORED_MOUNT)) / 2
        return mounts, ((seen[:, 3:] + other[:, 3:]) / 2).clamp(-4, 3).exp()


@functools.cache
def load_network(path: Path = WEIGHTS) -> MountNetwork:
    """Return the network with the weights of a file. Raises ModelError."""
    network = MountNetwork()
    tensors.load_weights(path, network, "the network for mountings", REMEDY)
    return network.eval()


def counts(mount: np.ndarray, deviation: np.ndarray, share: np.ndarray | float = 1.0) -> np.ndarray:
    """Return for each of a mounting's three whether it is certainly not 0: bool (…, 3).

    mount, deviation: float (…, 3), pixels, pixels and degrees; share: (…, 3), of the limits, that is enough.
    """
    return np.abs(mount) > np.maximum(CERTAIN * deviation, LEAST) * share


class Mount:
    """How the camera of one drive is mounted, whose frames it is given one after the other.

    It stays the same camera, so it is remembered over pauses, and over places to which the car is set back.
    """

    def __init__(self, network: MountNetwork | None = None):
        """network: None: the one that comes with the project. Raises ModelError."""
        self.network, self.picture = network or load_network(), MeanPicture()
        # Sums over the readings: of their weights, of the mountings times these, and their number
        self.weights, self.weighted, self.readings = np.zeros(3), np.zeros(3), 0.0
        self.found = np.zeros(3)  # the mounting, 0 where it does not count

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """Return the next frame, uint8 (160, 320, 3) RGB, as the simulator's camera would see it."""
        if self.picture.add(frame) and self.picture.frames >= FIRST and self.picture.frames % EVERY == 0:
            self._read()
        return moved(frame, self.found, back=True) if self.found.any() else frame

    def __str__(self) -> str:
        """Say how the picture is moved."""
        moves = zip(self.found.tolist(), WORDS, strict=True)
        return ", ".join(f"{abs(move):.0f}{words[move < 0]}" for move, words in moves if move)

    def _read(self) -> None:
        """Read the mean picture, and weigh what it tells with the readings before."""
        with torch.inference_mode():
            mount, deviation = self.network(torch.from_numpy(self.picture.directions())[None])
        weight = (deviation[0].numpy() * UNITS) ** -2
        self.weights = FADING * self.weights + weight
        self.weighted = FADING * self.weighted + weight * mount[0].numpy() * UNITS
        self.readings = FADING * self.readings + 1
        # Successive readings err alike: their mean is no more certain than one of them.
        mean, uncertain = self.weighted / self.weights, np.sqrt(self.readings / self.weights)
        self.found = np.where(counts(mean, uncertain, np.where(self.found, HELD, 1)), mean, 0)
