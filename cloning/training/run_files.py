"""The files of a run, and what they say of its epochs; without PyTorch, so that a page can show them."""

import contextlib
import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from cloning.base.files import locked
from cloning.base.outputs import check_folders, claimed

if TYPE_CHECKING:
    from cloning.training.distributed import Ranks


EpochMetrics = dict[str, float]  # a row of training_log.csv: `checkpoint.METRICS`


def judged_by(history: list[EpochMetrics], by: str) -> str:
    """Return the metric by which the epochs are judged: `by`, or val_loss if the last one's val_drift is unknown."""
    return "val_loss" if math.isnan(history[-1]["val_drift"]) else by


def best_epoch(history: list[EpochMetrics], by: str) -> EpochMetrics:
    """Return the epoch whose model is the best, the first of equals; by: the metric that is the lowest then."""
    metric = judged_by(history, by)
    return min(history, key=lambda row: math.inf if math.isnan(row[metric]) else row[metric])


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
        self.progress = self.last.with_name("training_progress.json")
        self.rejected = self.last.with_name("rejected_rows.csv")
        self.pictures = self.last.with_name("diagnostic_images")
        self.report = self.last.with_name("report.html")
        self._written, self._born, self._asked = math.nan, 0.0, -math.inf  # of `age`

    @contextlib.contextmanager
    def claimed(self, ranks: "Ranks") -> Iterator[None]:
        """Make the folders and keep other runs out of them until the block ends, or this process.

        Folders that are still empty then are removed. On Windows, and on a file system without locks, other runs are
        not kept out. Raises OutputError, OSError.
        """
        with contextlib.ExitStack() as stack:

            def claim() -> None:
                new = [folder for folder in (self.pictures, *self.pictures.parents) if not folder.exists()]
                stack.callback(_remove_empty, new)
                self.pictures.mkdir(parents=True, exist_ok=True)
                models, figures = (self.last, self.best, self.resume), (self.log, self.losses, self.arguments)
                check_folders(*map(str, (*models, *figures, self.progress, self.rejected)))
                if stack.enter_context(claimed(self.last.parent)) is None and sys.platform != "win32":
                    print(f"{self.last.parent}: cannot be locked; start no other run in it")

            ranks.from_first(claim)
            yield

    def age(self) -> float:
        """Return the age of the run's last state in s, at least 0; the clock counts only when it is asked first."""
        written = max((file.stat().st_mtime for file in (self.progress, self.arguments) if file.exists()), default=0.0)
        now = time.monotonic()
        if written != self._written:  # since this was asked last
            self._written, self._born = written, max(self._asked, now - max(0.0, time.time() - written))
        self._asked = now
        return now - self._born

    def is_claimed(self) -> bool | None:
        """Return whether a run is writing the files; None if that cannot be told, as where there are no locks.

        It looks for a moment as if this were a run, too: one that starts in the same microseconds is refused.
        """
        try:
            with locked(self.last.parent) as free:
                return None if free is None else not free
        except FileNotFoundError:
            return False

    def state(self) -> tuple[int, int] | None:
        """Return what shows whether model-resume.pt was replaced; None if there is none."""
        now = self.resume.stat() if os.path.exists(self.resume) else None
        return now and (now.st_ino, now.st_mtime_ns)


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders, each before the one around it, until one is in use."""
    for folder in folders:
        if not folder.is_dir() or any(folder.iterdir()):
            break
        folder.rmdir()
