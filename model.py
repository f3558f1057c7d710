"""Train NVIDIA's network to steer, from recordings of the Udacity simulator.

    python model.py                                     # every folder with a driving_log.csv under data/
    python model.py data/lake-ccw data/lake-cw          # or these
    python model.py --robust                            # not as the report, but to stay on the road
    python model.py --resume                            # go on where a run was stopped or killed
    torchrun --nproc_per_node=2 model.py data/lake-ccw  # two processes, each with its share of every batch

It reads top to bottom as the report does: recordings, observations, the generator, the network, training, pictures.
It leaves model.pt (the last epoch's, as in the report), model-best.pt (the least validation loss), model-resume.pt,
training_loss.png, training_log.csv, training_arguments.json and the pictures in diagnostic_images/.
"""

import argparse
import csv
import functools
import hashlib
import io
import itertools
import json
import math
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.distributed as dist
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from cloning.compute import (
    choose_device,
    choose_precision,
    in_precision,
    keep_freed_memory,
    one_thread,
    repeatable,
    threads,
)
from cloning.errors import ModelError, RecordingError
from cloning.files import set_aside, write
from cloning.pilot.network import CROP, UNITS, Network, layer_table, load_model, save_model, versions
from cloning.recordings.check import check_images
from cloning.recordings.format import FRAME, LOG
from cloning.recordings.images import decode
from cloning.recordings.log import Recording, find_folders, print_findings, read_recording
from cloning.training.options import load_resumed, model_files, parse
from cloning.training.pictures import batch_pictures, loss_picture
from cloning.training.pieces import PIECE, SquaredErrors
from cloning.training.robust import ROWS, Lanes, Poses

# The recipe's figures (report, "Data Pipeline") that are no options.
STRAIGHT, KEEP_STRAIGHT = 0.02, 0.8  # |steering| below which an observation is kept with this probability
TURN, JITTER = (0.2, 0.5), 0.01  # |steering| above, to: a copy is added, its angle perturbed by this share at most
REPEATED, REPEATS = ("-repetitive", "-corrections"), 4  # ends of the names of problem areas' folders
BLOCK_SECONDS, FOLDS = 2.0, 5  # validation takes every fifth stretch of two seconds
FLIP, SHADOW = 0.9, 0.8  # probabilities; each observation's own image and a brightened copy are always there
BRIGHTNESS, DARKNESS = (0.4, 1.2), (0.2, 0.5)  # factors of HSV value and HLS lightness
PICTURE_EVERY = 6400  # observations

KEEP_CROPPED = 5_000  # decoded images that are kept in memory: 360 MB, and half the generator's work
SAVE_SECONDS = 30  # at most this much work is lost to a kill


class Interrupted(Exception):
    """The run was asked to stop and has saved its state; args[0] is the signal."""


# --------------------------------------------------------------------------------------------------
# Recordings -> observations


