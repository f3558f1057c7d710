"""Training runs for the page: how far each is, its losses and its pictures, read from what model.py writes."""

import csv
import functools
import json
import math
import re
import threading
from pathlib import Path
from typing import Any

from cloning.base import program
from cloning.base.errors import UserError, message_of
from cloning.base.outputs import as_typed, short_names
from cloning.browse.analyses import UnknownError, file_stamp
from cloning.training.run_files import RunFiles, best_epoch, judged_by

PICTURE = re.compile(r"training_generator_(LRC_|augmented-)([0-9]{1,12})\.png")
SIGNATURE = b"\x89PNG\r\n\x1a\n"  # begins every PNG
ALIVE = 120.0  # s since a run's last state, saved every 30 s, in which it counts as running where there are no locks
METRICS = {"epoch": int, "images": int, "seconds": float, "loss": float, "val_loss": float}  # of training_log.csv
PROGRESS = {"finished": int, "batches": int, "images": int, "seconds": (int, float), "loss": (int, float, type(None))}
OPTIONS = {"epochs": int, "samples_per_epoch": int, "batch_size": int}


class Runs:
    """The runs in the given folders, each by its index."""

    def __init__(self, folders: list[Path]):
        """folders: into which model.py writes, or may later; none: perhaps into the current one."""
        self.asked = bool(folders)
        folders = folders or [Path()]
        self.files = [RunFiles(str(folder / "model.pt")) for folder in folders]
        self.names = short_names(folders)
        self._looking = threading.Lock()  # else one thread, which locks a run's folder for a moment, is another's run

    def found(self) -> list[dict[str, Any]]:
        """Return what the list shows of each run; {"message"} instead of figures if it can't be read or has not begun.

        The current folder is left out if nobody asked for it and there is no run.
        """
        shown = []
        for index, files in enumerate(self.files):
            if files.arguments.exists() or self.asked:
                try:
                    known = self._overview(files)
                    known = {key: known[key] for key in known.keys() - {"pictures", "trail", "history", "options"}}
                except (UserError, OSError) as error:
                    known = {"message": program.in_commands(message_of(error))}
                shown.append(self._place(index) | known)
        return shown

    def run(self, index: int) -> dict[str, Any]:
        """Return what the page shows of a run. Raises UserError, OSError."""
        files = self._files(index)
        return self._place(index) | self._overview(files)

    def picture(self, index: int, name: str) -> bytes:
        """Return a diagnostic picture, a PNG. Raises UserError, OSError."""
        files = self._files(index)
        path = files.pictures / name
        if not (PICTURE.fullmatch(name) and path.is_file()):
            raise UnknownError(f"no picture {name[:60]}")
        png = path.read_bytes()
        if not png.startswith(SIGNATURE):  # a link to something else
            raise UserError(f"{path}: not a PNG")
        return png

    def report(self, index: int) -> bytes:
        """Return the report that `cloning.report` has written about a run, a page. Raises UnknownError, OSError."""
        path = self._files(index).report
        writes = f"`{as_typed('python', '-m', 'cloning.report', path.parent)}` writes it"
        if not path.is_file():
            raise UnknownError(f"{path}: not written yet; {writes}")
        page = path.read_bytes()
        if not page.lstrip().startswith(b"<!doctype html>"):  # a link to something else
            raise UserError(f"{path}: not a report; {writes}")
        return page

    def _overview(self, files: RunFiles) -> dict[str, Any]:
        with self._looking:
            return overview(files)

    def _place(self, index: int) -> dict[str, Any]:
        folder = self.files[index].last.parent
        return {"id": index, "name": self.names[index], "folder": str(folder.resolve())}

    def _files(self, index: int) -> RunFiles:
        if index >= len(self.files):
            raise UnknownError(f"no run {index} here; go back to the list")
        return self.files[index]


def overview(files: RunFiles) -> dict[str, Any]:
    """Return what the page shows of a run. Raises UserError, OSError."""
    if not files.arguments.exists():
        if files.last.parent.is_file():
            raise UserError(f"{files.last.parent}: a file; name the folder that `python model.py` has written to")
        command = as_typed("python", "model.py", "--output", files.last)
        raise UserError(f"{files.last.parent}: no training run in this folder yet; `{command}` begins one")
    options, progress = _json(files.arguments, OPTIONS, 1, "recipe"), {}
    written = Path(str(options.get("output", files.last))).name or files.last.name  # by the last run
    output = RunFiles(str(files.last.with_name(written)))
    history = _history(files.log, file_stamp(files.log) if files.log.exists() else None)
    if files.progress.exists():
        progress = _json(files.progress, PROGRESS, 0)
        history = history[: progress["finished"]]  # else those are an earlier run's, or the state comes in a moment
    epochs, samples = options["epochs"], options["samples_per_epoch"]
    finished, images, seconds = len(history), progress.get("images", 0), progress.get("seconds", 0.0)
    age, claimed = files.age(), files.is_claimed()
    if claimed or (claimed is None and age < ALIVE and finished < epochs):
        state = "running"
    else:
        state = "finished" if finished >= epochs else "stopped"
    last = history[-1]["seconds"] if history else 0.0  # with its validation
    rate = images / seconds if images and seconds else history[-1]["images"] / last if last else None
    epoch = last or (samples / rate if rate else None)
    left = epoch * max(0.0, epochs - finished - min(1.0, images / samples)) if epoch and state == "running" else None
    recordings, robust = options.get("recordings"), options.get("robust") is True or options.get("name") == "robust"
    return {
        "run": progress.get("run"),  # its identifier, or None
        "models": [output.last.name, output.best.name],  # the names of its files
        "commands": {
            "resume": _command("python", "model.py", "--resume", "--output", output.last.resolve()),
            "report": _command("python", "-m", "cloning.report", files.last.parent.resolve()),
        },
        "state": state,
        "robust": robust,
        "recordings": [str(each) for each in recordings] if isinstance(recordings, list) else [],
        "epochs": epochs,
        "samples_per_epoch": samples,
        "finished": finished,  # epochs
        # Of each finished epoch METRICS and val_drift.
        "history": [{key: value if math.isfinite(value) else None for key, value in row.items()} for row in history],
        "images": images,  # so far in this epoch, as the loss
        "loss": progress.get("loss"),
        "age": age,  # of these two, s
        "rate": rate,  # images/s, None if unknown, as the next
        "left": left,  # s of training from there on
        "trail": _trail(progress, finished + min(1.0, images / samples)),
        "best": _best(history, options.get("best_by") or ("val_loss" if robust else "val_drift")),
        "options": _flat(options),
        "has_report": files.report.is_file() and files.report.stat().st_mtime >= files.arguments.stat().st_mtime,
        "pictures": _pictures(files, progress["batches"] * options["batch_size"] if progress else math.inf),
    }


