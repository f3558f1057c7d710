"""Slow analyses of recordings: where the car is, and how models steer and drive; each in a process of its own.

A process takes its memory along when it ends, and leaves its result in the user's cache folder, where it stays until
the recording changes. `analyse.py` is what runs in it.
"""

import contextlib
import hashlib
import json
import os
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cloning.base import program
from cloning.base.errors import RecordingError, UserError, message_of
from cloning.base.files import written_whole
from cloning.base.processes import PYTHON, environment
from cloning.recordings.check import cache_file
from cloning.recordings.excluded import read_cuts
from cloning.recordings.format import DRIVING_LOG, IMAGE_FOLDER, LANE_FILE

RULES = 8  # of what a result contains: counted up when they change
COMMAND = (*PYTHON, "-m", "cloning.browse.analyse")
PROGRESS = "progress "  # begins a line that a process prints, with a share of its work from 0 to 1


class UnknownError(UserError):
    """A recording, row, column or run that the page asks for and that does not exist."""


@dataclass(frozen=True)
class Analysis:
    """What can be analysed in a recording."""

    kind: str  # lane: where the car is; steering: a model's in each frame; replay: a drive with a model as the driver
    model: str = ""  # its file, unless the lane is analysed
    limit: float = 0.0  # m from the reference line at which a replay counts an intervention


LANE = Analysis("lane")
Job = tuple[Path, Analysis]  # a recording's folder, and what is analysed in it


@dataclass(frozen=True)
class Result:
    """What an analysis has found."""

    images: np.ndarray  # int32 (k,): the centre images, as in `Recording.images`, that the columns belong to
    columns: dict[str, np.ndarray]  # float32 (k,), by name
    about: dict[str, Any]  # everything else, in JSON's types

    def column(self, name: str, centres: np.ndarray) -> np.ndarray:
        """Return a column in the rows with these centre images: float32 (n,), nan in those not analysed."""
        values = np.full(max(centres.max(initial=0), self.images.max(initial=0)) + 1, np.nan, np.float32)
        values[self.images] = self.columns[name]
        return values[centres]


def stamp(folder: Path, analysis: Analysis) -> str:
    """Return what tells whether a result is still of the same files: their sizes and times of change, and the cuts.

    A `lane.csv` counts if there is one, and one image, which shows that all were changed in place. Only a replay leaves
    out what is cut. Raises RecordingError if the log, the images or the model is gone, and if a replay cannot read the
    cuts.
    """
    paths = [folder / DRIVING_LOG, folder / IMAGE_FOLDER, *[Path(analysis.model)] * bool(analysis.model)]
    paths += [folder / LANE_FILE] * (folder / LANE_FILE).exists()
    cuts = f" {[(cut.first, cut.last) for cut in read_cuts(folder)]}" if analysis.kind == "replay" else ""
    stamps = [file_stamp(path) for path in paths]
    with contextlib.suppress(OSError, StopIteration), os.scandir(folder / IMAGE_FOLDER) as images:
        image = next(each for each in images if not each.name.startswith("."))  # all would take long, every few seconds
        stamps.append(file_stamp(Path(image)))
    return f"{RULES} {stamps}{cuts}"


def file_stamp(path: Path) -> tuple[int, int]:
    """Return size and time of change in ns of a file or folder. Raises RecordingError if it is gone."""
    try:
        status = path.stat()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; put it back, or leave it out") from None
    return status.st_size, status.st_mtime_ns


def result_file(folder: Path, analysis: Analysis) -> Path:
    """Return the file in the user's cache folder for the result of an analysis."""
    name = f"-{analysis.kind}" + f"-{analysis.limit:g}" * bool(analysis.limit)
    if analysis.model:
        name += "-" + hashlib.blake2b(os.fsencode(Path(analysis.model).resolve()), digest_size=6).hexdigest()
    return cache_file(folder, name)


def write_result(folder: Path, analysis: Analysis, before: str, result: Result) -> None:
    """Write the result of an analysis; before: the `stamp` from before the analysis. Raises OSError."""
    file = result_file(folder, analysis)
    file.parent.mkdir(parents=True, exist_ok=True)
    names, columns = list(result.columns), np.array(list(result.columns.values()), np.float32)
    about = np.frombuffer(json.dumps({"stamp": before, "columns": names, **result.about}).encode(), np.uint8)
    with written_whole(file) as temporary, open(temporary, "wb") as opened:
        np.savez(opened, about=about, images=result.images, columns=columns)


def read_result(folder: Path, analysis: Analysis) -> Result | None:
    """Return the result of an analysis, None if these files have none yet. Raises RecordingError as `stamp` does."""
    wanted = stamp(folder, analysis)
    try:
        with np.load(result_file(folder, analysis)) as file:
            about, images, columns = json.loads(file["about"].tobytes()), file["images"], file["columns"]
        named = dict(zip(about["columns"], columns, strict=True))
    except Exception:  # there is no file yet, or a damaged one, in whatever way: the analysis replaces it
        return None
    return Result(images, named, about) if about["stamp"] == wanted else None


