"""A command that is killed, or finds the disk full, at every change to its files, and the next run of it."""

import hashlib
import io
import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from kill_points import Ended, Watched
from PIL import Image

from cloning.base.files import TEMPORARY_NAME

ALL = bool(os.environ.get("ALL_KILL_POINTS"))  # see `chosen`
KILLED = -signal.SIGKILL
VARYING = {  # what differs between two runs of one command
    "training_arguments.json": {"resume"},
    "training_progress.json": {"run", "seconds"},
    "drive.json": {"round_trip_ms", "own_ms_a_frame"},
}


# ----------------------------------------------------------------------------------------------------------------------
# What is on the disk


def is_temporary(path: Path) -> bool:
    return bool(TEMPORARY_NAME.fullmatch(path.name))


def temporaries(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if is_temporary(path)]


def check_whole(folder: Path) -> None:
    """Each file that stands under its own name can be read to its end."""
    for path in folder.rglob("*"):
        if path.is_dir() or any(map(is_temporary, (path, *path.parents))):
            continue
        data = path.read_bytes()
        if path.suffix == ".pt":
            torch.load(path, weights_only=True)
        elif path.suffix in (".jpg", ".png"):
            Image.open(io.BytesIO(data)).load()  # raises an error if it is cut short
        elif path.suffix == ".mp4":
            with av.open(str(path)) as film:
                assert sum(1 for _ in film.decode(video=0)) == film.streams.video[0].frames > 0
        elif path.suffix == ".json":
            json.loads(data)
        elif path.suffix == ".parquet":
            assert data.startswith(b"PAR1") and data.endswith(b"PAR1")
        elif path.suffix == ".html":
            assert data.endswith(b"</html>"), "the page is cut short"
        elif path.suffix == ".npz":
            with np.load(path) as arrays:
                assert all(arrays[name].size for name in arrays)
        elif path.suffix == ".x86_64":  # a launcher
            assert data.endswith(b'"$@"\n') and os.access(path, os.X_OK)
        else:
            assert path.suffix in (".csv", ".md", ".py"), path
            assert path.name in ("driving_log.csv", "lane.csv") or data.endswith(b"\n"), "the last row is cut"


def value(path: Path) -> object:
    """What a file says, without what differs between two runs of one command: times, and a run's identifier."""
    if path.suffix == ".pt":
        saved = torch.load(path, weights_only=True)
        saved.pop("digest", None)  # of all the contents, times too
        for row in saved["history"]:
            del row["seconds"]
            row["val_drift"] = str(row["val_drift"])  # nan is not equal to itself
        for part, name in ((saved, "run"), (saved.get("training", {}), "seconds")):
            part.pop(name, None)
        return plain(saved)
    if path.name == "training_log.csv":
        return [line.split(",")[:2] + line.split(",")[3:] for line in path.read_text(encoding="utf-8").splitlines()]
    if path.name in VARYING:
        return {name: found for name, found in json.loads(path.read_bytes()).items() if name not in VARYING[path.name]}
    if path.suffix == ".mp4":  # its bytes differ from one run to the next
        with av.open(str(path)) as film:
            return film.streams.video[0].average_rate, [frame.to_ndarray().shape for frame in film.decode(video=0)]
    return hashlib.sha256(path.read_bytes()).hexdigest()


def plain(saved: object) -> object:
    """A model file's contents in a form that can be compared."""
    if isinstance(saved, dict):
        return {key: plain(part) for key, part in saved.items()}
    if isinstance(saved, torch.Tensor):
        return str(saved.dtype), tuple(saved.shape), saved.numpy().tobytes()
    return [plain(part) for part in saved] if isinstance(saved, list | tuple) else saved


def contents(folder: Path) -> dict[str, object]:
    return {str(path.relative_to(folder)): value(path) for path in sorted(folder.rglob("*")) if path.is_file()}


# ----------------------------------------------------------------------------------------------------------------------
# Killing


