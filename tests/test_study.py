"""tools.study: its plan, what alters the training, its measures against oracles, and the command on tiny recordings."""

import csv
import os
import re
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import warm
from commands import HERE
from drive_process import awaited
from rendered import render_recording
from scenes import Here
from test_generator import loaded, observations

from cloning.base.errors import RecordingError, UserError
from cloning.network.network import Network
from cloning.replay.replay import load_recording
from model import REPORT, ROBUST, Generator, balance
from simulator.expert import Expert
from tools.study import __main__ as study
from tools.study import figures
from tools.study.measures import Simulator, offline
from tools.study.networks import RECIPE, RECOVERING, TRACKS, plan

DRIVING = ("departures_per_km", "offset_mean")  # of the laps


def test_the_plan_has_many_networks_none_of_which_is_trained_on_what_is_held_out():
    variants = plan()
    assert len({variant.name for variant in variants}) == len(variants) >= 40
    assert all(TRACKS[variant.track].held_out not in variant.recordings for variant in variants)
    methods = Counter(variant.method for variant in variants if variant.recovers)
    assert methods == dict.fromkeys(RECOVERING, 5)


def test_every_recipe_differs_from_the_reports_or_the_robust_one_as_its_name_says():
    """In the figures that the method names, besides the study's shorter steps."""
    common = {"report": {"batch_size", "learning_rate", "epochs"}, "robust": {"epochs"}}
    named = {"side correction": {"side_correction"}, "no flip": {"flip"}, "no shadow": {"shadow"}}
    named |= {"no resampling": {"keep_straight", "turn"}, "no throttle filter": {"throttle_threshold"}}
    named |= {"centre camera": {"side_cameras"}, "shifts": {"tinted", "shaded", "pose_yaw"}}
    named |= {"shifts, rotations": {"tinted", "shaded"}}
    for variant in plan():
        base = {"report": REPORT, "robust": ROBUST}[variant.recipe.name].saved()
        changed = {name for name, value in variant.recipe.saved().items() if value != base[name]}
        method = re.sub(r" [\d.]+$", "", variant.method)
        assert changed - common[variant.recipe.name] == named.get(method, set()), variant.method


def test_without_resampling_each_observation_counts_once():
    steering = np.array([0, 0.01, 0.3, -0.4, 1] * 20, np.float32)
    recipe = {variant.method: variant.recipe for variant in plan()}["no resampling"]
    assert len(balance(observations(steering), replace(REPORT, repeats=1), seed=0)) != len(steering)
    assert sorted(balance(observations(steering), replace(recipe, repeats=1), seed=0).steering) == sorted(steering)


def test_the_centre_camera_alone(sample_recording):
    found = loaded(sample_recording)
    with ThreadPoolExecutor(1) as pool:
        three, one = (Generator(found, recipe, 0, pool).sample(0) for recipe in (RECIPE, RECOVERING["centre camera"]))
    assert np.bincount(three.camera, minlength=3).min() > 0 and not one.camera.any()
    assert np.array_equal(three.observation, one.observation), "and nothing else is sampled in another way"
    assert one.views.labels[:, 0].tolist() == found.steering[one.observation].tolist()


def test_correlation_is_of_ranks_and_signed():
    values = np.arange(10.0)
    assert figures.correlated(np.exp(values), values, 1)[0] == pytest.approx(1)
    value, low, high = figures.correlated(-(values**3), values, 1)
    assert (value, low, high) == pytest.approx((-1, -1, -1))
    shuffled = np.array([2, 1, 4, 3, 6, 5, 8, 7, 10, 9.0])
    value, low, high = figures.correlated(shuffled, values, -1)
    assert value == pytest.approx(-(1 - 6 * 10 / (10 * 99)))  # Spearman's own formula: ten differences of 1
    assert -1 <= low < value < high < 0
    assert np.isnan(figures.correlated(np.zeros(10), values, 1)).all()


def test_driving_is_told_by_departures_and_among_equals_by_distance():
    rows: list[dict[str, float | str]] = [
        {"departures_per_km": far, "offset_mean": off} for far, off in ((0, 3.5), (0, 0.2), (0.4, 0.1), (2, 1))
    ]
    assert np.argsort(figures.driving(rows)).tolist() == [1, 0, 2, 3]


class Constant(Network):
    """A network that always steers alike, or one that repeats the recorded steering plus something."""

    def __init__(self, values):
        super().__init__()
        self.values = values.astype(np.float32)

    def forward(self, frames, keep=None):
        now, self.values = self.values[: len(frames)], self.values[len(frames) :]
        return torch.from_numpy(now)


def test_errors_on_recorded_frames(sample_recording):
    recording = load_recording(sample_recording)
    found = offline(Constant(recording.steering + np.tile([0.1, 0.3], 30)), recording)
    assert found["mse"] == pytest.approx(0.05, rel=1e-4)
    assert found["mae"] == pytest.approx(0.2, rel=1e-4)
    assert found["large_errors"] == 0.5
    assert 0.8 < found["correlation"] < 1
    still = offline(Constant(np.full(60, 0.2)), recording)
    assert (still["whiteness"], still["correlation"]) == (0, 0)


