"""The tools that measure how fast training and the stand-in simulator are, and count what the network computes."""

import re
import sys

import torch
from commands import ROOT, run_model

from cloning.network.network import Network
from cloning.training.pieces import converted
from tools import bench_layers


def run_tool(name, *arguments):
    """A tool in a process of its own, with its output."""
    return run_model(*arguments, command=[sys.executable, "-m", f"tools.{name}"], cwd=ROOT)


def test_the_training_benchmark_measures_the_epoch_and_the_step(sample_recording):
    done = run_tool("bench_training", sample_recording, "--part", "ab", "--samples", 2370)
    assert done.returncode == 0, done.stderr
    rates = re.search(r'"rates": \{"a": ([\d.]+), "b": ([\d.]+)\}', done.stdout)
    assert rates, done.stdout
    assert float(rates[1]) > 0 and float(rates[2]) > 0


def test_the_layers_costs_are_those_of_the_network():
    network = Network().to(memory_format=torch.channels_last)
    found, whole = bench_layers.costs(network, torch.float32)
    assert [cost.name for cost in found[:3]] == [
        "convolution 1, 3 to 24",
        "ELU of convolution 1",
        "convolution 2, 24 to 36",
    ]
    images = bench_layers.PIECE
    assert found[0].operations == 2 * images * 36 * 158 * 24 * 75
    assert found[0].operations_back == found[0].operations  # the image needs no gradient
    assert found[2].operations == 2 * images * 16 * 77 * 36 * 600
    assert found[2].operations_back == 2 * found[2].operations
    rows = bench_layers.table(found, whole).splitlines()
    shares = [int(re.search(r"(-?\d+) % \|$", row)[1]) for row in rows[2:-1]]
    assert abs(sum(shares) - 100) <= len(shares)  # rounded


def test_activations_in_half_the_precision_are_half_the_traffic():
    network = Network().to(memory_format=torch.channels_last)
    single, half = (
        bench_layers.traffic(converted(network, precision)) for precision in (torch.float32, torch.bfloat16)
    )
    assert single == 2 * half


def test_the_simulator_benchmark_measures_both_tracks():
    done = run_tool("bench_simulator", "--laps", 0.02, "--repeat", 1)
    assert done.returncode == 0, done.stderr
    for track in ("lake", "jungle"):
        row = re.search(rf"^{track} (.*)$", done.stdout, re.MULTILINE)
        assert row, done.stdout
        speeds = [float(number) for number in re.findall(r"[\d.]+", row[1])]
        assert len(speeds) == 7 and min(speeds) > 0


def test_a_speed_run_trains_drives_and_says_how_many_passed(sample_recording):
    few = ["--in-sample", "--seeds", "1", "--images", "60", "--limit", "20", "--autonomy", "99"]
    done = run_tool("speedrun", sample_recording, *few)
    name = sample_recording.name
    row = re.search(rf"\| {name} \| {name} \| 0 \| [\d.]+ \| (.*?) % \|", done.stdout)
    assert row, done.stderr
    passed = float(row[1]) >= 99
    assert f"{int(passed)} of 1 runs at 99 % or better at 20 m" in done.stdout
    assert done.returncode == (0 if passed else 1)
