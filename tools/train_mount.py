"""Train the network of `cloning/lane/mount.py`, which tells how a drive's camera is turned and shifted.

    python -m tools.train_mount          # twelve minutes on two cores; no recordings are needed

It is trained on short drives on rendered roads, whose camera is mounted at random: the rendered one is turned, or its
frames are moved afterwards. Two of three are disturbed, too, so that the network learns what rain, fog or dirt hide,
and that their own edges tell nothing; kinds on which no network may be trained (`disturbances.HELD_OUT`) are left out.
At the end it is measured on roads and looks that it never saw. The weights are written to mount.pt in the current
folder, which git ignores; to ship them, copy the file to cloning/lane/mount.pt.
"""

import functools
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import cv2
import numpy as np
import torch
from numpy.random import Generator, default_rng
from panda3d.core import NodePath, Point3, TransformState, Vec3

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.outputs import check_folders
from cloning.lane.mount import UNITS, MeanPicture, MountNetwork, counts
from cloning.network import tensors
from cloning.network.compute import threads
from cloning.recordings.format import SAMPLE_RATE
from cloning.road.camera import CAMERA_ROLL, CAMERA_YAW, FIRST_BONNET_ROW, FOCAL_LENGTH, MOUNT_PITCH
from cloning.road.disturbances import HELD_OUT, KINDS, STRENGTHS, Disturbance, Disturber, moved
from cloning.road.track import ROADS, Track
from simulator.cameras import Cameras
from simulator.workers import results, started_workers
from simulator.world import Scene
from tools.command import head, row
from tools.lane_frames import RenderedScene, every_second_shadowed, scenes

MOST = np.array([32.0, 32.0, 24.0])  # of a mounting: pixels, pixels and degrees
STRAIGHT = 0.4  # share of the mountings that are 0, in each of the three
RENDERED = 0.35  # share of the drives whose camera is mounted otherwise; in the others frames are moved
NO_BONNET = 0.2  # share of the drives whose frames are moved that show no bonnet
READ = (6, 15, 30)  # frames after which the mean picture is read; the last one ends the drive
SPEEDS = (2.0, 15.0)  # m/s
FOUL = tuple(kind for kind in KINDS if kind not in (*HELD_OUT, "shifted", "turned"))
HARD = ("rain", "fog", "sun", "occluded", "noise", "dirt", "night")  # which hide most, and come more often
BATCH, RATE, DECAY = 256, 3e-3, 1e-3


# ----------------------------------------------------------------------------------------------------------------------
# Drives


class Samples(NamedTuple):
    """What the network is trained on, or measured with; n of them."""

    directions: np.ndarray  # float16 (n, 3 SCALES, 10, 20)
    mounts: np.ndarray  # float32 (n, 3)
    disturbed: np.ndarray  # str (n,): the disturbance, "" for none

    @classmethod
    def of(cls, parts: Iterable[Self]) -> Self:
        """Return those of several, one after the other."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))


def random_mount(rng: Generator) -> np.ndarray:
    """Return a mounting: float64 (3,)."""
    return np.where(rng.random(3) < STRAIGHT, 0, rng.uniform(-MOST, MOST))


def mount_camera(camera: NodePath, mount: np.ndarray) -> None:
    """Turn a rendered camera so that its picture is as a mounting says, but for the perspective."""
    right, down, turn = mount.tolist()
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    across, along = right * cos - down * sin, right * sin + down * cos  # of the picture before it is turned
    yaw, pitch = (math.degrees(math.atan(pixels / FOCAL_LENGTH)) for pixels in (across, along))
    camera.set_hpr(-CAMERA_YAW + yaw, -MOUNT_PITCH + pitch, -CAMERA_ROLL + turn)


def random_drive(track: Track, rng: Generator) -> list[TransformState]:
    """Return where a car is that weaves along a track, at the times of a short drive's frames."""
    metres = np.arange(READ[-1]) * rng.uniform(*SPEEDS) / SAMPLE_RATE
    astray = rng.random() < 0.3
    middle, turn = rng.uniform(-2.8, 2.8) * (1 if astray else 0.4), rng.normal(0, 4) if astray else 0.0
    width, wave = rng.exponential(0.6 if astray else 0.3), 2 * np.pi / rng.uniform(25, 80)
    phase = rng.uniform(0, 2 * np.pi) + wave * metres
    offsets, yaws = middle + width * np.sin(phase), np.radians(turn) + np.arctan(width * wave * np.cos(phase))
    pitches, rolls = rng.normal((0.1, 0), (0.5, 0.6), (1, 2)).T + np.cumsum(rng.normal(0, 0.1, (2, len(metres))), 1)
    start, found = rng.uniform(0, track.length), []
    for metre, offset, yaw, pitch, roll in zip(metres, offsets.clip(-4, 4), yaws, pitches, rolls, strict=True):
        pose = track.at((start + metre) % track.length, offset)
        angles = Vec3(np.degrees(pose.heading - yaw) - 90, np.degrees(np.arctan(pose.grade)) + pitch, roll)
        found.append(TransformState.make_pos_hpr(Point3(pose.x, pose.y, pose.z + 0.025), angles))
    return found


