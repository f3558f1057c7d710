"""Trainings that other programs call: their settings change no weights, and are as they were afterwards."""

import math
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import pytest
import torch
from commands import same, weights
from steer_server import unused_port

from cloning.training.recipe import Augmentation
from model import REPORT, ROBUST, train

BRIEF: dict[str, Any] = {"epochs": 1, "samples_per_epoch": 16, "batch_size": 8}
QUICK = replace(REPORT, **BRIEF)


@pytest.fixture(scope="module")
def plain(sample_recording, tmp_path_factory) -> dict[str, dict[str, torch.Tensor]]:
    """The weights of both recipes."""
    folder = tmp_path_factory.mktemp("plain")
    for recipe in (REPORT, ROBUST):
        output = folder / recipe.name / "model.pt"
        assert train(replace(recipe, **BRIEF), [sample_recording], output, device="cpu") == 0
    return {recipe.name: weights(folder / recipe.name / "model.pt") for recipe in (REPORT, ROBUST)}


@pytest.fixture
def unset():
    """Afterwards torch's settings are the tests' again."""
    yield
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)
    torch.set_num_threads(1)


@pytest.mark.parametrize(
    ("recipe", "context"), [(REPORT, torch.inference_mode), (ROBUST, lambda: torch.autocast("cpu", torch.bfloat16))]
)
def test_a_callers_settings_of_torch_change_no_weights_and_stay(
    sample_recording, tmp_path, plain, unset, recipe: Any, context: type[AbstractContextManager]
):
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    torch.set_num_threads(2)
    before = torch.get_rng_state()
    with context():
        assert train(replace(recipe, **BRIEF), [sample_recording], tmp_path / "model.pt", device="cpu") == 0
    assert torch.equal(torch.get_rng_state(), before)
    assert (torch.get_num_threads(), torch.get_default_dtype()) == (2, torch.float64)
    assert torch.empty(1).device.type == "meta"
    torch.set_default_device(None)
    assert same(weights(tmp_path / "model.pt"), plain[recipe.name])


def test_threads_train_at_the_same_time_as_one_does(sample_recording, tmp_path, plain):
    """As in a sweep of several threads, of which none may note signals."""
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    outputs = [tmp_path / str(n) / "model.pt" for n in range(2)]
    with ThreadPoolExecutor(2) as threads:
        done = threads.map(lambda output: train(QUICK, str(sample_recording), output, device="cpu"), outputs)
        assert list(done) == [0, 0]
    assert all(same(weights(output), plain["report"]) for output in outputs)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


@pytest.mark.parametrize("figure", [{"dropout": 0.2}, {"batch_size": 8.0}, {"learning_rate": "1e-3"}])
def test_figures_of_another_type_are_refused(figure: dict[str, Any]):
    with pytest.raises(ValueError, match=f"{next(iter(figure))} is .*, not of type"):
        replace(REPORT, **figure)


BEYOND = [{"flip": 90.0}, {"epochs": 0}, {"learning_rate": math.nan}]
BEYOND += [{"augmentations": (Augmentation("mine", share=50),)}]


@pytest.mark.parametrize("figure", BEYOND)
def test_figures_beyond_their_limits_are_refused(figure: dict[str, Any]):
    with pytest.raises(ValueError, match=f"{next(iter(figure))} is .*, not a number from .* to .*"):
        replace(REPORT, **figure)


def test_lists_as_of_a_file_are_ranges():
    ranges: dict[str, Any] = {"brightness": [0.4, 1.2]}
    assert replace(REPORT, **ranges) == REPORT


def test_a_launchers_only_process_trains_several_times(sample_recording, tmp_path, monkeypatch):
    """As by `torchrun --nproc_per_node=1 sweep.py`."""
    for name, value in {"RANK": 0, "WORLD_SIZE": 1, "MASTER_ADDR": "localhost", "MASTER_PORT": unused_port()}.items():
        monkeypatch.setenv(name, str(value))
    for run in ("a", "b"):
        assert train(QUICK, [sample_recording], tmp_path / run / "model.pt", device="cpu") == 0
    assert not torch.distributed.is_initialized()
