"""Where in its lane the car is, read out of frames by a small network that knows many drawn roads and some real ones.

Of each frame it tells where the lane's centre lies at some distances ahead. The car's own motion lays what its frames
have seen together, so that the centre is known beside the car, too, where no camera looks: from the frames of a second
ago. `tools/train_lane.py` trains the network; `lane.pt` comes with the project.
"""

import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from cloning.compute import choose_precision, in_precision, one_thread, threads
from cloning.errors import ModelError
from cloning.recordings.images import decode
from cloning.recordings.log import Recording
from cloning.road.camera import CAMERA_MATRIX, CAMERA_OFFSETS, CAMERA_PITCH, INTRINSICS
from cloning.road.motion import AXLE_TO_CAMERA, MAX_GAP, REAR_AXLE, Stretch

SHIPPED = Path(__file__).with_name("lane.pt")
STRIP = (32, 160, 3)  # rows, columns, RGB
TOP = 60  # of the frame's rows: the horizon; 64 rows further down begins what the bonnet tints in the JPEG
AHEAD = np.array([3.0, 4.5, 6.5, 9.0, 13.0], np.float32)  # m before the camera
MOUNT_OFFSETS = np.array(list(CAMERA_OFFSETS.values()), np.float32)  # m to the right: centre, left, right
BATCH = 48  # strips that a thread works through at once

BEHIND = 40  # rows that may have seen the road beside the car
BESIDE = 4.0  # m before and behind the car's middle over which the centre is laid through what was seen of it
WINDOW = 15  # rows, one second, over which the cameras are compared
TOLERANCE = 0.3  # m by which the side cameras may stand elsewhere than where they are mounted, over a window
SCATTER = 0.9  # m that what the frames of a second have seen of the centre may lie beside it, over a window

# A camera that looks straight ahead and stands upright.
LEVEL = INTRINSICS @ cv2.Rodrigues(np.array([np.radians(CAMERA_PITCH), 0, 0]))[0]
HALF = np.array([[2, 0, 0.5], [0, 2, TOP + 0.5], [0, 0, 1]])  # from a strip's pixels to its frame's
TO_FRAME = CAMERA_MATRIX @ np.linalg.inv(LEVEL) @ HALF


