"""NVIDIA's network, the model file that stores it, and the steering computed with it."""

import platform
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import nn

from cloning.base import program
from cloning.base.errors import ModelError
from cloning.base.frame import FRAME
from cloning.network import FORMAT, tensors
from cloning.network.compute import placed, seeded
from cloning.network.fast_layers import BlockConv2d, elu

VERSION = 1  # of the model file
# By the endings of files that other projects' drive.py takes, and of those that cloning.network.export makes.
FOREIGN = {".h5": "Keras", ".hdf5": "Keras", ".keras": "Keras", ".json": "Keras", ".onnx": "ONNX"}
OTHERS = "LEADERBOARD.md tells how others can drive"
SHIPPED_MODEL = Path(__file__).with_name("shipped.pt")  # comes with the project
PREPROCESSING = "recipe"  # the key of frame, colour, crop, scale, offset and exposure in the file
COLOUR = "RGB"  # order of a frame's colours
CROP = (60, 25)  # rows cut off the top and the bottom of a frame
SEEN_ROWS = slice(CROP[0], FRAME[0] - CROP[1])  # the rows of a frame that the network sees
MOST_LIGHT, MOST_CONTRAST = 5.0, 8.0  # times: more would show little but the JPEG's errors
Exposure = tuple[float, float]  # least mean and standard deviation of an image's values, 0..255: see `exposed`
SEEN_SHAPE = (SEEN_ROWS.stop - SEEN_ROWS.start, *FRAME[1:])  # (75, 320, 3)


class Network(nn.Module):
    """NVIDIA's network (arXiv 1604.07316) with dropout, as in the report; 559,419 parameters.

    "The report" is the writeup of Udacity's Behavioral Cloning project that is reproduced here.

    forward: frames uint8 (N, 160, 320, 3), RGB, or already cropped (N, 75, 320, 3) -> steering float32 (N,), where
    -1..1 is the simulator's -25°..25°, positive to the right.
    keep: in training, bool (N, units), the units of the flattened layer that dropout keeps.
    """

    units = 4224  # of the flattened layer; dropout keeps half of them

    def __init__(
        self, crop: tuple[int, int] = CROP, scale: float = 127.5, offset: float = 1.0, exposure: Exposure = (0.0, 0.0)
    ):
        """Make the layers with random weights, from torch's generator.

        crop: rows cut off the top and the bottom; a pixel value x enters as x / scale - offset. exposure: that of the
        images by which it drives, not of those that it learns from.
        """
        super().__init__()
        top, bottom = crop
        self.crop, self.scale, self.offset, self.exposure = (top, bottom), scale, offset, exposure
        convolutions, dense = self.layers()
        self.convolutions, self.dense = nn.ModuleList(convolutions), nn.ModuleList(dense)

    def layers(self) -> tuple[list[nn.Conv2d], list[nn.Linear]]:
        """Return the convolutions and, after the flattened layer, the dense layers; another network has others."""
        return [
            nn.Conv2d(3, 24, kernel_size=5, stride=2),
            BlockConv2d(24, 36, kernel_size=5, stride=2),  # nn.Conv2d, but trains faster on a CPU
            nn.Conv2d(36, 48, kernel_size=5, stride=2),
            nn.Conv2d(48, 64, kernel_size=3),
            nn.Conv2d(64, 64, kernel_size=3),
        ], [nn.Linear(self.units, 100), nn.Linear(100, 50), nn.Linear(50, 10), nn.Linear(10, 1)]

    def forward(self, frames: torch.Tensor, keep: torch.Tensor | None = None) -> torch.Tensor:
        """Compute the steering for frames; shapes and ranges are in the class's docstring."""
        if frames.shape[1] == FRAME[0]:
            frames = frames[:, self.crop[0] : FRAME[0] - self.crop[1]]
        x = frames.permute(0, 3, 1, 2).float()  # in memory still channels last
        if any(self.exposure) and not self.training:
            x = exposed(x, self.exposure)
        x = x.div_(self.scale).sub_(self.offset)
        x = x.to(next(self.parameters()).dtype)
        for convolution in self.convolutions:
            x = elu(convolution(x))
        x = x.flatten(1)
        if keep is not None:
            x = x * keep.to(x.dtype).mul_(2)
        for layer in self.dense[:-1]:
            x = elu(layer(x))
        return self.dense[-1](x).squeeze(1).float()


