"""Loss, gradients and predictions; on a CPU in pieces of a batch that fit its cache."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from cloning.compute import in_precision

PIECE = 16  # images: on a CPU their activations fit the cache, which doubles the speed of a whole batch at once


@dataclass
class Batch:
    """One process's share of a batch.

    images      uint8 (n, 75, 320, 3), RGB, cropped
    angles      float32 (n,): labels, steering -1..1
    keep        bool (n, 4224): the units of the flattened layer that dropout keeps
    total       images in the whole batch, over all processes
    begin_next  to be called once this batch's work is in the pool's queue, so that idle cores make the next images
    """

    images: np.ndarray
    angles: np.ndarray
    keep: np.ndarray
    total: int
    begin_next: Callable[[], None] = lambda: None


def squared_errors(
    network: nn.Module,
    precision: torch.dtype,
    device: torch.device,
    images: np.ndarray,
    angles: np.ndarray,
    keep: np.ndarray | None = None,
) -> torch.Tensor:
    """The sum over the images of (predicted - label)²; arrays as in Batch."""
    frames, labels = torch.from_numpy(images).to(device), torch.from_numpy(angles).to(device)
    with in_precision(precision, device):
        predicted = network(frames, None if keep is None else torch.from_numpy(keep).to(device))
    return ((predicted - labels) ** 2).sum()


class PieceByPiece(torch.autograd.Function):
    """On a CPU: loss and gradients of a batch in pieces that fit the cache, each by one thread of the pool.

    The sums are taken in the order of the pieces, so that the result does not depend on which thread was faster.
    """

    @staticmethod
    def forward(
        context: Any,
        network: nn.Module,
        precision: torch.dtype,
        pool: ThreadPoolExecutor,
        batch: Batch,
        *parameters: nn.Parameter,
    ) -> torch.Tensor:
        """The sum of squared errors; the gradients are computed at once and kept for `backward`."""

        def piece(start: int) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
            part = slice(start, start + PIECE)
            with torch.enable_grad():
                loss = squared_errors(
                    network, precision, torch.device("cpu"), batch.images[part], batch.angles[part], batch.keep[part]
                )
            return loss.detach(), torch.autograd.grad(loss, parameters)

        pieces = pool.map(piece, range(0, len(batch.angles), PIECE))
        batch.begin_next()
        loss, gradients = torch.zeros(()), None
        for piece_loss, piece_gradients in pieces:
            loss += piece_loss
            if gradients is None:
                gradients = [gradient.clone() for gradient in piece_gradients]
            else:
                torch._foreach_add_(gradients, list(piece_gradients))
        context.gradients = gradients or [torch.zeros_like(p) for p in parameters]
        return loss

    @staticmethod
    def backward(context: Any, scale: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """The gradients of the parameters, times `scale`; the first four inputs have none."""
        return None, None, None, None, *torch._foreach_mul(context.gradients, scale)


class SquaredErrors(nn.Module):
    """The sum of a batch's squared errors, as a module that DistributedDataParallel can wrap."""

    def __init__(self, network: nn.Module, precision: torch.dtype, device: torch.device, pool: ThreadPoolExecutor):
        """pool: its threads compute the pieces on a CPU."""
        super().__init__()
        self.network, self.precision, self.device, self.pool = network, precision, device, pool

    def forward(self, batch: Batch) -> torch.Tensor:
        """The sum over this process's images: a scalar, float32."""
        if self.device.type == "cpu":
            return PieceByPiece.apply(self.network, self.precision, self.pool, batch, *self.network.parameters())
        batch.begin_next()
        return squared_errors(self.network, self.precision, self.device, batch.images, batch.angles, batch.keep)


def predict(
    network: nn.Module,
    images: Callable[[np.ndarray], np.ndarray],
    rows: np.ndarray,
    device: torch.device,
    precision: torch.dtype,
    pool: ThreadPoolExecutor,
) -> np.ndarray:
    """The network's steering for these rows, float32 (len(rows),); images: rows -> what the network sees of them."""

    def part(chosen: np.ndarray) -> np.ndarray:
        with torch.inference_mode(), in_precision(precision, device):
            return network(torch.from_numpy(images(chosen)).to(device)).cpu().numpy()

    pieces = [rows[start : start + PIECE] for start in range(0, len(rows), PIECE)]
    return np.concatenate([np.empty(0, np.float32), *pool.map(part, pieces)])