class Analyses:
    """Runs the analyses that are asked for, one after the other, the smallest recording first, and replays last."""

    def __init__(self) -> None:
        self.waiting: dict[Job, int] = {}  # -> size of the log, bytes
        self.urgent: Path | None = None  # the folder whose analyses go before all others
        self.failed: dict[tuple[Job, str], str] = {}  # job, stamp -> message
        # What is ready, and the `file_stamp` of its result: one of other cuts, for example, may take its place.
        self.ready: set[tuple[tuple[Job, str], tuple[int, int] | None]] = set()
        self.running: Job | None = None
        self.paused = False  # whether none is begun, until `resume`
        self.progress = 0.0
        self.process: subprocess.Popen[str] | None = None
        self.changed = threading.Condition()
        self.ended = False  # the running analysis, before it was done, by `stop` or `close`
        self.closed = False
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def state(self, folder: Path, analysis: Analysis, begin: bool = True, again: bool = False) -> dict[str, Any]:
        """Return how far an analysis is, for the page: {"state", and "progress", "message" or the result's "stamp"}.

        The states are ready, running, waiting, paused, failed and, if it is not to begin now and nobody asked for it,
        none. again: begin one that has failed, too. Raises RecordingError as `stamp` does.
        """
        job = folder, analysis
        now = job, stamp(*job)
        with self.changed:
            if again:
                self.failed.pop(now, None)
            if now in self.failed:
                return {"state": "failed", "message": self.failed[now]}
            file = result_file(*job)
            seen = now, file_stamp(file) if file.exists() else None
            if seen in self.ready or read_result(*job):
                self.ready.add(seen)
                return {"state": "ready", "stamp": now[1]}
            if self.running == job:
                return {"state": "running", "progress": self.progress}
            if job not in self.waiting:
                if not begin:
                    return {"state": "none"}
                self.waiting[job] = file_stamp(folder / DRIVING_LOG)[0]
                self.changed.notify()
            return {"state": "paused" if self.paused else "waiting"}

    def pause(self) -> None:
        """End the analysis that runs, to be done again, and begin no other until `resume`."""
        with self.changed:
            self.paused = True
            if self.running:
                self.waiting[self.running] = 0
                self._end()

    def resume(self) -> None:
        """Begin analyses again."""
        with self.changed:
            self.paused = False
            self.changed.notify()

    def stop(self, folder: Path, analysis: Analysis) -> None:
        """End an analysis that runs or waits; what is done already stays."""
        with self.changed:
            self.waiting.pop((folder, analysis), None)
            if self.running == (folder, analysis):
                self._end()

    def close(self) -> None:
        """End the analysis that runs, if one does, and begin no other."""
        with self.changed:
            self.closed = True
            self.changed.notify()
            self._end()
        self.thread.join()

    def _end(self) -> None:
        self.ended = True
        if self.process:
            self.process.kill()  # its result is whole or not there

    def _run(self) -> None:
        while job := self._next():
            before = ""
            with contextlib.suppress(RecordingError):
                before = stamp(*job)
            try:
                message = self._analyse(*job)
            except OSError as error:
                message = f"its process cannot be started: {message_of(error)}"
            with contextlib.suppress(RecordingError):
                if not message and not read_result(*job) and stamp(*job) == before:
                    message = "the program was updated since browse began: start browse again"
            with self.changed:
                if message and not self.ended:
                    self.failed[job, before] = program.in_commands(message)
                self.process = self.running = None

    def _next(self) -> Job | None:
        """Wait for an analysis to do, and return it as the running one; None at the end."""
        with self.changed:
            self.changed.wait_for(lambda: (self.waiting and not self.paused) or self.closed)
            if self.closed:
                return None
            order = {job: (job[0] != self.urgent, job[1].kind == "replay", size) for job, size in self.waiting.items()}
            self.running, self.progress, self.ended = min(order, key=order.__getitem__), 0.0, False
            del self.waiting[self.running]
            return self.running

    def _analyse(self, folder: Path, analysis: Analysis) -> str:
        """Run the process of an analysis; return why it failed, "" if it did not. Raises OSError."""
        with self.changed:
            if self.ended:
                return ""
            # Absolute, so that none is taken for an option, and what is said of it for progress.
            command = [*COMMAND, os.path.abspath(folder), analysis.kind]
            command += [os.path.abspath(analysis.model)] * bool(analysis.model)
            command += [f"{analysis.limit:g}"] * bool(analysis.limit)
            pipe, both, env = subprocess.PIPE, subprocess.STDOUT, environment()
            self.process = subprocess.Popen(command, stdout=pipe, stderr=both, env=env, text=True, errors="replace")
        message = "was ended"
        with self.process as process:
            assert process.stdout
            for line in process.stdout:
                if line.startswith(PROGRESS):
                    self.progress = float(line.removeprefix(PROGRESS))
                elif line.strip():
                    message = line.strip()
        return message if process.returncode else ""
