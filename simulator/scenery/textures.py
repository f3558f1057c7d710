"""Procedural textures: uint8 (rows, columns, 3 RGB or 4 RGBA).

They are bright and nearly grey, because the engine multiplies them by the meshes' colours.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.random import Generator

from simulator.scenery.shapes import Colour

ASPHALT_LEVEL = 0.72  # mean of the asphalt's texture, 0..1


def noise(rng: Generator, size: int, blur: float) -> np.ndarray:
    """Return square Gaussian noise of unit variance, smoothed over `blur` pixels, that tiles seamlessly."""
    grain, edge = rng.standard_normal((size, size)).astype(np.float32), int(3 * blur) + 1
    smooth: np.ndarray = cv2.GaussianBlur(np.pad(grain, edge, mode="wrap"), (0, 0), blur)[edge:-edge, edge:-edge]
    return smooth / smooth.std()


def clouds(rng: Generator, size: int, coarsest: float, octaves: int = 5) -> np.ndarray:
    """Return noise of mean 0 and variance 1 in octaves, each half as coarse and half as strong as the one before."""
    total = np.sum([noise(rng, size, coarsest / 2**k) / 2**k for k in range(octaves)], axis=0)
    return (total - total.mean()) / total.std()


def grey(mean: float, *layers: np.ndarray) -> np.ndarray:
    """Return a grey texture: a mean brightness, 0..1, plus layers of deviations from it."""
    level = np.clip((mean + sum(layers)) * 255, 0, 255).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=2)


def asphalt(rng: Generator, size: int = 512, grain: float = 0.15, spots: float = 1.0) -> np.ndarray:
    """Return asphalt; grain and spots scale the contrast of its fine and its coarse structure."""
    stones = noise(rng, size, 0.8)
    return grey(
        ASPHALT_LEVEL,
        grain * stones,
        spots * 0.12 * np.maximum(noise(rng, size, 0.9) - 1, 0),
        spots * 0.06 * noise(rng, size, 6),
        spots * 0.03 * noise(rng, size, 40),
    )


class Line(NamedTuple):
    """A painted line along the road."""

    offset: float  # m from the road's centre line, on both sides
    half_width: float  # m
    colour: Colour  # RGB, 0..1
    share: float = 1.0  # of the texture's length that is painted, from its first row on


def paint_lines(texture: np.ndarray, colour: Colour, half_width: float, lines: Sequence[Line]) -> np.ndarray:
    """Return a road's texture with lines, which compensate for the road's colour, by which the mesh multiplies them.

    texture: uint8 (rows, columns, 3), from the left edge to the right; half_width: of the road, m.
    """
    painted = texture.astype(float)
    rows, columns = texture.shape[:2]
    offset = np.abs((np.arange(columns) + 0.5) / columns * 2 * half_width - half_width)
    for line in lines:
        level = np.array(line.colour) / colour * 255
        painted[: round(rows * line.share), np.abs(offset - line.offset) < line.half_width] = level
    return np.clip(painted, 0, 255).astype(np.uint8)


def concrete(rng: Generator, size: int = 128) -> np.ndarray:
    """Return a concrete slab with the joint to the next."""
    texture = grey(0.90, 0.02 * noise(rng, size, 1.5), 0.03 * noise(rng, size, 20))
    texture[:2] = 160  # the joint
    return texture


def kerb(size: int = 64) -> np.ndarray:
    """Return a red and a white stripe of a kerb."""
    texture = np.full((size, size, 3), (250, 248, 240), np.uint8)
    texture[: size // 2] = (232, 100, 98)
    return texture


def plain() -> np.ndarray:
    """Return plain white."""
    return np.full((4, 4, 3), 255, np.uint8)


def soil(rng: Generator, size: int = 256) -> np.ndarray:
    """Return a texture for soil and grass."""
    return grey(0.80, 0.07 * clouds(rng, size, 24), 0.05 * noise(rng, size, 0.8))


def rock(rng: Generator, size: int = 256, streak: float = 6.0) -> np.ndarray:
    """Return rock with vertical streaks, as on the real cliffs; streak: length of a streak relative to its width."""
    pad = 40
    grain = np.pad(rng.standard_normal((size, size)).astype(np.float32), pad, mode="wrap")
    streaks = cv2.GaussianBlur(grain, (0, 0), 2, sigmaY=2 * streak)[pad:-pad, pad:-pad]
    return grey(0.74, 0.13 * streaks / streaks.std(), 0.06 * clouds(rng, size, 24))


def cobbles(rng: Generator, size: int = 512, stones: int = 12) -> np.ndarray:
    """Return irregular cobbles with pale joints, longer along the road (rows) than across it."""
    rows, columns = np.mgrid[0:size, 0:size].astype(np.float32)
    rows += 7 * noise(rng, size, 18)
    columns += 5 * noise(rng, size, 18)
    across = columns / size * stones
    course = np.floor(across)
    along = rows / size * stones * 0.6 + 0.37 * course
    edge = np.minimum(np.minimum(across % 1, 1 - across % 1), np.minimum(along % 1, 1 - along % 1) / 0.6)
    tint = rng.uniform(-0.13, 0.10, (64, 64))[course.astype(int) % 64, np.floor(along).astype(int) % 64]
    level = 0.76 + tint + 0.09 * noise(rng, size, 1.5)
    level = np.where(edge < 0.08, 0.95, level)
    return grey(0.0, level)


def transparent(size: int, level: int) -> np.ndarray:
    """Return a square texture, transparent everywhere, of this grey."""
    texture = np.full((size, size, 4), level, np.uint8)
    texture[..., 3] = 0
    return texture


def foliage(level: int, blue: float) -> tuple[int, int, int, int]:
    """Return an opaque grey for leaves, 0..255, with this share of blue."""
    return level, level, int(blue * level), 255


def pine(rng: Generator, size: int = 128, low: float = 0.62) -> np.ndarray:
    """Return a pine; low: height to which its branches reach down, from 0 at the top to 1 at the ground."""
    texture, middle = transparent(size, 150), size // 2
    cv2.line(texture, (middle, size - 1), (middle, size // 5), (150, 120, 100, 255), max(2, size // 48))
    for _ in range(230):
        y = rng.uniform(0.03, low)
        width = 0.05 + 0.30 * (y / low) ** 0.7
        x = middle + rng.normal() * width * size * 0.42
        level = int(255 * np.clip(rng.uniform(0.45, 0.85) + 0.25 * (1 - y / low) + 0.1 * (x > middle), 0, 1))
        axes, turn = (int(rng.integers(3, 8)), int(rng.integers(2, 4))), float(rng.uniform(-25, 25))
        cv2.ellipse(texture, (int(x), int(y * size)), axes, turn, 0, 360, foliage(level, 0.9), -1)
    return texture


def bush(rng: Generator, size: int = 64) -> np.ndarray:
    """Return a bush of dark tufts."""
    texture = transparent(size, 140)
    for _ in range(6):
        middle, wide, tall = rng.uniform(0.15, 0.85), rng.uniform(0.05, 0.13), rng.uniform(0.3, 0.9)
        for _ in range(22):
            x, y = middle + rng.normal() * wide * 0.6, 1 - abs(rng.normal()) * tall * 0.45
            level = int(rng.uniform(120, 250))
            centre = (int(np.clip(x, 0.04, 0.96) * size), int(max(0.1, y) * size))
            cv2.circle(texture, centre, int(rng.integers(1, 4)), foliage(level, 0.85), -1)
    return texture


def reeds(rng: Generator, size: int = 64) -> np.ndarray:
    """Return a clump of reeds."""
    texture = transparent(size, 140)
    for _ in range(60):
        across = rng.uniform(0.04, 0.96)
        tall = np.sin(np.pi * across) ** 0.5 * rng.uniform(0.5, 0.95)
        level = int(rng.uniform(110, 240))
        foot, tip = int(across * size), (int(across * size + rng.normal() * 4), int((1 - tall) * size))
        cv2.line(texture, (foot, size), tip, foliage(level, 0.8), 1)
    return texture


def palm(rng: Generator, size: int = 128) -> np.ndarray:
    """Return a palm on a bent trunk."""
    texture = transparent(size, 150)
    bend = rng.uniform(-0.14, 0.14) * size
    trunk = np.array([[size * 0.5 + bend * (1 - t) ** 2, size - t * size * 0.74] for t in np.linspace(0, 1, 12)])
    crown = np.array([trunk[-1][0], size * 0.26])
    cv2.polylines(texture, [trunk.astype(np.int32)], False, (120, 100, 80, 255), max(3, size // 30))
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False) + rng.uniform(0, 0.5):
        t = np.linspace(0, 1, 10)
        reach = size * rng.uniform(0.32, 0.46)
        fall = reach * 0.5 * t * t
        frond = crown + np.column_stack([np.cos(angle) * reach * t, np.sin(angle) * reach * 0.55 * t + fall])
        level = int(rng.uniform(120, 255))
        cv2.polylines(texture, [frond.astype(np.int32)], False, foliage(level, 0.8), 4)
        shade = (int(level * 0.8), int(level * 0.8), int(level * 0.6), 255)
        for (x, y), u in zip(frond[2:], t[2:], strict=True):
            for drop in (-1, 1):
                cv2.line(texture, (int(x), int(y)), (int(x + drop * 3), int(y + size * 0.07 * (1.2 - u))), shade, 2)
    return texture


def sky(zenith: Colour, horizon: Colour, rows: int = 128) -> np.ndarray:
    """Return a vertical gradient from the zenith's colour in the top row to the horizon's in the bottom row."""
    down = np.linspace(0, 1, rows)[:, None, None]
    level = (1 - down) * np.array(zenith) + down * np.array(horizon)
    return np.repeat(level * 255, 8, axis=1).astype(np.uint8)
