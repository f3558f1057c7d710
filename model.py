"""Train NVIDIA's network to predict steering from recordings of the Udacity simulator.

    python model.py                                     # all recordings (folders with a driving_log.csv) below data/
    python model.py data/lake-ccw data/lake-cw          # these recordings
    python model.py --robust                            # train for robustness rather than fidelity to the report
    python model.py --resume                            # continue a run that was stopped or killed
    python model.py --from model.pt                     # begin with the weights of a trained network
    torchrun --nproc_per_node=2 model.py data/lake-ccw  # two processes that share every batch

"The report" is the writeup of the Behavioral Cloning project that is reproduced here; this file follows it from top to
bottom, and REPORT has all its figures. A run writes model.pt (of the last epoch, as in the report), model-best.pt (of
the one that drives best), and more: see README.md. In a program: `train(replace(REPORT, flip=0.0), "data", "m.pt")`.
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("model.py")  # also while the libraries below are loaded

import functools
import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import default_rng
from torch import nn

from cloning.base.cores import threads
from cloning.base.errors import RecordingError, UserError
from cloning.base.files import write
from cloning.base.outputs import as_typed
from cloning.base.progress import progress_bar
from cloning.network import compute
from cloning.network.network import NETWORKS, load_model
from cloning.recordings.check import check_images
from cloning.recordings.format import CAMERAS
from cloning.recordings.frames import KEPT_FRAMES, FrameCache
from cloning.recordings.log import CheckedRecording, find_folders, print_findings, read_recording
from cloning.replay.drift import drifts, held_out, still_drifts
from cloning.training import options, summary
from cloning.training.checkpoint import Checkpoint, FirstWeights, SavedRun, resumed
from cloning.training.distributed import FirstRankFailed, Ranks
from cloning.training.lanes import Lanes
from cloning.training.light import brighten, choose_brightness, choose_shadow, shade
from cloning.training.observations import CameraViews, Choices, Data, Observations, centre_images
from cloning.training.optimizers import OPTIMIZERS
from cloning.training.options import Command, Process, Run
from cloning.training.pictures import batch_pictures, write_losses
from cloning.training.pieces import Batch, SquaredErrors, predict, start_batch
from cloning.training.recipe import Augmentation, Recipe, Words
from cloning.training.robust import robust
from cloning.training.run_files import RunFiles
from cloning.training.stop import SIGNALS, Interrupted, StopSignals, status_of

PICTURE_EVERY = 6400  # observations between two diagnostic pictures
VALIDATED = 4096  # observations at most: neighbours are nearly equal, and more took a fifth of a long epoch


# ----------------------------------------------------------------------------------------------------------------------
# Data preprocessing: recordings -> observations


def read_observations(recipe: Recipe, folders: list[Path], strict: bool) -> Observations:
    """Read and filter the recordings (steps 2 to 4 of the report), and print the numbers of rows.

    Raises RecordingError if too few rows are left, and if `strict` if a row is unusable.
    """
    parts, counts, frames = list[Observations](), [], FrameCache(KEPT_FRAMES)
    for folder in folders:
        recording = check_images(read_recording(folder), threads(), frames)
        parts.append(recipe.select(recording, recipe))
        counts.append(summary.Counts.of(recording, len(parts[-1])))
        print_findings(recording)
    observations, rows = Observations.of_recordings(parts), summary.total(counts)
    print(summary.recordings_table(counts, recipe.words.dropped.format(recipe=recipe)))
    if strict:
        summary.refuse_rejected(observations.recordings)
    summary.tell_of_twins(observations)
    if len(observations) < recipe.folds:
        raise RecordingError(rows.too_few(recipe.folds, recipe.words.too_few))
    return observations


def select_driven(recording: CheckedRecording, recipe: Recipe) -> Observations:
    """Step 3: discard observations with little or no throttle; the label is the driver's steering."""
    rows = np.flatnonzero(recording.throttle >= recipe.throttle_threshold)
    return Observations.of_rows(recording, rows, recording.steering[rows], Lanes.unknown(len(rows)))