@dataclass
class Observations:
    """What is trained on or validated with: one entry a row of a recording, or a copy of one.

    recordings  the folders' Recordings
    recording   int16 (n,): index into `recordings`
    images      int32 (n, 3): centre, left, right, indices into the recording's names
    steering    float32 (n,): -1..1, right positive
    frame       uint64 (n,): digest of the centre image's file
    time        float64 (n,): seconds
    lanes       with --robust, the lane beside each row; steering is then what leads back onto its centre
    """

    recordings: list[Recording]
    recording: np.ndarray
    images: np.ndarray
    steering: np.ndarray
    frame: np.ndarray
    time: np.ndarray
    lanes: Lanes | None = None

    def __post_init__(self):
        # Decoded images, by recording and image; memory is only taken as it is filled, all in one piece.
        self.rows = ROWS if self.lanes else slice(CROP[0], FRAME[0] - CROP[1])
        self.cropped = np.empty((KEEP_CROPPED, self.rows.stop - self.rows.start, *FRAME[1:]), np.uint8)
        self.places, self.free = {}, itertools.count()

    def __reduce__(self):  # for the other ranks: the rows, not the memory for images
        return Observations, tuple(getattr(self, one.name) for one in fields(self))

    def __len__(self):
        return len(self.steering)

    def take(self, rows: np.ndarray, steering=None) -> "Observations":
        return Observations(
            self.recordings,
            self.recording[rows],
            self.images[rows],
            self.steering[rows] if steering is None else steering,
            self.frame[rows],
            self.time[rows],
            self.lanes and self.lanes.take(rows),
        )

    def shuffled(self, rng: np.random.Generator) -> np.ndarray:
        """All of them once in a random order; with --robust as many, by lot, of bends more often: int (n,)."""
        n = len(self)
        return rng.choice(n, n, p=self.lanes.weights()) if self.lanes else rng.permutation(n)

    def image(self, at: int, camera: int, before: bool = False) -> int:
        """Index into the recording's names; before: of the earlier row that `lanes` has for this one."""
        images = self.recordings[self.recording[at]].images[self.lanes.before[at]] if before else self.images[at]
        return images[camera]

    def path(self, at: int, camera: int, before: bool = False) -> Path:
        recording = self.recordings[self.recording[at]]
        return recording.folder / "IMG" / os.fsdecode(recording.names[self.image(at, camera, before)])

    def read(self, at: int, camera: int, before: bool = False) -> np.ndarray:
        """uint8 (160, 320, 3), RGB. Raises RecordingError if the file has changed since it was checked."""
        path = self.path(at, camera, before)
        try:
            return decode(path.read_bytes())
        except (OSError, ValueError) as error:
            raise RecordingError(f"{path}: {error}; it was whole when the run began. Restore it and --resume") from None

    def read_cropped(self, at: int, camera: int, before: bool = False) -> np.ndarray:
        """uint8 (75, 320, 3), RGB, not to be changed; with lanes (90, 320, 3), the same rows at its end.

        The first KEEP_CROPPED of them are read and decoded only once.
        """
        key = self.recording[at], self.image(at, camera, before)
        if key in self.places:
            return self.cropped[self.places[key]]
        cropped = self.read(at, camera, before)[self.rows]
        if (place := next(self.free)) < KEEP_CROPPED:
            self.cropped[place] = cropped
            self.places[key] = place
        return cropped

    def center(self, rows: np.ndarray) -> np.ndarray:
        """The centre images of these rows as the network sees them: uint8 (len(rows), 75, 320, 3), RGB."""
        return np.stack([self.read_cropped(at, 0)[sum(CROP) - FRAME[0] :] for at in rows])

    def views(self, rows: np.ndarray, poses: list[Poses]) -> list[np.ndarray]:
        """What the network sees of these rows from each of the poses: uint8 (len(rows), 75, 320, 3), RGB, each."""
        made = [np.empty((len(rows), FRAME[0] - sum(CROP), *FRAME[1:]), np.uint8) for _ in poses]
        for i, at in enumerate(rows):
            read = functools.cache(functools.partial(self.read_cropped, at))
            for images, places in zip(made, poses, strict=True):
                images[i] = places.view(i, read)
        return made


def read_observations(
    folders: list[Path], throttle_threshold: float, strict: bool, rejected_file: Path, robust: bool = False
) -> Observations:
    """Steps 2 to 4 of the report: read each csv, drop rows off throttle, rewrite the images' paths; print the counts.

    robust: drop the rows where it is not known how the lane goes on, instead of those off throttle.
    Raises RecordingError when nothing is left, and with `strict` for the first row that is unusable.
    """
    recordings, lanes, table, rejected = [], [], [], []
    for folder in folders:
        recording = read_recording(folder)
        check_images(recording, threads())
        usable = len(recording)
        if robust:
            print(f"reading where the lane goes in {folder}", flush=True)
            lanes.append(Lanes.beside(recording))
            kept = int(lanes[-1].known.sum())
        else:
            recording.keep(recording.throttle >= throttle_threshold)
            kept = len(recording)
        recordings.append(recording)
        table.append((str(folder), recording.read, recording.read - usable, usable - kept, kept))
        print_findings(recording)
        rejected += [(folder / LOG, *row) for row in recording.rejected]
    if rejected:
        if strict:
            path, line, _, detail = rejected[0]
            raise RecordingError(f"{path}: line {line}: {detail} (--strict stops at {len(rejected)} unusable rows)")
        text = io.StringIO()
        csv.writer(text).writerows([("file", "line", "kind", "detail"), *rejected])
        write(rejected_file, text.getvalue().encode(errors="surrogateescape"))
        print(f"{len(rejected)} unusable rows are left out; all are listed in {rejected_file}")
    width = max(len(row[0]) for row in table)
    dropped = "way on unknown" if robust else f"throttle < {throttle_threshold:g}"
    print(f"\n{'recording':{width}}  rows read  unusable  {dropped}  kept")
    table.append(("total", *np.array([row[1:] for row in table]).sum(0)))
    for name, read, unusable, off, kept in table:
        print(f"{name:{width}}  {read:9,}  {unusable:8,}  {off:{len(dropped)},}  {kept:,}")
    joined = Lanes.joined(lanes) if robust else None
    steering = (
        joined.steering(joined.offset, joined.yaw) if robust else np.concatenate([r.steering for r in recordings])
    )
    observations = Observations(
        recordings,
        np.repeat(np.arange(len(recordings), dtype=np.int16), [len(r) for r in recordings]),
        np.concatenate([r.images for r in recordings]),
        steering,
        np.concatenate([r.digests[r.images[:, 0]] for r in recordings]),
        np.concatenate([r.time for r in recordings]),
        joined,
    )
    if robust:
        observations = observations.take(np.flatnonzero(observations.lanes.known))
    if len(observations) < FOLDS:
        why = f"see {rejected_file}"
        if table[-1][3] > table[-1][2]:
            why = "the drives are too short" if robust else "--throttle-threshold drops most of them"
        raise RecordingError(f"{len(observations)} rows are left of {table[-1][1]}, at least {FOLDS} are needed: {why}")
    return observations