@pytest.mark.parametrize(("steering", "departures"), [(None, False), (0.3, True)])
def test_laps_and_recovery_in_the_simulator(monkeypatch, steering, departures):
    """Steered by the known position, the car stays and comes back; steered to one side, it leaves the road."""
    simulator = Simulator(Network(), "lake", "ccw", 15)
    expert = Expert(simulator.track, wander=0)
    monkeypatch.setattr(simulator, "steering", lambda run: expert.drive(run)[0] if steering is None else steering)
    run = simulator.lap(0.05)
    assert (len(run.departures) > 0) == departures
    assert (np.abs(run.trajectory.offset).max() < 1) == (not departures)
    assert run.distance >= 0.05 * simulator.track.length * (not departures)
    assert simulator.recovery(6) == (0 if departures else 1)


def test_the_command_measures_and_goes_on(tmp_path, capsys, monkeypatch):
    for pool in ("ProcessPoolExecutor", "ThreadPoolExecutor"):
        monkeypatch.setattr(study, pool, Here)
    monkeypatch.setattr("simulator.record.started_workers", Here)
    first = plan()[0]
    monkeypatch.setattr(study, "plan", lambda: [first._replace(recipe=replace(first.recipe, epochs=1))])
    data, folder = tmp_path / "data", tmp_path / "study"
    for seed, (name, rows) in enumerate({"jungle": 1, "jungle-shadows": 1, "lake-ccw": 60, "lake-cw": 60}.items()):
        render_recording(data / name, rows, seed)
    command = [str(data), "--folder", str(folder), "--jobs", "1", "--networks", "1"]
    command += ["--images", "30", "--laps", "0.01", "--starts", "1"]
    assert study.main(command) == 0
    assert "lake-centre-camera-seed-0 is measured" in capsys.readouterr().out
    with open(folder / "study.csv", encoding="utf-8", newline="") as file:
        [row] = csv.DictReader(file)
    assert (row["method"], row["recordings"]) == ("centre camera", "lake-ccw")
    assert {*figures.MEASURES, *DRIVING} <= set(row)
    assert float(row["recovered"]) in (0, 1)
    assert study.main(command) == 0
    assert "is measured" not in capsys.readouterr().out, "it was measured before"
    (folder / "lake-centre-camera-seed-0" / "result.json").write_text("", encoding="utf-8")
    with pytest.raises(UserError, match=r"result\.json: damaged .*; delete it, and start again"):
        study.main(command)
    (data / "lake-cw" / "driving_log.csv").rename(data / "lake-cw" / "log.csv")
    with pytest.raises(RecordingError, match="recordings by the names jungle, jungle-shadows, lake-ccw, lake-cw"):
        study.main(command)


# In a module of its own, so that a network's process loads little else.
MEASURES = """
import os, time
def end_process(*_):
    os._exit(9)
def keep_measuring(variant, recordings, file, *_):
    file.parent.with_suffix(".pid").write_text(str(os.getpid()))
    time.sleep(60)
"""
STUDY = """
import sys, measures
from argparse import Namespace
from pathlib import Path
from tools.study import __main__ as study
study.measure = getattr(measures, sys.argv[1])
study.result(Namespace(name="lake"), Namespace(folder=Path(), recordings=None, images=1, laps=1, starts=1))
"""


def study_one(folder: Path, measure: str) -> warm.Process:
    """Start a study of one network, which one of MEASURES measures."""
    (folder / "measures.py").write_text(MEASURES, encoding="utf-8")
    command = [sys.executable, "-c", STUDY, measure]
    return warm.Popen(command, cwd=folder, env={**os.environ, **HERE}, stderr=subprocess.PIPE, text=True)


def test_a_killed_process_is_named(tmp_path):
    """As when memory is short."""
    assert "UserError: lake: its process was killed; " in study_one(tmp_path, "end_process").communicate(timeout=60)[1]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="without /proc processes cannot be listed")
def test_a_killed_study_leaves_no_process(tmp_path):
    """Which would train the same network as the study that is started again."""
    study = study_one(tmp_path, "keep_measuring")
    pid = awaited(lambda: [file.read_text() for file in tmp_path.glob("*.pid") if file.read_text()])[0]
    study.kill()
    study.wait(60)  # not for its output, which its process has, too
    awaited(lambda: not Path("/proc", pid).exists(), 30)


def test_the_report_and_the_picture_show_all_networks(monkeypatch):
    monkeypatch.setattr(figures, "RESAMPLES", 50)
    rng = np.random.default_rng(0)
    names = {*figures.MEASURES, *DRIVING}
    rows = [
        figures.row(variant, {**dict.fromkeys(names, 0.0), **{name: rng.random() for name in names}})
        for variant in plan()
    ]
    for row in rows[:25]:
        row["recovered"] = 0.25
    text = figures.report(rows)
    assert f"| lake, {sum(variant.track == 'lake' for variant in plan())} networks |" in text
    assert "| robust | 25 %, 25 %, 25 %, 25 %, 25 % | 25 % |" in text
    pixels = cv2.imdecode(np.frombuffer(figures.correlation_picture(rows), np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20
