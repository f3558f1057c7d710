"""Train NVIDIA's network to predict steering from recordings of the Udacity simulator.

    python model.py                                     # all recordings (folders with a driving_log.csv) below data/
    python model.py data/lake-ccw data/lake-cw          # these recordings
    python model.py --robust                            # train for robustness rather than fidelity to the report
    python model.py --resume                            # continue a run that was stopped or killed
    python model.py --from model.pt                     # begin with the weights of a trained network
    torchrun --nproc_per_node=2 model.py data/lake-ccw  # two processes that share every batch

"The report" is the writeup of the Behavioral Cloning project that is reproduced here; this file follows it from top to
bottom. A run writes model.pt (the last epoch's model, as in the report), model-best.pt (the epoch that drives best),
model-resume.pt, training_loss.png, training_log.csv, training_arguments.json and pictures in diagnostic_images/.
"""

import functools
import itertools
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self, TypeVar

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("model.py")  # also while the libraries below are loaded

import cv2
import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from cloning.base.errors import RecordingError, UserError, message_of
from cloning.base.files import write
from cloning.base.frame import FRAME
from cloning.network.compute import choose_device, choose_precision, keep_freed_memory, one_thread, repeatable, threads
from cloning.network.network import CROP, UNITS, Network, load_model
from cloning.recordings.check import check_images
from cloning.recordings.format import CAMERAS
from cloning.recordings.frames import KEPT_FRAMES, FrameCache
from cloning.recordings.log import CheckedRecording, find_folders, print_findings, read_recording
from cloning.replay.drift import drifts, held_out, still_drifts
from cloning.training import summary
from cloning.training.checkpoint import Checkpoint, Progress, RunFiles, fingerprint, resumed_arguments
from cloning.training.distributed import from_first_rank, join_processes, leave_processes, rank, summed, world
from cloning.training.muon import OPTIMIZERS
from cloning.training.observations import SEEN_SHAPE, Augmented, Choices, Example, Observations, Views, center_digests
from cloning.training.options import Arguments, parse
from cloning.training.pictures import batch_pictures, loss_picture
from cloning.training.pieces import Batch, SquaredErrors, pieces, predict
from cloning.training.robust import RobustObservations
from cloning.training.stop import SIGNALS, Interrupted, StopSignals

# The numbers of the report's recipe that are not options.
STRAIGHT, KEEP_STRAIGHT = 0.02, 0.8  # below this |steering| an observation is kept with this probability
TURN, JITTER = (0.2, 0.5), 0.01  # within this range of |steering| a copy is added, its angle changed by up to 1 %
BLOCK_SECONDS, FOLDS = 2.0, 5  # every fifth block of two seconds is for validation
FLIP, SHADOW = 0.9, 0.8  # probabilities of these images; the unaltered and the brightened image are always made
BRIGHTNESS, DARKNESS = (0.4, 1.2), (0.2, 0.5)  # ranges of the factors of HSV value and HLS lightness
PICTURE_EVERY = 6400  # observations between two diagnostic pictures
SAVE_SECONDS = 30  # between two saved states: the most work that a killed run loses

Kind = TypeVar("Kind", bound=Observations)  # the report's or those of --robust


# ----------------------------------------------------------------------------------------------------------------------
# Data preprocessing: recordings -> observations


def read_observations(kind: type[Kind], folders: list[Path], arguments: Arguments, rejected_file: Path) -> Kind:
    """Read and filter the recordings (steps 2 to 4 of the report), and print the numbers of rows.

    Unusable rows are listed in `rejected_file`. Raises RecordingError if too few rows are left,
    and with --strict if a row is unusable.
    """
    parts, counts, frames = [], [], FrameCache(KEPT_FRAMES)
    for folder in folders:
        recording = check_images(read_recording(folder), threads(), frames)
        parts.append(kind.select(recording, arguments))
        counts.append(summary.Counts.of(recording, len(parts[-1])))
        print_findings(recording)
    observations, rows = kind.joined(parts), summary.total(counts)
    summary.list_rejected(observations.recordings, rejected_file, arguments.strict)
    print(summary.recordings_table(counts, kind.dropped(arguments)))
    if len(observations) < FOLDS:
        why = kind.too_few if rows.dropped > rows.unusable else f"see {rejected_file}"
        left = f"{len(observations)} of {rows.rows_read} rows are left"
        raise RecordingError(f"{left}, at least {FOLDS} are needed: {why}")
    return observations


