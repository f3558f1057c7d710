"""Train the network of `cloning/lane/reader.py`, which reads the lane's centre out of frames.

    python -m tools.train_lane data/lake-ccw data/jungle     # drawn frames, and these real recordings

It draws frames of both tracks in many looks from known places. Of real frames nobody knows the place, but it is known
that the side cameras stand 0.81 and 0.83 m beside the centre one, and how the ground moves when a frame is seen from
elsewhere: the network learns these differences on real recordings, and the absolute place on drawn frames. Half of all
frames are mirrored, which fixes the middle. It leaves lane.pt.
"""

import argparse
import io
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import cv2
import numpy as np
import torch

from cloning.compute import choose_precision, in_precision, one_thread, threads
from cloning.errors import RecordingError
from cloning.files import write
from cloning.lane.place import centre_ahead
from cloning.lane.reader import (
    AHEAD,
    HALF,
    LEVEL,
    MOUNT_OFFSETS,
    SHIPPED,
    STRIP,
    LaneNetwork,
    normal,
    read_strips,
    strip,
)
from cloning.recordings.images import decode
from cloning.recordings.log import find_folders, read_recording
from cloning.road.camera import CAMERA_HEIGHT
from cloning.road.motion import AXLE_TO_CAMERA, CAMERA_FORWARD, MAX_GAP, Stretch
from cloning.road.track import Track

TRACKS = {"lake": 1, "jungle": 2}  # and how much of each is drawn: hills and narrow bends are harder
OFFSET, YAW = 3.5, 15.0  # m and degrees: as far as drawn cars stand beside and turn off the lane's centre
WARP = (0.9, 3.0)  # m and degrees, standard deviations: how far real frames are seen from elsewhere
DRAWN, REAL = 96, 40  # frames and pairs of frames of a batch
WEIGHTS = torch.tensor([1.0, 1.0, 0.9, 0.7, 0.5])  # of the distances AHEAD
CLEAR = 0.3  # m: beyond it an error counts in proportion, not by its square
FLAT = 8.0  # m ahead up to which what is seen from elsewhere is sure: the ground further off is not flat
ON = (1.0, 8.0)  # m: how much further on the road a frame is compared with another


# --------------------------------------------------------------------------------------------------
# Drawn frames, of which the place is known