def exposed(images: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """Brighten dark images, and then raise the contrast of those with little; others stay as they are, to the bit.

    images: float32 (N, 3, rows, columns), 0..255. They get the exposure's mean, by MOST_LIGHT times at most, and its
    standard deviation, by MOST_CONTRAST times at most.
    """
    some, dimensions, (mean, deviation) = images[..., ::4, ::4], (1, 2, 3), exposure  # enough to measure
    light = (mean / some.mean(dimensions, keepdim=True).clamp(min=1.0)).clamp(1.0, MOST_LIGHT)
    some = (some * light).clamp(max=255.0)
    middle = some.mean(dimensions, keepdim=True)
    contrast = (some - middle).square().mean(dimensions, keepdim=True).sqrt()
    gain = (deviation / contrast.clamp(min=0.1)).clamp(1.0, MOST_CONTRAST)
    if not torch.compiler.is_exporting() and max(light.max(), gain.max()) == 1:
        return images
    images = (images * light).clamp(max=255.0)
    return (images + (images - middle) * (gain - 1)).clamp(0.0, 255.0)


NETWORKS: dict[str, type[Network]] = {"nvidia": Network}  # by the name that a recipe and a model file have


# ----------------------------------------------------------------------------------------------------------------------
# Model file


def save_model(path: Path, network: Network, **more: object) -> None:
    """Write a model file: the weights, what driving needs to use them, and `more` (plain values and tensors)."""
    preprocessing = {
        "frame": FRAME,
        "colour": COLOUR,
        "crop": network.crop,
        "scale": network.scale,
        "offset": network.offset,
        "exposure": network.exposure,
    }
    name = next((name for name, kind in NETWORKS.items() if kind is type(network)), None)
    if name is None:  # also of what torch.compile makes of a network
        raise ModelError(f"{path}: {type(network).__name__} has no name in NETWORKS, by which a file calls it; add one")
    about = {"format": FORMAT, "version": VERSION, "layers": name, PREPROCESSING: preprocessing, "versions": versions()}
    tensors.save(path, {**about, "network": network.state_dict(), **more})


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries on which weights and decoded frames depend."""
    return {
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "opencv": cv2.__version__,
        "numpy": np.__version__,
    }


def load_checkpoint(path: str | Path, remedy: str = "`python model.py` trains a model") -> dict[str, Any]:
    """Return the contents of a model file, read without running code from it. Raises ModelError, with the remedy."""
    try:
        saved = tensors.load(path, remedy)
    except ModelError:
        if (kind := FOREIGN.get(Path(path).suffix)) and Path(path).is_file():  # else of this project, by such a name
            raise ModelError(f"{path}: a model of {kind}, which PyTorch can't read; {remedy}; {OTHERS}") from None
        raise
    if saved.get("format") != FORMAT:
        raise ModelError(f"{path}: not a model of this project; {remedy}; {OTHERS}")
    version = saved.get("version")
    if type(version) is not int or version != VERSION:
        raise ModelError(
            f"{path}: the model file has version {tensors.shown(version)}, but this program reads version {VERSION}; "
            "train the model again with `python model.py`"
        )
    if saved.pop("digest") is None:
        program.warn_once(f"{path}: has no digest, as of an earlier version: a change of its contents is not noticed")
    return saved


def load_model(path: str | Path, device: str | torch.device = "cpu") -> Network:
    """Return the network of a model file, in evaluation mode on the device. Raises ModelError."""
    saved = load_checkpoint(path)
    try:
        network = seeded(0, partial(read_network(saved), *read_preprocessing(saved)))
        restore_weights(network, saved)
    except ValueError as error:
        raise ModelError(
            f"{path}: its contents do not fit this project's network: {error}; train it again with `python model.py`"
        ) from None
    return placed(network, device).eval()


def read_network(saved: dict[str, Any]) -> type[Network]:
    """Return the kind of network that a model file contains, NVIDIA's in an earlier version's. Raises ValueError."""
    name = saved.get("layers", "nvidia")
    if not isinstance(name, str) or name not in NETWORKS:
        known = f"{' or '.join(NETWORKS)} (your own belong in {Path(__file__).name}: see CONTRIBUTING.md)"
        raise ValueError(f"its layers are {tensors.shown(name)}, not {known}")
    return NETWORKS[name]


def read_preprocessing(saved: dict[str, Any]) -> tuple[tuple[int, int], float, float, Exposure]:
    """Return crop, scale, offset and exposure, as `Network` takes them, from a model file's contents.

    Raises ValueError for frames of another shape or order of colours, which no caller has, and for unusable values.
    """
    found = saved.get(PREPROCESSING)
    if not isinstance(found, dict):
        raise ValueError("it has no preprocessing")

    def check(name: str, usable: bool, wanted: str) -> None:
        if not usable:
            raise ValueError(f"its preprocessing has the {name} {tensors.shown(found.get(name))}, not {wanted}")

    for name, value in (("frame", FRAME), ("colour", COLOUR)):
        check(name, repr(found.get(name)) == repr(value), repr(value))
    crop: Any = found.get("crop")
    scale: Any = found.get("scale")
    offset: Any = found.get("offset")
    exposure: Any = found.get("exposure", (0.0, 0.0))  # an earlier version had none
    is_pair = isinstance(crop, tuple) and [type(rows) for rows in crop] == [int, int]
    check("crop", is_pair and min(crop) >= 0 and sum(crop) == sum(CROP), f"two counts of rows, {sum(CROP)} in all")
    check("scale", tensors.is_number(scale, 1e-6, 1e6), "a number above 0")
    check("offset", tensors.is_number(offset, -1e6, 1e6), "a number")
    is_pair = isinstance(exposure, tuple) and len(exposure) == 2
    check("exposure", is_pair and all(tensors.is_number(least, 0, 255) for least in exposure), "two numbers, 0..255")
    return crop, scale, offset, exposure


def restore_weights(network: Network, saved: dict[str, Any]) -> None:
    """Give a network the weights of a model file's contents. Raises ValueError if they do not fit, or are too large."""
    network.load_state_dict(tensors.matching(saved.get("network"), network.state_dict()))
    try:
        steer(network, np.zeros(FRAME, np.uint8))
    except ArithmeticError as error:
        raise ValueError(str(error)) from None


def steer(network: Network, frame: np.ndarray) -> np.float32:
    """Return the steering for a frame, uint8 (160, 320, 3), RGB, clipped to -1..1: the number that is sent and shown.

    The frame may already be cropped: uint8 (75, 320, 3). Raises ArithmeticError if the network's output is not finite.
    """
    with torch.inference_mode():
        steering = network(torch.from_numpy(frame)[None].to(next(network.parameters()).device)).cpu().numpy()[0]
    if not np.isfinite(steering):
        raise ArithmeticError("the network's steering is not finite")
    return np.clip(steering, np.float32(-1), np.float32(1))