@dataclass
class ReportObservations(Observations):
    """Observations for the report's training; with --robust, RobustObservations takes its place."""

    label_source: ClassVar[str] = "driver"
    too_few: ClassVar[str] = "--throttle-threshold drops most of them"
    dropout: ClassVar[bool] = True
    best_by: ClassVar[str] = "val_drift"
    aimed_at: ClassVar[str] = "the driver's path"
    remedy: ClassVar[str] = "train longer, record more, or use --robust"

    @staticmethod
    def dropped(arguments: Arguments) -> str:
        """Return what step 3 drops, as the title of a column."""
        return f"throttle < {arguments.throttle_threshold:g}"

    @classmethod
    def select(cls, recording: CheckedRecording, arguments: Arguments) -> Self:
        """Step 3: discard observations with little or no throttle; the label is the driver's steering."""
        rows = np.flatnonzero(recording.throttle >= arguments.throttle_threshold).astype(np.int32)
        number, digests = np.zeros(len(rows), np.int16), center_digests(recording, rows)
        return cls([recording], number, rows, recording.steering[rows], digests, recording.time[rows])

    def resample(self, seed: int, repeats: int) -> Self:
        """Steps 5 to 7: undersample straight driving, oversample turns with jitter, repeat problem areas."""
        rng, size = np.random.default_rng([seed, 1]), np.abs(self.steering)
        kept = np.flatnonzero((size >= STRAIGHT) | (rng.random(len(size)) < KEEP_STRAIGHT))
        turns = np.flatnonzero((size > TURN[0]) & (size <= TURN[1]))
        jittered = self.steering[turns] * (1 + JITTER * rng.uniform(-1, 1, len(turns)))
        rows = np.concatenate([kept, turns])
        labels = np.concatenate([self.steering[kept], jittered.astype(np.float32)])
        counts = self.counts(repeats)[rows]
        return self.take(np.repeat(rows, counts), np.repeat(labels, counts))

    def shuffle(self, rng: np.random.Generator, repeats: int) -> np.ndarray:
        """Step 8: return the indices of all observations in random order, int (n,)."""
        return rng.permutation(len(self))

    def sample_views(
        self, rows: np.ndarray, cameras: np.ndarray, side_correction: float, rng: np.random.Generator
    ) -> Views:
        """Return the given camera's image for each observation; the labels of side cameras are corrected."""
        return CameraViews(self, rows, cameras, side_correction)


# ----------------------------------------------------------------------------------------------------------------------
# Data subdivision


