"""Changes of the light in training images: the report's brightness and shadow, and those of --robust.

The simulator casts shadows at its higher graphics qualities, and recordings at the lower ones have none. The recipe's
augmentation darkens one polygon; here the shade's edges are hard or soft, straight or ragged, and it is bluish, as
measured in real recordings: the road's median colour in the shade is (0.26, 0.30, 0.39) of that in the sun.
"""

import functools
from typing import TypeVar

import cv2
import numpy as np
import torch

from cloning.base.frame import FRAME
from cloning.network.network import CROP, SEEN_ROWS, SEEN_SHAPE
from cloning.recordings.images import compress, compressed_rows
from cloning.road.camera import JPEG_QUALITY
from cloning.road.disturbances import HELD_OUT, KINDS, Disturbance, disturb
from cloning.training import gpu
from cloning.training.recipe import Recipe

OFTEN = (1, 2, 3, 4, 4, 5, 5)  # strengths: the strong ones, at which networks fail, more often
TRAINED = [Disturbance(kind, strength) for kind in KINDS if kind not in HELD_OUT for strength in OFTEN]
SHADES = 256  # different pictures of shadows
SHADE, BLUISH = (0.15, 0.7), np.array([0.85, 1.0, 1.2])  # range of the factor of brightness in the shade; its colour
WIDTHS, SOFTNESS, RAGGED = (4, 400), (0.3, 4), (0, 25)  # pixels: of a shadow, of its edges' blur, of their displacement

Images = TypeVar("Images", np.ndarray, torch.Tensor)  # on the CPU or on a GPU


def multiply_channel(images: np.ndarray, channel: int, factors: np.ndarray, to: int, back: int) -> np.ndarray:
    """Multiply one channel of another colour space, rounded and clipped at 255.

    images: uint8 (n, rows, columns, 3), as the result; factors: (n,); to, back: OpenCV's codes of the conversions.
    OpenCV is given all images as one tall image, so that other Python threads can run during one long call.
    """
    tall = cv2.cvtColor(images.reshape(-1, *images.shape[2:]), to)
    values = cv2.extractChannel(tall, channel).reshape(len(images), -1)
    values = np.minimum(np.multiply(values, factors[:, None], dtype=np.float32) + np.float32(0.5), 255).astype(np.uint8)
    cv2.insertChannel(values.reshape(tall.shape[:2]), tall, channel)
    return cv2.cvtColor(tall, back, dst=tall).reshape(images.shape)


def choose_brightness(recipe: Recipe, rng: np.random.Generator, n: int) -> tuple[np.ndarray]:
    """Return the factors of `brighten`."""
    return (rng.uniform(*recipe.brightness, n),)


def brighten(images: Images, first_row: int, factors: np.ndarray) -> Images:
    """Multiply the HSV value of RGB images, uint8 (n, rows, columns, 3), clipped at 255; factors: (n,)."""
    if isinstance(images, torch.Tensor):
        return gpu.brightened(images, gpu.to_device(factors, images.device))[0]
    return multiply_channel(images, 2, factors, cv2.COLOR_RGB2HSV, cv2.COLOR_HSV2RGB)


