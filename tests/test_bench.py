"""The benchmark of training and the speed run, each in its quickest form."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from commands import python

import model
from cloning.base.program import DONE, INCOMPLETE
from cloning.network.network import Network
from tools import bench_training, speedrun


def test_the_training_benchmark_measures_the_epoch_and_the_step(sample_recording, capsys, monkeypatch):
    monkeypatch.setattr(model, "REPORT", replace(model.REPORT, batch_size=8))
    monkeypatch.setattr(bench_training, "BATCH_IMAGES", 30)
    assert bench_training.main([str(sample_recording), "--part", "ab", "--samples", "150"]) == DONE
    measured = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(measured["rates"]) == {"a", "b"} and min(measured["rates"].values()) > 0
    if sys.platform == "linux":
        peak = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
        assert peak and bench_training.peak_memory() == pytest.approx(1024 * int(peak[1]) / 1e9, rel=0.005)


def test_the_operations_are_those_of_the_network():
    """By hand: height x width x filters x inputs of each output, twice, and for three passes but for the image."""
    convolutions = (36 * 158 * 24 * 75, 16 * 77 * 36 * 600, 6 * 37 * 48 * 900, 4 * 35 * 64 * 432, 2 * 33 * 64 * 576)
    dense = 4224 * 100 + 100 * 50 + 50 * 10 + 10
    assert bench_training.flops(Network()) == 2 * (3 * (sum(convolutions) + dense) - convolutions[0])


def test_a_speed_run_trains_drives_and_says_how_many_passed(sample_recording, capsys, monkeypatch):
    monkeypatch.setattr(speedrun, "python", lambda *words, env, **_: python(*words, env=env))
    few = ["--in-sample", "--seeds", "1", "--images", "60", "--limit", "20", "--autonomy", "101"]
    assert speedrun.main([str(sample_recording), *few]) == INCOMPLETE
    printed, name = capsys.readouterr().out, sample_recording.name
    assert re.search(rf"^\| {name} \| {name} \| 0 \| [\d.]+ \| .* % \| .* m \|$", printed, re.MULTILINE)
    assert "0 of 1 runs at 101 % or better at 20 m" in printed