def _command(*words: object) -> str:
    return program.in_commands(as_typed(*words))


def _trail(progress: dict[str, Any], done: float) -> list[list[float]]:
    """Return the losses within the epochs, as [epochs done, loss]; done: epochs until now."""
    every, losses, batches = progress.get("trail_every"), progress.get("trail"), progress.get("batches", 0)
    if not (isinstance(every, int) and isinstance(losses, list) and batches):  # of an earlier version
        return []
    losses = [loss if isinstance(loss, float) and math.isfinite(loss) else None for loss in losses]
    known = [(n, loss) for n, loss in enumerate(losses, 1) if loss is not None and n * every <= batches]
    return [[round(n * every / batches * done, 4), loss] for n, loss in known]


def _best(history: list[dict[str, float]], by: Any) -> dict[str, Any] | None:
    """Return {"epoch", "by", "value"} of the best epoch, or None; by: the metric that the run's options name."""
    if not history:
        return None
    by = judged_by(history, by if by in ("val_loss", "val_drift") else "val_loss")
    best = best_epoch(history, by)
    return {"epoch": best["epoch"], "by": by, "value": best[by]} if math.isfinite(best[by]) else None


def _flat(options: dict[str, Any]) -> dict[str, str]:
    """Return the options of a run as texts, those of its recipe and of its libraries among them."""
    return {
        str(name)[:60]: (value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))[:300]
        for name, value in options.items()
        if not isinstance(value, dict) and name not in ("output", "resume")
    }


def _json(path: Path, kinds: dict[str, Any], least: int, within: str = "") -> dict[str, Any]:
    """Return a JSON object with values of these types, numbers from `least` on; they may also be in its part `within`.

    Raises UserError, OSError.
    """
    try:
        found = json.loads(_bytes(path))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON ({error}); `python model.py` writes it anew") from None
    if isinstance(found, dict) and isinstance(found.get(within), dict):  # an earlier version's has no such part
        found |= found[within]
    for name, kind in kinds.items():
        value = found.get(name) if isinstance(found, dict) else None
        if isinstance(value, bool) or not isinstance(value, kind) or (value is not None and not least <= value < 1e12):
            raise UserError(f"{path}: {name} is {str(value)[:40]}; `python model.py` writes it anew")
    return found


def _bytes(path: Path) -> bytes:
    """Return a file's contents. Raises UserError for a pipe, which would never end, and the like; OSError."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: not a regular file; delete it, and `python model.py` writes it anew")
    return path.read_bytes()


@functools.lru_cache(maxsize=100)
def _history(path: Path, stamp: tuple[int, int] | None) -> list[dict[str, float]]:
    """Return the finished epochs' metrics in training_log.csv. Raises UserError, OSError.

    stamp: its `file_stamp`, since it is asked for every few seconds; None if there is no file.
    """
    if not stamp:
        return []
    rows = list(csv.DictReader(_bytes(path).decode(errors="replace").splitlines()))
    try:
        history = [
            {name: kind(row[name]) for name, kind in METRICS.items()}
            | {"val_drift": float(row.get("val_drift") or "nan")}
            for row in rows
        ]
        if not all(math.isfinite(row["seconds"]) for row in history):  # a browser reads no nan
            raise ValueError
        return history
    except (KeyError, TypeError, ValueError):
        raise UserError(f"{path}: not a log of epochs; `python model.py` writes it anew") from None


def _pictures(files: RunFiles, observations: float) -> list[int]:
    """Return after how many observations there are pictures, ascending, without an earlier run's later ones."""
    numbers: dict[int, int] = {}
    try:
        names = [path.name for path in files.pictures.iterdir()]
    except OSError:  # none yet
        return []
    for name in names:
        if (match := PICTURE.fullmatch(name)) and int(match[2]) <= observations:
            numbers[int(match[2])] = numbers.get(int(match[2]), 0) + 1
    return sorted(number for number, kinds in numbers.items() if kinds == 2)
