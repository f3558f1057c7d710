"""The files of a run: its models, and the state from which --resume continues; no model is lost if it is killed.

A new run leaves an earlier run's models in place until its own first epoch has ended. Before it replaces a file of an
earlier run, it copies it to model-previous.pt, model-best-previous.pt or model-resume-previous.pt; if an even earlier
run's files are there, to -previous-2, -previous-3 … A model-resume.pt without a finished epoch is not copied.

So at any time model-resume.pt is complete, and it alone says which run --resume continues: the earlier one until the
new one's first state has replaced it, which happens before the first batch, then the new one. A run recognises files
by the run's identifier in them: a killed run that is resumed never takes its own models for an earlier run's, and a
copy that was made before the kill is not made again.
"""

import hashlib
import itertools
import json
import math
import uuid
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from cloning.base.errors import ModelError
from cloning.base.files import write
from cloning.network.network import Network, load_checkpoint, read_preprocessing, restore_weights, save_model, versions
from cloning.network.tensors import matching, shown
from cloning.training.adam import Adam
from cloning.training.muon import OPTIMIZERS
from cloning.training.observations import Observations
from cloning.training.options import Arguments, option
from cloning.training.pieces import LOSSES
from cloning.training.run_files import RunFiles

EpochMetrics = dict[str, float]  # a row of training_log.csv: epoch, images, seconds, loss, val_loss, val_drift
NEW_RUN = "start a new run without --resume"
PLACE = ("number", "images", "loss", "seconds")  # of Progress
METRICS = ("epoch", "images", "seconds", "loss", "val_loss", "val_drift")  # of EpochMetrics
COUNTS = {"number", "images", "epoch"}
NEVER_RESUMED = {"output", "device", "strict", "resume"}  # they belong to one process, not to the run
MAY_CHANGE = NEVER_RESUMED | {"recordings", "epochs"}  # with --resume; a fingerprint checks the recordings' contents


@dataclass
class Progress:
    """The progress of a run.

    number                 of the next batch, from 0, counted over all epochs
    images, loss, seconds  so far in this epoch; loss is the sum of squared errors
    history                the metrics of each finished epoch
    run                    a random identifier, by which a run recognises its own files; None from an earlier version
    """

    number: int = 0
    images: int = 0
    loss: float = 0.0
    seconds: float = 0.0
    history: list[EpochMetrics] = field(default_factory=list)
    run: str | None = field(default_factory=lambda: uuid.uuid4().hex)

    def told(self) -> dict[str, Any]:
        """Return what training_progress.json tells: the run, finished epochs, and the place in the next one.

        loss is the mean squared error so far in this epoch, None before its first batch.
        """
        loss = self.loss / self.images if self.images else None
        return {
            "run": self.run,
            "finished": len(self.history),
            "batches": self.number,
            "images": self.images,
            "seconds": round(self.seconds, 3),
            "loss": loss if loss is None or math.isfinite(loss) else None,
        }

    def finish_epoch(self, val_loss: float, val_drift: float, by: str = "val_loss") -> bool:
        """Add the epoch to the history and begin the next one; return whether its model is the best so far.

        val_drift: m, nan if unknown; by: see `best_epoch`. The first epoch always is, so that there is a best model
        even if the losses are not numbers.
        """
        row = {
            "epoch": len(self.history) + 1,
            "images": self.images,
            "seconds": round(self.seconds, 3),
            "loss": self.loss / self.images,
            "val_loss": val_loss,
            "val_drift": val_drift,
        }
        self.history.append(row)
        self.images, self.loss, self.seconds = 0, 0.0, 0.0
        return best_epoch(self.history, by) is row


def best_epoch(history: list[EpochMetrics], by: str) -> EpochMetrics:
    """Return the epoch whose model is the best, the first of equals.

    by: the metric whose lowest value is the best; it is val_loss if the last epoch's val_drift is unknown.
    """
    if math.isnan(history[-1]["val_drift"]):
        by = "val_loss"
    return min(history, key=lambda row: math.inf if math.isnan(row[by]) else row[by])


