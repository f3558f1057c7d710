"""The files of a run: its models, and the state from which --resume continues; no model is lost if it is killed.

A new run leaves an earlier run's models in place until its own first epoch has ended. Before it replaces a file of an
earlier run, it copies it to model-previous.pt, model-best-previous.pt or model-resume-previous.pt; if an even earlier
run's files are there, to -previous-2, -previous-3 … A model-resume.pt without a finished epoch is not copied.

So at any time model-resume.pt is complete, and it alone says which run --resume continues: the earlier one until the
new one's first state has replaced it, which happens before the first batch, then the new one. A run recognises files
by the run's identifier in them: a killed run that is resumed never takes its own models for an earlier run's, and a
copy that was made before the kill is not made again.
"""

import itertools
import json
import math
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from cloning.base.errors import ModelError
from cloning.base.files import write
from cloning.base.outputs import plural
from cloning.network.network import (
    CROP,
    NETWORKS,
    PREPROCESSING,
    Network,
    load_checkpoint,
    read_network,
    read_preprocessing,
    restore_weights,
    save_model,
    versions,
)
from cloning.network.tensors import MAX_SIZE, MAX_STRUCTURE, matching, shown
from cloning.recordings.format import BINS
from cloning.training.observations import Data
from cloning.training.optimizers import Adam
from cloning.training.options import Command, Process, Run
from cloning.training.pictures import write_losses
from cloning.training.recipe import Recipe, option_name
from cloning.training.run_files import EpochMetrics, RunFiles, best_epoch

NEW_RUN = "start a new run without --resume"
POSITION = ("number", "images", "loss", "seconds", "smooth")  # of Progress
TRAIL_EVERY, TRAIL_LENGTH = 5, 2000  # batches between two losses of `Progress.trail`, doubled when it has so many
SMOOTHED = 0.9  # weight of the losses until then beside a batch's
METRICS = ("epoch", "images", "seconds", "loss", "val_loss", "val_drift")  # of EpochMetrics
COUNTS = {"number", "images", "epoch"}
MAY_CHANGE = {"recordings", "epochs"}  # with --resume; a fingerprint checks the recordings' contents
HUBER = {"squared": None, "huber": 0.1}  # the loss, in checkpoints of earlier versions


@dataclass
class Progress:
    """The progress of a run."""

    number: int = 0  # of the next batch, counted over all epochs
    images: int = 0  # so far in this epoch, as the next two
    loss: float = 0.0  # sum of squared errors
    seconds: float = 0.0
    smooth: float = 0.0  # mean loss of the last batches: an exponential moving average over some 10
    trail: list[float] = field(default_factory=list)  # smooth after every `trail_every` batches, of all epochs
    history: list[EpochMetrics] = field(default_factory=list)  # the metrics of each finished epoch
    # A random identifier, by which a run recognises its own files; None from an earlier version.
    run: str | None = field(default_factory=lambda: uuid.uuid4().hex)

    def add(self, images: int, loss: float) -> None:
        """Count a batch; loss: its sum of squared errors."""
        self.smooth = SMOOTHED * self.smooth + (1 - SMOOTHED) * loss / images if self.number else loss / images
        self.number += 1
        if self.number % self.trail_every == 0:
            self.trail.append(self.smooth)
        if len(self.trail) == TRAIL_LENGTH:
            del self.trail[::2]
        self.images += images
        self.loss += loss

    @property
    def trail_every(self) -> int:
        """The number of batches between two losses of the trail."""
        every = TRAIL_EVERY
        while self.number >= TRAIL_LENGTH * every:
            every *= 2
        return every

    def done(self, recipe: Recipe) -> float:
        """Return the finished share of the run, 0..1 or, in the last batch, a little more."""
        return (len(self.history) + self.images / recipe.samples_per_epoch) / recipe.epochs

    def finish_epoch(self, val_loss: float, val_drift: float, by: str = "val_loss") -> bool:
        """Add the epoch to the history and begin the next one; return whether its model is the best so far.

        val_drift: m, nan if unknown; by: see `best_epoch`. The first epoch always is, so that there is a best model
        even if the losses are not numbers.
        """
        loss = self.loss / self.images
        figures = (len(self.history) + 1, self.images, round(self.seconds, 3), loss, val_loss, val_drift)
        row = dict(zip(METRICS, figures, strict=True))
        self.history.append(row)
        self.images, self.loss, self.seconds = 0, 0.0, 0.0
        return best_epoch(self.history, by) is row


