"""Estimates the car's lateral offset and heading error in its lane from camera frames, with a small network.

The network detects where the lane's centre lies at some distances ahead of a camera. With the car's motion, detections
from frames that were taken a second earlier show the centre next to the car, too, where no camera looks.

`tools/train_lane.py` trains the network. Two sets of weights come with the project: `lane.pt`, trained on the lake and
jungle tracks alone, reads these more accurately, also where a frame hardly shows the lane; `any_road.pt`,
trained on generated roads and shadows as well, reads any road.
"""

import copy
import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from cloning.base.frame import FRAME, ROAD_ROWS
from cloning.base.outputs import as_typed
from cloning.lane.recovery import LanePosition
from cloning.network import tensors
from cloning.network.compute import choose_precision, in_precision, one_thread, threads
from cloning.recordings.log import Recording
from cloning.road.camera import CAMERA_MATRIX, CAMERA_OFFSETS, LEVEL_CAMERA_MATRIX
from cloning.road.motion import AXLE_TO_CAMERA, MAX_GAP, REAR_AXLE, Stretch

SHIPPED_WEIGHTS = Path(__file__).with_name("lane.pt")
ANY_ROAD_WEIGHTS = Path(__file__).with_name("any_road.pt")
STRIP_SHAPE = (32, 160, 3)  # rows, columns, RGB
FIRST_ROW = 60  # of the level frame that a strip shows: the horizon; the bonnet tints the JPEG 64 rows further down
DISTANCES_AHEAD = np.array([3.0, 4.5, 6.5, 9.0, 13.0], np.float32)  # m from the camera
MOUNT_OFFSETS = np.array(list(CAMERA_OFFSETS.values()), np.float32)  # m to the right: centre, left, right
STRIPS_PER_PIECE = 48  # that a thread computes at once

PAST_ROWS, PAST_METRES = 40, 12.0  # earlier rows whose detections may lie next to the car
FITTED = 4  # of the detections of a camera, the nearest: in hairpins the lane is out of sight further ahead
# Detections this far (m) from the centre line count less in the next of so many rounds: in hairpins many are wrong.
OUTLIER, ROUNDS = 0.3, 3
FIT_LENGTH = 4.0  # m before and behind the car's middle: detections within this distance decide the fit
SMOOTHING_ROWS = 15  # one second, over which cameras are compared and residuals averaged
MAX_CAMERA_ERROR = 0.3  # m, smoothed: difference between the centres that the side cameras and the centre one detect
# On roads of another width or kind the network sees too small distances across the road: the side cameras, whose
# distance is known, seem to be so many times too close together. The offset is seen at about the square root of that.
SCALE_ROWS, MIN_SCALE = 225, 0.4  # 15 s, over which this scale is averaged; cameras that seem closer don't agree
# m, smoothed: between the detections and the centre line fitted to them. With 0.4, a real drive in the jungle loses a
# tenth of its rows; with 0.6, roads drawn without regard to the camera are trusted.
MAX_RESIDUAL = 0.5

# A strip is a level camera's frame at half the resolution, from FIRST_ROW down. These matrices, (3, 3), lead from a
# strip's pixels to those of the level camera's frame and to those of the real camera's.
STRIP_TO_LEVEL = np.array([[2, 0, 0.5], [0, 2, FIRST_ROW + 0.5], [0, 0, 1]])
STRIP_TO_FRAME = CAMERA_MATRIX @ np.linalg.inv(LEVEL_CAMERA_MATRIX) @ STRIP_TO_LEVEL
DIRECTION_TO_STRIP = np.linalg.inv(STRIP_TO_LEVEL) @ LEVEL_CAMERA_MATRIX  # (3, 3), of a ray from the level camera


