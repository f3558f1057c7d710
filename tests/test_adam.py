"""The optimizer against torch's."""

import subprocess
import sys

import torch
from conftest import ROOT

from cloning.pilot.network import Network
from cloning.training.adam import Adam

STEPS = """
import sys, torch
from cloning.training.adam import Adam
weight = torch.nn.Parameter(torch.ones(3))
optimizer = Adam([weight])
weight.sum().backward()
optimizer.step(0.1)
optimizer.zero_grad()
print([name for name in ("torch._dynamo", "sympy") if name in sys.modules])
"""


def networks():
    """Two equal networks, in memory as in training."""
    made = [Network().to(memory_format=torch.channels_last) for _ in "ab"]
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
        give_gradients((network, torchs_network), number)
        torchs.param_groups[0]["lr"] = rate
        optimizer.step(rate)
        torchs.step()
        assert_same(network, optimizer, torchs_network, torchs)
    optimizer.zero_grad()
    assert all(parameter.grad is None for parameter in network.parameters())


def test_it_continues_from_torchs_state():
    """Checkpoints of earlier versions hold one."""
    network, torchs_network = networks()
    torchs = torch.optim.Adam(torchs_network.parameters(), 1e-4, fused=True)
    for number in range(3):
        give_gradients((torchs_network,), number)
        torchs.step()
    network.load_state_dict(torchs_network.state_dict())
    optimizer = Adam(network.parameters())
    optimizer.restore(torchs.state_dict()["state"])
    give_gradients((network, torchs_network), 3)
    optimizer.step(1e-4)
    torchs.step()
    assert_same(network, optimizer, torchs_network, torchs)


def test_it_does_not_import_torchs_compiler():
    done = subprocess.run([sys.executable, "-c", STEPS], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