class SavedRun(NamedTuple):
    """A checkpoint of a run, which is to be continued."""

    run: Run
    progress: Progress
    contents: dict[str, Any]  # of the file, of which network and optimizer are not looked at yet


class FirstWeights(NamedTuple):
    """The weights with which a new run begins."""

    contents: dict[str, Any]  # of the model file, which fit this program's network


def read_first_weights(path: str, recipe: Recipe) -> FirstWeights:
    """Return the weights of a model file, which the recipe's network can have. Raises ModelError."""
    saved = load_checkpoint(path, "name a model file of model.py")
    try:
        _restore_network(NETWORKS[recipe.network](), saved)
    except ValueError as error:
        raise ModelError(f"{path}: its contents do not fit this program: {error}; name another model file") from None
    return FirstWeights({name: saved[name] for name in ("layers", PREPROCESSING, "network") if name in saved})


def read_saved_run(path: Path, recipes: Mapping[str, Recipe]) -> SavedRun:
    """Return the run of a checkpoint; recipes: those that may have trained it, by name. Raises ModelError."""
    contents = load_checkpoint(path, NEW_RUN)
    if "training" not in contents:
        raise ModelError(f"{path}: contains no state to resume; give the --output of the run")
    try:
        return SavedRun(_saved_run(contents, recipes), _progress(contents), contents)
    except ValueError as error:
        raise _unusable(path, error) from None


def resumed(command: Command) -> tuple[Run, SavedRun | FirstWeights | None]:
    """Return the run that a command is about, and with what it begins, if not with random weights.

    A run that is resumed has the arguments of its checkpoint, where they are not given. Raises ModelError.
    """
    run, process, given, recipes = command
    files = RunFiles(process.output)
    if not process.resume or not files.resume.exists():
        if process.resume:
            print(f"{files.resume}: nothing to resume yet; starting a new run")
        return run, read_first_weights(run.from_model, run.recipe) if run.from_model else None
    saved = read_saved_run(files.resume, recipes)
    began, wanted = _values(saved.run), _values(run)
    for name in sorted(given & began.keys() - MAY_CHANGE):
        if began[name] != wanted[name]:
            differs = f"the run began with {option_name(name)} {began[name]!r}, not {wanted[name]!r}"
            raise ModelError(f"{files.resume}: {differs}; leave the option out, or {NEW_RUN}")
    for model in (files.last, files.best):
        if saved.progress.history and model.exists() and _run_of(model) != saved.progress.run:
            other = f"damaged, or of another run than {files.resume.name}, which would replace it"
            raise ModelError(f"{model}: {other}; move it away first")
    epochs = run.recipe.epochs if "epochs" in given else saved.run.recipe.epochs
    begun = len(saved.progress.history) + (saved.progress.images > 0)
    if epochs < begun:
        raise ModelError(f"{files.resume}: the run is in epoch {begun}; give more --epochs, or leave the option out")
    recordings = run.recordings if "recordings" in given else saved.run.recordings
    return replace(saved.run, recordings=recordings, recipe=replace(saved.run.recipe, epochs=epochs)), saved


def _values(run: Run) -> dict[str, Any]:
    """Return all that a user may give of a run, by name."""
    values = run.saved()
    return {**values.pop("recipe"), **values, "robust": run.recipe.name == "robust"}


