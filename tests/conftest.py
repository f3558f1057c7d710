"""A tiny rendered recording in the simulator's own format, and helpers that run model.py on it."""

import contextlib
import csv
import io
import os
import shutil
import signal
import subprocess
import sys
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from cloning.network.network import Network, load_model, save_model
from cloning.recordings.images import decode

ROOT = Path(__file__).parent.parent
SHORT = ("--epochs", 2, "--samples-per-epoch", 150, "--batch-size", 8, "--device", "cpu")
HERE = {"PYTHONPATH": str(ROOT)}  # for a command that imports the project from another folder


def pytest_configure():
    """Ctrl-C reaches the commands that tests start, even if the tests run in a shell's background, which ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def shared_cache(tmp_path_factory):
    """Fixtures that several tests share write no checked images into the user's cache folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Each test has a cache of checked images of its own, empty at first."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def render_frame(bend: float, offset: float, rng: np.random.Generator) -> np.ndarray:
    """A grey road to the horizon, bent by -1..1 and seen from `offset` metres right of its centre: uint8 RGB."""
    frame = np.zeros((160, 320, 3), np.uint8)
    frame[:60] = (90, 140, 210)
    frame[60:] = (120, 130, 60)
    rows = np.arange(60, 160)
    far = (160 - rows) / 100
    middle = 160 + 120 * bend * far**2 - offset * (rows - 60) * 1.2
    half = 3.5 * (rows - 60) * 1.2 + 4
    for row, centre, width in zip(rows, middle, half, strict=True):
        left, right = int(centre - width), int(centre + width)
        frame[row, max(left, 0) : max(right, 0)] = (110, 110, 105)
        for edge in (left, right):
            frame[row, max(edge - 3, 0) : max(edge + 3, 0)] = (210, 180, 60)
    return np.clip(frame + rng.normal(0, 6, frame.shape), 0, 255).astype(np.uint8)


def render_recording(folder: Path, rows: int = 60, seed: int = 0, prefix: str = "/Users/driver/data/IMG/") -> Path:
    """A folder as the simulator records it: no header, absolute paths, 15 rows a second, throttle 0 in every tenth."""
    rng = np.random.default_rng(seed)
    (folder / "IMG").mkdir(parents=True)
    clock, lines = datetime(2018, 7, 16, 17, 11, 43) + timedelta(days=seed), []
    for row in range(rows):
        clock += timedelta(milliseconds=67)
        stamp = clock.strftime("%Y_%m_%d_%H_%M_%S_%f")[:-3]
        bend = float(np.sin(row / 5))
        names = []
        for camera, offset in (("center", 0), ("left", -0.8), ("right", 0.8)):
            names.append(f"{camera}_{stamp}.jpg")
            frame = render_frame(bend, offset, rng)
            cv2.imwrite(str(folder / "IMG" / names[-1]), frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
        throttle = 0 if row % 10 == 9 else 1
        lines.append(",".join([prefix + name for name in names] + [f"{0.4 * bend:.6g}", str(throttle), "0", "30.19"]))
    (folder / "driving_log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def sample_recording(tmp_path_factory) -> Path:
    """A recording of 60 rows; not to be changed."""
    return render_recording(tmp_path_factory.mktemp("data") / "lake sample")


@pytest.fixture
def copied(tmp_path) -> Path:
    """A recording of 60 rows that a test may change."""
    return render_recording(tmp_path / "data" / "lake")


@pytest.fixture
def linked(sample_recording, tmp_path) -> Path:
    """A recording of 60 rows whose images are links, which a test may change."""
    folder = tmp_path / "data" / "lake"
    (folder / "IMG").mkdir(parents=True)
    shutil.copy(sample_recording / "driving_log.csv", folder)
    for image in (sample_recording / "IMG").iterdir():
        os.link(image, folder / "IMG" / image.name)
    return folder


@pytest.fixture(scope="session")
def model_file(tmp_path_factory) -> Path:
    """A model file with random weights."""
    torch.manual_seed(3)
    network = Network()
    torch.nn.init.normal_(network.dense[-1].weight, std=3)  # so that the frames' steering differs
    path = tmp_path_factory.mktemp("model") / "model.pt"
    save_model(path, network)
    return path


@pytest.fixture(scope="session")
def jpegs() -> list[bytes]:
    """Eight frames as the simulator sends them."""
    rng = np.random.default_rng(0)
    return [cv2.imencode(".jpg", render_frame(np.sin(n), 0, rng))[1].tobytes() for n in range(8)]


@pytest.fixture(scope="session")
def steering(model_file, jpegs) -> list[np.float32]:
    """The network's steering for the same JPEGs, without drive.py."""
    torch.set_num_threads(1)
    network = load_model(model_file)
    with torch.inference_mode():
        return [network(torch.from_numpy(decode(jpeg))[None])[0].clamp(-1, 1).numpy()[()] for jpeg in jpegs]


def run_model(*arguments, command=None, **more) -> subprocess.CompletedProcess:
    """model.py, or another command, in a process of its own, with its output."""
    command = command or [sys.executable, str(ROOT / "model.py")]
    return subprocess.run(
        [*command, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, **more.pop("env", {})},
        **more,
    )


def run_here(*arguments, cwd: Path = ROOT) -> subprocess.CompletedProcess:
    """The same as `run_model`, in this process: it saves two seconds of imports."""
    import model

    command = list(map(str, arguments))
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(cwd):
        try:
            status = model.main(command)
        except SystemExit as error:  # argparse's
            status = error.code
    return subprocess.CompletedProcess(command, status, out.getvalue(), err.getvalue())


def finished_run(recording: Path, folder: Path, *arguments) -> tuple[subprocess.CompletedProcess, Path]:
    """A run that was never interrupted: what it printed, and its folder."""
    done = run_here(recording, *arguments, "--output", folder / "model.pt")
    assert done.returncode == 0, done.stderr
    return done, folder


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["network"]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    """Whether two networks have equal weights."""
    return all(torch.equal(a[name], b[name]) for name in a)


def log(folder: Path) -> list[dict[str, str]]:
    """The rows of a run's training_log.csv."""
    with open(folder / "training_log.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="session")
def finished(sample_recording, tmp_path_factory) -> tuple[subprocess.CompletedProcess, Path]:
    """A run of two epochs as in the report: what it printed, and its folder; not to be changed."""
    return finished_run(sample_recording, tmp_path_factory.mktemp("run"), *SHORT)
