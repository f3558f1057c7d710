"""Train the network of `cloning/lane/reader.py`, which detects the lane's centre in camera frames.

    python -m tools.train_lane data/lake-ccw data/jungle     # on rendered frames and these real recordings

The network learns absolute positions from rendered frames: both tracks and generated roads in many looks, from known
poses. The pose of a real frame is unknown, but differences between poses are known: between the cameras of the car,
between two rows of a drive, and between two warps of a frame. The network learns these from real recordings. Half of
all frames are mirrored, so that no side is preferred. The weights are written to lane.pt in the current folder, which
git ignores. To ship them, measure them with `python -m tools.lane_accuracy --network lane.pt --edges 7`, then copy the
file to cloning/lane/any_road.pt. That was made like this in four steps: without mountain roads; 4,000 batches from a
rate of 1.5e-3 with frames of 306 laps that `tools.shipped` had rendered; then, each with --start,

    python -m tools.train_lane RECORDING … --looks 0 --roads 210 --mountains 300 --steps 12000 --rate 2e-3
    python -m tools.train_lane RECORDING … --looks 0 --roads 210 --mountains 300 --steps 9000 --rate 1.5e-3

with four real recordings, and with frames of walls two and a half times as often, those of rails and of mountain roads
one and a half times. cloning/lane/lane.pt was made by an earlier version of this file, from the two tracks without
shadows. For both, the jungle was first rendered with 4.1 m between its centre and its edge lines.
"""

import copy
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.outputs import check_folders
from cloning.lane.reader import (
    DIRECTION_TO_STRIP,
    DISTANCES_AHEAD,
    MOUNT_OFFSETS,
    STRIP_SHAPE,
    STRIP_TO_LEVEL,
    LaneNetwork,
    load_network,
    normalize,
    read_strips,
)
from cloning.network import tensors
from cloning.network.compute import choose_precision, in_precision, one_thread
from cloning.recordings.log import find_folders, read_recording
from cloning.road.camera import LEVEL_CAMERA_MATRIX, camera_position, homographies
from cloning.road.motion import MAX_GAP, Stretch, components, forward_vector
from tools.lane_frames import render_all, scenes

WARP_DEVIATION = (0.9, 3.0)  # m and degrees: standard deviations of the poses to which real frames are warped
RENDERED, PAIRS = 96, 40  # rendered frames and pairs of real frames in a batch
DISTANCE_WEIGHTS = torch.tensor([1.0, 1.0, 0.9, 0.7, 0.5])  # of the errors at DISTANCES_AHEAD
HUBER_THRESHOLD = 0.3  # m: the loss is quadratic in smaller errors and linear in larger ones
FLAT_GROUND = 8.0  # m ahead: detections in warped frames are compared up to here; further away the ground is not flat
BRIGHTNESS = (0.3, 1.4)  # least and greatest factor; dark ones lose digits, as frames in dark shade did
TRAVEL = (1.0, 8.0)  # m that the car drives between the two frames of a pair


# ----------------------------------------------------------------------------------------------------------------------
# Augmentation

STRIP_TO_DIRECTION = np.linalg.inv(LEVEL_CAMERA_MATRIX) @ STRIP_TO_LEVEL


def strip_homography(right: float, yaw: float) -> np.ndarray:
    """Return the homography of the ground from a strip to that of another pose: float64 (3, 3).

    right: m further right; yaw: radians, turned right.
    """
    return homographies(right, 0.0, yaw, DIRECTION_TO_STRIP, STRIP_TO_DIRECTION)[0]


def visible_mask(homography: np.ndarray) -> np.ndarray:
    """Return a mask, uint8 (32, 160, 1): 1 where a warped strip has pixels of the original, else 0."""
    ones = np.ones(STRIP_SHAPE[:2], np.uint8)
    return cv2.warpPerspective(ones, homography, STRIP_SHAPE[1::-1], flags=cv2.INTER_NEAREST, borderValue=0)[..., None]