def resumed_arguments(arguments: Arguments, given: frozenset[str]) -> tuple[Arguments, dict[str, Any] | None]:
    """Return a run's arguments and, with --resume, its checkpoint, which supplies arguments that are not given.

    given: the names of the arguments on the command line. For a new run the checkpoint is None, or with --from the
    weights to begin with, without a state of training. Raises ModelError.
    """
    files = RunFiles(arguments.output)
    path = files.resume
    if not arguments.resume or not path.exists():
        if arguments.resume:
            print(f"{path}: nothing to resume yet; starting a new run")
        return arguments, _first_weights(arguments.from_) if arguments.from_ else None
    saved = load_checkpoint(path, NEW_RUN)
    if "training" not in saved:
        raise ModelError(f"{path}: contains no state to resume; give the --output of the run")
    try:
        initial, history = _initial_arguments(saved), _progress(saved).history
    except ValueError as error:
        raise _unusable(path, error) from None
    for name in sorted(given - MAY_CHANGE):
        began = initial.get(name, getattr(Arguments(), name))  # an earlier version had no such option
        if began != getattr(arguments, name):
            raise ModelError(
                f"{path}: the run began with {option(name)} {began!r}, not {getattr(arguments, name)!r}; "
                f"leave the option out, or {NEW_RUN}"
            )
    for model in (files.last, files.best):
        if history and model.exists() and _run_of(model) != saved.get("run"):
            raise ModelError(
                f"{model}: damaged, or of another run than {path.name}, which would replace it; move it away first"
            )
    return replace(arguments, **{name: value for name, value in initial.items() if name not in given}), saved


def _first_weights(path: str) -> dict[str, Any]:
    """Return what `Checkpoint.restore` needs of a model file with whose weights a new run begins. Raises ModelError."""
    saved = load_checkpoint(path, "name a model file of model.py")
    weights = {name: saved.get(name) for name in ("recipe", "network")}
    try:
        _restore_network(Network(), weights)
    except ValueError as error:
        raise ModelError(f"{path}: its contents do not fit this program: {error}; name another model file") from None
    return weights


def _restore_network(network: Network, saved: dict[str, Any]) -> None:
    """Give the network the weights of a checkpoint. Raises ValueError if they, or their recipe, do not fit."""
    if read_preprocessing(saved) != (network.crop, network.scale, network.offset):
        raise ValueError("its recipe is not that of this program's training")
    restore_weights(network, saved)


