"""Visualise what the network looks at, by VisualBackProp (arXiv 1611.05418)."""

import math

import numpy as np
import torch
from torch import nn

from cloning.base.frame import FRAME
from cloning.network.network import Network, steer


def visual_backprop(network: Network, frame: np.ndarray) -> tuple[float, np.ndarray]:
    """Return steering, -1..1, and attention mask, float32 (160, 320), 0..1, for a frame, uint8 (160, 320, 3), RGB.

    VisualBackProp: the feature maps of each layer are averaged; from the last layer to the first, the average is
    scaled up to the layer below and multiplied with that layer's average. The paper scales up by a transposed
    convolution with ones, of which more overlap at some pixels than at their neighbours: that shows as a grid. Here
    the kernels are binomial coefficients, whose sum is the same everywhere at a stride of 1 or 2. Raises
    ArithmeticError if the network's output is not finite.
    """
    maps, sizes = list[torch.Tensor](), list[tuple[int, ...]]()  # of outputs; of inputs: rows, columns

    def keep_average(_: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        # Only the positive part: the method is made for ReLU, which passes no other.
        maps.append(output.relu().mean(1, keepdim=True))
        sizes.append(tuple(inputs[0].shape[2:]))

    layers = [layer for layer in network.convolutions.modules() if isinstance(layer, nn.Conv2d)]
    hooks = [layer.register_forward_hook(keep_average) for layer in layers]
    try:
        steering = float(steer(network, frame))
    finally:
        for hook in hooks:
            hook.remove()
    top, bottom = network.crop
    cropped = (FRAME[0] - top - bottom, FRAME[1])
    below = [cropped, *(tuple(average.shape[2:]) for average in maps[:-1])]
    with torch.inference_mode():
        mask = torch.ones_like(maps[-1])
        for layer, average, size, wanted in reversed(list(zip(layers, maps, sizes, below, strict=True))):
            mask = mask * average
            covered = [(n - 1) * s + k for n, s, k in zip(mask.shape[2:], layer.stride, layer.kernel_size, strict=True)]
            # What the layer left over at its input's end, and what it padded it with at the start.
            missing = [max(0, whole - part) for whole, part in zip(size, covered, strict=True)]
            padded = [max(0, part - whole + 1) // 2 for whole, part in zip(size, covered, strict=True)]
            kernel = torch.outer(*map(_binomial, layer.kernel_size))[None, None].to(mask.device)
            mask = nn.functional.conv_transpose2d(mask, kernel, stride=layer.stride, output_padding=missing)
            mask = mask[..., padded[0] :, padded[1] :][..., : size[0], : size[1]]
            if size != wanted:  # another network has layers in between, such as pooling
                mask = nn.functional.interpolate(mask, wanted, mode="bilinear")
            mask = mask / mask.max().clamp(min=1e-12)
    whole_frame = np.zeros(FRAME[:2], np.float32)
    whole_frame[top : FRAME[0] - bottom] = mask[0, 0].cpu().numpy()
    return steering, whole_frame


def _binomial(size: int) -> torch.Tensor:
    """Return so many binomial coefficients: 1 4 6 4 1."""
    return torch.tensor([float(math.comb(size - 1, at)) for at in range(size)])