class Seen:
    """The mean picture of a drive through one camera, and what was read from it."""

    def __init__(self, mount: np.ndarray, move: bool, foul: Disturbance | None, rng: Generator):
        """mount: of the camera; move: by moving its frames; foul: what disturbs them."""
        self.mount, self.move, self.foul = mount, move, foul
        self.border = int(rng.choice((cv2.BORDER_REPLICATE, cv2.BORDER_REFLECT_101)))
        self.bonnet = not move or rng.random() >= NO_BONNET
        self.colour = rng.integers(0, 256, 3) if rng.random() < 0.5 else None  # of what hides the bonnet; None: road
        self.disturber = Disturber(foul, int(rng.integers(1 << 30))) if foul else None
        self.picture, self.read = MeanPicture(), list[np.ndarray]()

    def add(self, frame: np.ndarray) -> None:
        """Show the next frame, uint8 (160, 320, 3) RGB."""
        if not self.bonnet:
            frame, hidden = frame.copy(), len(frame) - FIRST_BONNET_ROW
            road = frame[FIRST_BONNET_ROW - hidden : FIRST_BONNET_ROW][::-1]
            frame[FIRST_BONNET_ROW:] = road if self.colour is None else self.colour
        if self.move:
            frame = moved(frame, self.mount, self.border)
        self.picture.add(self.disturber(frame) if self.disturber else frame)
        if self.picture.frames in READ:
            self.read.append(self.picture.directions().astype(np.float16))

    def samples(self) -> Samples:
        """Return what was read."""
        n, mount = len(self.read), self.mount.astype(np.float32)
        return Samples(np.stack(self.read), np.tile(mount, (n, 1)), np.repeat(str(self.foul or ""), n))


def render_drives(scene: RenderedScene, seed: int) -> Samples:
    """Render drives in a scene, as many as its `frames`, each as three cameras show it, of which two are disturbed.

    Where the rendered camera is turned, all three are mounted alike.
    """
    name, look, drives = scene
    rng = default_rng([seed, look, *name.encode()])
    cameras, tracks = Cameras(Scene.of(name, look), ("center",)), [Track(name, way) for way in ("ccw", "cw")]
    found = []
    for _ in range(drives):
        rendered = random_mount(rng) if rng.random() < RENDERED else None
        mount_camera(cameras.mounted[0], np.zeros(3) if rendered is None else rendered)
        kinds = None, rng.choice(FOUL), rng.choice(HARD if rng.random() < 0.6 else FOUL)
        fouls = [kind and Disturbance(str(kind), int(rng.choice(STRENGTHS))) for kind in kinds]
        seen = [
            Seen(random_mount(rng) if rendered is None else rendered, rendered is None, foul, rng) for foul in fouls
        ]
        for transform in random_drive(tracks[rng.integers(2)], rng):
            frame = cameras.frames(transform)[0]
            for each in seen:
                each.add(frame)
        found += [each.samples() for each in seen]
    return Samples.of(found)


