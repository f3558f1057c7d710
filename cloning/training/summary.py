"""Make the tables that a training run prints and logs: recordings, epochs and errors."""

import itertools
import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch

from cloning.base.errors import RecordingError, printable
from cloning.base.files import csv_bytes, write
from cloning.base.outputs import as_typed, plural
from cloning.base.progress import Bar
from cloning.network.compute import threads
from cloning.network.layer_table import layer_table
from cloning.network.network import Network
from cloning.recordings.format import DRIVING_LOG
from cloning.recordings.log import Recording
from cloning.training.checkpoint import Progress
from cloning.training.distributed import Ranks
from cloning.training.observations import Observations
from cloning.training.recipe import Recipe
from cloning.training.run_files import EpochMetrics, RunFiles, best_epoch

MIN_CORRELATION = 0.3  # with the labels; below it, the model has hardly learned anything
# By val_drift in m, how networks drove in the stand-in simulator: see the study in writeup_report.md.
VERDICTS = (
    (0.8, "Networks like this one stay on the road."),
    (1.6, "Networks like this one leave the road now and then."),
    (math.inf, "Networks like this one leave the road often: {remedy}."),
)
TIMED_BATCHES, TIMED_SECONDS = 10, 5.0  # at least, before it prints how long the whole run takes


class Counts(NamedTuple):
    """Counts of a recording's rows: read from the csv, cut, unusable, dropped by `Recipe.select`, and kept."""

    recording: str
    rows_read: int
    cut: int
    unusable: int
    dropped: int
    kept: int

    @classmethod
    def of(cls, recording: Recording, kept: int) -> Self:
        """Return the counts of a checked recording; kept: number of its rows that are kept."""
        usable, cut = len(recording), sum(rows for _, rows in recording.cuts)
        unusable = recording.rows_read - cut - usable
        return cls(printable(str(recording.folder)), recording.rows_read, cut, unusable, usable - kept, kept)

    def too_few(self, needed: int, dropped: str) -> str:
        """Return that too few rows are kept, and the main reason; dropped: why `Recipe.select` drops rows."""
        reasons = {"record more": self.kept, dropped: self.dropped, "most can't be used, see above": self.unusable}
        reasons["excluded.csv cuts most of them"] = self.cut
        why = max(reasons, key=reasons.__getitem__)
        return f"{self.kept} of {self.rows_read} rows are left, at least {needed} are needed: {why}"


def total(counts: list[Counts]) -> Counts:
    """Return the sums over all recordings."""
    return Counts("total", *(sum(column) for column in list(zip(*counts, strict=True))[1:]))


def recordings_table(counts: list[Counts], dropped: str) -> str:
    """Return a table with a line for each recording and one for all; dropped: the title of that column.

    It has a column for excluded rows if there are any.
    """
    width = max(len(row.recording) for row in counts)
    is_cut = total(counts).cut > 0
    lines = [f"\n{'recording':{width}}  rows read{'  excluded' * is_cut}  unusable  {dropped}  kept"]
    for name, rows_read, cut, unusable, off, kept in [*counts, total(counts)]:
        excluded = f"  {cut:8,}" * is_cut
        lines.append(f"{name:{width}}  {rows_read:9,}{excluded}  {unusable:8,}  {off:{len(dropped)},}  {kept:,}")
    return "\n".join(lines)


def refuse_rejected(recordings: Iterable[Recording]) -> None:
    """Raise RecordingError if a recording has unusable rows."""
    if rejected := _rejected(recordings):
        (path, line, _, detail), count = rejected[0], plural(len(rejected), "unusable line")
        raise RecordingError(f"{path}: line {line}: {detail} (--strict stops at {count})")


def list_rejected(recordings: Iterable[Recording], file: Path) -> None:
    """Write the unusable rows of all recordings to a csv file, or delete it if there are none. Raises OSError."""
    if rejected := _rejected(recordings):
        write(file, csv_bytes([("file", "line", "finding", "detail"), *rejected]))
        print(f"{plural(len(rejected), 'unusable line')} left out; {file} lists them")
    else:
        file.unlink(missing_ok=True)  # an earlier run's


def _rejected(recordings: Iterable[Recording]) -> list[tuple[Any, ...]]:
    """Return the file, line, finding and detail of each unusable row."""
    return [(recording.folder / DRIVING_LOG, *row) for recording in recordings for row in recording.rejected]


def tell_of_twins(observations: Observations) -> None:
    """Print how many frames are in several recordings, such as in one and in a part of it that was exported.

    observations: in the order of the recordings.
    """
    order = np.argsort(observations.frame, kind="stable")  # np.unique takes ten times as long
    frame, recording = observations.frame[order], observations.recording[order]
    if twins := len(np.unique(frame[1:][(frame[1:] == frame[:-1]) & (recording[1:] != recording[:-1])])):
        are = "frame is" if twins == 1 else "frames are"
        print(f"{twins:,} {are} in more than one of these recordings: there they count again, also if one cuts them")


def run_header(network: Network, device: torch.device, precision: torch.dtype, ranks: Ranks, layers: bool) -> str:
    """Return the network's size, with or without its layers, and what computes it: device, precision, threads."""
    processes = f", {ranks.world} processes" if ranks.world > 1 else ""
    name = str(precision).removeprefix("torch.")
    size = sum(parameter.numel() for parameter in network.parameters())
    table = f"{layer_table(network)}\n" if layers else ""
    return f"{table}\na network of {size:,} parameters on {device}, {name}, {plural(threads(), 'thread')}{processes}"