def _saved_run(contents: dict[str, Any], recipes: Mapping[str, Recipe]) -> Run:
    """Return the run that a checkpoint contains. Raises ValueError."""
    saved = contents.get("arguments")
    if not isinstance(saved, dict):
        raise ValueError("it has no arguments")
    if "recipe" not in saved:
        saved = _of_earlier_version(saved)
    figures = saved["recipe"]
    name = figures.get("name") if isinstance(figures, dict) else None
    if not isinstance(name, str) or name not in recipes:
        raise ValueError(f"its recipe is {shown(name)}, not {' or '.join(recipes)}")
    recordings, seed, from_model = (saved.get(key) for key in ("recordings", "seed", "from_model"))
    if not isinstance(recordings, list) or not all(type(folder) is str for folder in recordings):
        raise ValueError(f"its --recordings is of type {type(recordings).__name__}")
    if type(seed) is not int:
        raise ValueError(f"its --seed is of type {type(seed).__name__}")
    if type(from_model) is not str:
        raise ValueError(f"its --from is of type {type(from_model).__name__}")
    figures = {"exposure": (0.0, 0.0)} | figures  # earlier versions' networks had none
    return Run(recipes[name].restored(figures), tuple(recordings), seed, from_model)


def _of_earlier_version(saved: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of an earlier version, which were one flat dict, as `Run.saved` does. Raises ValueError."""
    loss, optimizer = saved.get("loss", "squared"), saved.get("optimizer", "adam")
    if not isinstance(loss, str) or loss not in HUBER:
        raise ValueError(f"its loss is {shown(loss)}, not {' or '.join(HUBER)}")
    figures = {**saved, "name": "robust" if saved.get("robust") is True else "report", "huber": HUBER[loss]}
    figures |= {"optimizer": optimizer} | ({"momentum": 0.9, "weight_decay": 0.0} if optimizer == "adam" else {})
    run = {"recordings": saved.get("recordings", ["data"]), "seed": saved.get("seed", 0)}
    return {**run, "from_model": saved.get("from_", ""), "recipe": figures}


def _restore_network(network: Network, saved: dict[str, Any]) -> None:
    """Give the network the weights of a checkpoint. Raises ValueError if they, or their preprocessing, do not fit."""
    if read_network(saved) is not type(network):
        raise ValueError(f"its layers are {shown(saved.get('layers'))}")
    *preprocessing, _ = read_preprocessing(saved)  # not the exposure, which the recipe tells
    if preprocessing != [network.crop, network.scale, network.offset]:
        raise ValueError("its preprocessing is not that of this program's network")
    restore_weights(network, saved)


def _progress(saved: dict[str, Any]) -> Progress:
    """Return the progress that a checkpoint contains. Raises ValueError."""
    state, history, run = saved["training"], saved.get("history"), saved.get("run")
    if not isinstance(state, dict) or not isinstance(history, list) or type(run) not in (str, type(None)):
        raise ValueError("it has no state, history or identifier of its run")
    values: list[tuple[str, Any]] = [(name, state.get(name)) for name in POSITION[:-1]]
    values += [("smooth", state.get("smooth", 0.0))]  # an earlier version had none
    trail = state.get("trail", [])
    if not isinstance(trail, list):
        raise ValueError(f"its trail is {shown(trail)}")
    for row in history:
        if isinstance(row, dict) and tuple(row) == METRICS[:-1]:
            row["val_drift"] = math.nan  # an earlier version did not measure it
        if not isinstance(row, dict) or tuple(row) != METRICS:
            raise ValueError(f"its history has {shown(row)}, not {', '.join(METRICS)}")
        values += row.items()
    for name, value in [*values, *(("trail", loss) for loss in trail)]:
        if not (type(value) is int and 0 <= value <= 10**12 if name in COUNTS else type(value) is float):
            raise ValueError(f"its {name} is {shown(value)}")
    return Progress(**dict(values[: len(POSITION)]), trail=trail, history=history, run=run)


def _unusable(path: Path, error: ValueError) -> ModelError:
    return ModelError(f"{path}: its contents do not fit this program: {error}; {NEW_RUN}")


class Checkpoint:
    """Writes the model files of a run, and restores the run from them."""

    def __init__(self, run: Run, process: Process, network: Network, optimizer: Adam, data: Data):
        """network, optimizer: whose state is saved and restored.

        Raises ModelError for a network that can't be saved whole, or sees other rows of a frame.
        """
        averages = [optimizer.zeros(index).values() for index in range(len(optimizer.parameters))]
        tensors = itertools.chain(network.state_dict().values(), *averages, [data.labels])
        size = sum(tensor.nbytes for tensor in tensors)
        if size > MAX_SIZE - MAX_STRUCTURE:
            raise ModelError(f"the network's weights and their averages take {size:,} bytes, too many for a file")
        frozen = not all(parameter.requires_grad for parameter in network.parameters())
        if frozen or next(network.buffers(), None) is not None:  # buffers: copies that compute gradients have their own
            raise ModelError("batch normalization (take GroupNorm), other buffers and frozen weights can't be trained")
        if network.crop != CROP:  # it would drive by other rows than those that it learns from
            raise ModelError(f"a network that crops frames by {network.crop}, not {CROP}, can't be trained here")
        self.run, self.process, self.network, self.optimizer = run, process, network, optimizer
        self.files, self.data = RunFiles(process.output), data
        self.resumed = False  # whether `restore` found a state of this run
        self.changed = 0.0  # by how much its labels differed, at most
        self._state: tuple[int, int] | None = None  # of model-resume.pt, as this run left it

    def begin(self, progress: Progress, precision: torch.dtype, labels: np.ndarray) -> None:
        """Write training_arguments.json and, first, unless the run is resumed, its first state.

        labels: float32 (n,), the steering of the observations for training, whose histogram is written, too.
        """
        if not self.resumed:
            if self.files.resume.exists() and _contents(self.files.resume).get("history") != []:
                self.set_aside(self.files.resume)
            self.save(progress)
        self._state = self.files.state()
        settings = {**self.run.saved(), **asdict(self.process), "precision": str(precision), "versions": versions()}
        counts, _ = np.histogram(labels, np.linspace(-1, 1, BINS + 1))
        settings["training"] = {"labels": counts.tolist()}
        write(self.files.arguments, json.dumps(settings, indent=2).encode())
        if self.resumed:
            if progress.history:  # in the place of its losses there may be another run's
                write_losses(self.files, progress.history, self.run.recipe.dropout)
            if progress.history and not progress.images and not self.files.last.exists():  # it was moved away
                self.save(progress, self.files.last)
            self._write_progress(progress)  # a killed run may not have come so far
            if len(progress.history) == self.run.recipe.epochs:
                print(f"the run has finished its {plural(len(progress.history), 'epoch')}; for more, raise --epochs")
            else:
                print(f"resumed in epoch {len(progress.history) + 1} at image {progress.images:,}")
            if self.changed:
                print(f"labels differ by up to {self.changed:.2g}, as --robust's on another processor; so will weights")
        elif self.run.from_model:
            print(f"begins with the weights of {self.run.from_model}, by the recipe {self.run.recipe.name}")
            print("it may have been trained on this run's validation frames: judge it by a recording that it never saw")

    def save(self, progress: Progress, *models: Path) -> None:
        """Write these models, then model-resume.pt with all that --resume needs, then how far it is.

        Raises OSError, and ModelError if another run writes there now: it has no locks, or was moved and made anew.
        """
        has_changed = self._state not in (None, self.files.state()) and self.files.resume.exists()
        if has_changed and _run_of(self.files.resume) != progress.run:
            raise ModelError(
                f"{self.files.resume}: now of another run, which goes on; start this one in another folder"
            )
        more = {"arguments": self.run.saved(), "history": progress.history, "run": progress.run}
        position = {name: getattr(progress, name) for name in POSITION}
        position["trail"] = progress.trail
        data = {"fingerprint": self.data.fingerprints[0], "labels": self.data.labels}
        training = {"optimizer": {"state": self.optimizer.state}, **position, **data}
        if models and len(progress.history) == 1:
            for path in (self.files.last, self.files.best):
                if path.exists() and _run_of(path) != progress.run:  # its own if it was killed in `save`
                    self.set_aside(path)
        for path in models:
            save_model(path, self.network, **more)
        save_model(self.files.resume, self.network, **more, training=training)
        self._state = self.files.state()
        self._write_progress(progress)  # last, so that it never tells of more than --resume continues with

    def _write_progress(self, progress: Progress) -> None:
        """Write training_progress.json: the run, finished epochs, and the position in the next one."""
        position = {
            "run": progress.run,
            "finished": len(progress.history),
            "batches": progress.number,
            "images": progress.images,
            "seconds": round(progress.seconds, 3),
            "loss": progress.loss / progress.images if progress.images else None,  # mean squared error in this epoch
            "trail_every": progress.trail_every,
            "trail": [float(f"{loss:.4g}") for loss in progress.trail],
        }
        write(self.files.progress, json.dumps(position).encode())

    def restore(self, begin: SavedRun | FirstWeights | None) -> Progress:
        """Load weights and, of a saved run, the optimizer's state, and return the run's progress.

        Raises ModelError if the run was trained on other data.
        """
        if isinstance(begin, FirstWeights):
            _restore_network(self.network, begin.contents)
        if not isinstance(begin, SavedRun):
            return Progress()
        state, self.resumed = begin.contents["training"], True
        try:
            self.changed = self.data.changed(state.get("fingerprint"), state.get("labels"))
        except ValueError:
            began = "the run began with other recordings, or by a version that reads them otherwise"
            raise ModelError(f"{self.files.resume}: {began}; restore them, or {NEW_RUN}") from None
        try:
            _restore_network(self.network, begin.contents)
            self._restore_optimizer(state.get("optimizer"), has_begun=begin.progress.number > 0)
        except ValueError as error:
            raise _unusable(self.files.resume, error) from None
        return begin.progress

    def _restore_optimizer(self, saved: object, has_begun: bool) -> None:
        """Load the averages of a checkpoint into the optimizer; its settings follow from the arguments."""
        averages = saved.get("state") if isinstance(saved, dict) else None
        indices = range(len(self.optimizer.parameters) if has_begun else 0)
        if not isinstance(averages, dict) or averages.keys() != set(indices):
            raise ValueError("the optimizer's state is not that of this network")
        state = {}
        for index in indices:
            try:
                state[index] = matching(averages[index], self.optimizer.zeros(index))
            except ValueError as error:
                raise ValueError(f"in the optimizer's state {index}: {error}") from None
        self.optimizer.restore(state)

    def set_aside(self, path: Path) -> None:
        """Copy an earlier run's file to its name with -previous, or -previous-2 …; nothing if there is a copy already.

        All files of a run get the same ending. A copy, not a new name: at any time, `path` is there.
        """
        data, run = path.read_bytes(), _run_of(path)
        for ending in itertools.chain(["previous"], (f"previous-{n}" for n in itertools.count(2))):
            files = (self.files.last, self.files.best, self.files.resume)
            copies = [file.with_stem(f"{file.stem}-{ending}") for file in files]
            copy = path.with_stem(f"{path.stem}-{ending}")
            if copy.exists():
                if copy.read_bytes() == data:  # made before this program was killed
                    return
            elif all(_run_of(other) == run for other in copies if other.exists()):
                write(copy, data)
                print(f"{path} of an earlier run is now {copy}")
                return


def _contents(path: Path) -> dict[str, Any]:
    """Return the contents of a model file; those of a damaged one are of an unknown run."""
    try:
        return load_checkpoint(path)
    except ModelError:
        return {"run": "?"}


def _run_of(path: Path) -> str | None:
    """Return the identifier of the run that wrote a model; None from an earlier version."""
    run = _contents(path).get("run")
    return run if type(run) is str else None
