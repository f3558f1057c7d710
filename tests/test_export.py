"""An exported model steers like the model file, also in a program that has no PyTorch."""

import subprocess
import sys

import numpy as np
import onnxruntime
import pytest
import torch
import warm
from commands import ROOT
from real_recordings import FOLDERS, MISSING

from cloning.network.network import SHIPPED_MODEL, load_model
from cloning.recordings.images import read_frame


def run(*arguments) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "cloning.network.export", *map(str, arguments)]
    return warm.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "model.onnx"
    done = run(SHIPPED_MODEL, path)
    assert done.returncode == 0, done.stderr
    assert "opset 20" in done.stdout and "ONNX Runtime" in done.stdout and not done.stderr
    return path


def compare(exported, images):
    frames = np.stack([read_frame(path) for path in images])
    (steering,) = onnxruntime.InferenceSession(exported).run(["steering"], {"frames": frames})
    with torch.inference_mode():
        expected = load_model(SHIPPED_MODEL)(torch.from_numpy(frames)).numpy()
    assert steering.dtype == np.float32 and np.ptp(expected) > 0.1
    np.testing.assert_allclose(steering, expected, atol=1e-5)


def test_the_exported_file_steers_like_the_model(exported, sample_recording):
    compare(exported, sorted((sample_recording / "IMG").glob("center*")))


@pytest.mark.skipif(not FOLDERS, reason=MISSING)
def test_the_exported_file_steers_like_the_model_on_real_frames(exported):
    compare(exported, [path for folder in FOLDERS for path in sorted((folder / "IMG").glob("center*"))[::100]])


def test_a_missing_model_or_folder_is_told_and_nothing_is_written(tmp_path):
    for arguments in ((tmp_path / "none.pt", tmp_path / "a.onnx"), (SHIPPED_MODEL, tmp_path / "none" / "a.onnx")):
        done = run(*arguments)
        assert done.returncode == 2
        assert done.stderr.startswith("export: ") and "none" in done.stderr and done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
