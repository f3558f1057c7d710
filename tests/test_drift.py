"""The quick replay by which a training run tells how its network drives: which pieces, how far, and what is chosen."""

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from rendered import render_recording, without_files

from cloning.base.errors import SimulatorError
from cloning.network.network import Network
from cloning.replay import drift
from cloning.replay.drift import MOST_PIECES, ROWS, drifts, held_out, still_drifts
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import load_recording
from cloning.road.motion import Stretch, curvature
from cloning.training.checkpoint import Progress
from cloning.training.run_files import RunFiles
from cloning.training.summary import driving
from model import REPORT, ROBUST


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return load_recording(render_recording(tmp_path_factory.mktemp("drift") / "lake", rows=100))


def moving(n, name="lake", steering=0.0):
    return without_files(n, name, seconds=1 / 15, speed=20, steering=steering)


def rows_of(found):
    return [(piece.line.rows.start, piece.line.rows.stop) for piece in found]


def driven(recordings, which, rows):
    """The pieces of a network that should follow the driver's path."""
    return held_out(recordings, which, rows, np.zeros(len(rows)))


def test_pieces_are_those_of_the_held_out_stretches_with_the_rows_in_between():
    chosen = np.r_[0:30, 150:165, 170:180, 300:310]  # five rows of the second are filtered out, the third is short
    found = driven([moving(400)], np.zeros(len(chosen), int), chosen)
    assert rows_of(found) == [(0, 30), (150, 180)]
    two = driven([moving(60), moving(60, "b")], np.repeat([1, 0], 30), np.r_[10:40, 20:50])
    assert [piece.recording.folder.name for piece in two] == ["lake", "b"]
    assert rows_of(two) == [(20, 50), (10, 40)]
    every = driven([moving(10_000)], np.zeros(10_000, int), np.arange(10_000))
    assert len(every) == MOST_PIECES
    assert rows_of(every)[0] == (0, ROWS)
    assert rows_of(every)[-1][1] > 9_900, "from the first to the last"
    twice = driven([moving(60).take(np.repeat(np.arange(60), 2))], np.zeros(60, int), np.arange(20, 80))
    assert rows_of(twice) == [(10, 40)], "a copy of a row is no break"
    assert driven([without_files(400)], np.zeros(400, int), np.arange(400)) == [], "the car stands still"
    assert driven([moving(400)], np.array([], int), np.array([], int)) == []


def test_drift_is_the_distance_between_the_two_cars(recording, monkeypatch):
    """The oracle is the recorded car's trajectory, integrated with the other steering instead of its own."""
    found = driven([recording], np.zeros(100, int), np.arange(100))
    assert rows_of(found) == [(0, 30), (30, 60), (60, 90)]

    monkeypatch.setattr(drift, "ModelDriver", lambda driver: driver)

    def more(steering) -> Any:
        return lambda frame: frame.human_steering + steering

    with ThreadPoolExecutor(2) as pool:
        assert drifts(found, more(0.0), pool) == pytest.approx(np.zeros(3), abs=1e-6)
        [first, *_] = drifts(found, more(0.1), pool)
    line = found[0].line
    other = load_recording(recording.folder)
    other = other.take(slice(None), steering=other.steering + np.float32(0.1))
    path = Stretch.of(other, line.rows)
    apart = np.hypot(path.right[-1] - line.stretch.right[-1], path.forward[-1] - line.stretch.forward[-1])
    assert first == pytest.approx(apart, rel=0.15)


def test_the_aim_is_that_of_the_pieces_last_row():
    rows = np.r_[0:30, 150:175, 176:179]
    found = held_out([moving(400)], np.zeros(len(rows), int), rows, rows / 10)
    assert [piece.aim for piece in found] == [2.9, 17.8]
    assert still_drifts(found) == pytest.approx([2.9, 17.8]), "the driver goes straight ahead"


def test_straight_ahead_the_car_drifts_by_the_bends_that_the_driver_takes():
    [far] = still_drifts(driven([moving(30, steering=0.1)], np.zeros(30, int), np.arange(30)))
    metres = 20 * 0.44704 * 29 / 15
    assert far == pytest.approx(float(curvature(0.1)) * metres**2 / 2, rel=0.25)  # a parabola; the lag takes some


def test_a_network_that_diverged_drives_nowhere(recording):
    network = Network()
    torch.nn.init.constant_(list(network.parameters())[-1], math.nan)
    found = driven([recording], np.zeros(100, int), np.arange(100))
    with ThreadPoolExecutor(1) as pool:
        assert np.isnan(drifts(found, network, pool)).all()
    with pytest.raises(SimulatorError, match="train the model again"):
        found[0].drift(ModelDriver(network))


@pytest.mark.parametrize(
    ("by", "best"),
    [("val_drift", [True, True, True, False, True, False]), ("val_loss", [True, True, False, True, False, False])],
)
def test_the_best_epoch_is_chosen_by_one_metric(by, best):
    """The first is the best so far, also if it diverged."""
    progress, found = Progress(), []
    for loss, far in ((math.nan, math.nan), (0.3, 2.0), (0.4, 1.5), (0.2, 1.7), (0.5, 1.0), (0.4, math.nan)):
        progress.images = 1
        found.append(progress.finish_epoch(loss, far, by))
    assert found == best


def epoch(number, loss, far):
    return {"epoch": number, "images": 1, "seconds": 1.0, "loss": 0.1, "val_loss": loss, "val_drift": far}


def test_the_last_lines_say_in_words_how_the_network_will_drive():
    still, files = np.array([2.0, 3.0]), RunFiles("runs/net.pt")

    def text(recipe, *history):
        return driving(list(history), recipe, still, files)

    found = text(REPORT, epoch(1, 0.1, 0.4), epoch(2, 0.2, 1.0))
    told = "Steered by net.pt for two seconds, from where the driver was, a car is 1.00 m from the driver's path"
    assert told in found
    assert "2 held-out stretches; 0.40 m by net-best.pt of epoch 1, 2.50 m with the wheels straight ahead" in found
    assert found.endswith("leave the road now and then.")
    assert text(REPORT, epoch(1, 0.1, 0.4)).endswith("stay on the road.")
    assert "mean of 1 held-out stretch;" in driving([epoch(1, 0.1, 0.4)], REPORT, still[:1], files)
    assert "--robust" in text(REPORT, epoch(1, 0.1, 4.0))
    assert text(ROBUST, epoch(1, 0.1, 4.0)).endswith("leave the road often: train longer, or record more.")
    found = text(ROBUST, epoch(1, 0.2, 1.0), epoch(2, 0.1, 1.2))
    assert "1.20 m from the lane's centre" in found and "net-best" not in found
    assert text(ROBUST, epoch(1, 0.1, math.nan)) == ""