def render_all(chosen: Sequence[RenderedScene], seed: int) -> Samples:
    """Run `render_drives` for several scenes, in several processes. Raises SimulatorError."""
    with started_workers(threads()) as pool:
        return Samples.of(results(pool, functools.partial(render_drives, seed=seed), chosen, "scenes"))


# ----------------------------------------------------------------------------------------------------------------------
# Training


def train(samples: Samples, epochs: int, seed: int) -> MountNetwork:
    """Return a network that was trained on samples, by the likelihood of their mountings."""
    torch.manual_seed(seed)
    network, n = MountNetwork(), len(samples.mounts)
    inputs, mounts = torch.from_numpy(samples.directions), torch.from_numpy(samples.mounts / UNITS).float()
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, epochs * -(-n // BATCH))
    for epoch in range(epochs):
        total = 0.0
        for batch in torch.randperm(n).split(BATCH):
            found, deviation = network(inputs[batch].float())
            loss = (deviation.log() + ((mounts[batch] - found) / deviation) ** 2 / 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += loss.item() * len(batch) / n
        print(f"epoch {epoch + 1}: loss {total:.3f}", flush=True)
    return network.eval()


def print_errors(network: MountNetwork, samples: Samples) -> None:
    """Print a table of how wrong a network's single readings are, by kind of disturbance."""
    with torch.inference_mode():
        found, deviation = (each.numpy() * UNITS for each in network(torch.from_numpy(samples.directions).float()))
    wrong, kinds = found - samples.mounts, np.array([each.split(":")[0] or "none" for each in samples.disturbed])
    false = (samples.mounts == 0) & counts(found, deviation)
    print(head("disturbance", "readings", "px right", "px down", "degrees", "false ones"))
    for kind in sorted(set(kinds)):
        rows = kinds == kind
        errors = (f"{error:.1f}" for error in np.sqrt((wrong[rows] ** 2).mean(0)))
        print(row(kind, rows.sum(), *errors, false[rows].any(1).sum()))


def main(argv: list[str] | None = None) -> int:
    """Train the network and write its weights; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.train_mount", __doc__)
    add = parser.add_argument
    add("--looks", type=number(int, 0), default=12, help="looks of each track, also with shadows (default %(default)s)")
    roads = "generated roads, and half as many mountain roads (default %(default)s)"
    add("--roads", type=number(int, 1), default=250, help=roads)
    add("--drives", type=number(int, 1), default=16, help="drives in a scene (default %(default)s)")
    add("--epochs", type=number(int, 1), default=25, help="default %(default)s")
    add("--seed", type=number(int, 0), default=0, help="of all random choices (default %(default)s)")
    add("--output", type=Path, default=Path("mount.pt"), help="file of weights (default %(default)s)")
    options = parser.parse_args(argv)
    check_folders(str(options.output))
    number_of = {"road": options.roads, "mountain": -(-options.roads // 2)}
    chosen = scenes(options.looks, number_of, options.drives)
    looks = range(101, 102 + options.roads // 32)  # and roads below 1001: unknown
    unknown = [RenderedScene(f"road-{k}", every_second_shadowed(k), 3) for k in range(1, 2 + options.roads // 5)]
    unknown += [RenderedScene(track, every_second_shadowed(look), 4) for track in ROADS for look in looks]
    network = train(render_all(chosen, options.seed), options.epochs, options.seed)
    tensors.save_weights(options.output, network)
    print_errors(network, render_all(unknown, options.seed + 1))
    return program.DONE


if __name__ == "__main__":
    program.run(main)