def split(observations: Observations, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows for training (80 %) and validation (20 %), by stretches of two seconds spread over each recording.

    Neighbouring frames are near copies, so a random split would validate on what was trained on; and a frame that
    stands in several rows or folders goes, with all of them, where its first row goes.
    """
    n = len(observations)
    starts = np.ones(n, bool)  # of stretches without a break
    pause = np.diff(observations.time)
    starts[1:] = (np.diff(observations.recording) != 0) | (pause < 0) | (pause > 1)
    stretch = np.cumsum(starts) - 1
    second = observations.time - observations.time[starts][stretch]
    block = np.unique(np.stack([stretch, second // BLOCK_SECONDS]), axis=1, return_inverse=True)[1].ravel()
    if block[-1] + 1 < FOLDS:  # a few seconds in all
        block = np.arange(n) * FOLDS // n
    validation = (block + np.random.default_rng([seed, 0]).integers(FOLDS)) % FOLDS == 0
    _, first, which = np.unique(observations.frame, return_index=True, return_inverse=True)
    validation = validation[first][which]
    if validation.all() or not validation.any():
        raise RecordingError(f"{len(first)} different frames are too few to train and to validate with; record more")
    return np.flatnonzero(~validation), np.flatnonzero(validation)


def resample(observations: Observations, seed: int) -> Observations:
    """Steps 5 to 7 of the report: straight driving under-sampled, turns over-sampled, problem areas repeated."""
    rng, steering = np.random.default_rng([seed, 1]), observations.steering
    size = np.abs(steering)
    kept = np.flatnonzero((size >= STRAIGHT) | (rng.random(len(steering)) < KEEP_STRAIGHT))
    turns = np.flatnonzero((size > TURN[0]) & (size <= TURN[1]))
    jittered = steering[turns] * (1 + JITTER * rng.uniform(-1, 1, len(turns)))
    rows, angles = np.concatenate([kept, turns]), np.concatenate([steering[kept], jittered.astype(np.float32)])
    repeats = np.array([REPEATS if r.folder.resolve().name.endswith(REPEATED) else 1 for r in observations.recordings])
    times = repeats[observations.recording[rows]]
    return observations.take(np.repeat(rows, times), np.repeat(angles, times))


# --------------------------------------------------------------------------------------------------
# The generator


def multiply_channel(images: np.ndarray, channel: int, factors: np.ndarray, there: int, back: int) -> np.ndarray:
    """One channel of another colour space multiplied, rounded and clipped at 255: uint8 (n, rows, columns, 3).

    factors: (n,); there, back: OpenCV's conversions. OpenCV takes all images as one tall one, as long calls let the
    other threads go on.
    """
    if not len(images):
        return images
    tall = cv2.cvtColor(images.reshape(-1, *images.shape[2:]), there)
    values = cv2.extractChannel(tall, channel).reshape(len(images), -1)
    values = np.minimum(np.multiply(values, factors[:, None], dtype=np.float32) + np.float32(0.5), 255).astype(np.uint8)
    cv2.insertChannel(values.reshape(tall.shape[:2]), tall, channel)
    return cv2.cvtColor(tall, back, dst=tall).reshape(images.shape)


def brighten(images: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """RGB images, uint8 (n, rows, columns, 3), with their HSV value multiplied, clipped and never wrapped."""
    return multiply_channel(images, 2, factors, cv2.COLOR_RGB2HSV, cv2.COLOR_HSV2RGB)


def shade(images: np.ndarray, lines: np.ndarray, left: np.ndarray, factors: np.ndarray, first_row: int) -> np.ndarray:
    """RGB images, uint8 (n, rows, columns, 3), with the HLS lightness on one side of a line multiplied.

    lines: (n, 2), the columns where it meets the top and the bottom edge of the full frame of 160 rows; left: bool
    (n,), the side; factors: (n,); first_row: the full frame's row that is the images' first.
    """
    rows = np.arange(first_row, first_row + images.shape[1])
    edges = (lines[:, :1] + (lines[:, 1:] - lines[:, :1]) * rows / FRAME[0]).astype(np.float32)
    shadow = (np.arange(images.shape[2], dtype=np.float32) < edges[:, :, None]) == left[:, None, None]
    dark = multiply_channel(images, 1, factors, cv2.COLOR_RGB2HLS, cv2.COLOR_HLS2RGB)
    return np.where(shadow[..., None], dark, images)


def of_each_kind(images: np.ndarray) -> list[np.ndarray]:
    """What the recipe makes its kinds of (as it is, mirrored, brightened, shadowed) of images (n, rows, columns, 3)."""
    return [images, images[:, :, ::-1], images, images]


def rank() -> int:
    return dist.get_rank() if dist.is_initialized() else 0


def world() -> int:
    return dist.get_world_size() if dist.is_initialized() else 1


@dataclass
class Batch:
    """One rank's share of a batch.

    images uint8 (n, 75, 320, 3) RGB, cropped; angles float32 (n,); keep bool (n, 4224): what dropout leaves of the
    flattened layer; total: images in the whole batch, over all ranks; begin_next: to be called once this batch's
    work is handed to the pool, so that the next one's images are made where cores fall idle.
    """

    images: np.ndarray
    angles: np.ndarray
    keep: np.ndarray
    total: int
    begin_next: Callable[[], None] = lambda: None


class Generator:
    """Endless batches of the training observations: shuffled, a random camera each, augmented (report, "Augmenting").

    What a batch is made of depends on the seed and its number alone, so that a resumed run, or several processes,
    draw the same ones. Images are made by the pool's threads, `ahead` batches before they are needed.
    """

    def __init__(
        self, observations: Observations, batch_size: int, side_correction: float, seed: int, pool, ahead: int
    ):
        self.observations, self.batch_size, self.seed = observations, batch_size, seed
        self.corrections = np.array([0, side_correction, -side_correction], np.float32)  # centre, left, right
        self.pool, self.ahead = pool, ahead
        self.shuffled = functools.lru_cache(2)(
            lambda turn: observations.shuffled(np.random.default_rng([seed, 2, turn]))
        )

    def draw(self, number: int) -> dict[str, np.ndarray]:
        """All that chance decides in a batch; one entry an observation, but `keep` one an image."""
        rng, n = np.random.default_rng([self.seed, 3, number]), self.batch_size
        at = np.arange(number * n, (number + 1) * n)
        turns = at // len(self.observations)
        chosen = np.concatenate(
            [self.shuffled(int(turn))[at[turns == turn] % len(self.observations)] for turn in np.unique(turns)]
        )
        camera = rng.integers(3, size=n)
        kinds = np.stack([np.ones(n, bool), rng.random(n) < FLIP, np.ones(n, bool), rng.random(n) < SHADOW], axis=1)
        total = int(kinds.sum())
        places = np.full(kinds.shape, -1)
        places[kinds] = rng.permutation(total)  # the batch is shuffled
        angle = self.observations.steering[chosen] + self.corrections[camera]
        angles = np.stack([angle, -angle, angle, angle], axis=1)
        bits = np.unpackbits(np.frombuffer(rng.bytes(total * UNITS // 8), np.uint8))
        drawn = {
            "observation": chosen,
            "camera": camera,
            "places": places,
            "angles": angles,
            "brightness": rng.uniform(*BRIGHTNESS, n),
            "darkness": rng.uniform(*DARKNESS, n),
            "line": rng.uniform(0, FRAME[1], (n, 2)),
            "left": rng.random(n) < 0.5,
            "keep": bits.view(bool).reshape(total, UNITS),
        }
        if self.observations.lanes:  # every kind from a pose of its own, half of them in the mirror world
            near = self.observations.lanes.take(chosen)
            drawn["poses"] = [near.drawn(rng, rng.random(n) < 0.5) for _ in range(kinds.shape[1])]
            drawn["angles"] = np.stack([poses.steering for poses in drawn["poses"]], axis=1)
        return drawn

    def images(self, drawn: dict, part: np.ndarray) -> list[np.ndarray]:
        """What each kind is made of, for these of the batch's observations: uint8 (len(part), 75, 320, 3) each."""
        if self.observations.lanes:
            return self.observations.views(drawn["observation"][part], [poses.take(part) for poses in drawn["poses"]])
        images = np.stack(
            [
                self.observations.read_cropped(at, camera)
                for at, camera in zip(drawn["observation"][part], drawn["camera"][part], strict=True)
            ]
        )
        return of_each_kind(images)

    def augment(self, drawn: dict, part: np.ndarray, images: list[np.ndarray], first_row: int):
        """Of each kind (as it is, mirrored, brightened, shadowed): which observations have it, and their images.

        part: indices into the batch's observations; images: what each kind is made of, uint8 (len(part), rows, 320, 3);
        first_row: the full frame's row that is the images' first.
        """
        plain, flipped, bright, dark = images
        some, shadowed = (np.flatnonzero(drawn["places"][part, kind] >= 0) for kind in (1, 3))
        shade_at = part[shadowed]
        shadow = drawn["line"][shade_at], drawn["left"][shade_at], drawn["darkness"][shade_at]
        return (
            (part, plain),
            (part[some], flipped[some]),
            (part, brighten(bright, drawn["brightness"][part])),
            (shade_at, shade(dark[shadowed], *shadow, first_row)),
        )

    def begin(self, number: int):
        """Start making this rank's share of a batch; the returned call waits for it."""
        drawn = self.draw(number)
        mine = np.arange(self.batch_size)[rank() :: world()]
        places = drawn["places"][mine]
        order = np.sort(places[places >= 0])  # this rank's images among all, in the batch's order
        images = np.empty((len(order), FRAME[0] - sum(CROP), *FRAME[1:]), np.uint8)
        angles = np.empty(len(order), np.float32)

        def make(part):
            for kind, (which, made) in enumerate(self.augment(drawn, part, self.images(drawn, part), CROP[0])):
                at = np.searchsorted(order, drawn["places"][which, kind])
                images[at], angles[at] = made, drawn["angles"][which, kind]

        parts = [self.pool.submit(make, mine[start : start + PIECE]) for start in range(0, len(mine), PIECE)]

        def wait() -> Batch:
            for part in parts:
                part.result()
            return Batch(images, angles, drawn["keep"][order], len(drawn["keep"]))

        return wait

    def batches(self, number: int):
        """Batches from this number on."""
        begun, numbers = deque(), itertools.count(number)

        def begin_next():
            begun.append(self.begin(next(numbers)))

        while True:
            while len(begun) < self.ahead:
                begin_next()
            batch = begun.popleft()()
            batch.begin_next = begin_next
            yield batch


# --------------------------------------------------------------------------------------------------
# Training: the run


class TrainingRun:
    """A training run: its state, and the files that it leaves. rank 0 writes them."""

    def __init__(self, arguments: argparse.Namespace, training: Observations, validation: Observations):
        self.arguments, self.training, self.validation = arguments, training, validation
        self.device = choose_device(arguments.device)
        self.precision = choose_precision(self.device)
        self.last_file, self.best_file, self.resume_file = model_files(arguments.output)
        self.folder = self.last_file.parent
        torch.manual_seed(arguments.seed)
        self.network = Network().to(self.device, memory_format=torch.channels_last)
        repeatable(self.device)
        one_thread()
        self.pool = ThreadPoolExecutor(threads(), initializer=one_thread)
        self.errors = SquaredErrors(self.network, self.precision, self.device, self.pool)
        if dist.is_initialized():
            self.errors = DistributedDataParallel(self.errors)
        self.optimizer = torch.optim.Adam(self.network.parameters(), arguments.learning_rate, fused=True)
        self.generator = Generator(
            training,
            arguments.batch_size,
            arguments.side_correction,
            arguments.seed,
            self.pool,
            ahead=1 if self.device.type == "cpu" else 4,
        )
        self.number = 0  # of the next batch, over all epochs
        self.images, self.loss, self.seconds = 0, 0.0, 0.0  # so far in this epoch
        self.history: list[dict] = []  # a finished epoch each
        self.saved_at = time.monotonic()
        self.signal = 0

    @functools.cached_property
    def fingerprint(self) -> str:
        """Of what is trained on and validated with: a resumed run must go on with the same."""
        digest = hashlib.blake2b(digest_size=16)
        for part in (self.training, self.validation):
            digest.update(part.frame.tobytes() + part.steering.tobytes())
        return digest.hexdigest()

    def save(self, *models: Path) -> None:
        """Write these models, and then model-resume.pt with all that --resume needs."""
        if rank() == 0:
            more = {"arguments": vars(self.arguments), "history": self.history}
            for path in models:
                save_model(path, self.network, **more)
            save_model(
                self.resume_file,
                self.network,
                **more,
                training={
                    "optimizer": self.optimizer.state_dict(),
                    "number": self.number,
                    "images": self.images,
                    "loss": self.loss,
                    "seconds": self.seconds,
                    "fingerprint": self.fingerprint,
                },
            )
        self.saved_at = time.monotonic()

    def resume(self, saved: dict) -> None:
        """Go on from a checkpoint. Raises ModelError if the recordings are not those that it was trained on."""
        state = saved["training"]
        if state["fingerprint"] != self.fingerprint:
            raise ModelError(
                f"{self.resume_file}: its recordings were others; restore them, or begin anew without --resume"
            )
        self.network.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.number, self.images, self.loss, self.seconds = (state[k] for k in ("number", "images", "loss", "seconds"))
        self.history = saved["history"]

    def train(self) -> None:
        """Epochs as in the report's log. Raises Interrupted, with everything saved, after SIGINT or SIGTERM."""
        batches = self.generator.batches(self.number)
        while len(self.history) < self.arguments.epochs:
            self.epoch(batches)
            started = time.monotonic()
            loss = self.validate()
            self.seconds += time.monotonic() - started
            is_best = loss < min((row["val_loss"] for row in self.history), default=float("inf"))
            row = {
                "epoch": len(self.history) + 1,
                "images": self.images,
                "seconds": round(self.seconds, 3),
                "loss": self.loss / self.images,
                "val_loss": loss,
            }
            self.history.append(row)
            self.images, self.loss, self.seconds = 0, 0.0, 0.0
            if rank() == 0:
                self.write_log()  # before the checkpoint, from which a killed run would not write this epoch's again
            self.save(self.last_file, *[self.best_file] * is_best)
            if rank() == 0:
                print(
                    "{images}/{0} [{1}] - {seconds:.0f}s - loss: {loss:.4f} - val_loss: {val_loss:.4f}".format(
                        self.arguments.samples_per_epoch, "=" * 30, **row
                    ),
                    flush=True,
                )

    def epoch(self, batches) -> None:
        """Batches until `samples_per_epoch` images are reached (as Keras counted), from where the epoch stands."""
        arguments, started = self.arguments, time.monotonic() - self.seconds
        if rank() == 0:
            print(f"Epoch {len(self.history) + 1}/{arguments.epochs}", flush=True)
        with tqdm(
            total=arguments.samples_per_epoch,
            initial=self.images,
            unit="image",
            leave=False,
            disable=None if rank() == 0 else True,
        ) as bar:
            while self.images < arguments.samples_per_epoch:
                self.draw_pictures()
                batch = next(batches)
                # DistributedDataParallel takes the mean over the ranks, each of which has its share of the sum.
                loss = self.errors(batch)
                (loss * (world() / batch.total)).backward()
                self.optimizer.param_groups[0]["lr"] = self.learning_rate()
                self.optimizer.step()
                self.optimizer.zero_grad()
                self.number += 1
                self.images += batch.total
                sums = torch.tensor([float(loss.detach()), float(self.signal)], dtype=torch.float64)
                if dist.is_initialized():
                    sums = sums.to(self.device)
                    dist.all_reduce(sums)
                self.loss += float(sums[0])
                self.seconds = time.monotonic() - started
                bar.update(batch.total)
                bar.set_postfix(loss=f"{self.loss / self.images:.4f}")
                if sums[1]:
                    self.save()
                    raise Interrupted(self.signal or signal.SIGTERM)
                if time.monotonic() - self.saved_at > SAVE_SECONDS:
                    self.save()

    def learning_rate(self) -> float:
        """Of the next step: the recipe's is constant, that of --robust falls to 0 along a cosine over the whole run."""
        arguments = self.arguments
        done = (len(self.history) + self.images / arguments.samples_per_epoch) / arguments.epochs
        return arguments.learning_rate * ((1 + math.cos(math.pi * done)) / 2 if arguments.robust else 1)

    def validate(self) -> float:
        """Mean squared error on centre images, unchanged; 0.2 x samples_per_epoch of them, or all if they are fewer.

        With --robust, as many views from other poses count as much.
        """
        count = min(len(self.validation), self.arguments.samples_per_epoch // 5)
        chosen = np.random.default_rng([self.arguments.seed, 4]).permutation(len(self.validation))[: max(count, 1)]
        mine = chosen[rank() :: world()]
        errors = torch.tensor(self.squared_errors(self.validation.center, mine, self.validation.steering))
        if self.validation.lanes:
            poses = self.validation_poses
            errors += self.squared_errors(
                lambda rows: self.validation.views(rows, [poses.take(rows)])[0], mine, poses.steering
            )
            errors /= 2
        if dist.is_initialized():
            errors = errors.to(self.device)
            dist.all_reduce(errors)
        return float(errors) / len(chosen)

    def squared_errors(self, frames: Callable, rows: np.ndarray, truth: np.ndarray) -> float:
        predicted = predict(self.network, frames, rows, self.device, self.precision, self.pool)
        return float(((predicted - truth[rows]) ** 2).sum())

    @functools.cached_property
    def validation_poses(self) -> Poses:
        rows = len(self.validation)
        return self.validation.lanes.drawn(np.random.default_rng([self.arguments.seed, 5]), np.zeros(rows, bool))

    def write_log(self) -> None:
        """training_log.csv and training_loss.png, from the history."""
        text = io.StringIO()
        table = csv.DictWriter(text, list(self.history[0]))
        table.writeheader()
        table.writerows(self.history)
        write(self.folder / "training_log.csv", text.getvalue().encode())
        write(self.folder / "training_loss.png", loss_picture(self.history))

    def draw_pictures(self) -> None:
        """Every 6,400 observations: a batch's first one, by the three cameras and augmented."""
        before, now = (n * self.arguments.batch_size for n in (self.number - 1, self.number))
        if rank() or before // PICTURE_EVERY == now // PICTURE_EVERY:
            return
        for name, png in batch_pictures(self.generator, self.number).items():
            write(self.folder / "diagnostic_images" / name.format(now // PICTURE_EVERY * PICTURE_EVERY), png)

    def summary(self) -> str:
        """The last and the best epoch's error, by how hard is steered, beside those of steering 0 and the mean."""
        truth = self.validation.steering
        guesses = {"steer 0": np.zeros_like(truth), "steer mean": np.full_like(truth, self.training.steering.mean())}
        for path in (self.last_file, self.best_file):
            guesses[path.name] = predict(
                load_model(path, self.device),
                self.validation.center,
                np.arange(len(truth)),
                self.device,
                self.precision,
                self.pool,
            )
        lines = ["\n" + f"{'validation: mean squared error':32} {'rows':>6}" + "".join(f"{n:>15}" for n in guesses)]
        size = np.abs(truth)
        for low, high in [(0, STRAIGHT), (STRAIGHT, TURN[0]), TURN, (TURN[1], 1.001), (0, 1.001)]:
            rows = (size >= low) & (size < high)
            if rows.any():
                errors = "".join(f"{np.mean((guess - truth)[rows] ** 2):15.4f}" for guess in guesses.values())
                lines.append(f"{f'steering of {low:g} to {min(high, 1):g}':32} {rows.sum():6,}{errors}")
        with np.errstate(invalid="ignore"):  # a constant correlates with nothing
            follows = [np.corrcoef(guess, truth)[0, 1] for guess in guesses.values()]
        whom = "correlation with the " + ("way back" if self.validation.lanes else "driver")
        lines.append(f"{whom:39}" + "".join(f"{value:15.2f}" for value in follows))
        if not follows[2] > 0.3:
            lines.append(f"{self.last_file} hardly follows the driver: train longer, or record more turns.")
        return "\n".join(lines)


def predict(network, frames: Callable, rows: np.ndarray, device, precision, pool) -> np.ndarray:
    """Steering for these rows, float32 (len(rows),); frames gives what the network sees of some of them."""

    def part(chosen):
        with torch.inference_mode(), in_precision(precision, device):
            return network(torch.from_numpy(frames(chosen)).to(device)).cpu().numpy()

    return np.concatenate(
        [np.empty(0, np.float32), *pool.map(part, [rows[i : i + PIECE] for i in range(0, len(rows), PIECE)])]
    )


# --------------------------------------------------------------------------------------------------
# The command


def prepare(arguments: argparse.Namespace, given: dict) -> tuple[Observations, Observations, dict | None]:
    """What is trained on, what is validated with, and the checkpoint to go on from."""
    saved = load_resumed(arguments, given)
    output = Path(arguments.output)
    (output.parent / "diagnostic_images").mkdir(parents=True, exist_ok=True)
    folders = find_folders(arguments.recordings)
    arguments.recordings = [str(folder.resolve()) for folder in folders]
    observations = read_observations(
        folders, arguments.throttle_threshold, arguments.strict, output.with_name("rejected_rows.csv"), arguments.robust
    )
    train, validation = split(observations, arguments.seed)
    training = observations.take(train)
    if not arguments.robust:
        training = resample(training, arguments.seed)
    print(
        f"\ntraining: {len(train):,} rows, {len(training):,} observations after resampling; "
        f"validation: {len(validation):,} rows\n"
    )
    return training, observations.take(validation), saved


def run(arguments: argparse.Namespace, given: dict) -> None:
    """All that the command does. Raises RecordingError, ModelError, OSError, Interrupted."""
    data = [None]
    if rank() == 0:
        try:
            data = [(*prepare(arguments, given), arguments)]
        except (RecordingError, ModelError, OSError) as error:
            data = [error]
    if dist.is_initialized():
        dist.broadcast_object_list(data)
    if isinstance(data[0], Exception):
        raise data[0]
    training, validation, saved, arguments = data[0]  # with --resume, the arguments are the checkpoint's on every rank
    one = TrainingRun(arguments, training, validation)
    if saved:
        one.resume(saved)
    if rank() == 0:
        print(layer_table(one.network))
        print(
            f"\n{one.device}, {str(one.precision).removeprefix('torch.')}, {threads()} threads"
            + (f", {world()} processes" if world() > 1 else "")
        )
        if saved:
            print(f"resumed in epoch {len(one.history) + 1} at image {one.images:,}")
        else:
            set_aside(one.last_file, one.best_file, one.resume_file)
        write(
            one.folder / "training_arguments.json",
            json.dumps({**vars(arguments), "precision": str(one.precision), "versions": versions()}, indent=2).encode(),
        )
    if not saved:
        one.save()

    def stop(number, _):
        if one.signal:
            raise KeyboardInterrupt  # asked twice
        one.signal = number

    handlers = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        one.train()
        if rank() == 0:
            print(f"{one.summary()}\n\nnext: python drive.py {one.last_file}")
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        one.pool.shutdown(cancel_futures=True)


def main(argv: list[str] | None = None) -> int:
    """Exit status: 0 done, 1 a file could not be written or read, 2 unusable input, 128 + signal when interrupted."""
    arguments, given = parse(argv)
    keep_freed_memory()
    status, message = 0, None
    if "RANK" in os.environ:  # torchrun's
        device = choose_device(arguments.device)
        if device.type == "cuda":
            torch.cuda.set_device(device)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        run(arguments, given)
    except (RecordingError, ModelError) as error:
        status, message = 2, f"error: {error}"
    except OSError as error:
        status, message = (
            1,
            (
                f"error: {error.filename}: {error.strerror}. What was written before stays; mend this "
                "and go on with --resume"
            ),
        )
    except Interrupted as error:
        status, message = 128 + error.args[0], "stopped and saved; go on with --resume"
    except KeyboardInterrupt:
        status, message = 128 + signal.SIGINT, "stopped at once; --resume goes on from what was saved last"
    if message and rank() == 0:
        print(message, file=sys.stderr)
    if dist.is_initialized():
        dist.destroy_process_group()
        # gloo's threads outlive the group; one that lets go of its last tensor while Python ends aborts the process.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


if __name__ == "__main__":
    sys.exit(main())