def _initial_arguments(saved: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments that a checkpoint supplies. Raises ValueError."""
    initial, known = saved.get("arguments"), {}
    if not isinstance(initial, dict):
        raise ValueError("it has no arguments")
    for name, default in asdict(Arguments()).items():
        if name not in NEVER_RESUMED:
            value = known[name] = initial.get(name, default)  # an earlier version may have had no such argument
            if type(value) is not type(default) or (name == "recordings" and not all(type(it) is str for it in value)):
                raise ValueError(f"its {option(name)} is of type {type(value).__name__}")
    for name, values in (("optimizer", OPTIMIZERS), ("loss", LOSSES)):
        if known[name] not in values:
            raise ValueError(f"its {name} is {shown(known[name])}, not {' or '.join(values)}")
    return known


def _progress(saved: dict[str, Any]) -> Progress:
    """Return the progress that a checkpoint contains. Raises ValueError."""
    state, history, run = saved["training"], saved.get("history"), saved.get("run")
    if not isinstance(state, dict) or not isinstance(history, list) or type(run) not in (str, type(None)):
        raise ValueError("it has no state, history or identifier of its run")
    values = [(name, state.get(name)) for name in PLACE]
    for row in history:
        if isinstance(row, dict) and tuple(row) == METRICS[:-1]:
            row["val_drift"] = math.nan  # an earlier version did not measure it
        if not isinstance(row, dict) or tuple(row) != METRICS:
            raise ValueError(f"its history has {shown(row)}, not {', '.join(METRICS)}")
        values += row.items()
    for name, value in values:
        if not (type(value) is int and 0 <= value <= 10**12 if name in COUNTS else type(value) is float):
            raise ValueError(f"its {name} is {shown(value)}")
    place: dict[str, Any] = {name: state[name] for name in PLACE}
    return Progress(**place, history=history, run=run)


def _unusable(path: Path, error: ValueError) -> ModelError:
    return ModelError(f"{path}: its contents do not fit this program: {error}; {NEW_RUN}")


def fingerprint(*observations: Observations) -> str:
    """Return a digest of a run's images and labels, which must not change before the run is resumed."""
    digest = hashlib.blake2b(digest_size=16)
    for part in observations:
        digest.update(part.frame.tobytes() + part.steering.tobytes())
    return digest.hexdigest()


class Checkpoint:
    """Writes the model files of a run, and restores the run from them."""

    def __init__(
        self,
        files: RunFiles,
        arguments: Arguments,
        network: Network,
        optimizer: Adam,
        data_fingerprint: str,
    ):
        """network, optimizer: whose state is saved and restored; data_fingerprint: of `fingerprint`."""
        self.files, self.arguments, self.network, self.optimizer = files, arguments, network, optimizer
        self.fingerprint = data_fingerprint
        self.resumed = False  # whether `restore` found a state of this run

    def begin(self, progress: Progress, precision: torch.dtype) -> None:
        """Write training_arguments.json and, first, unless the run is resumed, its first state."""
        if not self.resumed:
            if _has_finished_epoch(self.files.resume):
                self.set_aside(self.files.resume)
            self.save(progress)
        settings = {**asdict(self.arguments), "precision": str(precision), "versions": versions()}
        write(self.files.arguments, json.dumps(settings, indent=2).encode())
        if self.resumed:
            self._tell(progress)  # a killed run may not have come so far
            print(f"resumed in epoch {len(progress.history) + 1} at image {progress.images:,}")
        elif self.arguments.from_:
            print(f"begins with the weights of {self.arguments.from_}")

    def save(self, progress: Progress, *models: Path) -> None:
        """Write the network to these files, then model-resume.pt with all that --resume needs, then how far it is.

        Raises OSError.
        """
        more = {"arguments": asdict(self.arguments), "history": progress.history, "run": progress.run}
        if models and len(progress.history) == 1:
            for path in (self.files.last, self.files.best):
                if path.exists() and _run_of(path) != progress.run:  # its own if it was killed in `save`
                    self.set_aside(path)
        for path in models:
            save_model(path, self.network, **more)
        save_model(
            self.files.resume,
            self.network,
            **more,
            training={
                "optimizer": {"state": self.optimizer.state},
                **{name: getattr(progress, name) for name in PLACE},
                "fingerprint": self.fingerprint,
            },
        )
        self._tell(progress)  # last, so that it never tells of more than --resume continues with

    def _tell(self, progress: Progress) -> None:
        write(self.files.progress, json.dumps(progress.told()).encode())

    def restore(self, saved: dict[str, Any]) -> Progress:
        """Load a checkpoint of `resumed_arguments` into network and optimizer, and return its progress.

        Raises ModelError if the run was trained on other data.
        """
        if "training" not in saved:  # with --from, a new run
            _restore_network(self.network, saved)
            return Progress()
        path, self.resumed = self.files.resume, True
        try:
            progress, state = _progress(saved), saved["training"]
            if state.get("fingerprint") != self.fingerprint:
                raise ModelError(f"{path}: the run began with other recordings; restore them, or {NEW_RUN}")
            _restore_network(self.network, saved)
            self._restore_optimizer(state.get("optimizer"), has_begun=progress.number > 0)
        except ValueError as error:
            raise _unusable(path, error) from None
        return progress

    def _restore_optimizer(self, saved: object, has_begun: bool) -> None:
        """Load the averages of a checkpoint into the optimizer; its settings follow from the arguments."""
        averages = saved.get("state") if isinstance(saved, dict) else None
        numbers = range(len(self.optimizer.parameters) if has_begun else 0)
        if not isinstance(averages, dict) or averages.keys() != set(numbers):
            raise ValueError("the optimizer's state is not that of this network")
        state = {}
        for number in numbers:
            try:
                state[number] = matching(averages[number], self.optimizer.zeros(number))
            except ValueError as error:
                raise ValueError(f"in the optimizer's state {number}: {error}") from None
        self.optimizer.restore(state)

    def set_aside(self, path: Path) -> None:
        """Copy an earlier run's file to its name with -previous, or -previous-2 …; nothing if there is a copy already.

        All files of a run get the same ending. A copy, not a new name: at any time, `path` is there.
        """
        data, run = path.read_bytes(), _run_of(path)
        for ending in itertools.chain(["previous"], (f"previous-{number}" for number in itertools.count(2))):
            last, best, resume = (
                file.with_stem(f"{file.stem}-{ending}")
                for file in (self.files.last, self.files.best, self.files.resume)
            )
            copy = path.with_stem(f"{path.stem}-{ending}")
            if copy.exists():
                if copy.read_bytes() == data:  # made before this program was killed
                    return
            elif all(_run_of(file) == run for file in (last, best, resume) if file.exists()):
                write(copy, data)
                print(f"{path} of an earlier run is now {copy}")
                return


def _has_finished_epoch(path: Path) -> bool:
    """Return whether a file may contain a finished epoch."""
    try:
        return path.exists() and load_checkpoint(path).get("history") != []
    except ModelError:
        return True  # unknown, so keep it


def _run_of(path: Path) -> str | None:
    """Return the identifier of the run that wrote a model; None from an earlier version, "?" in no usable file."""
    try:
        run = load_checkpoint(path).get("run")
    except ModelError:
        return "?"
    return run if type(run) is str else None
