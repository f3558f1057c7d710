"""What the network looks at: VisualBackProp (arXiv 1611.05418), and its picture for the page and the film."""

import cv2
import numpy as np
import torch
from torch import nn

from cloning.pilot.network import Network
from cloning.recordings.format import FRAME
from cloning.road.camera import project_ground
from cloning.road.motion import curvature

GREEN, MAGENTA = (60, 255, 60), (255, 0, 200)  # RGB


def visual_backprop(network: Network, frame: np.ndarray) -> tuple[float, np.ndarray]:
    """Steering -1..1 for a frame, uint8 (160, 320, 3), RGB, and what it rests on, float32 (160, 320), 0..1.

    VisualBackProp: the feature maps of each layer are averaged; from the last layer to the first, the average is
    scaled up to the layer below (a transposed convolution with ones) and multiplied with that layer's average.
    """
    maps = []
    # The positive part is what ReLU, which the method is made for, would have left; ELU's negative part is below 1.
    hooks = [
        layer.register_forward_hook(lambda _, __, out: maps.append(out.relu().mean(1, keepdim=True)))
        for layer in network.convolutions
    ]
    try:
        with torch.inference_mode():
            device = next(network.parameters()).device
            steering = float(network(torch.from_numpy(frame)[None].to(device))[0])
    finally:
        for hook in hooks:
            hook.remove()
    top, bottom = network.crop
    rows = FRAME[0] - top - bottom
    sizes = [(rows, FRAME[1]), *(average.shape[2:] for average in maps[:-1])]  # of what each layer reads
    with torch.inference_mode():
        mask = torch.ones_like(maps[-1])
        for layer, average, size in reversed(list(zip(network.convolutions, maps, sizes, strict=True))):
            mask = mask * average
            ones = torch.ones(1, 1, *layer.kernel_size, device=device)
            covered = [(n - 1) * s + k for n, s, k in zip(mask.shape[2:], layer.stride, layer.kernel_size, strict=True)]
            padding = [whole - part for whole, part in zip(size, covered, strict=True)]
            mask = nn.functional.conv_transpose2d(mask, ones, stride=layer.stride, output_padding=padding)
            mask = mask / mask.max().clamp(min=1e-12)
    whole = np.zeros(FRAME[:2], np.float32)
    whole[top : FRAME[0] - bottom] = mask[0, 0].cpu().numpy()
    return steering, whole


def overlay(frame: np.ndarray, steering: float, mask: np.ndarray | None = None) -> np.ndarray:
    """A frame at twice its size, uint8 (320, 640, 3), RGB, with the way that the steering takes in green and, in
    magenta, the mask of `visual_backprop`."""
    picture = frame.astype(np.float32)
    if mask is not None:
        strength = np.sqrt(mask)[..., None] * 0.7  # the root brings out what is weak
        picture = picture * (1 - strength) + np.float32(MAGENTA) * strength
    picture = cv2.resize(picture.astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    ahead = np.linspace(2.5, 25, 40)  # m; the bonnet hides what is nearer
    points = project_ground(curvature(steering) * ahead**2 / 2, ahead) * 2
    cv2.polylines(picture, [np.round(points).astype(np.int32)], False, GREEN, 3, cv2.LINE_AA)
    return picture
