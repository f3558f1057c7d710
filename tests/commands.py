"""Helpers that run model.py and other commands, and read what a run of training has written."""

import contextlib
import csv
import functools
import io
import os
import subprocess
import sys
import unittest.mock
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import warm
from PIL import Image

from cloning.base import program
from cloning.base.errors import UserError

ROOT = Path(__file__).parent.parent
SHORT = ("--epochs", 2, "--samples-per-epoch", 80, "--batch-size", 8, "--device", "cpu")
TINY = ("--epochs", 1, "--samples-per-epoch", 16, "--batch-size", 8, "--device", "cpu")
PICTURE = cv2.imencode(".png", np.zeros((100, 160, 3), np.uint8))[1].tobytes()  # for one that takes 0.2 s to draw
HERE = {"PYTHONPATH": str(ROOT)}  # for a command that imports the project from another folder


def python(*words, cwd: Path = ROOT, env: dict[str, str] = HERE) -> subprocess.CompletedProcess:
    """This Python with these words, in a process of its own, and what it prints."""
    command = [sys.executable, *map(str, words)]
    return warm.run(command, cwd=cwd, env={**os.environ, **env}, capture_output=True, text=True, timeout=300)


def call_here(main: Callable, name: str, *arguments, cwd: Path = ROOT) -> subprocess.CompletedProcess:
    """What a command prints, and its exit status, in this process; main: its function, name: as it prints it."""
    command, out, err = [name, *map(str, arguments)], io.StringIO(), io.StringIO()
    named = unittest.mock.patch.object(program, "name", name)
    called = unittest.mock.patch.object(sys, "argv", command)
    with named, called, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(cwd):
        try:
            status: Any = main()
        except (UserError, OSError) as error:
            status = program.failed(error)
        except SystemExit as error:  # argparse's
            status = error.code
    return subprocess.CompletedProcess(command, status, out.getvalue(), err.getvalue())


# To pack its pictures well would take a fifth of a short run.
@unittest.mock.patch.object(Image.Image, "save", functools.partialmethod(Image.Image.save, compress_level=1))
def run_here(*arguments, cwd: Path = ROOT) -> subprocess.CompletedProcess:
    """model.py in this process, which saves two seconds of imports. No curves are drawn: see PICTURE."""
    import model
    from cloning.training import pictures

    with unittest.mock.patch.multiple(pictures, SCALE=1, png=lambda *_: PICTURE):
        return call_here(model.main, "model.py", *arguments, cwd=cwd)


def started_run(*arguments, until: str) -> warm.Process:
    """model.py in a process of its own, which has printed a line that begins like this."""
    command = [sys.executable, str(ROOT / "model.py"), *map(str, arguments)]
    run = warm.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout and any(line.startswith(until) for line in run.stdout)
    return run


def trained(*arguments, cwd: Path = ROOT) -> str:
    """What model.py prints that ends as it should, in this process."""
    done = run_here(*arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(*arguments, cwd: Path = ROOT) -> str:
    """The error with which model.py ends, in this process."""
    done = run_here(*arguments, cwd=cwd)
    assert done.returncode == 2, done.stdout
    return done.stderr


def finished_run(recording: Path, folder: Path, *arguments) -> tuple[str, Path]:
    """A run that was never interrupted: what it printed, and its folder."""
    return trained(recording, *arguments, "--output", folder / "model.pt"), folder


def begun_training(*arguments) -> Any:
    """model.py's TrainingRun before its first batch, with the pool that its caller ends."""
    import model
    from cloning.training.distributed import Ranks
    from cloning.training.options import parse

    asked = parse(list(map(str, arguments)), model.REPORT, model.ROBUST)
    return model.TrainingRun(model.prepare(asked), asked.process, Ranks())


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["network"]


@contextlib.contextmanager
def edited(path: Path) -> Iterator[dict[str, Any]]:
    """The contents of a model file, which are written back without their digest, as earlier versions did."""
    contents = torch.load(path, weights_only=True)
    yield contents
    contents.pop("digest", None)
    torch.save(contents, path)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    """Whether two networks have equal weights."""
    return all(torch.equal(a[name], b[name]) for name in a)


def log(folder: Path) -> list[dict[str, str]]:
    """The rows of a run's training_log.csv."""
    with open(folder / "training_log.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))