def balance(observations: Observations, recipe: Recipe, seed: int) -> Observations:
    """Steps 5 to 7: undersample straight driving, oversample turns with jitter, repeat problem areas."""
    rng, size = default_rng([seed, 1]), np.abs(observations.steering)
    kept = np.flatnonzero((size >= recipe.straight) | (rng.random(len(size)) < recipe.keep_straight))
    turns = np.flatnonzero((size > recipe.turn[0]) & (size <= recipe.turn[1]))
    jittered = observations.steering[turns] * (1 + recipe.jitter * rng.uniform(-1, 1, len(turns)))
    rows = np.concatenate([kept, turns])
    labels = np.concatenate([observations.steering[kept], jittered.astype(np.float32)])
    counts = observations.counts(recipe.repeats)[rows]
    return observations.take(np.repeat(rows, counts), steering=np.repeat(labels, counts))


def shuffle(observations: Observations, recipe: Recipe, rng: np.random.Generator) -> np.ndarray:
    """Step 8: return the indices of all observations in random order, int (n,)."""
    return rng.permutation(len(observations))


# ----------------------------------------------------------------------------------------------------------------------
# Data subdivision


def split(observations: Observations, recipe: Recipe, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices for training (80 %) and validation (20 %), in blocks of two seconds of each recording.

    Neighbouring frames are nearly equal, so a random split would validate on what was trained on. If several rows have
    the same frame, all are in the set of the first. Raises RecordingError if there are too few frames.
    """
    n, folds = len(observations), recipe.folds
    drive, second = observations.drives()
    block = np.unique(np.stack([drive, second // recipe.block_seconds]), axis=1, return_inverse=True)[1].ravel()
    if block[-1] + 1 < folds:  # less than ten seconds in all
        block = np.arange(n) * folds // n
    validation = (block + default_rng([seed, 0]).integers(folds)) % folds == 0
    _, first, frame = np.unique(observations.frame, return_index=True, return_inverse=True)
    validation = validation[first][frame]
    if validation.all() or not validation.any():
        raise RecordingError(f"{len(first)} different frames are too few to train and to validate with; record more")
    return np.flatnonzero(~validation), np.flatnonzero(validation)


# ----------------------------------------------------------------------------------------------------------------------
# The recipe, and the generator: it makes an unaltered, a flipped, a brightened and a shadowed image of an observation


REPORT = Recipe(
    name="report",
    words=Words(
        dropped="throttle < {recipe.throttle_threshold:g}",
        too_few="--throttle-threshold drops most of them",
        label_source="driver",
        aimed_at="the driver's path",
        remedy="train longer, record more, or use --robust",
        val_loss="",
    ),
    # Data preprocessing
    select=select_driven,
    throttle_threshold=0.25,
    side_cameras=True,
    side_correction=0.2,
    resample=balance,
    straight=0.02,
    keep_straight=0.8,
    turn=(0.2, 0.5),
    jitter=0.01,
    repeats=4,
    order=shuffle,
    # Data subdivision: every fifth block of two seconds is for validation
    block_seconds=2.0,
    folds=5,
    validation_sets=centre_images,
    # Augmentation: the unaltered and the brightened image are always made
    views=CameraViews,
    augmentations=(
        Augmentation("unaltered"),
        Augmentation("flipped", mirrors=True, share="flip"),
        Augmentation("brightened", brighten, choose_brightness, caption="brightness x {:.2f}", gpu=True),
        Augmentation("shadowed", shade, choose_shadow, share="shadow", caption="shadow x {:.2f}", gpu=True),
    ),
    flip=0.9,
    brightness=(0.4, 1.2),
    shadow=0.8,
    darkness=(0.2, 0.5),
    # Training: NVIDIA's network with dropout, Adam and mean squared error
    network="nvidia",
    dropout=True,
    optimizer="adam",
    learning_rate=1e-4,
    cosine_decay=False,
    momentum=0.9,
    weight_decay=0.0,
    huber=None,
    batch_size=128,
    samples_per_epoch=20224,
    epochs=10,
    best_by="val_drift",
)
ROBUST = robust(REPORT)


class Generator:
    """Makes endless batches: observations in random order, each by a random camera, augmented and shuffled.

    The choices for a batch depend only on the seed and its number, so that a resumed run, or several processes, make
    the same batches. The pool's threads make the images, up to `ahead` batches before they are needed.
    """

    def __init__(
        self,
        observations: Observations,
        recipe: Recipe,
        seed: int,
        pool: ThreadPoolExecutor,
        first: int = 0,
        ranks: Ranks | None = None,
    ):
        """pool: makes the images; first: the next batch."""
        self.observations, self.recipe, self.seed, self.pool = observations, recipe, seed, pool
        # Batches made at the same time; only one on a GPU, in this thread, which makes it while the GPU computes.
        self.ahead, self.ranks = 1 if observations.gpu else 2, ranks or Ranks()
        self.numbers, self.started = itertools.count(first), deque[Callable[[], Batch]]()
        self.order = functools.lru_cache(2)(lambda n: recipe.order(observations, recipe, default_rng([seed, 2, n])))

    def sample(self, number: int) -> Choices:
        """Return the random choices for batch `number`, counted from 0."""
        recipe, rng, n = self.recipe, default_rng([self.seed, 3, number]), self.recipe.batch_size
        at = np.arange(number * n, (number + 1) * n)
        passes = at // len(self.observations)  # over all observations, each in another order
        parts = [self.order(int(p))[at[passes == p] % len(self.observations)] for p in np.unique(passes)]
        chosen, camera = np.concatenate(parts), rng.integers(len(CAMERAS), size=n) * recipe.side_cameras
        made = np.stack([rng.random(n) < share if share < 1 else np.ones(n, bool) for share in recipe.shares()], axis=1)
        made[0, 0] |= not made.any()  # a small batch of rare augmentations has one image, too
        total_images, slots = int(made.sum()), np.full(made.shape, -1)
        slots[made] = rng.permutation(total_images)  # the batch is shuffled
        units = NETWORKS[recipe.network].units
        bits = np.unpackbits(np.frombuffer(rng.bytes(-(-total_images * units // 8)), np.uint8))
        keep = bits[: total_images * units].view(bool).reshape(total_images, units) if recipe.dropout else None
        augmenting = [augmentation.choose(recipe, rng, n) for augmentation in recipe.augmentations]
        views = recipe.views(self.observations, chosen, camera, recipe, rng)
        return Choices(chosen, camera, slots, keep, augmenting, views)

    def start_batch(self, number: int) -> Callable[[], Batch]:
        """Start making this process's share of batch `number`; return a function that waits for it and returns it."""
        pool = None if self.observations.gpu else self.pool
        return start_batch(self.sample(number), self.recipe.augmentations, self.ranks.share, pool)

    def start_next(self) -> None:
        """Start making one more batch."""
        self.started.append(self.start_batch(next(self.numbers)))

    def next_batch(self) -> Batch:
        """Return the next batch, and see that enough others are started."""
        while len(self.started) < self.ahead:
            self.start_next()
        return self.started.popleft()()


# ----------------------------------------------------------------------------------------------------------------------
# Training and validation


class Prepared(NamedTuple):
    """A run, its observations, and with what it begins: None for random weights."""

    run: Run
    training: Observations
    validation: Observations
    begin: SavedRun | FirstWeights | None


class TrainingRun:
    """A training run: network, optimizer, generator and progress; rank 0 writes its files."""

    def __init__(self, prepared: Prepared, process: Process, ranks: Ranks):
        """Raises ModelError if the run is resumed and its data are others."""
        run, training, validation, begin = prepared
        recipe, aim = run.recipe, validation.lanes.from_middle()
        self.recipe, self.seed, self.process, self.ranks = recipe, run.seed, process, ranks
        self.device, self.files = compute.choose_device(process.device), RunFiles(process.output)
        self.precision = compute.choose_precision(self.device)
        network = compute.seeded(run.seed, functools.partial(NETWORKS[recipe.network], exposure=recipe.exposure))
        self.network = compute.placed(network, self.device)
        compute.repeatable(self.device)
        compute.one_thread()
        self.pool = ThreadPoolExecutor(threads(), initializer=compute.one_thread)
        self.training, self.validation = training, validation
        if self.device.type == "cuda" and recipe.on_gpu():
            self.training, self.validation = (part.on_gpu(self.device, self.pool) for part in (training, validation))
        self.errors: nn.Module = SquaredErrors(self.network, self.precision, self.pool, recipe.huber)
        if ranks.world > 1:
            self.errors = nn.parallel.DistributedDataParallel(self.errors)
        self.predict = functools.partial(predict, precision=self.precision, pool=self.pool)
        self.optimizer = OPTIMIZERS[recipe.optimizer](self.network.parameters(), recipe.momentum, recipe.weight_decay)
        self.checkpoint = Checkpoint(run, process, self.network, self.optimizer, Data.of(training, validation))
        self.progress = self.checkpoint.restore(begin)
        self.generator = Generator(self.training, recipe, run.seed, self.pool, self.progress.number, ranks)
        self.validation_sets = recipe.validation_sets(self.validation, recipe, run.seed)
        self.held_out = held_out(validation.recordings, validation.recording, validation.row, aim)
        self.pace, self.stop, self.saved_at = summary.Pace(recipe, ranks.first), StopSignals(), time.monotonic()

    def train(self) -> None:
        """Train the remaining epochs. Raises Interrupted, after saving the state, if a signal stops the run."""
        progress, history = self.progress, self.progress.history
        while len(history) < self.recipe.epochs:
            self.epoch()
            started = time.monotonic()
            with self.stop.at_once(self.save, alone=self.ranks.world == 1):
                figures = self.validate()
            self.check_finite(figures[0])
            progress.seconds += time.monotonic() - started
            is_best = progress.finish_epoch(*figures, self.recipe.best_by)
            if self.ranks.first:  # first: a run killed before `save` repeats this
                write_losses(self.files, history, self.recipe.dropout)
            self.save(self.files.last, *[self.files.best] * is_best)
            if self.ranks.first:
                print(summary.epoch_line(history[-1]), flush=True)

    def epoch(self) -> None:
        """Train on whole batches until the epoch has at least `samples_per_epoch` images, as Keras 1 counts."""
        recipe, progress, ranks = self.recipe, self.progress, self.ranks
        total, started = recipe.samples_per_epoch, time.monotonic() - progress.seconds
        self.network.train()
        if ranks.first:
            print(f"Epoch {len(progress.history) + 1}/{recipe.epochs}", flush=True)
        with progress_bar(total, "image", not ranks.first, initial=progress.images, leave=False) as bar:
            while progress.images < total:
                self.write_pictures()
                batch = self.generator.next_batch()
                # While the pool's threads compute the batch, the next one is begun, to be made after it.
                loss = self.errors(batch, self.generator.start_next)
                # DistributedDataParallel takes the mean over the processes, each of which has a share of the sum.
                (loss * (ranks.world / batch.total)).backward()
                self.optimizer.step(recipe.rate(progress.done(recipe)))
                self.optimizer.zero_grad()
                error, stopped = ranks.summed([float(loss.detach()), float(self.stop.received)], self.device)
                self.check_finite(error)
                progress.add(batch.total, error)
                progress.seconds = time.monotonic() - started
                bar.update(batch.total)
                bar.set_postfix_str(self.pace.after_batch(batch.total, progress), refresh=False)
                if stopped:
                    self.save()
                    raise Interrupted(self.stop.received or SIGNALS[-1])
                if time.monotonic() - self.saved_at > self.process.save_seconds:
                    self.save()

    def validate(self) -> tuple[float, float]:
        """Return val_loss, of 0.2 x samples_per_epoch, VALIDATED or all of the observations, and val_drift, m."""
        self.network.eval()  # as it drives: dark images are brightened, if the recipe says so
        most = min(max(self.recipe.samples_per_epoch // 5, 1), VALIDATED)
        chosen = default_rng([self.seed, 4]).permutation(len(self.validation))[:most]
        mine, sets = chosen[self.ranks.share], self.validation_sets
        guesses = [(self.predict(self.network, images, mine), labels[mine]) for images, labels in sets]
        error = sum(float(((guess - labels) ** 2).sum()) for guess, labels in guesses)
        far = drifts(self.held_out[self.ranks.share], self.network, self.pool)
        error, metres, driven = self.ranks.summed([error, float(far.sum()), float(len(far))], self.device)
        return error / len(sets) / len(chosen), metres / driven if driven else math.nan

    def check_finite(self, loss: float) -> None:
        """Raise UserError on rank 0, FirstRankFailed on the others, unless a loss is finite."""
        if not math.isfinite(loss):
            epoch, rate = len(self.progress.history) + 1, self.recipe.learning_rate
            error = f"epoch {epoch}: the loss is not finite; start again with a smaller --learning-rate than {rate:g}"
            raise UserError(error) if self.ranks.first else FirstRankFailed

    def save(self, *models: Path) -> None:
        """Write the network to these files, and the state that --resume needs. Raises UserError, OSError."""
        if self.ranks.first:
            self.check_finite(float(sum(values.sum() for values in self.network.state_dict().values())))
            self.checkpoint.save(self.progress, *models)
        self.saved_at = time.monotonic()

    def write_pictures(self) -> None:
        """Write the diagnostic pictures of the batch's first observation, if 6,400 more observations are done."""
        done, size = self.progress.number * self.recipe.batch_size, self.recipe.batch_size
        if self.ranks.first and done % PICTURE_EVERY < size:
            for name, png in batch_pictures(self.generator.sample(self.progress.number), self.recipe).items():
                write(self.files.pictures / name.format(done // PICTURE_EVERY * PICTURE_EVERY), png)

    def summary(self) -> str:
        """Return a table of the errors of the last and the best epoch's models, and in words how they will drive."""
        labels, mean = self.validation.steering, self.training.steering.mean()
        last, best = self.files.last, self.files.best
        guess = functools.partial(self.predict, images=self.validation.center, rows=np.arange(len(labels)))
        models = {last: guess(self.network.eval())}
        if best.exists():  # not if it was moved away before the run was resumed
            is_last = last.read_bytes() == best.read_bytes()
            models[best] = models[last] if is_last else guess(load_model(best, self.device))
        table = summary.error_table(labels, mean, models, self.recipe)
        return table + summary.driving(self.progress.history, self.recipe, still_drifts(self.held_out), self.files)


# ----------------------------------------------------------------------------------------------------------------------
# Main


def prepare(command: Command) -> Prepared:
    """Read the data of the run that a command is about. Raises UserError, OSError."""
    run, begin = resumed(command)
    folders = find_folders(run.recordings, exact=isinstance(begin, SavedRun) and "recordings" not in command.given)
    run = replace(run, recordings=tuple(str(folder.absolute()) for folder in folders))
    observations = read_observations(run.recipe, folders, command.process.strict)
    train, validation = split(observations, run.recipe, run.seed)
    training = run.recipe.resample(observations.take(train), run.recipe, run.seed)
    resampled = f"{len(train):,} rows, {len(training):,} observations after resampling"
    print(f"\ntraining: {resampled}; validation: {len(validation):,} rows\n")
    if not len(training):
        raise RecordingError("resampling has left out all rows for training, straight driving; record more")
    return Prepared(run, training, observations.take(validation), begin)


def run(command: Command, ranks: Ranks) -> None:
    """Read the data, train, and print the summary. Raises UserError, OSError, Interrupted, KeyboardInterrupt."""
    training_run = TrainingRun(ranks.from_first(lambda: prepare(command)), command.process, ranks)
    plain = training_run.recipe.name != ROBUST.name  # the layers are shown, as in the report
    if ranks.first:
        summary.list_rejected(training_run.training.recordings, training_run.files.rejected)  # not of a refused run
        print(summary.run_header(training_run.network, training_run.device, training_run.precision, ranks, plain))
        training_run.checkpoint.begin(training_run.progress, training_run.precision, training_run.training.steering)
    try:
        with training_run.stop:
            training_run.train()
        if ranks.first:
            following = as_typed("python", "drive.py", training_run.files.last)
            better = "\n`python model.py --robust` trains a network that drives better" if plain else ""
            print(program.in_commands(f"{training_run.summary()}\n\nnext: {following}{better}"))
    finally:
        training_run.pool.shutdown(cancel_futures=True)


@compute.own_settings()
def execute(command: Command) -> int:
    """Do what the command asks; return the exit status: 0, 2 after an error, 128 + signal if stopped."""
    compute.keep_freed_memory()
    ranks = Ranks.join(command.process.device)
    return ranks.leave(status_of(lambda: run(command, ranks), command.process, ranks))


def train(recipe: Recipe, recordings: Sequence[str | Path], output: str | Path, seed: int = 0, **process: Any) -> int:
    """Train a network by any recipe, as the command does; return the exit status, or under torchrun end with it.

    All as for the options, `from_model` as --from, too; a run is resumed only if its recipe and recordings are these.
    """
    folders = tuple(map(str, [recordings] if isinstance(recordings, str | Path) else recordings))
    run, own = Run(recipe, folders, int(seed), str(process.pop("from_model", None) or "")), {recipe.name: recipe}
    return execute(Command(run, Process(str(output), **process), options.given_by_program(run), own))


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return execute(options.parse(argv, REPORT, ROBUST))


if __name__ == "__main__":
    program.run(main)