def choose_shadow(recipe: Recipe, rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the factors, lines and sides of `shade`."""
    return rng.uniform(*recipe.darkness, n), rng.uniform(0, FRAME[1], (n, 2)), rng.random(n) < 0.5


def shade(images: Images, first_row: int, factors: np.ndarray, lines: np.ndarray, left: np.ndarray) -> Images:
    """Multiply the HLS lightness of RGB images, uint8 (n, rows, columns, 3), on one side of a line.

    first_row: the row of the full frame that is the images' first; factors: (n,); lines: (n, 2), the columns at which
    the line meets the top and bottom of the full frame of 160 rows; left: bool (n,), the side.
    """
    rows = np.arange(first_row, first_row + images.shape[1])
    edges = (lines[:, :1] + (lines[:, 1:] - lines[:, :1]) * rows / FRAME[0]).astype(np.float32)
    if isinstance(images, torch.Tensor):
        return gpu.darkened(images, *(gpu.to_device(each, images.device) for each in (factors, edges, left)))[0]
    lit = (np.arange(images.shape[2], dtype=np.float32) < edges[:, :, None]) != left[:, None, None]
    shaded = multiply_channel(images, 1, factors, cv2.COLOR_RGB2HLS, cv2.COLOR_HLS2RGB)
    np.copyto(shaded.view("V3"), images.view("V3"), where=lit[..., None])  # by pixels: takes a tenth of the time
    return shaded


def tints(recipe: Recipe, rng: np.random.Generator, n: int) -> np.ndarray:
    """Sample changes of saturation, tint and brightness: float32 (n, 3, 3), matrices by which RGB is multiplied.

    Only the recipe's share of them changes anything.
    """
    saturation = rng.uniform(*recipe.saturation, n)[:, None, None]
    tint = rng.uniform(*recipe.tint, (n, 3, 1)) * rng.uniform(*recipe.dimmed, (n, 1, 1))
    changed = (rng.random(n) < recipe.tinted)[:, None, None]
    return np.where(changed, tint * (saturation * np.eye(3) + (1 - saturation) / 3), np.eye(3)).astype(np.float32)


def sample_shades(share: float, rng: np.random.Generator, n: int) -> np.ndarray:
    """Sample shadows: int16 (n,), a number below SHADES for this share of them, else -1."""
    return np.where(rng.random(n) < share, rng.integers(0, SHADES, n), -1).astype(np.int16)


def relight(image: np.ndarray, colours: np.ndarray, shade: int) -> np.ndarray:
    """Return an image, uint8 (75, 320, 3), in another light; colours: of `tints`; shade: of `sample_shades`."""
    image = cv2.transform(image, colours)
    return image if shade < 0 else cv2.multiply(image, shades()[shade], scale=1 / 255)


def sample_disturbances(share: float, rng: np.random.Generator, n: int) -> np.ndarray:
    """Sample disturbances of kinds that are not held out: int32 (n,), for `disturbed`; -1, none, but for this share."""
    if not share:
        return np.full(n, -1, np.int32)
    return np.where(rng.random(n) < share, rng.integers(len(TRAINED) << 20, size=n), -1).astype(np.int32)


def disturbed(image: np.ndarray, disturbance: int) -> np.ndarray:
    """Return an image, uint8 (75, 320, 3), as part of a drive's frame under a disturbance of `sample_disturbances`.

    The rest of the frame, on which much depends, is drawn out from the image's edges; the whole is compressed.
    """
    if disturbance < 0:
        return image
    which, drive, frame = disturbance >> 20, disturbance >> 10 & 0x3FF, disturbance & 0x3FF
    whole = cv2.copyMakeBorder(image, *CROP, 0, 0, cv2.BORDER_REPLICATE)
    seen = disturb(whole, TRAINED[which], drive, frame)
    return compress(seen[compressed_rows(SEEN_ROWS)], SEEN_ROWS, JPEG_QUALITY)


def name_of(disturbance: int) -> str:
    """Return the name of a disturbance of `sample_disturbances`, such as `fog:3`; "" for none."""
    return "" if disturbance < 0 else str(TRAINED[disturbance >> 20])


@functools.cache
def shades() -> np.ndarray:
    """Return pictures of shadows, which are always the same: uint8 (SHADES, 75, 320, 3), 255 in the sun."""
    rng = np.random.default_rng(0)
    rows, columns, _ = SEEN_SHAPE
    down, across = np.mgrid[0:rows, 0:columns].astype(np.float32)
    pictures = np.empty((SHADES, *SEEN_SHAPE), np.uint8)
    for picture in pictures:
        light = np.ones(SEEN_SHAPE, np.float32)
        for _ in range(rng.integers(1, 4)):
            # A band at any angle; on the ground it is seen from a flat angle, so it is flattened, too.
            angle, edge, width = rng.uniform(0, 2 * np.pi), rng.uniform(-100, 100), np.exp(rng.uniform(*np.log(WIDTHS)))
            depth = np.cos(angle) * (across - columns / 2) + np.sin(angle) * 3 * (down - rows / 2) - edge
            ragged = rng.normal(0, rng.uniform(*RAGGED), (8, 20)).astype(np.float32)
            depth += cv2.resize(ragged, (columns, rows), interpolation=cv2.INTER_CUBIC)
            shaded = ((depth > 0) & (depth < width)).astype(np.float32)
            shaded = cv2.GaussianBlur(shaded, (0, 0), rng.uniform(*SOFTNESS))[..., None]
            light *= 1 - shaded * (1 - np.minimum(1, rng.uniform(*SHADE) * BLUISH))
        picture[:] = np.round(light * 255)
    return pictures
