"""Where the time of an optimisation step goes, by layer, and how fast the machine's memory would allow it to be.

Part of `tools.bench_training`. As in model.py, one thread computes a piece of a batch, in the run's precision.
"""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import nn

from cloning.network.compute import threads
from cloning.network.network import Network
from cloning.training.observations import SEEN_SHAPE
from cloning.training.pieces import PIECE, converted, squared_errors

REPEATS = 15  # of each measurement, of which the median counts


class Cost(NamedTuple):
    """What one layer costs for a piece of a batch.

    name                          of the layer
    forward, backward             seconds
    operations, operations_back   multiplications and additions
    """

    name: str
    forward: float
    backward: float
    operations: int
    operations_back: int


def seconds(work: Callable[[], object]) -> float:
    """Return the median time of `work` in seconds, after one run that is not counted."""
    work()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def operations(layer: nn.Conv2d | nn.Linear, out: torch.Tensor) -> int:
    """Return how many multiplications and additions a layer's output takes; a gradient by input or weights as many."""
    return 2 * out.numel() * layer.weight[0].numel()


def activations(network: Network) -> dict[nn.Module, tuple[torch.Tensor, torch.Tensor]]:
    """Return each layer's input and output for a piece of random frames, in the network's precision."""
    seen: dict[nn.Module, tuple[torch.Tensor, torch.Tensor]] = {}

    def note(layer: nn.Module, given: tuple[torch.Tensor], out: torch.Tensor) -> None:
        seen[layer] = given[0].clone(), out.clone()  # ELU overwrites both

    hooks = [layer.register_forward_hook(note) for layer in (*network.convolutions, *network.dense)]
    with torch.no_grad():
        network(torch.randint(0, 256, (PIECE, *SEEN_SHAPE), dtype=torch.uint8))
    for hook in hooks:
        hook.remove()
    return seen


def traffic(network: Network) -> int:
    """Return how many bytes of activations and of their gradients a step reads and writes for a piece."""
    total = 0
    for layer, (x, out) in activations(network).items():
        # Forward: read x, write out. Backward: read x and the gradient of out; write that of x, unless it is the image.
        total += (2 + (layer is not network.convolutions[0])) * x.nbytes + 2 * out.nbytes
        if layer is not network.dense[-1]:
            total += 5 * out.nbytes  # ELU, likewise
    return total


def timed(name: str, layer: Callable, x: torch.Tensor, weights: list[nn.Parameter], first: bool) -> Cost:
    """Measure one layer; x: its input; weights: its parameters; first: whether x is the image, without a gradient."""
    x = x.clone().requires_grad_(not first)
    out = layer(x)
    wanted = [*weights] if first else [x, *weights]
    into = torch.randn_like(out)
    forward = seconds(lambda: layer(x))
    backward = seconds(lambda: torch.autograd.grad(out, wanted, into, retain_graph=True))
    count = operations(layer, out) if isinstance(layer, nn.Conv2d | nn.Linear) else 0
    return Cost(name, forward, backward, count, count if first else 2 * count)


def costs(network: Network, precision: torch.dtype) -> tuple[list[Cost], float]:
    """Return what each layer costs, and the seconds of the whole piece, forward and backward."""
    torch.set_num_threads(1)
    network, found = converted(network, precision), []
    convolutions, dense = list(network.convolutions), list(network.dense)
    for layer, (x, out) in activations(network).items():
        assert isinstance(layer, nn.Conv2d | nn.Linear)
        if isinstance(layer, nn.Conv2d):
            name = f"convolution {convolutions.index(layer) + 1}, {layer.in_channels} to {layer.out_channels}"
        else:
            name = f"dense {dense.index(layer) + 1}, {layer.in_features} to {layer.out_features}"
        found.append(timed(name, layer, x, [*layer.parameters()], layer is convolutions[0]))
        if layer is not dense[-1]:
            found.append(timed(f"ELU of {name.split(',')[0]}", nn.functional.elu, out, [], False))
    images = torch.randint(0, 256, (PIECE, *SEEN_SHAPE), dtype=torch.uint8).numpy()
    labels = torch.zeros(PIECE).numpy()
    parameters = [*network.parameters()]

    def piece() -> None:
        torch.autograd.grad(squared_errors(network, images, labels), parameters)

    return found, seconds(piece)


def memory_limit(network: Network, precision: torch.dtype) -> float:
    """Return images per second if a step only moved its activations, at the rate of copying the largest of them."""
    network = converted(network, precision)
    largest = max((out for _, out in activations(network).values()), key=torch.Tensor.numel)
    torch.set_num_threads(threads())
    source = torch.empty(threads() * largest.numel(), dtype=largest.dtype)
    target = torch.empty_like(source)
    rate = 2 * source.nbytes / min(seconds(lambda: target.copy_(source)) for _ in range(8))  # bytes/s
    return PIECE * rate / traffic(network)


def table(found: list[Cost], whole: float) -> str:
    """Return the costs as a Markdown table; the small layers in one row; the rest is conversions and copies."""
    head = f"| layer (a piece of {PIECE} images, one thread) | forward ms | GFLOP/s | backward ms | GFLOP/s | share |"
    rows = [head, "|---|---|---|---|---|---|"]

    def row(name: str, some: list[Cost]) -> None:
        forward, backward, operations, operations_back = (sum(column) for column in list(zip(*some, strict=True))[1:5])
        rates = [f"{n / t / 1e9:.0f}" if n else "" for n, t in ((operations, forward), (operations_back, backward))]
        share = f"{100 * (forward + backward) / whole:.0f} %"
        rows.append(f"| {name} | {1e3 * forward:.2f} | {rates[0]} | {1e3 * backward:.2f} | {rates[1]} | {share} |")

    large = [cost for cost in found if cost.forward + cost.backward >= 0.01 * whole]
    for cost in large:
        row(cost.name, [cost])
    row("the other layers", [cost for cost in found if cost not in large])
    rest = whole - sum(cost.forward + cost.backward for cost in found)
    rows.append(f"| conversions, copies | | | | | {round(100 * rest / whole)} % |")
    rows.append(f"| **all, {1e3 * whole:.1f} ms** | | | | | {PIECE / whole:.0f} images/s |")
    return "\n".join(rows)
