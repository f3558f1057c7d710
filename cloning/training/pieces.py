"""Batches, from the choices for them; loss, gradients and predictions, on a CPU in pieces that fit its cache."""

import copy
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cloning.network.compute import Graphed, in_precision
from cloning.network.network import CROP, SEEN_SHAPE
from cloning.training.gpu import to_device
from cloning.training.observations import Choices
from cloning.training.recipe import Augmentation

GPU_PIECE = 512  # images at most that a GPU predicts together
GPU_SIZES = 16  # of batches on a GPU are multiples of this, because each size is recorded: see Graphed
PIECE = 28  # images at most: their activations fit a CPU's cache, which is twice as fast as a whole batch at once

Part = tuple[Tensor, Tensor, Tensor | None]  # some images of a batch, their labels, and the units that are kept


@dataclass
class Batch:
    """One process's share of a batch."""

    images: Any  # uint8 (n, 75, 320, 3), RGB, cropped; a tensor if they were made on a GPU
    labels: np.ndarray  # float32 (n,): steering, -1..1
    keep: np.ndarray | None  # bool (n, units): the units of the flattened layer that dropout keeps; None: all
    total: int  # images in the whole batch, of all processes

    def part(self, piece: slice) -> Part:
        """Return some images, their labels, and the units that are kept."""
        keep = None if self.keep is None else torch.from_numpy(self.keep[piece])
        return torch.as_tensor(self.images[piece]), torch.from_numpy(self.labels[piece]), keep


