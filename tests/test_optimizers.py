"""The optimizers against torch's, and the learning rate from a run's first step to its last."""

from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from torch import nn

import model
from cloning.base.errors import ModelError
from cloning.network.network import Network
from cloning.training.checkpoint import METRICS, Checkpoint, Progress, read_saved_run
from cloning.training.observations import Data
from cloning.training.optimizers import Adam, Muon, orthogonal
from cloning.training.options import Process, Run
from cloning.training.recipe import LIMITS
from model import REPORT, ROBUST


class LargeNetwork(Network):
    """Of 2.7 million parameters."""

    def layers(self):
        convolutions, _ = super().layers()
        return convolutions, [nn.Linear(self.units, 600), nn.Linear(600, 1)]


class NormalizedNetwork(Network):
    """With batch normalization, of which a copy of the network would learn the averages."""

    def layers(self):
        (first, *others), dense = super().layers()
        return [nn.Sequential(first, nn.BatchNorm2d(24)), *others], dense


def partly_frozen():
    """A network whose convolutions are not to be trained further."""
    network = Network()
    network.convolutions.requires_grad_(False)
    return network


def cropped_otherwise():
    """A network that would learn from rows 60 to 135 of a frame, and drive by rows 40 to 115."""
    return Network(crop=(40, 45))


NO_DATA = Data(torch.zeros(1), [""])
REFUSED = [(LargeNetwork, "too many"), (NormalizedNetwork, "batch norm"), (cropped_otherwise, r"by \(40, 45")]
REFUSED += [(partly_frozen, "frozen")]


@pytest.mark.parametrize(("kind", "words"), REFUSED)
def test_a_network_that_cannot_be_trained_or_saved_whole_is_refused_before(kind, words):
    network, process = kind(), Process("model.pt")
    with pytest.raises(ModelError, match=words):
        Checkpoint(Run(REPORT, ()), process, network, Adam(network.parameters()), NO_DATA)


def test_the_state_of_the_longest_run_can_be_resumed(tmp_path):
    """One of more epochs ended in files that no program here reads, its models', too."""
    network, chance, path = Network(), np.random.default_rng(1), tmp_path / "model.pt"
    adam = Adam(network.parameters())
    adam.restore({index: adam.zeros(index) for index in range(len(adam.parameters))})
    most_epochs = int(LIMITS["epochs"][1])
    rows = ((epoch + 1, 128, *chance.random(4).tolist()) for epoch in range(most_epochs))
    history = [dict(zip(METRICS, row, strict=True)) for row in rows]
    progress = Progress(number=most_epochs, history=history, trail=chance.random(1999).tolist())
    Checkpoint(Run(REPORT), Process(str(path)), network, adam, NO_DATA).save(progress)
    assert read_saved_run(tmp_path / "model-resume.pt", {"report": REPORT}).progress.history == history


def networks():
    """Two equal networks, in memory as in training."""
    made: list[Any] = [Network() for _ in "ab"]
    for network in made:
        network.to(memory_format=torch.channels_last)
    made[1].load_state_dict(made[0].state_dict())
    return made


def give_gradients(networks, seed):
    torch.manual_seed(seed)
    for parameters in zip(*(network.parameters() for network in networks), strict=True):
        gradient = torch.randn_like(parameters[0]) * 10.0 ** (seed - 5)
        for parameter in parameters:
            parameter.grad = gradient.clone()


def assert_same(network, optimizer, torchs_network, torchs):
    assert all(map(torch.equal, network.parameters(), torchs_network.parameters()))
    saved = torchs.state_dict()["state"]
    assert optimizer.state.keys() == saved.keys()
    for number, state in saved.items():
        assert state.keys() == optimizer.state[number].keys()
        assert all(torch.equal(value, optimizer.state[number][name]) for name, value in state.items())


def test_every_bit_is_as_with_torchs():
    network, torchs_network = networks()
    optimizer, torchs = Adam(network.parameters()), torch.optim.Adam(torchs_network.parameters(), fused=True)
    for number, rate in enumerate([1e-4, 1e-4, 3e-4, 1e-3, 0.0, 1e-5]):
        if number == 3:  # it goes on from torch's state, which checkpoints of earlier versions hold
            optimizer = Adam(network.parameters())
            optimizer.restore(torchs.state_dict()["state"])
        give_gradients((network, torchs_network), number)
        torchs.param_groups[0]["lr"] = rate
        optimizer.step(rate)
        torchs.step()
        assert_same(network, optimizer, torchs_network, torchs)
    optimizer.zero_grad()
    assert all(parameter.grad is None for parameter in network.parameters())


@pytest.mark.parametrize("inputs", [40, 20])  # to 30 units: the matrix is wide, or high
def test_weights_move_as_with_torchs_muon_and_biases_as_with_adam(inputs):
    torch.manual_seed(0)
    layers: list[Any] = [torch.nn.Sequential(torch.nn.Linear(inputs, 30), torch.nn.Linear(30, 1)) for _ in "ab"]
    ours, torchs = layers
    torchs.load_state_dict(ours.state_dict())
    begin = ours[0].weight.detach().clone()
    optimizer = Muon(ours.parameters(), weight_decay=1.0)
    muon = torch.optim.Muon([torchs[0].weight], 1e-2, weight_decay=1.0, adjust_lr_fn="match_rms_adamw")
    adam = torch.optim.Adam([torchs[0].bias, *torchs[1].parameters()], 1e-2, fused=True)
    for seed in range(4):
        give_gradients((ours, torchs), seed)
        optimizer.step(1e-2)
        muon.step()
        adam.step()
    moved, expected = ours[0].weight - begin, torchs[0].weight - begin
    assert (moved - expected).norm() < 0.05 * expected.norm()  # torch's computes in bfloat16
    assert torch.equal(ours[0].bias, torchs[0].bias)
    assert all(map(torch.equal, ours[1].parameters(), torchs[1].parameters()))
    assert not orthogonal(torch.zeros(3, 4)).any(), "where a layer has no gradient"


@pytest.mark.parametrize("recipe, begins", [(REPORT, 1e-4), (ROBUST, 4e-3)], ids=["report", "robust"])
def test_the_learning_rate_is_constant_or_decays_to_zero_along_a_cosine(
    sample_recording, tmp_path, monkeypatch, recipe, begins
):
    done: list[float] = []  # the share of the run that is finished before each step
    share = Progress.done

    def noted_share(progress, recipe):
        done.append(share(progress, recipe))
        return done[-1]

    monkeypatch.setattr(Progress, "done", noted_share)
    short = replace(recipe, epochs=2, samples_per_epoch=150, batch_size=8)
    with patch.object(Adam, "step", autospec=True, side_effect=Adam.step) as steps:
        assert model.train(short, [sample_recording], tmp_path / "model.pt", device="cpu") == 0
    rates = [call.args[1] for call in steps.call_args_list]
    expected = begins * (1 + np.cos(np.pi * np.array(done))) / 2 if recipe is ROBUST else np.full(len(done), begins)
    np.testing.assert_allclose(rates, expected, rtol=1e-9)
    assert len(rates) > 8 and done[0] == 0 and 0.8 < done[-1] < 1
    assert np.diff(done).min() > 0 and np.median(np.diff(done)) == pytest.approx(29 / 300, rel=0.2)  # of images
