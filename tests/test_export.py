"""An exported model steers like the model file, also in a program that has no PyTorch."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from commands import HERE, ROOT, python
from real_recordings import FOLDERS, MISSING

from cloning.base.program import DONE, in_commands
from cloning.network.network import SHIPPED_MODEL, load_model
from cloning.recordings.images import read_frame
from simulator.__main__ import main
from simulator.driving import load_driver


def run(*arguments, **environment) -> subprocess.CompletedProcess:
    return python("-m", "cloning.network.export", *arguments, env=environment)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "model.onnx"
    named = path.with_name(os.fsdecode(b"mod\xe8le.onnx") if sys.platform == "linux" else path.name)
    done = run(SHIPPED_MODEL, named, XDG_CACHE_HOME=str(path.parent), CI="")
    assert done.returncode == 0, done.stderr
    named.rename(path)
    assert os.listdir(path.parent) == [path.name], "ONNX Runtime keeps a mark of this machine, and reports it"
    assert "opset 18" in done.stdout and not done.stderr
    assert str(ROOT).encode() not in path.read_bytes(), "no folder of the machine that made it"
    return path


def test_every_program_that_knows_the_operators_reads_the_exported_file(exported):
    model = onnx.load(exported)
    assert [each.version for each in model.opset_import] == [18]
    assert model.ir_version == onnx.helper.find_min_ir_version_for(model.opset_import)


@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.skipif(not FOLDERS, reason=MISSING))])
def test_the_exported_file_steers_like_the_model(exported, sample_recording, real):
    folders, step = (FOLDERS, 100) if real else ([sample_recording], 1)
    images = [path for folder in folders for path in sorted((folder / "IMG").glob("center*"))[::step]]
    frames = np.stack([read_frame(path) for path in images])
    frames = np.concatenate([frames, frames // 4])  # in deep shade, too
    (steering,) = onnxruntime.InferenceSession(exported).run(["steering"], {"frames": frames})
    with torch.inference_mode():
        expected = load_model(SHIPPED_MODEL)(torch.from_numpy(frames)).numpy()
    assert steering.dtype == np.float32 and np.ptp(expected) > 0.1
    np.testing.assert_allclose(steering, expected, atol=1e-5)
    assert load_driver(str(exported))(frames[0]) == pytest.approx(np.clip(expected[0], -1, 1), abs=1e-5)


def test_an_onnx_file_drives_recordings_as_the_model_does(exported, sample_recording, tmp_path):
    figures = []
    for model in (SHIPPED_MODEL, exported):
        report = tmp_path / "report.json"
        assert main(["replay", str(sample_recording), "--model", str(model), "--report", str(report)]) == DONE
        limits = json.loads(report.read_text(encoding="utf-8"))[0]["limits"]
        figures.append([each["distance_mean_m"] for each in limits.values()])
    assert len(figures[0]) == 2 and figures[1] == pytest.approx(figures[0], abs=0.01)


def test_what_is_missing_is_told_and_nothing_is_written(tmp_path):
    """A model, a folder, or the libraries, which only the export itself needs."""
    output = tmp_path / "a.onnx"
    (tmp_path / "libraries").mkdir()
    (tmp_path / "libraries" / "onnx.py").write_text("raise ImportError('there is none')", encoding="utf-8")
    without = {"PYTHONPATH": os.pathsep.join([str(tmp_path / "libraries"), HERE["PYTHONPATH"]])}
    for arguments, environment, message in (
        ((tmp_path / "none.pt", output), {}, "none.pt: no such file"),
        ((SHIPPED_MODEL, tmp_path / "none" / "a.onnx"), {}, "no such folder"),
        ((SHIPPED_MODEL, output), without, in_commands("there is none; pip install onnx onnxscript onnxruntime")),
    ):
        done = run(*arguments, **environment)
        assert done.returncode == 2
        assert done.stderr.startswith("export: ") and message in done.stderr and done.stderr.count("\n") == 1
    assert "usage" in run("--help", **without).stdout
    assert os.listdir(tmp_path) == ["libraries"]


def test_no_output_replaces_the_model_itself(tmp_path):
    model, link = shutil.copy(SHIPPED_MODEL, tmp_path), tmp_path / "link.onnx"
    link.symlink_to(model)
    for output in (model, tmp_path / ".." / tmp_path.name / "shipped.pt", link):
        done = run(model, output)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr == f"export: {output}: is read, and would be replaced; name another file\n"
    assert (tmp_path / "shipped.pt").read_bytes() == SHIPPED_MODEL.read_bytes()
