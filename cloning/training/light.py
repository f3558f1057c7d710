"""Changes of the light in a training image: saturation, tint, brightness, and shadows across the road.

The simulator casts shadows at its higher graphics qualities, and recordings at the lower ones have none. The recipe's
augmentation darkens one polygon; here the shade's edges are hard or soft, straight or ragged, and it is bluish, as
measured in real recordings: the road's median colour in the shade is (0.26, 0.30, 0.39) of that in the sun.
"""

import functools

import cv2
import numpy as np

from cloning.training.observations import SEEN_SHAPE

TINTED_SHARE = 0.5  # of the images whose colours are changed
SHADED_SHARE = 0.4  # of the images with shadows
# Ranges of the factors of saturation, of red, green and blue each, and of all three.
SATURATION, TINT, BRIGHTNESS = (0.1, 1.5), (0.85, 1.15), (0.5, 1.15)
SHADES = 256  # different pictures of shadows
SHADE, BLUISH = (0.15, 0.7), np.array([0.85, 1.0, 1.2])  # range of the factor of brightness in the shade; its colour
WIDTHS, SOFTNESS, RAGGED = (4, 400), (0.3, 4), (0, 25)  # pixels: of a shadow, of its edges' blur, of their displacement


def tints(rng: np.random.Generator, n: int) -> np.ndarray:
    """Sample changes of saturation, tint and brightness: float32 (n, 3, 3), matrices by which RGB is multiplied.

    Only TINTED_SHARE of them change anything.
    """
    saturation = rng.uniform(*SATURATION, n)[:, None, None]
    tint = rng.uniform(*TINT, (n, 3, 1)) * rng.uniform(*BRIGHTNESS, (n, 1, 1))
    changed = (rng.random(n) < TINTED_SHARE)[:, None, None]
    return np.where(changed, tint * (saturation * np.eye(3) + (1 - saturation) / 3), np.eye(3)).astype(np.float32)


def sample_shades(rng: np.random.Generator, n: int) -> np.ndarray:
    """Sample shadows: int16 (n,), a number below SHADES for SHADED_SHARE of them, else -1."""
    return np.where(rng.random(n) < SHADED_SHARE, rng.integers(0, SHADES, n), -1).astype(np.int16)


def relight(image: np.ndarray, colours: np.ndarray, shade: int) -> np.ndarray:
    """Return an image, uint8 (75, 320, 3), in another light; colours: of `tints`; shade: of `sample_shades`."""
    image = cv2.transform(image, colours)
    return image if shade < 0 else cv2.multiply(image, _shades()[shade], scale=1 / 255)


@functools.cache
def _shades() -> np.ndarray:
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
