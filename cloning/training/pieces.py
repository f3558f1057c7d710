"""Batches; loss, gradients and predictions, on a CPU in pieces of a batch that fit its cache."""

import copy
import functools
import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import nn

from cloning.network.compute import in_precision

PIECE = 28  # images at most: their activations fit a CPU's cache, which is twice as fast as a whole batch at once
Module = TypeVar("Module", bound=nn.Module)


@dataclass
class Batch:
    """One process's share of a batch.

    images  uint8 (n, 75, 320, 3), RGB, cropped
    labels  float32 (n,): steering, -1..1
    keep    bool (n, units): the units of the flattened layer that dropout keeps; None: all
    total   images in the whole batch, of all processes
    """

    images: np.ndarray
    labels: np.ndarray
    keep: np.ndarray | None
    total: int

    def part(self, piece: slice) -> "Batch":
        """Return some of the images."""
        keep = None if self.keep is None else self.keep[piece]
        return Batch(self.images[piece], self.labels[piece], keep, self.total)


def pieces(images: int) -> list[slice]:
    """Return the pieces of a batch of this many images: of about the same size, at most PIECE.

    Their number is even, so that two threads finish together, and the same on every machine, as are then the sums; none
    is empty.
    """
    count = min(images, 2 * math.ceil(images / (2 * PIECE)))
    edges = [images * piece // count for piece in range(count + 1)] if count else [0]
    return [slice(*ends) for ends in itertools.pairwise(edges)]


def converted(network: Module, precision: torch.dtype) -> Module:
    """Return the network if its weights have this precision, else a copy whose weights have it."""
    same = next(network.parameters()).dtype == precision
    return network if same else copy.deepcopy(network).to(precision)


def squared_errors(network: nn.Module, batch: Batch, huber: float | None = None) -> torch.Tensor:
    """Return the sum over the images of (predicted - label)², a scalar, float32.

    huber: error beyond which the gradient is that of Huber's loss, which grows linearly; None: at no error. The value
    is the squared errors' nevertheless.
    """
    device = next(network.parameters()).device
    keep = None if batch.keep is None else torch.from_numpy(batch.keep).to(device)
    predicted = network(torch.from_numpy(batch.images).to(device), keep)
    error = predicted - torch.from_numpy(batch.labels).to(device)
    known = error.detach()
    slope = 2 * (known if huber is None else known.clamp(-huber, huber))
    return (known**2 + slope * (error - known)).sum()  # the second term is 0, and has the gradient


class WithGradients(torch.autograd.Function):
    """A sum whose gradients are computed together with it, before `backward` asks for them."""

    @staticmethod
    def forward(
        context: Any, compute: Callable[[], tuple[torch.Tensor, list[torch.Tensor]]], *parameters: nn.Parameter
    ) -> torch.Tensor:
        """Return the sum, a scalar; compute: returns it and the gradient of each parameter."""
        total, context.gradients = compute()
        return total

    @staticmethod
    def backward(context: Any, scale: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Return the gradients of the parameters, times `scale`."""
        return None, *torch._foreach_mul(context.gradients, scale)


class SquaredErrors(nn.Module):
    """Sums a batch's squared errors; a module, so that DistributedDataParallel can wrap it."""

    def __init__(
        self, network: nn.Module, precision: torch.dtype, pool: ThreadPoolExecutor, huber: float | None = None
    ):
        """pool: its threads compute the pieces on a CPU; huber: see `squared_errors`."""
        super().__init__()
        self.network, self.precision, self.pool, self.huber = network, precision, pool, huber
        self.device = next(network.parameters()).device
        on_cpu = self.device.type == "cpu"
        # In a tuple, because the weights of the copy are not this module's parameters.
        self.converted = (converted(network, precision) if on_cpu else network,)

    def forward(self, batch: Batch, meanwhile: Callable[[], None] = lambda: None) -> torch.Tensor:
        """Return the sum over this process's images: a scalar, float32.

        meanwhile: called while the batch is being computed, when its work is in the pool's queue: what it gives to the
        pool is done later.
        """
        if self.device.type == "cpu":
            in_pieces = functools.partial(self.in_pieces, batch, meanwhile)
            return WithGradients.apply(in_pieces, *self.network.parameters())
        meanwhile()
        with in_precision(self.precision, self.device):
            return squared_errors(self.network, batch, self.huber)

    def in_pieces(self, batch: Batch, meanwhile: Callable[[], None]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Return the sum and its gradients, computed in pieces, each by one thread of the pool.

        They are added in the order of the pieces, so that the result does not depend on which thread was faster.
        """
        (network,) = self.converted  # once for a batch: converting the weights for each piece would take longer
        weights, parameters = list(network.parameters()), list(self.network.parameters())
        with torch.no_grad():
            torch._foreach_copy_([*weights], [*parameters])

        def compute(part: slice) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
            with torch.enable_grad():
                errors = squared_errors(network, batch.part(part), self.huber)
            return errors.detach(), torch.autograd.grad(errors, weights)

        done = self.pool.map(compute, pieces(len(batch.labels)))
        meanwhile()
        total, gradients = torch.zeros(()), [torch.zeros_like(parameter) for parameter in parameters]
        for piece_errors, piece_gradients in done:
            total += piece_errors
            torch._foreach_add_(gradients, list(piece_gradients))
        return total, gradients


def predict(
    network: nn.Module,
    images: Callable[[np.ndarray], np.ndarray],
    rows: np.ndarray,
    device: torch.device,
    precision: torch.dtype,
    pool: ThreadPoolExecutor,
) -> np.ndarray:
    """Return the network's steering for these observations: float32 (len(rows),).

    rows: int (k,), indices; images: from indices to images, as in ValidationSet; pool: its threads share the work.
    """

    def part(chosen: np.ndarray) -> np.ndarray:
        with torch.inference_mode(), in_precision(precision, device):
            return network(torch.from_numpy(images(chosen)).to(device)).cpu().numpy()

    parts = [rows[piece] for piece in pieces(len(rows))]
    return np.concatenate([np.empty(0, np.float32), *pool.map(part, parts)])