def epoch_line(row: EpochMetrics) -> str:
    """Return the line for a finished epoch, in the format of the report's log."""
    losses = f"loss: {row['loss']:.4f} - val_loss: {row['val_loss']:.4f}"
    drift = "" if math.isnan(row["val_drift"]) else f" - val_drift: {row['val_drift']:.2f} m"
    return f"{row['images']} images [{'=' * 30}] - {row['seconds']:.0f}s - {losses}{drift}"


class Pace:
    """Measures how fast this process trains, and estimates how long the rest of the run will take on this machine."""

    def __init__(self, recipe: Recipe, prints: bool = True):
        """prints: whether the estimate is printed once, too."""
        self.epochs, self.samples = recipe.epochs, recipe.samples_per_epoch
        self.batches = self.images = 0  # timed so far
        self.started: float | None = None  # time.monotonic() at the end of the first batch, which is slower
        self.to_print, self.rest = prints, ""

    def after_batch(self, images: int, progress: Progress) -> str:
        """Return the epoch's mean loss and the time left for the run, for a progress bar; images: in this batch."""
        loss = f"loss: {progress.loss / progress.images:.4f}"
        if self.started is None:
            self.started = time.monotonic()
            self.rest = "the rest of " if progress.history or progress.images > images else ""  # of a resumed run
            return loss
        self.batches, self.images = self.batches + 1, self.images + images
        seconds = time.monotonic() - self.started
        done = len(progress.history) * self.samples + progress.images
        left = max(0, self.epochs * self.samples - done) * seconds / self.images
        if self.to_print and self.batches >= TIMED_BATCHES and seconds >= TIMED_SECONDS:
            self.to_print = False
            epochs = plural(self.epochs, "epoch")
            Bar.write(f"about {duration(seconds + left)} for {self.rest}{epochs} on this machine")
        return f"{loss}, {duration(left)} left in all"


def duration(seconds: float) -> str:
    """Return a duration in words, as exact as an estimate is."""
    if seconds < 90:
        return f"{seconds:.0f} seconds"
    return f"{seconds / 60:.0f} minutes" if seconds < 90 * 60 else f"{seconds / 3600:.1f} hours"


def error_table(labels: np.ndarray, mean: float, models: Mapping[Path, np.ndarray], recipe: Recipe) -> str:
    """Return a table of mean squared error by range of |label|, and correlation, for constant steering and for models.

    labels: steering, float32 (n,); mean: of the training labels; models: file -> predictions, float32 (n,), last first.
    """
    edges, label_source = (0, recipe.straight, *recipe.turn, 1), recipe.words.label_source
    predictions = {"steer 0": np.zeros_like(labels), "steer mean": np.full_like(labels, mean)}
    predictions |= {path.name: guess for path, guess in models.items()}
    width = max(13, *map(len, predictions)) + 2
    titles = "".join(f"{name:>{width}}" for name in predictions)
    lines = [f"\n{'validation: mean squared error':32} {'rows':>6}{titles}"]
    size = np.abs(labels)
    for low, high in [*itertools.pairwise(edges), (edges[0], edges[-1])]:
        rows = (size >= low) & ((size < high) | (high == edges[-1]))
        if rows.any():
            errors = "".join(f"{np.mean((guess - labels)[rows] ** 2):{width}.4f}" for guess in predictions.values())
            lines.append(f"{f'steering of {low:g} to {high:g}':32} {rows.sum():6,}{errors}")
    correlations = {name: correlation(guess, labels) for name, guess in predictions.items()}
    values = "".join(f"{'-' if np.isnan(value) else f'{value:.2f}':>{width}}" for value in correlations.values())
    lines.append(f"{f'correlation with the {label_source}':39}{values}")
    lines.append("\nsteer 0 and steer mean, constant steering, are for comparison; they have no correlation (-).")
    lines[-1] += recipe.words.val_loss
    path, guess = next(iter(models.items()))
    last, worse = path.name, np.mean((guess - labels) ** 2) > np.mean(labels**2)
    if not correlations[last] > MIN_CORRELATION:
        lines.append(f"{last} hardly follows the {label_source}: train longer, or record more turns.")
    elif worse:
        lines.append(
            f"{last} has a larger error than steer 0, which is nearly right on straights.\n"
            f"It follows the {label_source} nevertheless. How well it drives, a replay tells:\n"
            + as_typed("python", "-m", "simulator", "replay", "RECORDING", "--model", path)
        )
    return "\n".join(lines)


def driving(history: list[EpochMetrics], recipe: Recipe, still: np.ndarray, files: RunFiles) -> str:
    """Return in words how the last and the best epoch's models will drive, "" if no piece of a drive is held out.

    still: float64 (n,), m, of `drift.still_drifts`.
    """
    last, best = history[-1], best_epoch(history, recipe.best_by)
    if math.isnan(last["val_drift"]) or not len(still):
        return ""
    verdict = next(words for limit, words in VERDICTS if last["val_drift"] <= limit).format(remedy=recipe.words.remedy)
    others = f"{still.mean():.2f} m with the wheels straight ahead"
    if best is not last and not math.isnan(best["val_drift"]):
        others = f"{best['val_drift']:.2f} m by {files.best.name} of epoch {best['epoch']:.0f}, {others}"
    return (
        f"\n\nSteered by {files.last.name} for two seconds, from where the driver was, a car is "
        f"{last['val_drift']:.2f} m from {recipe.words.aimed_at}\n"
        f"(mean of {plural(len(still), 'held-out stretch', 'held-out stretches')}; {others}).\n{verdict}"
    )


def correlation(predicted: np.ndarray, labels: np.ndarray) -> float:
    """Return Pearson's correlation, nan if either is constant; predicted, labels: (n,)."""
    if len(labels) < 2:
        return math.nan
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(predicted, labels)[0, 1])
