"""The files of a run: its models, and the state from which --resume continues; no model is lost if it is killed.

A new run leaves an earlier run's models in place until its own first epoch has ended. Then it renames them to
model-previous.pt and model-best-previous.pt, or to -previous-2, -previous-3 … if that name is taken. The earlier run's
model-resume.pt has to go at the start, because --resume continues the new run from then on: it is renamed in the same
way if it contains a finished epoch, and replaced if it does not.
"""

import hashlib
import itertools
import json
import math
import os
import uuid
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch

from cloning.errors import ModelError
from cloning.files import write
from cloning.pilot.network import Network, load_checkpoint, save_model, versions
from cloning.training.observations import Observations
from cloning.training.options import Arguments, option

EpochMetrics = dict[str, float]  # a row of training_log.csv: epoch, images, seconds, loss, val_loss
NEVER_RESUMED = {"output", "device", "strict", "resume"}  # they belong to one process, not to the run
MAY_CHANGE = NEVER_RESUMED | {"recordings", "epochs"}  # with --resume; a fingerprint checks the recordings' contents


class RunFiles:
    """The paths of the files that a run writes: the model's, and all others in the same folder."""

    def __init__(self, output: str):
        """output: the model's file, such as model.pt; its folder need not exist."""
        self.last = Path(output)
        self.best = self.last.with_stem(f"{self.last.stem}-best")
        self.resume = self.last.with_stem(f"{self.last.stem}-resume")
        self.log = self.last.with_name("training_log.csv")
        self.losses = self.last.with_name("training_loss.png")
        self.arguments = self.last.with_name("training_arguments.json")
        self.rejected = self.last.with_name("rejected_rows.csv")
        self.pictures = self.last.with_name("diagnostic_images")


@dataclass
class Progress:
    """The progress of a run.

    number                 of the next batch, from 0, counted over all epochs
    images, loss, seconds  so far in this epoch; loss is the sum of squared errors
    history                the metrics of each finished epoch
    run                    a random identifier, by which a run recognises its own files
    """

    number: int = 0
    images: int = 0
    loss: float = 0.0
    seconds: float = 0.0
    history: list[EpochMetrics] = field(default_factory=list)
    run: str = field(default_factory=lambda: uuid.uuid4().hex)

    def finish_epoch(self, val_loss: float) -> bool:
        """Add the epoch to the history and begin the next one; return whether val_loss is the lowest so far.

        The first epoch always is, so that there is a best model even if the losses are not numbers.
        """
        earlier = [row["val_loss"] for row in self.history if not math.isnan(row["val_loss"])]
        is_best = not self.history or val_loss < min(earlier, default=math.inf)
        self.history.append(
            {
                "epoch": len(self.history) + 1,
                "images": self.images,
                "seconds": round(self.seconds, 3),
                "loss": self.loss / self.images,
                "val_loss": val_loss,
            }
        )
        self.images, self.loss, self.seconds = 0, 0.0, 0.0
        return is_best


def resumed_arguments(arguments: Arguments, given: frozenset[str]) -> tuple[Arguments, dict[str, Any] | None]:
    """Return a run's arguments and, with --resume, its checkpoint, which supplies arguments that are not given.

    given: the names of the arguments on the command line. The checkpoint is None for a new run. Raises ModelError.
    """
    path = RunFiles(arguments.output).resume
    if not arguments.resume:
        return arguments, None
    if not path.exists():
        print(f"{path}: nothing to resume yet; starting a new run")
        return arguments, None
    saved = load_checkpoint(path)
    if "training" not in saved:
        raise ModelError(f"{path}: contains no state to resume; give the --output of the run")
    initial: dict[str, Any] = saved["arguments"]
    for name in sorted(given - MAY_CHANGE):
        if name in initial and initial[name] != getattr(arguments, name):
            raise ModelError(
                f"{path}: the run began with {option(name)} {initial[name]}, not {getattr(arguments, name)}; "
                "leave the option out, or start a new run without --resume"
            )
    names = {item.name for item in fields(Arguments)} - NEVER_RESUMED - given
    return replace(arguments, **{name: value for name, value in initial.items() if name in names}), saved


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
        optimizer: torch.optim.Optimizer,
        data_fingerprint: str,
    ):
        """network, optimizer: whose state is saved and restored; data_fingerprint: of `fingerprint`."""
        self.files, self.arguments, self.network, self.optimizer = files, arguments, network, optimizer
        self.fingerprint = data_fingerprint

    def begin(self, progress: Progress, precision: torch.dtype, resumed: bool) -> None:
        """Write training_arguments.json and, unless the run is resumed, its first state."""
        settings = {**asdict(self.arguments), "precision": str(precision), "versions": versions()}
        write(self.files.arguments, json.dumps(settings, indent=2).encode())
        if resumed:
            print(f"resumed in epoch {len(progress.history) + 1} at image {progress.images:,}")
        else:
            if _has_finished_epoch(self.files.resume):
                set_aside(self.files.resume)
            self.save(progress)

    def save(self, progress: Progress, *models: Path) -> None:
        """Write the network to these files, then model-resume.pt with all that --resume needs. Raises OSError."""
        more = {"arguments": asdict(self.arguments), "history": progress.history, "run": progress.run}
        if models and len(progress.history) == 1:
            for path in (self.files.last, self.files.best):
                if path.exists() and _run_of(path) != progress.run:  # its own if it was killed in `save`
                    set_aside(path)
        for path in models:
            save_model(path, self.network, **more)
        save_model(
            self.files.resume,
            self.network,
            **more,
            training={
                "optimizer": self.optimizer.state_dict(),
                "number": progress.number,
                "images": progress.images,
                "loss": progress.loss,
                "seconds": progress.seconds,
                "fingerprint": self.fingerprint,
            },
        )

    def restore(self, saved: dict[str, Any]) -> Progress:
        """Load a checkpoint into network and optimizer and return its progress.

        Raises ModelError if the run was trained on other data.
        """
        path = self.files.resume
        try:
            state = saved["training"]
            if state["fingerprint"] != self.fingerprint:
                raise ModelError(
                    f"{path}: the run began with other recordings; restore them, or start a new run without --resume"
                )
            self.network.load_state_dict(saved["network"])
            self.optimizer.load_state_dict(state["optimizer"])
            progress = Progress(**{name: state[name] for name in ("number", "images", "loss", "seconds")})
            progress.history = saved["history"]
        except (KeyError, ValueError, RuntimeError) as error:
            raise ModelError(f"{path}: its contents do not fit this program ({error}); start a new run") from None
        progress.run = saved.get("run", progress.run)
        return progress


def set_aside(path: Path) -> None:
    """Rename an earlier run's file: append -previous, or -previous-2 … if that name is taken."""
    endings = itertools.chain(["previous"], (f"previous-{number}" for number in itertools.count(2)))
    previous = next(free for ending in endings if not (free := path.with_stem(f"{path.stem}-{ending}")).exists())
    os.rename(path, previous)
    print(f"{path} of an earlier run is now {previous}")


def _has_finished_epoch(path: Path) -> bool:
    """Return whether a file may contain a finished epoch."""
    try:
        return path.exists() and bool(load_checkpoint(path).get("history", True))
    except ModelError:
        return True  # unknown, so keep it


def _run_of(path: Path) -> str | None:
    """Return the identifier of the run that wrote a model; None if the file has none."""
    try:
        return load_checkpoint(path).get("run")
    except ModelError:
        return None
