"""Finds the dashed line along a road's centre in strips, near where a localisation expects it.

The lane network sees the whole road and is a few tenths of a metre off; the paint, where there is some, is the centre.
"""

import functools

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
MIN_PROMINENCE = 2.0  # contrast of the line relative to that of any other line within reach
APART = 0.6  # m: lines closer together count as one
SLOPES = np.arange(-4, 5) * 0.15  # directions in which the line is sought: tangents of the angle to the expected one
ROWS_AT_ONCE = 64  # of a recording, 96 rows each of one image; OpenCV takes images of up to 32,767
NEAR_ROWS, SUPPORT, AGREEMENT, DRIFT = 4, 5, 0.3, 0.12  # of a detection: see `supported`

BESIDE = round(FLANK / STEP)  # points
SIDE = round(REACH / STEP) + BESIDE  # points
SEEN = np.arange(-SIDE, SIDE + 1) * STEP  # m right of the expected centre
ACROSS = SEEN[BESIDE:-BESIDE]  # where the line is sought; it has road on both sides
SHIFTS = [np.round(SLOPES[:, None] * (AHEAD[part] - AHEAD[part].mean()) / STEP).astype(int) for part in PARTS]


def _strip_pixels(right: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and the rows, (k,), of a strip at which points so far to the right are seen, at AHEAD."""
    points = np.stack([np.full_like(AHEAD, right), np.full_like(AHEAD, CAMERA_HEIGHT), AHEAD], axis=1)
    pixels = points @ DIRECTION_TO_STRIP.T
    return pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2]


MIDDLE, ROWS = _strip_pixels(0.0)  # the camera is level, so that a row of pixels is at one distance
COLUMNS_PER_METRE = _strip_pixels(1.0)[0] - MIDDLE


def line_contrast(strips: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return by how much points are brighter than the road on both of their sides: float32 (n, k, m), relative, 0..1.

    strips: uint8 (n, 32, 160, 3), n at most 1,000; expected: float (n, k), m right of each strip's camera, at AHEAD;
    the points are at AHEAD, and at ACROSS from there. The contrast is 0 where a point is not seen.
    """
    columns = (MIDDLE[:, None] + COLUMNS_PER_METRE[:, None] * (expected[..., None] + SEEN)).astype(np.float32)
    seen = (columns > 0) & (columns < STRIP_SHAPE[1] - 1)
    # All strips as one image, one below the other, so that OpenCV is called once for all instead of once for each.
    tops = np.arange(len(strips))[:, None] * STRIP_SHAPE[0]
    rows = np.repeat((tops + ROWS).astype(np.float32).reshape(-1, 1), len(SEEN), axis=1)
    gray = cv2.cvtColor(strips.reshape(-1, *STRIP_SHAPE[1:]), cv2.COLOR_RGB2GRAY)
    above = cv2.remap(gray, columns.reshape(rows.shape), rows, cv2.INTER_LINEAR).astype(np.float32)
    bright = cv2.blur(above, (round(LINE / STEP), 1), borderType=cv2.BORDER_REPLICATE).reshape(columns.shape)
    left, middle, right = bright[..., : -2 * BESIDE], bright[..., BESIDE:-BESIDE], bright[..., 2 * BESIDE :]
    beside = np.maximum(left, right)
    contrast = np.clip((middle - beside) / (beside + 10), 0, 1)
    return np.where(seen[..., : -2 * BESIDE] & seen[..., 2 * BESIDE :], contrast, 0)


def _sharpest(contrast: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Return the mean contrast of the line through each point in the direction in which it is greatest: (n, m).

    contrast: (n, k, m), at k distances, across the road; shifts: int (SLOPES, k), the points by which a line in each
    direction is further right at each distance.
    """
    most = int(np.abs(shifts).max())
    padded, m = np.pad(contrast, [(0, 0), (0, 0), (most, most)]), contrast.shape[2]
    lines = (
        sum(padded[:, k, most + shift : most + shift + m] for k, shift in enumerate(of_slope.tolist()))
        for of_slope in shifts
    )
    return functools.reduce(np.maximum, lines) / contrast.shape[1]


def find_lines(strips: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return how far right of where it is expected the centre line is painted, at DISTANCES: float64 (n, 3), m.

    strips: uint8 (n, 3, 32, 160, 3), of the three cameras in n rows of a recording, at most ROWS_AT_ONCE; expected:
    float (n, 2, k), of `ahead.line_ahead` for the centre camera, at AHEAD, nan where it is out of sight. The result is
    nan where no line is found, or more than one.
    """
    right, factor = np.nan_to_num(expected, nan=1e3).swapaxes(0, 1)[:, :, None]
    from_cameras = right - MOUNT_OFFSETS[:, None] * factor
    contrast = line_contrast(strips.reshape(-1, *STRIP_SHAPE), from_cameras.reshape(-1, len(AHEAD)))
    contrast = contrast.reshape(*strips.shape[:2], *contrast.shape[1:]).max(1)
    profile = np.stack([_sharpest(contrast[:, part], shifts) for part, shifts in zip(PARTS, SHIFTS, strict=True)], 1)
    padded = np.pad(profile, [(0, 0), (0, 0), (1, 1)])
    profile = (padded[..., :-2] + 2 * profile + padded[..., 2:]) / 4
    away = np.abs(ACROSS - ACROSS[profile.argmax(2)][..., None])
    others = np.where(away > APART, profile, 0).max(2)
    near = np.where(away < LINE, profile, 0)
    found = (near @ ACROSS) / np.maximum(near.sum(2), 1e-9)
    return np.where(profile.max(2) >= np.maximum(MIN_CONTRAST, MIN_PROMINENCE * others), found, np.nan)


def supported(found: np.ndarray) -> np.ndarray:
    """Return the detections with which others agree, and nan for the rest: float (n, 3), m.

    found: of `find_lines`, in successive rows. At least SUPPORT of those up to NEAR_ROWS before and after must be
    within AGREEMENT m of a detection, and DRIFT m more for each row between them, since the expectation may be wrong:
    what looks like a line in a few frames only is the edge of a shadow, or a post.
    """
    padded = np.pad(found, [(NEAR_ROWS, NEAR_ROWS), (0, 0)], constant_values=np.nan)
    near = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR_ROWS + 1, axis=0)[:, None]  # (n, 1, 3, rows)
    allowed = AGREEMENT + DRIFT * np.abs(np.arange(-NEAR_ROWS, NEAR_ROWS + 1))
    agreeing = (np.abs(near - found[:, :, None, None]) < allowed).sum((2, 3)) - 1
    return np.where(agreeing >= SUPPORT, found, np.nan)
