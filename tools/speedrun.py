"""Measure how soon a network drives: from the start of model.py, with empty caches, to a lap without an intervention.

    python -m tools.speedrun data/lake-ccw data/lake-cw         # train on one, drive the other, and the reverse
    python -m tools.speedrun --in-sample --limit 2.5 --autonomy 95 --images 40000 --learning-rate 4e-3 data/jungle …

Each run trains with --robust and counts everything until its model is saved: loading the libraries, reading and
checking the recordings, estimating the lane, training, validation, pictures. Then a replay drives with the model.
"""

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import UserError
from cloning.recordings.log import Recording, find_folders
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import ReferenceLine, drive, load_recording, reference_lines
from cloning.road.autonomy import autonomy
from tools.command import ROOT, head, python, row

Course = tuple[Recording, list[ReferenceLine]]  # what a model drives
IMAGES, BATCH, RATE = 4_500, 8, 8e-3  # enough for one lap of the lake; tools/experiments.md has what was tried


class Result(NamedTuple):
    """What one training run took, and how its model drives."""

    seconds: float  # from the start of model.py to its end
    autonomy: float  # per cent of the time, over all recordings driven
    distance: float  # m from the lane's centre, mean


def speed_run(train: Sequence[Path], courses: Sequence[Course], options: argparse.Namespace, seed: int) -> Result:
    """Train on some recordings and drive others. Raises UserError if the training fails."""
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "model.pt")
        length = ("--epochs", 1, "--samples-per-epoch", options.images, "--batch-size", options.batch_size)
        words = (*train, "--output", model, "--robust", *length, "--learning-rate", options.learning_rate)
        environment = {**os.environ, "XDG_CACHE_HOME": folder}
        begin = time.perf_counter()
        done = python(ROOT / "model.py", *words, "--seed", seed, env=environment, capture_output=True)
        seconds = time.perf_counter() - begin
        if done.returncode != program.DONE:
            raise UserError(f"model.py failed: {done.stderr.strip()[-500:]}")
        driver = ModelDriver(str(model))
        drives = [drive(*course, options.limit, driver) for course in courses]
    driven = sum(sum(each.seconds) for each in drives)
    share = autonomy(sum(len(each.interventions) for each in drives), driven)
    return Result(seconds, 100 * share, float(np.abs(np.concatenate([each.offset for each in drives])).mean()))


def main(argv: list[str] | None = None) -> int:
    """Train and drive, print a table; return 1 if a model drives worse than it should. Raises UserError, OSError."""
    parser = command_line("python -m tools.speedrun", __doc__)
    add = parser.add_argument
    add("recordings", nargs="+", help="real recordings, or folders of recordings")
    add("--in-sample", action="store_true", help="train on all recordings, and drive these")
    add("--seeds", type=number(int, 1), default=5, help="runs on the same recordings (default %(default)s)")
    add("--limit", type=number(float, 0.1), default=1.0, help="m from the centre (default %(default)s)")
    add("--autonomy", type=number(float), default=98.0, help="per cent that every run must reach (default %(default)s)")
    add("--images", type=number(int, 1), default=IMAGES, help="to train on (default %(default)s)")
    add("--batch-size", type=number(int, 1), default=BATCH, help="observations (default %(default)s)")
    add("--learning-rate", type=number(float, 1e-9), default=RATE, help="at first (default %(default)s)")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    folders = find_folders(options.recordings)
    recordings = [load_recording(folder) for folder in folders]
    courses = {folder: (whole, reference_lines(whole)) for folder, whole in zip(folders, recordings, strict=True)}
    runs = [([train], [other for other in folders if other != train]) for train in folders]
    if options.in_sample:
        runs = [(folders, folders)]
    if not all(driven for _, driven in runs):
        raise UserError("one recording has no other to drive; name two, or use --in-sample")
    results = []
    print(head("trained on", "driven", "seed", "seconds", "autonomy", "mean distance"))
    for train, driven in runs:
        names = [", ".join(folder.name for folder in part) for part in (train, driven)]
        for seed in range(options.seeds):
            result = speed_run(train, [courses[folder] for folder in driven], options, seed)
            results.append(result)
            figures = f"{result.seconds:.1f}", f"{result.autonomy:.1f} %", f"{result.distance:.2f} m"
            print(row(*names, seed, *figures), flush=True)
    seconds = [result.seconds for result in results]
    passed = sum(result.autonomy >= options.autonomy for result in results)
    print(
        f"{passed} of {len(results)} runs at {options.autonomy:g} % or better at {options.limit:g} m; "
        f"{statistics.median(seconds):.1f} s at the median, {min(seconds):.1f} to {max(seconds):.1f} s"
    )
    return program.DONE if passed == len(results) else program.INCOMPLETE


if __name__ == "__main__":
    program.run(main)