def split(observations: Observations, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices for training (80 %) and validation (20 %), in blocks of two seconds of each recording.

    Neighbouring frames are nearly equal, so a random split would validate on what was trained on. If several rows have
    the same frame, all are in the set of the first. Raises RecordingError if there are too few frames.
    """
    n = len(observations)
    drive, second = observations.drives()
    block = np.unique(np.stack([drive, second // BLOCK_SECONDS]), axis=1, return_inverse=True)[1].ravel()
    if block[-1] + 1 < FOLDS:  # less than ten seconds in all
        block = np.arange(n) * FOLDS // n
    validation = (block + np.random.default_rng([seed, 0]).integers(FOLDS)) % FOLDS == 0
    _, first, frame = np.unique(observations.frame, return_index=True, return_inverse=True)
    validation = validation[first][frame]
    if validation.all() or not validation.any():
        raise RecordingError(f"{len(first)} different frames are too few to train and to validate with; record more")
    return np.flatnonzero(~validation), np.flatnonzero(validation)


# ----------------------------------------------------------------------------------------------------------------------
# Augmentation: from each observation an unaltered, a flipped, a brightened and a shadowed image may be made.


class CameraViews(Views):
    """One camera's image of each observation of a batch, from which all four kinds of image are made."""

    def __init__(self, observations: Observations, rows: np.ndarray, cameras: np.ndarray, side_correction: float):
        """rows, cameras: int (n,); side_correction: added to left, subtracted from right labels."""
        self.observations, self.rows, self.cameras = observations, rows, cameras
        self.corrections = np.array([0, side_correction, -side_correction], np.float32)  # centre, left, right
        label = observations.steering[rows] + self.corrections[cameras]
        self.labels = np.stack([label, -label, label, label], axis=1)

    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """Return the images of some observations, int (k,), for each of the four kinds: uint8 (k, 75, 320, 3)."""
        chosen = zip(self.rows[part], self.cameras[part], strict=True)
        return kind_inputs(np.stack([self.observations.read_cropped(row, camera) for row, camera in chosen]))

    def example(self, i: int) -> Example:
        """Return the batch's observation number i for the diagnostic pictures."""
        row, camera = self.rows[i], self.cameras[i]
        frames = [self.observations.read(row, number) for number in range(len(CAMERAS))]
        labels, name = self.observations.steering[row] + self.corrections, f"{CAMERAS[camera]} camera"
        return Example(frames, labels, kind_inputs(frames[camera][None]), 0, [name, f"{name}, flipped", name, name])


def kind_inputs(images: np.ndarray) -> list[np.ndarray]:
    """Return the four kinds of image before brightening and shadowing: uint8 (n, rows, columns, 3) each."""
    flipped = cv2.flip(images.reshape(-1, *images.shape[2:]), 1).reshape(images.shape)
    return [images, flipped, images, images]


def multiply_channel(images: np.ndarray, channel: int, factors: np.ndarray, to: int, back: int) -> np.ndarray:
    """Multiply one channel of another colour space, rounded and clipped at 255.

    images: uint8 (n, rows, columns, 3), as the result; factors: (n,); to, back: OpenCV's codes of the conversions.
    OpenCV is given all images as one tall image, so that other Python threads can run during one long call.
    """
    if not len(images):
        return images
    tall = cv2.cvtColor(images.reshape(-1, *images.shape[2:]), to)
    values = cv2.extractChannel(tall, channel).reshape(len(images), -1)
    values = np.minimum(np.multiply(values, factors[:, None], dtype=np.float32) + np.float32(0.5), 255).astype(np.uint8)
    cv2.insertChannel(values.reshape(tall.shape[:2]), tall, channel)
    return cv2.cvtColor(tall, back, dst=tall).reshape(images.shape)


def brighten(images: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Multiply the HSV value of RGB images, uint8 (n, rows, columns, 3), clipped at 255; factors: (n,)."""
    return multiply_channel(images, 2, factors, cv2.COLOR_RGB2HSV, cv2.COLOR_HSV2RGB)


def shade(images: np.ndarray, lines: np.ndarray, left: np.ndarray, factors: np.ndarray, first_row: int) -> np.ndarray:
    """Multiply the HLS lightness of RGB images, uint8 (n, rows, columns, 3), on one side of a line.

    lines: (n, 2), the columns at which the line meets the top and bottom of the full frame of 160 rows; left: bool
    (n,), the side; factors: (n,); first_row: the row of the full frame that is the images' first.
    """
    rows = np.arange(first_row, first_row + images.shape[1])
    edges = (lines[:, :1] + (lines[:, 1:] - lines[:, :1]) * rows / FRAME[0]).astype(np.float32)
    lit = (np.arange(images.shape[2], dtype=np.float32) < edges[:, :, None]) != left[:, None, None]
    shaded = multiply_channel(images, 1, factors, cv2.COLOR_RGB2HLS, cv2.COLOR_HLS2RGB)
    np.copyto(shaded.view("V3"), images.view("V3"), where=lit[..., None])  # by pixels: takes a tenth of the time
    return shaded


def augment(choices: Choices, part: np.ndarray, images: list[np.ndarray], first_row: int) -> list[Augmented]:
    """Return the images of the four kinds (unaltered, flipped, brightened, shadowed) that a batch is to have.

    part: int (k,), indices into the batch; images: the four kinds before brightening and shadowing, uint8
    (k, rows, 320, 3) each; first_row: the row of the full frame that is the images' first.
    """
    unaltered, flipped, bright, dark = images
    flips, shadows = (np.flatnonzero(choices.places[part, kind] >= 0) for kind in (1, 3))
    shadowed = part[shadows]
    shadow = choices.line[shadowed], choices.left[shadowed], choices.darkness[shadowed]
    return [
        Augmented(part, unaltered),
        Augmented(part[flips], flipped[flips]),
        Augmented(part, brighten(bright, choices.brightness[part])),
        Augmented(shadowed, shade(dark[shadows], *shadow, first_row)),
    ]


class Generator:
    """Makes endless batches: observations in random order, each by a random camera, augmented and shuffled.

    The choices for a batch depend only on the seed and its number, so that a resumed run, or several processes, make
    the same batches. The pool's threads make the images, up to `ahead` batches before they are needed.
    """

    def __init__(self, observations: Observations, arguments: Arguments, pool: ThreadPoolExecutor, ahead: int):
        """pool: makes the images; ahead: number of batches that are made at the same time."""
        self.observations, self.arguments, self.pool, self.ahead = observations, arguments, pool, ahead
        seed, repeats, shuffle = arguments.seed, arguments.repeats, observations.shuffle
        self.shuffled = functools.lru_cache(2)(lambda n: shuffle(np.random.default_rng([seed, 2, n]), repeats))

    def sample(self, number: int) -> Choices:
        """Return the random choices for batch `number`, counted from 0."""
        rng, n = np.random.default_rng([self.arguments.seed, 3, number]), self.arguments.batch_size
        at = np.arange(number * n, (number + 1) * n)
        passes = at // len(self.observations)  # over all observations, each in another order
        parts = [self.shuffled(int(p))[at[passes == p] % len(self.observations)] for p in np.unique(passes)]
        chosen = np.concatenate(parts)
        camera = rng.integers(len(CAMERAS), size=n)
        kinds = np.stack([np.ones(n, bool), rng.random(n) < FLIP, np.ones(n, bool), rng.random(n) < SHADOW], axis=1)
        total_images = int(kinds.sum())
        places = np.full(kinds.shape, -1)
        places[kinds] = rng.permutation(total_images)  # the batch is shuffled
        bits = np.unpackbits(np.frombuffer(rng.bytes(total_images * UNITS // 8), np.uint8))
        keep = bits.view(bool).reshape(total_images, UNITS) if self.observations.dropout else None
        return Choices(
            observation=chosen,
            camera=camera,
            places=places,
            keep=keep,
            brightness=rng.uniform(*BRIGHTNESS, n),
            darkness=rng.uniform(*DARKNESS, n),
            line=rng.uniform(0, FRAME[1], (n, 2)),
            left=rng.random(n) < 0.5,
            views=self.observations.sample_views(chosen, camera, self.arguments.side_correction, rng),
        )

    def start_batch(self, number: int) -> Callable[[], Batch]:
        """Start making this process's share of batch `number`; return a function that waits for it and returns it."""
        choices = self.sample(number)
        mine = np.arange(self.arguments.batch_size)[rank() :: world()]
        places = choices.places[mine]
        order = np.sort(places[places >= 0])  # the places of this process's images among those of the whole batch
        images, labels = np.empty((len(order), *SEEN_SHAPE), np.uint8), np.empty(len(order), np.float32)

        def make(part: np.ndarray) -> None:
            for kind, (which, augmented) in enumerate(augment(choices, part, choices.views.images(part), CROP[0])):
                at = np.searchsorted(order, choices.places[which, kind])
                images[at], labels[at] = augmented, choices.views.labels[which, kind]

        parts = [self.pool.submit(make, mine[piece]) for piece in pieces(len(mine))]

        def wait() -> Batch:
            for part in parts:
                part.result()
            keep = None if choices.keep is None else choices.keep[order]
            return Batch(images, labels, keep, int((choices.places >= 0).sum()))

        return wait

    def batches(self, number: int) -> Iterator[Batch]:
        """Yield the batches from this number on."""
        started: deque[Callable[[], Batch]] = deque()
        numbers = itertools.count(number)

        def start_next() -> None:
            started.append(self.start_batch(next(numbers)))

        while True:
            while len(started) < self.ahead:
                start_next()
            batch = started.popleft()()
            batch.start_next = start_next
            yield batch


# ----------------------------------------------------------------------------------------------------------------------
# Training and validation


class TrainingRun:
    """A training run: network, optimizer, generator and progress; rank 0 writes its files."""

    def __init__(
        self, arguments: Arguments, training: Observations, validation: Observations, resumed: dict | None = None
    ):
        """resumed: a checkpoint to continue or begin with, or None. Raises ModelError if its data are others."""
        self.arguments, self.training, self.validation = arguments, training, validation
        self.device = choose_device(arguments.device)
        self.precision = choose_precision(self.device)
        self.files = RunFiles(arguments.output)
        torch.manual_seed(arguments.seed)
        self.network = Network().to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        repeatable(self.device)
        one_thread()
        self.pool = ThreadPoolExecutor(threads(), initializer=one_thread)
        self.errors: nn.Module = SquaredErrors(self.network, self.precision, self.pool, arguments.loss)
        if world() > 1:
            self.errors = nn.parallel.DistributedDataParallel(self.errors)
        self.optimizer = OPTIMIZERS[arguments.optimizer](self.network.parameters())
        self.generator = Generator(training, arguments, self.pool, ahead=2 if self.device.type == "cpu" else 4)
        self.predict = functools.partial(predict, device=self.device, precision=self.precision, pool=self.pool)
        data = fingerprint(training, validation)
        self.checkpoint = Checkpoint(self.files, arguments, self.network, self.optimizer, data)
        self.validation_sets = validation.validation_sets(arguments.seed)
        self.held_out = held_out(validation.recordings, validation.recording, validation.row, validation.aim())
        self.progress = self.checkpoint.restore(resumed) if resumed else Progress()
        self.pace, self.stop, self.saved_at = summary.Pace(arguments), StopSignals(), time.monotonic()

    def train(self) -> None:
        """Train the remaining epochs. Raises Interrupted, after saving the state, if a signal stops the run."""
        batches, progress = self.generator.batches(self.progress.number), self.progress
        while len(progress.history) < self.arguments.epochs:
            self.epoch(batches)
            started = time.monotonic()
            figures = self.validate()
            progress.seconds += time.monotonic() - started
            is_best, history = progress.finish_epoch(*figures, self.validation.best_by), progress.history
            if rank() == 0:  # first: a run killed before `save` repeats this
                write(self.files.log, summary.history_csv(history))
                write(self.files.losses, loss_picture(history, self.training.dropout))
            self.save(self.files.last, *[self.files.best] * is_best)
            if rank() == 0:
                print(summary.epoch_line(history[-1]), flush=True)

    def epoch(self, batches: Iterator[Batch]) -> None:
        """Train on whole batches until the epoch has at least `samples_per_epoch` images, as Keras 1 counts."""
        progress, samples = self.progress, self.arguments.samples_per_epoch
        started = time.monotonic() - progress.seconds
        if rank() == 0:
            print(f"Epoch {len(progress.history) + 1}/{self.arguments.epochs}", flush=True)
        hidden = None if rank() == 0 else True  # None: only on a terminal
        with tqdm(total=samples, initial=progress.images, unit="image", leave=False, disable=hidden) as bar:
            while progress.images < samples:
                self.write_pictures()
                batch = next(batches)
                loss = self.errors(batch)
                # DistributedDataParallel takes the mean over the processes, each of which has a share of the sum.
                (loss * (world() / batch.total)).backward()
                done = (len(progress.history) + progress.images / samples) / self.arguments.epochs
                self.optimizer.step(self.training.learning_rate(self.arguments, done))
                self.optimizer.zero_grad()
                progress.number += 1
                progress.images += batch.total
                local = torch.tensor([float(loss.detach()), float(self.stop.received)], dtype=torch.float64)
                squared_error, stopped = summed(local, self.device).tolist()
                progress.loss += squared_error
                progress.seconds = time.monotonic() - started
                bar.update(batch.total)
                bar.set_postfix_str(self.pace.after_batch(batch.total, progress))
                if stopped:
                    self.save()
                    raise Interrupted(self.stop.received or SIGNALS[-1])
                if time.monotonic() - self.saved_at > SAVE_SECONDS:
                    self.save()

    def validate(self) -> tuple[float, float]:
        """Return val_loss, of 0.2 x samples_per_epoch observations or all of each validation set, and val_drift, m."""
        count = min(len(self.validation), self.arguments.samples_per_epoch // 5)
        chosen = np.random.default_rng([self.arguments.seed, 4]).permutation(len(self.validation))[: max(count, 1)]
        mine, sets = chosen[rank() :: world()], self.validation_sets
        error = sum(float(((self.predict(self.network, x, mine) - y[mine]) ** 2).sum()) for x, y in sets)
        far = drifts(self.held_out[rank() :: world()], self.network, self.pool)
        error, metres, n = summed(torch.tensor([error, far.sum(), len(far)], dtype=torch.float64), self.device).tolist()
        return error / len(sets) / len(chosen), metres / n if n else math.nan

    def save(self, *models: Path) -> None:
        """Write the network to these files, and the state that --resume needs."""
        if rank() == 0:
            self.checkpoint.save(self.progress, *models)
        self.saved_at = time.monotonic()

    def write_pictures(self) -> None:
        """Write the diagnostic pictures of the batch's first observation, if 6,400 more observations are done."""
        before, now = (n * self.arguments.batch_size for n in (self.progress.number - 1, self.progress.number))
        if rank() or before // PICTURE_EVERY == now // PICTURE_EVERY:
            return
        for name, png in batch_pictures(self.generator.sample(self.progress.number), augment).items():
            write(self.files.pictures / name.format(now // PICTURE_EVERY * PICTURE_EVERY), png)

    def summary(self) -> str:
        """Return a table of the errors of the last and the best epoch's models, and in words how they will drive."""
        labels, mean, models = self.validation.steering, self.training.steering.mean(), {}
        for path in (self.files.last, self.files.best):
            network = load_model(path, self.device)
            models[path.name] = self.predict(network, self.validation.center, np.arange(len(labels)))
        table = summary.error_table(labels, mean, models, (0, STRAIGHT, *TURN, 1), self.validation.label_source)
        return table + summary.driving(self.progress.history, type(self.validation), still_drifts(self.held_out))


# ----------------------------------------------------------------------------------------------------------------------
# Main


def prepare(arguments: Arguments, given: frozenset[str]) -> tuple[Arguments, Observations, Observations, dict | None]:
    """Return the arguments, the training and validation observations, and what `resumed_arguments` returns."""
    arguments, checkpoint = resumed_arguments(arguments, given)
    kind: type[Observations] = RobustObservations if arguments.robust else ReportObservations
    folders = find_folders(arguments.recordings)
    arguments = replace(arguments, recordings=[str(folder.resolve()) for folder in folders])
    observations = read_observations(kind, folders, arguments, RunFiles(arguments.output).rejected)
    train, validation = split(observations, arguments.seed)
    training = observations.take(train).resample(arguments.seed, arguments.repeats)
    sizes = f"training: {len(train):,} rows, {len(training):,} observations after resampling"
    print(f"\n{sizes}; validation: {len(validation):,} rows\n")
    return arguments, training, observations.take(validation), checkpoint


def run(arguments: Arguments, given: frozenset[str]) -> None:
    """Read the data, train, and print the summary. Raises UserError, OSError, Interrupted, KeyboardInterrupt."""
    arguments, training, validation, checkpoint = from_first_rank(lambda: prepare(arguments, given))
    training_run = TrainingRun(arguments, training, validation, checkpoint)
    if rank() == 0:
        print(summary.run_header(training_run.network, training_run.device, training_run.precision))
        training_run.checkpoint.begin(training_run.progress, training_run.precision)
    try:
        with training_run.stop:
            training_run.train()
        if rank() == 0:
            print(f"{training_run.summary()}\n\nnext: python drive.py {training_run.files.last}")
    finally:
        training_run.pool.shutdown(cancel_futures=True)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 after an error, 128 + signal if stopped."""
    arguments, given = parse(argv)
    keep_freed_memory()
    join_processes(arguments.device)
    status, message, files = 0, "", RunFiles(arguments.output)
    try:
        with files.claimed():
            run(arguments, given)
    except UserError as error:
        status, message = 2, str(error)
    except OSError as error:
        remedy = f"all earlier files are intact. Remove the cause and {files.next_step(arguments.resume)}"
        status, message = 2, f"{message_of(error)}; {remedy}"
    except Interrupted as error:
        status, message = 128 + error.args[0], "stopped and saved; continue with --resume"
    except KeyboardInterrupt:
        status, message = 128 + SIGNALS[0], f"stopped at once; {files.next_step(arguments.resume)}"
    if message and (rank() == 0 or status == 2):  # the other ranks' errors are their own
        print(f"model.py: {message}", file=sys.stderr)
    return leave_processes(status)


if __name__ == "__main__":
    program.run(main)