def draw(track_name: str, look: int, frames: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Strips uint8 (n, 32, 160, 3) from random places, and the lane's centre there: float32 (n, 5), nan out of reach.

    Off the centre, turned, nodding and leaning as a car on its springs does, in both directions of the track.
    """
    from panda3d.core import Point3, TransformState, Vec3

    from simulator import scenery
    from simulator.cameras import Cameras, jpeg
    from simulator.world import Scene

    rng = np.random.default_rng([seed, look, list(TRACKS).index(track_name)])
    cameras = Cameras(Scene(scenery.build(track_name, look)), ("center",))
    tracks = [Track(track_name, direction) for direction in ("ccw", "cw")]
    strips, centres = np.empty((frames, *STRIP), np.uint8), np.empty((frames, len(AHEAD)), np.float32)
    for k, s in enumerate(np.sort(rng.uniform(0, tracks[0].length, frames))):  # in order: haze is drawn anew every 25 m
        way = rng.integers(2)
        track, s = tracks[way], (s, tracks[0].length - s)[way]
        right = rng.uniform(-OFFSET, OFFSET)
        yaw = rng.uniform(-YAW, YAW) if rng.random() < 0.3 else np.clip(rng.normal(0, YAW / 3), -YAW, YAW)
        place = track.at(s, right)
        heading = place.heading - np.radians(yaw)
        nod = np.degrees(np.arctan(place.grade)) + rng.normal(0.1, 0.5)
        pose = Vec3(np.degrees(heading) - 90, nod, rng.normal(0, 0.6))
        frame = cameras.frames(
            TransformState.make_pos_hpr(Point3(place.x, place.y, place.z + rng.normal(0.025, 0.03)), pose)
        )[0]
        strips[k] = strip(decode(jpeg(frame)))
        eye = place.x + CAMERA_FORWARD * np.cos(heading), place.y + CAMERA_FORWARD * np.sin(heading)
        centres[k] = centre_ahead(track, s, *eye, heading)
    return strips, centres


def draw_many(looks: range, frames: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """`draw` of both tracks in these looks, by several processes; of look 0, as the real one, three times as many."""
    jobs = [
        (track, look, frames * share * (1 if look else 3), seed) for look in looks for track, share in TRACKS.items()
    ]
    with ProcessPoolExecutor(threads(), mp_context=multiprocessing.get_context("spawn")) as pool:
        strips, centres = zip(*pool.map(draw, *zip(*jobs, strict=True)), strict=True)
    return np.concatenate(strips), np.concatenate(centres)


# --------------------------------------------------------------------------------------------------
# Augmentation


def seen_from(right: float, yaw: float) -> np.ndarray:
    """From a strip's pixels to those of one seen `right` m further right, turned right by `yaw` radians: (3, 3)."""
    moved = np.eye(3)
    moved[0, 1] = -right / CAMERA_HEIGHT
    turned = LEVEL @ cv2.Rodrigues(np.array([0.0, -yaw, 0.0]))[0]
    return np.linalg.inv(HALF) @ turned @ moved @ np.linalg.inv(LEVEL) @ HALF


def in_sight(view: np.ndarray) -> np.ndarray:
    """uint8 (32, 160, 1): 1 where a strip seen from elsewhere, by `seen_from`, shows what the camera saw."""
    seen = np.ones(STRIP[:2], np.uint8)
    return cv2.warpPerspective(seen, view, STRIP[1::-1], flags=cv2.INTER_NEAREST, borderValue=0)[..., None]


class Photographs:
    """Other light, colours, shadows, noise and blur, and things in the way."""

    def __init__(self, rng: np.random.Generator):
        rows, columns, _ = STRIP
        down, across = np.mgrid[0:rows, 0:columns].astype(np.float32)
        self.noise = rng.normal(0, 10, (64, *STRIP)).round().astype(np.int16)
        self.shadows = np.ones((256, *STRIP), np.float32)
        for shadow in self.shadows:
            for _ in range(rng.integers(1, 4)):  # bands, soft-edged
                turned, begins, wide = rng.uniform(0, 2 * np.pi), rng.uniform(-60, 60), rng.uniform(8, 200)
                into = np.cos(turned) * (across - columns / 2) + np.sin(turned) * 2 * (down - rows / 2) - begins
                shadow *= np.where((into > 0) & (into < wide), rng.uniform(0.35, 0.95), 1)[..., None]
            shadow[:] = cv2.GaussianBlur(shadow, (0, 0), rng.uniform(0.3, 2))
        turns = np.radians(rng.normal(0, 4, 512))
        self.wedges = [
            in_sight(seen_from(right, yaw)) for right, yaw in zip(rng.normal(0, 0.8, 512), turns, strict=True)
        ]
        self.whole = np.ones((rows, columns, 1), np.uint8)

    def wedge(self, rng: np.random.Generator, share: float) -> np.ndarray:
        """Where a strip may be seen, uint8 (32, 160, 1): a share of all lack a border, as if seen from elsewhere."""
        return self.wedges[rng.integers(len(self.wedges))] if rng.random() < share else self.whole

    def another(self, picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The same view, taken otherwise: uint8 (32, 160, 3)."""
        if rng.random() < 0.6:
            picture = cv2.multiply(picture, self.shadows[rng.integers(len(self.shadows))], dtype=cv2.CV_8U)
        if rng.random() < 0.2:
            picture = picture.copy()
            for _ in range(rng.integers(1, 4)):
                down, across = rng.integers(0, STRIP[0]), rng.integers(0, STRIP[1])
                picture[down : down + rng.integers(1, 12), across : across + rng.integers(2, 28)] = rng.integers(
                    0, 256, 3
                )
        if rng.random() < 0.7:  # paler or stronger colours
            strength = rng.uniform(0.2, 1.5)
            picture = cv2.transform(picture, np.eye(3) * strength + (1 - strength) / 3)
        if rng.random() < 0.3:
            picture = cv2.blur(picture, (3, 3))
        if rng.random() < 0.6:
            picture = cv2.add(picture, self.noise[rng.integers(len(self.noise))], dtype=cv2.CV_8U)
        level = (np.arange(256)[:, None] / 255) ** rng.uniform(0.6, 1.6)
        table = level * rng.uniform(0.6, 1.4) * rng.uniform(0.85, 1.15, 3) * 255
        return cv2.LUT(picture, np.clip(table, 0, 255).astype(np.uint8)[None])


# --------------------------------------------------------------------------------------------------
# Training


class Real:
    """A real recording: strips uint8 (n, 3, 32, 160, 3), and the way of its centre camera."""

    def __init__(self, folder):
        recording = read_recording(folder)
        self.strips = read_strips(recording)
        stretch = Stretch.of(recording, slice(0, len(recording)))
        self.heading, self.driven = stretch.heading, stretch.driven
        self.right = stretch.right + AXLE_TO_CAMERA * np.sin(self.heading)
        self.forward = stretch.forward + AXLE_TO_CAMERA * np.cos(self.heading)
        pause = np.diff(recording.time, append=np.inf)
        self.breaks = np.flatnonzero((pause <= 0) | (pause > MAX_GAP))

    def later(self, row: int, driven: float) -> tuple[int, tuple[float, float, float]]:
        """The row `driven` metres on, or the last before a break, and where it is: m right, m forward, yaw."""
        last = self.breaks[np.searchsorted(self.breaks, row)]
        later = min(int(np.searchsorted(self.driven, self.driven[row] + driven)), int(last))
        right, forward = self.right[later] - self.right[row], self.forward[later] - self.forward[row]
        s, c = np.sin(self.heading[row]), np.cos(self.heading[row])
        return later, (right * c - forward * s, right * s + forward * c, self.heading[later] - self.heading[row])


class Batches:
    """Batches, each from its own number and the seed alone."""

    def __init__(self, strips, centres, recordings: list[Real], seed: int):
        self.strips, self.centres, self.recordings, self.seed = strips, centres, recordings, seed
        self.photographs = Photographs(np.random.default_rng([seed, 1]))

    def __call__(self, number: int):
        """Entered strips float32 (n, 32, 160, 3), their signs float32 (n, 1), -1 where mirrored; the drawn ones'
        centres float32 (96, 5); where the last 40 cameras stand from the 40 before, as `pair` says: float32 (40, 4)."""
        rng = np.random.default_rng([self.seed, 2, number])
        chosen = rng.integers(0, len(self.strips), DRAWN)
        pictures, seen = list(self.strips[chosen]), [self.photographs.wedge(rng, 0.3) for _ in range(DRAWN)]
        firsts, seconds, masks, poses = [], [], [], []
        for _ in range(REAL if self.recordings else 0):
            pair, mask, pose = self.pair(self.recordings[rng.integers(len(self.recordings))], rng)
            firsts.append(pair[0])
            seconds.append(pair[1])
            masks.append(mask)
            poses.append(pose)
        pictures, seen = pictures + firsts + seconds, seen + masks + masks
        entered = np.stack(
            [
                normal(self.photographs.another(picture, rng)) * mask
                for picture, mask in zip(pictures, seen, strict=True)
            ]
        )
        mirrored = rng.random(len(entered)) < 0.5
        entered[mirrored] = entered[mirrored, :, ::-1]
        signs = np.where(mirrored, -1, 1)[:, None].astype(np.float32)
        return entered, signs, self.centres[chosen], np.array(poses, np.float32).reshape(-1, 4)

    def pair(self, recording: Real, rng: np.random.Generator):
        """Two views of a place, what may be seen in both, and where the second camera stands from the first.

        As two cameras saw it at once; or one, on the way; or as it is seen from elsewhere. Both lack the same borders,
        so that these don't tell who stands further right. The pose is m right, m forward, yaw, and m ahead up to which
        the ground is sure to be where it is taken to be.
        """
        row, kind = rng.integers(len(recording.strips)), rng.random()
        if kind < 0.4:
            one, other = rng.permutation(3)[:2]
            views = recording.strips[row, [one, other]]
            return views, self.photographs.wedge(rng, 0.3), (MOUNT_OFFSETS[other] - MOUNT_OFFSETS[one], 0, 0, np.inf)
        if kind < 0.7:
            later, pose = recording.later(row, rng.uniform(*ON))
            one, other = rng.integers(0, 3, 2)
            views = recording.strips[row, one], recording.strips[later, other]
            c, s = np.cos(pose[2]), np.sin(pose[2])
            pose = (
                pose[0] + MOUNT_OFFSETS[other] * c - MOUNT_OFFSETS[one],
                pose[1] - MOUNT_OFFSETS[other] * s,
                pose[2],
                np.inf,
            )
            return views, self.photographs.wedge(rng, 0.3), pose
        views, mask, poses = [], self.photographs.wedge(rng, 0.5), []
        for camera in rng.integers(0, 3, 2):
            right, yaw = rng.normal(0, WARP[0]), np.radians(rng.normal(0, WARP[1]))
            view = seen_from(right, yaw)
            views.append(
                cv2.warpPerspective(
                    recording.strips[row, camera],
                    view,
                    STRIP[1::-1],
                    flags=cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REFLECT,
                )
            )
            mask = mask & in_sight(view)
            poses.append((MOUNT_OFFSETS[camera] + right, yaw))
        (right, yaw), (other, turned) = poses
        c, s = np.cos(yaw), np.sin(yaw)
        return views, mask, ((other - right) * c, (other - right) * s, turned - yaw, FLAT)


def carried(seen: torch.Tensor, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The lane's centre as a first camera has seen it, (n, 5), in the view of a second one: m right, m ahead.

    poses: float32 (n, 4), of the second camera.
    """
    right, forward, yaw = poses[:, :3].split(1, dim=1)
    aside, ahead = seen - right, torch.from_numpy(AHEAD) - forward
    return aside * yaw.cos() - ahead * yaw.sin(), aside * yaw.sin() + ahead * yaw.cos()


def disagreement(first: torch.Tensor, second: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
    """How far apart two cameras see the same centre, where both see it; seen: float32 (n, 5)."""
    aside, ahead = carried(first, poses)
    ahead = ahead.detach()
    distances = torch.from_numpy(AHEAD)
    after = torch.bucketize(ahead, distances).clamp(1, len(AHEAD) - 1)
    part = (ahead - distances[after - 1]) / (distances[after] - distances[after - 1])
    there = second.gather(1, after - 1) * (1 - part) + second.gather(1, after) * part
    common = (ahead > AHEAD[0] - 0.6) & (ahead < torch.clamp(poses[:, 3:], max=float(AHEAD[-1]) + 0.6))
    return mean_error(there, torch.where(common, aside, torch.nan))


def mean_error(found: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Of what is known: nan is not. float32 (n, 5)."""
    known = ~torch.isnan(true)
    apart = torch.where(known, found, 0.0) - torch.where(known, true, 0.0)
    errors = torch.nn.functional.smooth_l1_loss(apart, torch.zeros_like(apart), beta=CLEAR, reduction="none")
    return (errors * WEIGHTS).sum() / (known * WEIGHTS).sum()


def train(batches: Batches, steps: int, rate: float = 4e-3) -> LaneNetwork:
    """Adam, the rate rising over the first seventh of the steps and falling to nothing; a line every 250 steps."""
    torch.manual_seed(batches.seed)
    one_thread()  # two batches are prepared beside the one that is worked through
    device = torch.device("cpu")
    precision = choose_precision(device)
    network = LaneNetwork().to(memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps, pct_start=0.15)
    started, sums = time.monotonic(), np.zeros(2)
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(batches, 0)
        for step in range(steps):
            entered, signs, centres, poses = coming.result()
            coming = pool.submit(batches, step + 1)
            with in_precision(precision, device):
                found = network(torch.from_numpy(entered))
            found = found * torch.from_numpy(signs)
            drawn = mean_error(found[:DRAWN], torch.from_numpy(centres))
            real = torch.zeros(())
            if len(poses):
                real = disagreement(*found[DRAWN:].split(len(poses)), torch.from_numpy(poses))
            (drawn + real).backward()
            optimizer.step()
            optimizer.zero_grad()
            schedule.step()
            sums += float(drawn.detach()), float(real.detach())
            if step % 250 == 249 or step + 1 == steps:
                count = step % 250 + 1
                print(
                    f"step {step + 1}/{steps} - {time.monotonic() - started:.0f}s - drawn: {sums[0] / count:.3f}"
                    f" - real: {sums[1] / count:.3f}",
                    flush=True,
                )
                sums[:] = 0
    return network.eval()


# --------------------------------------------------------------------------------------------------
# The command


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("recordings", nargs="*", help="real recordings: folders with a driving_log.csv")
    parser.add_argument("--looks", type=int, default=24, help="looks of either track that are drawn")
    parser.add_argument("--frames", type=int, default=200, help="of the lake in each look; of the jungle twice that")
    parser.add_argument("--steps", type=int, default=2400, help="batches of 96 drawn frames and 40 pairs of real ones")
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same network on a machine")
    parser.add_argument("--output", default=SHIPPED, help="the weights")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    arguments = parse(argv)
    try:
        folders = find_folders(arguments.recordings)
        recordings = [Real(folder) for folder in folders]
        print(f"drawing {arguments.looks} looks of {' and '.join(TRACKS)}", flush=True)
        strips, centres = draw_many(range(arguments.looks), arguments.frames, arguments.seed)
        network = train(Batches(strips, centres, recordings, arguments.seed), arguments.steps)
        buffer = io.BytesIO()
        torch.save(
            {
                name: value.half() if value.is_floating_point() else value
                for name, value in network.state_dict().items()
            },
            buffer,
        )
        write(arguments.output, buffer.getvalue())
    except (RecordingError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
