"""The files of a run: models and the state that --resume continues from, written so that a kill loses no model.

A new run leaves the models of an earlier run in place until its own first epoch has ended. Then it renames them to
model-previous.pt and model-best-previous.pt, or -previous-2, -previous-3 … where that name is taken. The earlier run's
model-resume.pt makes room at the start, because from then on --resume continues the new run: it is renamed in the same
way if it holds a finished epoch, and replaced if it does not, since then there is less than an epoch in it.
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

Row = dict[str, float]  # of training_log.csv: epoch, images, seconds, loss, val_loss
NEVER_RESUMED = {"output", "device", "strict", "resume"}  # they say where and how this process runs
MAY_CHANGE = NEVER_RESUMED | {"recordings", "epochs"}  # between start and --resume; recordings by their fingerprint


class RunFiles:
    """The paths of what a run leaves: the model, and everything else in the same folder."""

    def __init__(self, output: str):
        """output: the model's file, such as model.pt; the folder need not exist."""
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
    """How far a run has come.

    number                 of the next batch, counted over all epochs
    images, loss, seconds  so far in this epoch; loss is the sum of squared errors
    history                a row for each finished epoch
    run                    an identifier by which a run knows its own files
    """

    number: int = 0
    images: int = 0
    loss: float = 0.0
    seconds: float = 0.0
    history: list[Row] = field(default_factory=list)
    run: str = field(default_factory=lambda: uuid.uuid4().hex)

    def finish_epoch(self, val_loss: float) -> bool:
        """Add the epoch to the history and begin the next one; whether it is the best so far."""
        earlier = [row["val_loss"] for row in self.history if not math.isnan(row["val_loss"])]
        is_best = not self.history or val_loss < min(earlier, default=math.inf)  # there is always a best one
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
    """The arguments completed from the checkpoint that --resume names, and this checkpoint; None to begin a run.

    given: the names of the arguments on the command line. Raises ModelError.
    """
    path = RunFiles(arguments.output).resume
    if not arguments.resume:
        return arguments, None
    if not path.exists():
        print(f"{path}: nothing to resume yet; starting a new run")
        return arguments, None
    saved = load_checkpoint(path)
    if "training" not in saved:
        raise ModelError(f"{path}: holds no state to resume; give the --output of the run")
    began_with: dict[str, Any] = saved["arguments"]
    for name in sorted(given - MAY_CHANGE):
        if name in began_with and began_with[name] != getattr(arguments, name):
            raise ModelError(
                f"{path}: the run began with {option(name)} {began_with[name]}, not {getattr(arguments, name)}; "
                "leave the option out, or start a new run without --resume"
            )
    names = {item.name for item in fields(Arguments)} - NEVER_RESUMED - given
    return replace(arguments, **{name: value for name, value in began_with.items() if name in names}), saved


def fingerprint(*observations: Observations) -> str:
    """A digest of the images and labels of a run, which a resumed run must share."""
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
        """network, optimizer: the run's own, whose state is saved and restored."""
        self.files, self.arguments, self.network, self.optimizer = files, arguments, network, optimizer
        self.fingerprint = data_fingerprint

    def begin(self, progress: Progress, precision: torch.dtype, resumed: bool) -> None:
        """Write training_arguments.json, and the first state of a run that is not resumed."""
        settings = {**asdict(self.arguments), "precision": str(precision), "versions": versions()}
        write(self.files.arguments, json.dumps(settings, indent=2).encode())
        if resumed:
            print(f"resumed in epoch {len(progress.history) + 1} at image {progress.images:,}")
        else:
            if _has_finished_epoch(self.files.resume):
                set_aside(self.files.resume)
            self.save(progress)

    def save(self, progress: Progress, *models: Path) -> None:
        """Write these models, and then model-resume.pt with everything that --resume needs. Raises OSError."""
        more = {"arguments": asdict(self.arguments), "history": progress.history, "run": progress.run}
        if models and len(progress.history) == 1:
            for path in (self.files.last, self.files.best):
                if path.exists() and _run_of(path) != progress.run:  # its own, if a kill came before model-resume.pt
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
        """Load the state of a checkpoint into network and optimizer. Raises ModelError if it belongs to other data."""
        path = self.files.resume
        try:
            state = saved["training"]
            if state["fingerprint"] != self.fingerprint:
                raise ModelError(
                    f"{path}: its recordings were others; restore them, or start a new run without --resume"
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
    """Rename an earlier run's file to -previous, -previous-2 …, whichever name is free."""
    endings = itertools.chain(["previous"], (f"previous-{number}" for number in itertools.count(2)))
    previous = next(free for ending in endings if not (free := path.with_stem(f"{path.stem}-{ending}")).exists())
    os.rename(path, previous)
    print(f"{path} of an earlier run is now {previous}")


def _has_finished_epoch(path: Path) -> bool:
    """Whether a file may hold a run's state that is worth keeping."""
    try:
        return path.exists() and bool(load_checkpoint(path).get("history", True))
    except ModelError:
        return True  # not known to be worthless


def _run_of(path: Path) -> str | None:
    """The identifier of the run that wrote a model; None for a file that has none."""
    try:
        return load_checkpoint(path).get("run")
    except ModelError:
        return None