def pieces(images: int, most: int = PIECE) -> list[slice]:
    """Return the pieces of a batch of this many images: of about the same size, at most `most`.

    Their number is even, for two threads, and the same on every machine, as are then the sums; none is empty.
    """
    count = min(images, 2 * math.ceil(images / (2 * most)))
    edges = [images * piece // count for piece in range(count + 1)] if count else [0]
    return [slice(*ends) for ends in itertools.pairwise(edges)]


def start_batch(
    choices: Choices, augmentations: Sequence[Augmentation], share: slice, pool: Executor | None
) -> Callable[[], Batch]:
    """Start making a process's share of a batch; return a function that waits for it and returns it.

    share: of the batch's observations; pool: its threads make the images; None: a GPU does, which has the frames.
    """
    mine = np.arange(len(choices.observation))[share]
    slots = choices.slots[mine]
    order = np.sort(slots[slots >= 0])  # the slots of the share's images among those of the whole batch
    at = np.where(slots < 0, -1, np.searchsorted(order, slots))  # and where they are in the share
    labels = np.empty(len(order), np.float32)
    labels[at[at >= 0]] = choices.views.labels[mine][at >= 0]
    images: Any = np.empty((len(order), *SEEN_SHAPE), np.uint8) if pool else None

    def changed(i: int, seen: Any, which: np.ndarray) -> Any:
        made = augmentations[i].change(seen, CROP[0], *(column[which] for column in choices.augmenting[i]))
        return choices.views.finished(i, made, which)

    def make(part: slice) -> None:
        for i, seen in enumerate(choices.views.images(mine[part])):
            has = at[part, i] >= 0
            if has.any():
                images[at[part, i][has]] = changed(i, seen if has.all() else seen[has], mine[part][has])

    if pool is None:
        every = [changed(i, seen, mine) for i, seen in enumerate(choices.views.images(mine))]
        made = np.argsort(at.ravel())[(at < 0).sum() :]
        images = torch.stack(every, dim=1).flatten(0, 1)[to_device(made, every[0].device)]
    parts = [pool.submit(make, piece) for piece in pieces(len(mine))] if pool else []

    def wait() -> Batch:
        for part in parts:
            part.result()
        keep = None if choices.keep is None else choices.keep[order]
        return Batch(images, labels, keep, int((choices.slots >= 0).sum()))

    return wait


def squared_errors(
    network: Callable[..., Tensor], part: Part, huber: float | None, real: Tensor | None = None
) -> Tensor:
    """Return the sum over the images of (predicted - label)², a scalar, float32.

    huber: error beyond which the gradient is that of Huber's loss, which grows linearly; None: at no error. The value
    is the squared errors' nevertheless. real: float32 (n,), 0 for an image that does not count, else 1.
    """
    images, labels, keep = part
    error = network(images, keep) - labels
    if real is not None:
        error = error * real
    known = error.detach()
    slope = 2 * (known if huber is None else known.clamp(-huber, huber))
    return (known**2 + slope * (error - known)).sum()  # the second term is 0, and has the gradient


class WithGradients(torch.autograd.Function):
    """A sum whose gradients are computed together with it, before `backward` asks for them."""

    @staticmethod
    def forward(context: Any, compute: Callable[[], tuple[Tensor, list[Tensor]]], *parameters: nn.Parameter) -> Tensor:
        """Return the sum, a scalar; compute: returns it and the gradient of each parameter."""
        total, context.gradients = compute()
        return total

    @staticmethod
    def backward(context: Any, scale: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of the parameters, times `scale`."""
        return None, *torch._foreach_mul(context.gradients, scale)


class SquaredErrors(nn.Module):
    """Sums a batch's squared errors; a module, so that DistributedDataParallel can wrap it."""

    def __init__(self, network: nn.Module, precision: torch.dtype, pool: Executor, huber: float | None = None):
        """pool: its threads compute the pieces on a CPU; huber: see `squared_errors`."""
        super().__init__()
        self.network, self.precision, self.pool, self.huber = network, precision, pool, huber
        self.device = next(network.parameters()).device
        is_usable = self.device.type != "cpu" or next(network.parameters()).dtype == precision
        self.graphed = Graphed(self.gradients)
        # In a tuple, because the weights of the copy are not this module's parameters.
        self.converted = (network if is_usable else copy.deepcopy(network).to(precision),)

    def forward(self, batch: Batch, meanwhile: Callable[[], None] = lambda: None) -> Tensor:
        """Return the sum over this process's images: a scalar, float32.

        meanwhile: called when the batch's work is in the pool's queue: what it gives to the pool is done later.
        """
        if self.device.type == "cpu":
            in_pieces = functools.partial(self.in_pieces, batch, meanwhile)
            return WithGradients.apply(in_pieces, *self.network.parameters())
        if self.device.type == "cuda":
            total = WithGradients.apply(functools.partial(self.on_gpu, batch), *self.network.parameters())
            meanwhile()
            return total
        meanwhile()
        images, labels, keep = batch.part(slice(None))
        with in_precision(self.precision, self.device):
            part = images.to(self.device), labels.to(self.device), None if keep is None else keep.to(self.device)
            return squared_errors(self.network, part, self.huber)

    def on_gpu(self, batch: Batch) -> tuple[Tensor, list[Tensor]]:
        """Return the sum and its gradients; images that do not count fill the batch up to one of a few sizes."""
        n = len(batch.labels)
        room = -(-n // GPU_SIZES) * GPU_SIZES
        values = [batch.images, batch.labels, np.ones(n, np.float32), *([] if batch.keep is None else [batch.keep])]
        arguments = []
        for each in map(torch.as_tensor, values):
            arguments.append(torch.zeros((room, *each.shape[1:]), dtype=each.dtype, device=self.device))
            arguments[-1][:n] = each
        total, *gradients = self.graphed(*arguments)
        return total, gradients

    def gradients(self, images: Tensor, labels: Tensor, real: Tensor, keep: Tensor | None = None) -> list[Tensor]:
        """Return the sum of the squared errors of real images, and its gradients."""
        # As new variables, because what autograd keeps of the parameters belongs to another of the GPU's streams.
        weights = {name: each.detach().requires_grad_() for name, each in self.network.named_parameters()}

        def network(*inputs: Tensor | None) -> Tensor:
            return torch.func.functional_call(self.network, weights, inputs)

        with torch.enable_grad(), in_precision(self.precision, self.device):
            total = squared_errors(network, (images, labels, keep), self.huber, real)
            return [total.detach(), *torch.autograd.grad(total, list(weights.values()))]

    def in_pieces(self, batch: Batch, meanwhile: Callable[[], None]) -> tuple[Tensor, list[Tensor]]:
        """Return the sum and its gradients, computed in pieces, each by one thread of the pool.

        They are added in the order of the pieces, so that the result does not depend on which thread was faster.
        """
        (network,) = self.converted  # once for a batch: converting the weights for each piece would take longer
        weights, parameters = list(network.parameters()), list(self.network.parameters())
        with torch.no_grad():
            torch._foreach_copy_([*weights], [*parameters])

        def compute(part: slice) -> tuple[Tensor, tuple[Tensor, ...]]:
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
    network: nn.Module, images: Callable[[np.ndarray], Any], rows: np.ndarray, precision: torch.dtype, pool: Executor
) -> np.ndarray:
    """Return the network's steering for these observations: float32 (len(rows),).

    rows: int (k,), indices; images: from indices to images, as in ValidationSet; pool: its threads do it on a CPU.
    """
    device = next(network.parameters()).device

    def part(chosen: np.ndarray) -> np.ndarray:
        with torch.inference_mode(), in_precision(precision, device):
            return network(torch.as_tensor(images(chosen)).to(device)).cpu().numpy()

    on_cpu = device.type == "cpu"
    parts = [rows[piece] for piece in pieces(len(rows), PIECE if on_cpu else GPU_PIECE)]
    done = pool.map(part, parts) if on_cpu else map(part, parts)
    return np.concatenate([np.empty(0, np.float32), *done])
