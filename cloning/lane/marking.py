"""Finds the dashed line along a road's centre in strips, near where a localisation expects it.

The lane network sees the whole road and is a few tenths of a metre off; the paint, where there is some, is the centre.
"""

import cv2
import numpy as np

from cloning.lane.reader import DIRECTION_TO_STRIP, MOUNT_OFFSETS, STRIP_SHAPE
from cloning.road.camera import CAMERA_HEIGHT

AHEAD = np.arange(3.3, 6.3, 0.1)  # m from the camera: nearer ground lies below the strip, further ground is seldom flat
PARTS = np.array_split(np.arange(len(AHEAD)), 3)  # of AHEAD; each gives a detection
DISTANCES = np.array([AHEAD[part].mean() for part in PARTS])  # m ahead of the camera, of the detections
STEP = 0.05  # m, between points across the road
REACH = 1.2  # m to the left and right of the expected centre in which the line is sought
LINE, FLANK = 0.25, 0.35  # m: width over which brightness is averaged, and from a line's middle to the road beside it
MIN_CONTRAST = 0.08  # of the line, relative to the road beside it, averaged over a part
MIN_PROMINENCE = 1.6  # contrast of the line relative to that of any other line within reach
APART = 0.3  # m: lines closer together count as one
NEAR_ROWS, SUPPORT, AGREEMENT = 7, 8, 0.3  # of a detection: see `supported`

BESIDE = round(FLANK / STEP)  # points
SIDE = round(REACH / STEP) + BESIDE  # points
SEEN = np.arange(-SIDE, SIDE + 1) * STEP  # m right of the expected centre
ACROSS = SEEN[BESIDE:-BESIDE]  # where the line is sought; it has road on both sides


def _strip_pixels(right: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and the rows, (k,), of a strip at which points so far to the right are seen, at AHEAD."""
    points = np.stack([np.full_like(AHEAD, right), np.full_like(AHEAD, CAMERA_HEIGHT), AHEAD], axis=1)
    pixels = points @ DIRECTION_TO_STRIP.T
    return pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2]


MIDDLE, ROWS = _strip_pixels(0.0)  # the camera is level, so that a row of pixels is at one distance
COLUMNS_PER_METRE = _strip_pixels(1.0)[0] - MIDDLE


def line_contrast(strip: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return by how much points are brighter than the road on both of their sides: float32 (k, m), relative, 0..1.

    strip: uint8 (32, 160, 3); expected: float (k,), m right of its camera, at AHEAD; the points are at AHEAD, and at
    ACROSS from there. The contrast is 0 where a point is not seen.
    """
    columns = (MIDDLE[:, None] + COLUMNS_PER_METRE[:, None] * (expected[:, None] + SEEN)).astype(np.float32)
    rows = np.repeat(ROWS.astype(np.float32)[:, None], len(SEEN), axis=1)
    seen = (columns > 0) & (columns < STRIP_SHAPE[1] - 1)
    above = cv2.remap(cv2.cvtColor(strip, cv2.COLOR_RGB2GRAY), columns, rows, cv2.INTER_LINEAR).astype(np.float32)
    bright = cv2.blur(above, (round(LINE / STEP), 1), borderType=cv2.BORDER_REPLICATE)
    left, middle, right = bright[:, : -2 * BESIDE], bright[:, BESIDE:-BESIDE], bright[:, 2 * BESIDE :]
    beside = np.maximum(left, right)
    contrast = np.clip((middle - beside) / (beside + 10), 0, 1)
    return np.where(seen[:, : -2 * BESIDE] & seen[:, 2 * BESIDE :], contrast, 0)


def find_line(strips: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return how far right of where it is expected the centre line is painted, at DISTANCES: float64 (3,), m.

    strips: uint8 (3, 32, 160, 3), of the three cameras; expected: float (k,), m right of the centre camera, at AHEAD,
    nan where it is out of sight. The result is nan where no line is found, or more than one.
    """
    known = np.nan_to_num(expected, nan=1e3)
    contrasts = [line_contrast(strip, known - mount) for strip, mount in zip(strips, MOUNT_OFFSETS, strict=True)]
    contrast = np.max(contrasts, axis=0)
    found = np.full(len(PARTS), np.nan)
    for k, part in enumerate(PARTS):
        profile = np.convolve(contrast[part].mean(0), np.array([1, 2, 1]) / 4, "same")
        peak = ACROSS[profile.argmax()]
        others = profile[np.abs(ACROSS - peak) > APART]
        if profile.max() >= max(MIN_CONTRAST, MIN_PROMINENCE * others.max()):
            near = np.abs(ACROSS - peak) < LINE
            found[k] = (ACROSS[near] * profile[near]).sum() / profile[near].sum()
    return found


def supported(found: np.ndarray) -> np.ndarray:
    """Return the detections with which others agree, and nan for the rest: float (n, 3), m.

    found: of `find_line`, in successive rows. At least SUPPORT of those up to NEAR_ROWS before and after must be within
    AGREEMENT m of a detection: what looks like a line in a few frames only is the edge of a shadow, or a post.
    """
    padded = np.pad(found, [(NEAR_ROWS, NEAR_ROWS), (0, 0)], constant_values=np.nan)
    near = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR_ROWS + 1, axis=0).reshape(len(found), 1, -1)
    agreeing = (np.abs(near - found[:, :, None]) < AGREEMENT).sum(2) - 1
    return np.where(agreeing >= SUPPORT, found, np.nan)
