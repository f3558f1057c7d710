"""tools.pose_errors: its figures against an oracle, and the command on a tiny recording."""

import numpy as np
import pytest
import torch

from cloning.network.network import Network
from cloning.replay.replay import load_recording
from tools import pose_errors

ROWS = 300


@pytest.fixture
def found():
    rng = np.random.default_rng(0)
    wanted = rng.normal(0, 0.3, ROWS)
    columns = {"wanted": wanted, "shifted": wanted + 0.05, "steering": 0.5 * wanted}
    for name, most in (("offset", 2), ("yaw", 25), ("bend", 1), ("brightness", 255)):
        columns[name] = rng.uniform(0, most, ROWS)
    return columns


def test_half_the_steering_has_slope_one_half(found):
    views, error, slope, unsure, deviation = pose_errors.figures(found).split(" | ")
    assert (views, slope, unsure) == (str(ROWS), "0.50", "0.050")
    assert float(error) == pytest.approx(np.sqrt(np.mean(found["wanted"] ** 2)) / 2, abs=1e-3)
    assert float(deviation) == pytest.approx(found["wanted"].std(), abs=1e-3)


def test_each_view_is_in_one_group_of_each_kind(found):
    title, rule, everything, *groups = pose_errors.tables("drive", found).splitlines()
    assert title.startswith("| drive |") and everything.startswith(f"| all | {ROWS} |")
    assert rule.count("|") == title.count("|") == everything.count("|")
    assert sum(int(row.split(" | ")[1]) for row in groups) == 4 * ROWS


class Still(Network):
    """Its output is a constant."""

    def forward(self, frames, keep=None):
        assert frames.shape[1:] == (75, 320, 3)
        return torch.full((len(frames),), 0.25)


def test_a_sample_has_the_networks_and_the_recovery_steering(sample_recording):
    found = pose_errors.sample(Still(), load_recording(sample_recording), 50, seed=1)
    assert all(values.shape == (50,) for values in found.values())
    assert (found["steering"] == 0.25).all()
    assert (np.abs(found["wanted"]) <= 1).all() and found["wanted"].std() > 0.05
    assert (found["shifted"] <= found["wanted"]).all(), "further right of the lane's centre, it steers more to the left"
    assert found["offset"].max() <= 2.5 and found["yaw"].max() <= 25
    again = pose_errors.sample(Still(), load_recording(sample_recording), 50, seed=1)
    assert all(np.array_equal(found[name], again[name]) for name in found)


def test_the_command(sample_recording, model_file, capsys):
    assert pose_errors.main([str(model_file), str(sample_recording), "--views", "20"]) == 0
    assert "| all | 20 |" in capsys.readouterr().out