@dataclass
class Trial:
    """A folder in which a command runs again and again from the same beginning."""

    folder: Path
    command: list  # to kill
    begin: Path | None = None  # a folder: what is there before the command
    more: tuple[str, ...] = ()  # options of the next run
    checked: Callable[[], None] = lambda: None  # called after each kill
    companion: Callable[[Watched], None] = lambda running: None  # does its part while the command runs
    done: int = 0  # the command's exit status; a server's is that of the Ctrl-C with which its companion ends it
    whole: tuple[dict[str, object], list[str]] | None = None  # what `whole_run` has found
    sizes: dict[str, int] = field(default_factory=dict)  # of the files that it left

    def restore(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        if self.begin:
            shutil.copytree(self.begin, self.folder)
        else:
            self.folder.mkdir()

    def run(self, command: list, **more) -> Ended:
        running = Watched(command, self.folder, **more)
        self.companion(running)
        return running.wait()

    def age_temporaries(self) -> None:
        """As if the next run came two days later."""
        for path in self.folder.rglob(".*.part"):
            os.utime(path, (time.time() - 2 * 86_400,) * 2)

    def whole_run(self) -> tuple[dict[str, object], list[str]]:
        """The command without a kill, when first called: what it leaves, and its points."""
        if self.whole:
            return self.whole
        self.restore()
        ended = self.run(self.command)
        assert ended.status == self.done, ended.printed
        check_whole(self.folder)
        assert not temporaries(self.folder)
        self.sizes = {path.name: path.stat().st_size for path in self.folder.rglob("*")}
        self.whole = contents(self.folder), ended.points
        return self.whole

    def killed_everywhere(self, count: int, next_run: Callable[[dict[str, object]], None] | None = None) -> None:
        """Kill the command at the chosen points, each time from the beginning, and let the next run go on.

        count: see `chosen`; next_run: instead of `goes_on`.
        """
        wanted, points = self.whole_run()

        def kill(number: int) -> None:
            ended = self.run(self.command, kill=number)
            assert ended.status == KILLED, ended.printed
            self.checked()
            check_whole(self.folder)
            self.age_temporaries()
            (next_run or self.goes_on)(wanted)

        self.at_each(chosen(points, count), points, kill)

    def goes_on(self, wanted: dict[str, object]) -> None:
        """The next run ends as if the one before had not been killed, and leaves no temporary file."""
        ended = self.run([*self.command, *self.more])
        assert ended.status == self.done, ended.printed
        self.checked()
        assert differences(contents(self.folder), wanted) == []

    def disk_full_everywhere(self, others: int) -> None:
        """Fill the disk in the chosen writes; the command ends with status 2."""
        wanted, points = self.whole_run()

        def fill(number: int) -> None:
            ended = self.run(self.command, full=number)
            assert "Traceback" not in ended.printed, ended.printed
            assert ended.status == 2, ended.printed
            assert "No space left on device" in ended.printed, ended.printed
            self.checked()
            check_whole(self.folder)
            assert not temporaries(self.folder)
            self.goes_on(wanted)

        self.at_each(writes(points, others), points, fill)

    def at_each(self, numbers: list[int], points: list[str], attempt: Callable[[int], None]) -> None:
        """Try at each of these points, each time from the beginning, and report all failures at the end."""
        failures = []
        for number in numbers:
            self.restore()
            try:
                attempt(number)
            except Exception as error:
                failures.append(f"{number} of {len(points)}, {points[number - 1]}: {str(error)[:300]}")
        print(f"{len(numbers)} of {len(points)} points")
        if failures:
            pytest.fail("\n".join([f"{len(failures)} failures", *failures]), pytrace=False)

    def killed_at_every_length(self, name: str, lengths: int) -> None:
        """Have the system kill the command in the write that makes its film longer, at so many different lengths."""
        wanted, _ = self.whole_run()
        whole = self.sizes[name]
        # Not up to the whole length, because x264's threads do not always take the same decisions.
        for length in np.linspace(0.9 * whole, 0, lengths).astype(int).tolist():
            self.restore()
            assert self.run(self.command, bytes=length).status == -signal.SIGXFSZ
            check_whole(self.folder)
            assert not (self.folder / name).exists()
            self.age_temporaries()
            self.goes_on(wanted)


def differences(found: dict[str, object], wanted: dict[str, object]) -> list[str]:
    return sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))


def spread(numbers: list[int], count: int) -> list[int]:
    """At most this many of the numbers, evenly spread, the first and the last among them."""
    if count >= len(numbers):
        return numbers
    return [numbers[i] for i in np.linspace(0, len(numbers) - 1, count).round().astype(int)] if count else []


def writes(points: list[str], count: int) -> list[int]:
    """The numbers of the points that are writes: all of them, or so many."""
    numbers = [number for number, point in enumerate(points, 1) if point.startswith("write")]
    return numbers if ALL else spread(numbers, count)


def chosen(points: list[str], count: int) -> list[int]:
    """The numbers of the points at which to kill: all of them, or so many renames and others, evenly spread."""
    numbers = list(range(1, len(points) + 1))
    if ALL:
        return numbers
    renames = [number for number in numbers if points[number - 1].startswith("os.rename")]
    others = [number for number in numbers if number not in renames]
    return sorted(spread(renames, count) + spread(others, count))