def extract_strip(frame: np.ndarray) -> np.ndarray:
    """Warp a frame's road to what the network sees: uint8 (160, 320, 3) -> uint8 (32, 160, 3).

    The strip has half the resolution and is seen by a camera that looks straight ahead and is not rolled, so that the
    mirror image of a strip is the strip of the mirrored world. Only the frame's `ROAD_ROWS` matter.
    """
    size, flags = STRIP_SHAPE[1::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(frame, STRIP_TO_FRAME, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def normalize(strip: np.ndarray) -> np.ndarray:
    """Scale a strip, uint8, to mean 0 for each colour and a common standard deviation of 1: float32 (32, 160, 3)."""
    mean, deviation = cv2.meanStdDev(strip)
    scale = 1 / (np.sqrt(np.mean(deviation**2)) + 4)  # + 4, so that the noise of a plain strip is not amplified
    table = (np.arange(256)[:, None] - mean.T) * scale
    return cv2.LUT(strip, table.astype(np.float32)[None])


class LaneNetwork(nn.Module):
    """The network that detects the lane's centre in strips; 296,773 parameters.

    forward: normalised strips float32 (n, 32, 160, 3) -> float32 (n, 5), m from the camera to the lane's centre, right
    positive, at the distances DISTANCES_AHEAD.
    """

    def __init__(self) -> None:
        super().__init__()
        shapes = [(3, 24, 5, (2, 2)), (24, 32, 3, (2, 2)), (32, 48, 3, (2, 2)), (48, 64, 3, (1, 2))]
        layers: list[nn.Module] = []
        for inputs, outputs, kernel, stride in shapes:
            convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
            layers += [convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
        self.convolutions = nn.Sequential(*layers)
        self.dense = nn.Sequential(nn.Linear(64 * 4 * 10, 96), nn.ReLU(), nn.Linear(96, len(DISTANCES_AHEAD)))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack this argument

    def forward(self, strips: torch.Tensor) -> torch.Tensor:
        """Detect the lane's centre; shapes and units are in the class's docstring."""
        x = strips.permute(0, 3, 1, 2)  # in memory still channels last
        return self.dense(self.convolutions(x).flatten(1)).float()


@functools.cache
def load_network(path: str | Path | None = None) -> LaneNetwork:
    """Return the network with the weights of a file, or with the shipped ones. Raises ModelError."""
    path, network = path or SHIPPED_WEIGHTS, LaneNetwork()
    remedy = f"train the lane network with `{as_typed('python', '-m', 'tools.train_lane', '--output', path)}`"
    tensors.load_weights(path, network, "the lane network", remedy)
    return network.eval()


def fold_norms(network: LaneNetwork) -> LaneNetwork:
    """Return a copy whose convolutions do the work of the batch norms as well: in float32 a sixth less time.

    network: in evaluation mode, as is the copy.
    """
    folded, layers = copy.deepcopy(network), list[nn.Module]()
    for layer in folded.convolutions:
        if isinstance(layer, nn.BatchNorm2d) and isinstance(convolution := layers[-1], nn.Conv2d):
            layers[-1] = fuse_conv_bn_eval(convolution, layer)
        else:
            layers.append(layer)
    folded.convolutions = nn.Sequential(*layers)
    return folded


def estimate_centres(strips: np.ndarray, network: LaneNetwork | None = None) -> np.ndarray:
    """Detect the lane's centre in strips, uint8 (…, 32, 160, 3): float32 (…, 5), m to the right of the camera.

    The centre is detected at DISTANCES_AHEAD. network: the shipped one if None.
    """
    detector = fold_norms(network or load_network())
    device = torch.device("cpu")
    precision = choose_precision(device)
    flat = strips.reshape(-1, *STRIP_SHAPE)

    def detect(start: int) -> np.ndarray:
        piece = flat[start : start + STRIPS_PER_PIECE]
        inputs = torch.from_numpy(np.stack([normalize(strip) for strip in piece]))
        with torch.inference_mode(), in_precision(precision, device):
            seen, mirrored = detector(torch.cat([inputs, inputs.flip(2)])).chunk(2)  # a road has no preferred side
            return ((seen - mirrored) / 2).numpy()

    nothing = np.empty((0, len(DISTANCES_AHEAD)), np.float32)
    with ThreadPoolExecutor(threads(), initializer=one_thread) as pool:
        centres = np.concatenate([nothing, *pool.map(detect, range(0, len(flat), STRIPS_PER_PIECE))])
    return centres.reshape(*strips.shape[:-3], len(DISTANCES_AHEAD))


def read_strips(recording: Recording, rows: slice = slice(None)) -> np.ndarray:
    """Return the strips of a recording's three cameras in these rows: uint8 (n, 3, 32, 160, 3). Raises RecordingError.

    rows: without a step.
    """
    first, end, _ = rows.indices(len(recording))
    strips = np.empty((end - first, 3, *STRIP_SHAPE), np.uint8)

    def read(row: int) -> None:
        frame = np.zeros(FRAME, np.uint8)
        for camera in range(3):
            frame[ROAD_ROWS] = recording.road(row, camera)
            strips[row - first, camera] = extract_strip(frame)

    with ThreadPoolExecutor(threads()) as pool:
        list(pool.map(read, range(first, end)))  # raises what reading a row raised
    return strips


def detect_centres(recording: Recording, network: LaneNetwork | None = None) -> np.ndarray:
    """Detect the lane's centre in each row by each camera (centre, left, right): float32 (n, 3, 5).

    m to the right of the camera, at DISTANCES_AHEAD. Raises RecordingError for images that can't be read,
    ModelError without a usable network.
    """
    return estimate_centres(read_strips(recording), network)


def fuse_detections(recording: Recording, centres: np.ndarray) -> LanePosition:
    """Estimate the position in the lane from the cameras' detections and the car's motion, on any road.

    Detections before a break in time are not used after it. centres: float32 (n, 3, 5), of `detect_centres`.
    """
    pause = np.diff(recording.time)
    breaks = np.flatnonzero((pause <= 0) | (pause > MAX_GAP)) + 1
    parts = [slice(*edges) for edges in itertools.pairwise([0, *breaks.tolist(), len(recording)])]
    return LanePosition.joined([_fit_centre(Stretch.of(recording, rows), centres[rows]) for rows in parts])


def _fit_centre(stretch: Stretch, centres: np.ndarray) -> LanePosition:
    """Fit a centre line next to the car in each row without a break; return the car's position relative to it.

    centres: float32 (n, 3, 5), m to the right of the cameras.
    """
    near = centres[..., :2]  # further ahead a metre is few pixels
    scale = smooth((near[:, 1] - near[:, 2]).mean(1), SCALE_ROWS) / (MOUNT_OFFSETS[2] - MOUNT_OFFSETS[1])
    scale = np.clip(scale, MIN_SCALE, 1)
    near = near / scale[:, None, None] + MOUNT_OFFSETS[:, None]
    camera_error = smooth(near[:, 1:] - near[:, :1])
    heading = stretch.heading
    # The path of the rear axle, which slides outwards in bends.
    path, step = heading[:-1] + np.diff(heading) / 2 + stretch.slip, np.diff(stretch.driven)
    right, forward = (np.r_[0.0, np.cumsum(step * function(path))] for function in (np.sin, np.cos))
    driven = np.r_[0.0, np.cumsum(step)]
    distances = DISTANCES_AHEAD[:FITTED]
    ahead = distances + AXLE_TO_CAMERA
    s, c = np.sin(heading)[:, None], np.cos(heading)[:, None]
    centre = (centres[..., :FITTED] + MOUNT_OFFSETS[:, None]).mean(1)
    points = np.stack([right[:, None] + ahead * s + centre * c, forward[:, None] + ahead * c - centre * s], axis=-1)
    firsts = np.maximum(np.searchsorted(driven, driven - PAST_METRES), np.arange(len(driven)) - PAST_ROWS)
    offset, yaw, residual = np.empty((3, len(centres)), np.float32)
    for row, first in enumerate(firsts):
        away = points[first : row + 1].reshape(-1, 2) - (right[row], forward[row])
        x = away @ (c[row, 0], -s[row, 0])
        z = away @ (s[row, 0], c[row, 0]) - REAR_AXLE
        # A quadratic by weighted least squares: points near the car's middle or detected from near weigh most.
        weight = np.tile(1 / (1 + distances / 6), row + 1 - first) / (1 + (z / FIT_LENGTH) ** 4)
        powers = np.stack([np.ones_like(z), z, z * z / 2])
        error = np.zeros_like(x)
        for _ in range(ROUNDS):
            counted = weight / np.sqrt(1 + (error / OUTLIER) ** 2)
            weighted = powers * counted
            damped = weighted @ weighted.T + np.diag([0, 1e-2, 1.0])  # a road's curvature is 0.1 at most
            curve = np.linalg.solve(damped, weighted @ (x * counted))
            error = x - curve @ powers
        residual[row] = np.linalg.norm(error * weight) / np.linalg.norm(weight)
        a, b, _ = curve
        yaw[row] = -np.arctan(b)
        offset[row] = -a * np.cos(yaw[row])
    trusted = (np.abs(camera_error) < MAX_CAMERA_ERROR).all((1, 2)) & (smooth(residual) < MAX_RESIDUAL)
    return LanePosition.read(offset / np.sqrt(scale), yaw, trusted)


def smooth(values: np.ndarray, rows: int = SMOOTHING_ROWS) -> np.ndarray:
    """Average values (n, …) over an odd number of rows with a Hann window, at the ends over the rows that there are."""
    weights = np.hanning(rows + 2)[1:-1].astype(np.float32)
    half, others = rows // 2, values.ndim - 1
    padded = np.pad(values, [(half, half)] + [(0, 0)] * others)
    present = np.pad(np.ones(len(values), np.float32), half)
    total, share = np.zeros_like(values), np.zeros(len(values), np.float32)
    for k, weight in enumerate(weights):
        total = total + weight * padded[k : k + len(values)]
        share = share + weight * present[k : k + len(values)]
    return total / share.reshape((-1,) + (1,) * others)