class PhotometricAugmentation:
    """Changes the light, colours, shadows, noise and blur of strips, and hides parts of them."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Sample the noise, shadows and masks that are later applied to strips."""
        rows, columns, _ = STRIP_SHAPE
        down, across = np.mgrid[0:rows, 0:columns].astype(np.float32)
        self.noise = rng.normal(0, 10, (64, *STRIP_SHAPE)).round().astype(np.int16)
        self.shadows = np.ones((256, *STRIP_SHAPE), np.float32)
        for shadow in self.shadows:
            for _ in range(rng.integers(1, 4)):  # bands with soft edges
                angle, edge, width = rng.uniform(0, 2 * np.pi), rng.uniform(-60, 60), rng.uniform(8, 200)
                depth = np.cos(angle) * (across - columns / 2) + np.sin(angle) * 2 * (down - rows / 2) - edge
                shadow *= np.where((depth > 0) & (depth < width), rng.uniform(0.15, 0.95), 1)[..., None]
            shadow[:] = cv2.GaussianBlur(shadow, (0, 0), rng.uniform(0.3, 2))
        yaws = np.radians(rng.normal(0, 4, 512))
        poses = zip(rng.normal(0, 0.8, 512), yaws, strict=True)
        self.masks = [visible_mask(strip_homography(right, yaw)) for right, yaw in poses]
        self.full_mask = np.ones((rows, columns, 1), np.uint8)

    def mask(self, rng: np.random.Generator, share: float) -> np.ndarray:
        """Sample a mask, uint8 (32, 160, 1); with probability `share` it hides a border, as warping does."""
        return self.masks[rng.integers(len(self.masks))] if rng.random() < share else self.full_mask

    def apply(self, strip: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return a strip, uint8 (32, 160, 3), with other light and colours."""
        if rng.random() < 0.6:
            strip = cv2.multiply(strip, self.shadows[rng.integers(len(self.shadows))], dtype=cv2.CV_8U)
        if rng.random() < 0.2:  # rectangles of one colour
            strip = strip.copy()
            for _ in range(rng.integers(1, 4)):
                top, left = rng.integers(0, STRIP_SHAPE[0]), rng.integers(0, STRIP_SHAPE[1])
                colour = rng.integers(0, 256, 3)
                height, width = rng.integers(1, 12), rng.integers(2, 28)
                strip[top : top + height, left : left + width] = colour
        if rng.random() < 0.7:  # paler or stronger colours
            strength = rng.uniform(0.2, 1.5)
            strip = cv2.transform(strip, np.eye(3) * strength + (1 - strength) / 3)
        if rng.random() < 0.3:
            strip = cv2.blur(strip, (3, 3))
        if rng.random() < 0.6:
            strip = cv2.add(strip, self.noise[rng.integers(len(self.noise))], dtype=cv2.CV_8U)
        level = (np.arange(256)[:, None] / 255) ** rng.uniform(0.6, 1.6)
        table = level * np.exp(rng.uniform(*np.log(BRIGHTNESS))) * rng.uniform(0.85, 1.15, 3) * 255
        return cv2.LUT(strip, np.clip(table, 0, 255).astype(np.uint8)[None])


# ----------------------------------------------------------------------------------------------------------------------
# Batches


class RealRecording:
    """A real recording: its strips, uint8 (n, 3, 32, 160, 3), and the trajectory of its centre camera."""

    def __init__(self, folder: Path) -> None:
        """Read the recording's images. Raises RecordingError, OSError."""
        recording = read_recording(folder)
        self.strips = read_strips(recording)
        stretch = Stretch.of(recording, slice(0, len(recording)))
        self.heading, self.driven = stretch.heading, stretch.driven
        axle = np.stack([stretch.right, stretch.forward], axis=1)
        self.position = camera_position(axle, forward_vector(self.heading))
        pause = np.diff(recording.time, append=np.inf)
        self.breaks = np.flatnonzero((pause <= 0) | (pause > MAX_GAP))

    def later(self, row: int, driven: float) -> tuple[int, tuple[float, float, float]]:
        """Return the row `driven` m later, or the last before a break, and its pose: m right, m forward, yaw."""
        last = self.breaks[np.searchsorted(self.breaks, row)]
        later = min(int(np.searchsorted(self.driven, self.driven[row] + driven)), int(last))
        right, forward = components(self.position[later] - self.position[row], forward_vector(self.heading[row]))
        return later, (right, forward, self.heading[later] - self.heading[row])


# m to the right, m forward, yaw in radians, and m ahead up to which the detections are compared
Pose = tuple[float, float, float, float]
Batch = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Pair(NamedTuple):
    """Two strips of the same road, uint8 (32, 160, 3), and the second camera's pose relative to the first.

    mask: of both, uint8 (32, 160, 1): the same, so that it does not show which camera is further right.
    """

    first: np.ndarray
    second: np.ndarray
    mask: np.ndarray
    pose: Pose


class BatchSampler:
    """Samples training batches, which depend only on the seed and the batch's index."""

    def __init__(self, strips: np.ndarray, centres: np.ndarray, recordings: list[RealRecording], seed: int) -> None:
        """strips, centres: rendered, see `render_all`; recordings: real ones."""
        self.strips, self.centres, self.recordings, self.seed = strips, centres, recordings, seed
        self.augmentation = PhotometricAugmentation(np.random.default_rng([seed, 1]))

    def __call__(self, index: int) -> Batch:
        """Return the batch of this index: inputs, signs, centres, poses.

        inputs: float32 (n, 32, 160, 3), the rendered strips, then the first and then the second strip of each real
        pair; signs: float32 (n, 1), -1 where mirrored; centres: float32 (RENDERED, 5), of the rendered strips; poses:
        float32 (PAIRS, 4), of each pair's second camera relative to its first, see `Pose`.
        """
        rng = np.random.default_rng([self.seed, 2, index])
        chosen = rng.integers(0, len(self.strips), RENDERED)
        strips, masks = list(self.strips[chosen]), [self.augmentation.mask(rng, 0.3) for _ in range(RENDERED)]
        pairs = [self.pair(rng) for _ in range(PAIRS if self.recordings else 0)]
        strips += [pair.first for pair in pairs] + [pair.second for pair in pairs]
        masks += 2 * [pair.mask for pair in pairs]
        poses = [pair.pose for pair in pairs]
        masked = zip(strips, masks, strict=True)
        inputs = np.stack([normalize(self.augmentation.apply(strip, rng)) * mask for strip, mask in masked])
        mirrored = rng.random(len(inputs)) < 0.5
        inputs[mirrored] = inputs[mirrored, :, ::-1]
        signs = np.where(mirrored, -1, 1)[:, None].astype(np.float32)
        return inputs, signs, self.centres[chosen], np.array(poses, np.float32).reshape(-1, 4)

    def pair(self, rng: np.random.Generator) -> Pair:
        """Sample a pair: from two cameras at once, from two rows of a drive, or from one row, warped twice."""
        recording = self.recordings[rng.integers(len(self.recordings))]
        row, choice = int(rng.integers(len(recording.strips))), rng.random()
        if choice < 0.4:
            first, second = rng.permutation(3)[:2]
            pose = (MOUNT_OFFSETS[second] - MOUNT_OFFSETS[first], 0, 0, np.inf)
            strips = recording.strips[row]
            return Pair(strips[first], strips[second], self.augmentation.mask(rng, 0.3), pose)
        if choice < 0.7:
            later, (right, forward, yaw) = recording.later(row, rng.uniform(*TRAVEL))
            first, second = rng.integers(0, 3, 2)
            views = recording.strips[row, first], recording.strips[later, second]
            right = right + MOUNT_OFFSETS[second] * np.cos(yaw) - MOUNT_OFFSETS[first]
            forward = forward - MOUNT_OFFSETS[second] * np.sin(yaw)
            return Pair(*views, self.augmentation.mask(rng, 0.3), (right, forward, yaw, np.inf))
        mask = self.augmentation.mask(rng, 0.5)
        warped, poses = [], []
        for camera in rng.integers(0, 3, 2):
            right, yaw = rng.normal(0, WARP_DEVIATION[0]), np.radians(rng.normal(0, WARP_DEVIATION[1]))
            homography, strip = strip_homography(right, yaw), recording.strips[row, camera]
            warped.append(cv2.warpPerspective(strip, homography, STRIP_SHAPE[1::-1], borderMode=cv2.BORDER_REFLECT))
            mask = mask & visible_mask(homography)
            poses.append((MOUNT_OFFSETS[camera] + right, yaw))
        (first_right, yaw), (second_right, second_yaw) = poses
        apart = second_right - first_right
        pose = (apart * np.cos(yaw), apart * np.sin(yaw), second_yaw - yaw, FLAT_GROUND)
        return Pair(warped[0], warped[1], mask, pose)


# ----------------------------------------------------------------------------------------------------------------------
# Training


def consistency_loss(first: torch.Tensor, second: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
    """Return the loss of two cameras' detections, float32 (n, 5), for their differences where both see the lane.

    poses: float32 (n, 4), of the second camera relative to the first, see `Pose`.
    """
    distances = torch.from_numpy(DISTANCES_AHEAD)
    to_right, forward, yaw, furthest = poses.split(1, dim=1)
    across, along = first - to_right, distances - forward
    # Where the first camera detects the centre, seen from the second one
    right = across * yaw.cos() - along * yaw.sin()
    ahead = (across * yaw.sin() + along * yaw.cos()).detach()
    after = torch.bucketize(ahead, distances).clamp(1, len(DISTANCES_AHEAD) - 1)
    part = (ahead - distances[after - 1]) / (distances[after] - distances[after - 1])
    there = second.gather(1, after - 1) * (1 - part) + second.gather(1, after) * part
    common = (ahead > DISTANCES_AHEAD[0] - 0.6) & (ahead < furthest.clamp(max=float(DISTANCES_AHEAD[-1]) + 0.6))
    return masked_loss(there, torch.where(common, right, torch.nan))


def masked_loss(predicted: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Return the weighted Huber loss over the true values that are not nan; both float32 (n, 5)."""
    known = ~torch.isnan(true)
    error = torch.where(known, predicted, 0.0) - torch.where(known, true, 0.0)
    losses = torch.nn.functional.smooth_l1_loss(error, torch.zeros_like(error), beta=HUBER_THRESHOLD, reduction="none")
    return (losses * DISTANCE_WEIGHTS).sum() / (known * DISTANCE_WEIGHTS).sum()


def train(batches: BatchSampler, steps: int, rate: float, network: LaneNetwork) -> LaneNetwork:
    """Train a network with AdamW and a one-cycle learning rate of this maximum; print a line every 250 steps."""
    one_thread()  # because another thread prepares the next batch at the same time
    device = torch.device("cpu")
    precision = choose_precision(device)
    network.train()
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps, pct_start=0.15)
    started, sums = time.monotonic(), np.zeros(2)
    with ThreadPoolExecutor(1) as pool:
        next_batch = pool.submit(batches, 0)
        for step in range(steps):
            inputs, signs, centres, poses = next_batch.result()
            next_batch = pool.submit(batches, step + 1)
            with in_precision(precision, device):
                predicted = network(torch.from_numpy(inputs))
            predicted = predicted * torch.from_numpy(signs)
            rendered, real = masked_loss(predicted[:RENDERED], torch.from_numpy(centres)), torch.zeros(())
            if len(poses):
                first, second = predicted[RENDERED:].split(len(poses))
                real = consistency_loss(first, second, torch.from_numpy(poses))
            (rendered + real).backward()
            optimizer.step()
            optimizer.zero_grad()
            schedule.step()
            sums += float(rendered.detach()), float(real.detach())
            if step % 250 == 249 or step + 1 == steps:
                means, sums = sums / (step % 250 + 1), np.zeros(2)
                begin = f"step {step + 1}/{steps} - {time.monotonic() - started:.0f}s"
                print(f"{begin} - rendered: {means[0]:.3f} - real: {means[1]:.3f}", flush=True)
    return network.eval()


# ----------------------------------------------------------------------------------------------------------------------
# The command


def main(argv: list[str] | None = None) -> int:
    """Train the network and write its weights; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.train_lane", __doc__)
    add = parser.add_argument
    add("recordings", nargs="*", help="folders of real recordings, each with a driving_log.csv")
    looks = "looks of each track, each also with shadows (default %(default)s)"
    add("--looks", type=number(int, 0), default=24, help=looks)
    frames = "frames of the lake in a look, and of each road; twice as many of the jungle (default %(default)s)"
    add("--frames", type=number(int, 1), default=150, help=frames)
    add("--roads", type=number(int, 0), default=100, help="generated roads (default %(default)s)")
    add("--mountains", type=number(int, 0), default=100, help="generated mountain roads (default %(default)s)")
    add("--steps", type=number(int, 1), default=3600, help="batches to train on (default %(default)s)")
    add("--rate", type=number(float, 0, 1), default=4e-3, help="greatest learning rate (default %(default)s)")
    add("--start", metavar="lane.pt", help="file of weights to train on (default: random ones)")
    add("--seed", type=number(int, 0), default=0, help="of all random choices (default %(default)s)")
    add("--output", type=Path, default=Path("lane.pt"), help="file of weights (default %(default)s)")
    options = parser.parse_args(argv)
    check_folders(str(options.output))
    chosen = scenes(options.looks, {"road": options.roads, "mountain": options.mountains}, options.frames)
    if not chosen:
        parser.error("--looks, --roads and --mountains are all 0: nothing to render; raise one of them")
    torch.manual_seed(options.seed)
    network = copy.deepcopy(load_network(options.start)) if options.start else LaneNetwork()
    recordings = [RealRecording(folder) for folder in find_folders(options.recordings)]
    print(f"rendering {sum(scene.frames for scene in chosen)} frames of {len(chosen)} scenes", flush=True)
    strips, centres = render_all(chosen, options.seed)
    batches = BatchSampler(strips, centres, recordings, options.seed)
    tensors.save_weights(options.output, train(batches, options.steps, options.rate, network))
    return program.DONE


if __name__ == "__main__":
    program.run(main)