def strip(frame: np.ndarray) -> np.ndarray:
    """A frame's road as the network sees it: uint8 (160, 320, 3) -> uint8 (32, 160, 3).

    At half the resolution, and turned as if the camera looked straight ahead and stood upright: the mirror image of a
    strip is the strip of the mirrored world.
    """
    return cv2.warpPerspective(
        frame, TO_FRAME, STRIP[1::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )


def normal(picture: np.ndarray) -> np.ndarray:
    """A strip, uint8, with each colour's mean 0 and a common deviation of 1: float32 (32, 160, 3)."""
    mean, deviation = cv2.meanStdDev(picture)
    scale = 1 / (np.sqrt(np.mean(deviation**2)) + 4)  # so that a plain picture's noise is not blown up
    table = (np.arange(256)[:, None] - mean.T) * scale
    return cv2.LUT(picture, table.astype(np.float32)[None])


class LaneNetwork(nn.Module):
    """296,773 parameters. forward: normalised strips float32 (n, 32, 160, 3) -> float32 (n, 5).

    The metres by which the lane's centre lies to the right of the camera, at the distances AHEAD of it.
    """

    def __init__(self):
        super().__init__()
        shapes = [(3, 24, 5, 2), (24, 32, 3, 2), (32, 48, 3, 2), (48, 64, 3, (1, 2))]
        self.convolutions = nn.Sequential(
            *(
                layer
                for into, out, kernel, stride in shapes
                for layer in (
                    nn.Conv2d(into, out, kernel, stride, kernel // 2, bias=False),
                    nn.BatchNorm2d(out),
                    nn.ReLU(),
                )
            )
        )
        self.dense = nn.Sequential(nn.Linear(64 * 4 * 10, 96), nn.ReLU(), nn.Linear(96, len(AHEAD)))

    def forward(self, strips: torch.Tensor) -> torch.Tensor:
        x = strips.permute(0, 3, 1, 2)  # in memory still channels last
        return self.dense(self.convolutions(x).flatten(1)).float()

    def both_ways(self, strips: torch.Tensor) -> torch.Tensor:
        """The mean of what the strips and, turned back, their mirror images say: a road has no preferred side."""
        both = self(torch.cat([strips, strips.flip(2)]))
        return (both[: len(strips)] - both[len(strips) :]) / 2


@functools.cache
def load(path: str | Path = SHIPPED) -> LaneNetwork:
    """The trained network. Raises ModelError."""
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
        network = LaneNetwork()
        network.load_state_dict(weights)
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file; `python -m tools.train_lane` trains one") from None
    except Exception as error:
        raise ModelError(f"{path}: no weights of this project's lane network ({type(error).__name__})") from error
    return network.to(memory_format=torch.channels_last).eval()


def estimate(strips: np.ndarray, network: LaneNetwork | None = None) -> np.ndarray:
    """Where the lane's centre lies ahead, in each of some strips, uint8 (n, 32, 160, 3): float32 (n, 5).

    Metres to the right of the camera that saw it, at the distances AHEAD of it.
    """
    network = network or load()
    device = torch.device("cpu")
    precision = choose_precision(device)

    def part(at: int) -> np.ndarray:
        entered = torch.from_numpy(np.stack([normal(one) for one in strips[at : at + BATCH]]))
        with torch.inference_mode(), in_precision(precision, device):
            return network.both_ways(entered).numpy()

    with ThreadPoolExecutor(threads(), initializer=one_thread) as pool:
        return np.concatenate([np.empty((0, len(AHEAD)), np.float32), *pool.map(part, range(0, len(strips), BATCH))])


@dataclass
class Lane:
    """The car's place in its lane, a value a row of a recording.

    offset   float32 (n,): m to the right of the lane's centre, of the car's middle
    yaw      float32 (n,): radians by which the car points to the right of the road beside it
    trusted  bool (n,): the three cameras stand to one another as they are mounted, and what they see keeps its place
             while the car drives on, or the drive was found on a known road (`roads.py`); else the two mean nothing
    """

    offset: np.ndarray
    yaw: np.ndarray
    trusted: np.ndarray


def read_strips(recording: Recording) -> np.ndarray:
    """The strips of a recording's three cameras: uint8 (n, 3, 32, 160, 3). Raises OSError, ValueError."""
    strips = np.empty((len(recording), 3, *STRIP), np.uint8)

    def read(row: int) -> None:
        for camera in range(3):
            strips[row, camera] = strip(decode(recording.path(row, camera).read_bytes()))

    with ThreadPoolExecutor(threads()) as pool:
        for _ in pool.map(read, range(len(recording))):
            pass
    return strips


def see(recording: Recording, network: LaneNetwork | None = None) -> np.ndarray:
    """What the three cameras, centre, left, right, see of the lane's centre in each row: float32 (n, 3, 5).

    Raises OSError, ValueError for images that can't be read.
    """
    return estimate(read_strips(recording).reshape(-1, *STRIP), network).reshape(-1, 3, len(AHEAD))


def combine(recording: Recording, seen: np.ndarray) -> Lane:
    """One lane from what the three cameras, centre, left, right, see in each row: float32 (n, 3, 5).

    Nothing is laid together over a break in time.
    """
    seen = seen + MOUNT_OFFSETS[:, None]
    pause = np.diff(recording.time)
    breaks = np.flatnonzero((pause <= 0) | (pause > MAX_GAP)) + 1
    edges = [0, *breaks.tolist(), len(recording)]
    parts = [_stretch(recording, slice(a, b), seen[a:b]) for a, b in itertools.pairwise(edges)]
    return Lane(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _stretch(recording: Recording, rows: slice, seen: np.ndarray):
    """Offset, yaw and trust over rows without a break; seen: (n, 3, 5), m to the right of the car's middle line."""
    aside = _smoothed(seen[:, 1:] - seen[:, :1])[..., :2]  # nearest: further ahead a metre is few pixels
    stretch = Stretch.of(recording, rows)
    right, forward, heading = stretch.right, stretch.forward, stretch.heading
    ahead = AHEAD + AXLE_TO_CAMERA  # of the rear axle, whose way is known
    s, c = np.sin(heading)[:, None], np.cos(heading)[:, None]
    centre = seen.mean(1)
    there = np.stack([right[:, None] + ahead * s + centre * c, forward[:, None] + ahead * c - centre * s], axis=-1)
    offset, yaw, scatter = np.empty((3, len(seen)), np.float32)
    for at in range(len(seen)):
        away = there[max(0, at - BEHIND) : at + 1].reshape(-1, 2) - (right[at], forward[at])
        x = away @ (c[at, 0], -s[at, 0])
        z = away @ (s[at, 0], c[at, 0]) - REAR_AXLE
        # Quadratic, by least squares: what was seen near the car's middle counts most, what was seen from near by more.
        weight = np.tile(1 / (1 + AHEAD / 6), len(x) // len(AHEAD)) / (1 + (z / BESIDE) ** 4)
        powers = np.stack([np.ones_like(z), z, z * z / 2]) * weight
        damped = powers @ powers.T + np.diag([0, 1e-2, 1.0])  # a road's curvature is 0.1 at most
        curve = np.linalg.solve(damped, powers @ (x * weight))
        scatter[at] = np.linalg.norm(x * weight - curve @ powers) / np.linalg.norm(weight)
        a, b, _ = curve
        yaw[at] = -np.arctan(b)
        offset[at] = -a * np.cos(yaw[at])
    trusted = (np.abs(aside) < TOLERANCE).all((1, 2)) & (_smoothed(scatter) < SCATTER)
    return offset, yaw, trusted


def _smoothed(values: np.ndarray) -> np.ndarray:
    """Values (n, …) averaged over a window, weighted towards its middle; at the ends over what there is of it."""
    weights = np.hanning(WINDOW + 2)[1:-1].astype(np.float32)
    shape = (-1,) + (1,) * (values.ndim - 1)
    padded = np.pad(values, [(WINDOW // 2, WINDOW // 2)] + [(0, 0)] * (values.ndim - 1))
    here = np.pad(np.ones(len(values), np.float32), WINDOW // 2)
    total = sum(weight * padded[k : k + len(values)] for k, weight in enumerate(weights))
    share = sum(weight * here[k : k + len(values)] for k, weight in enumerate(weights))
    return total / share.reshape(shape)
