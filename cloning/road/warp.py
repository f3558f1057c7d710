"""Warp frames to what a camera would have seen from another pose, by the homographies of `camera.py`."""

import functools

import cv2
import numpy as np

from cloning.base.frame import FRAME, ROAD_ROWS
from cloning.road.camera import CAMERA_MATRIX, FAR_SLOPE, FIRST_BONNET_ROW, FROM_PIXELS, camera_position, homographies
from cloning.road.motion import components, forward_vector

FIRST_GROUND_ROW, FIRST_ROW_WITHOUT_SKY = 57, 66  # the first row with any ground, and the first without sky


def _shifted(top: int, left: int = 0) -> np.ndarray:
    """Return the translation that makes this row and column the first: float64 (3, 3)."""
    return np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]])


def _shows_ground(shape: tuple[int, int], from_pixels: np.ndarray) -> np.ndarray:
    """Return which pixels show ground near enough to move with the camera: bool (rows, columns)."""
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    directions = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ from_pixels.T
    return directions[..., 1] > FAR_SLOPE * directions[..., 2]


@functools.cache
def ground_mask() -> np.ndarray:
    """Return uint8 (160, 320): 255 where a frame shows ground near enough to move with the camera, else 0."""
    return np.where(_shows_ground(FRAME[:2], FROM_PIXELS), 255, 0).astype(np.uint8)


@functools.cache
def road_mask() -> np.ndarray:
    """Return uint8 (160, 320): 0 on the bonnet and at the border of a frame, else 255."""
    mask = np.zeros(FRAME[:2], np.uint8)
    mask[1:FIRST_BONNET_ROW, 1:-1] = 255
    return mask


def warp(
    frame: np.ndarray, right: float, forward: float, yaw: float, end: int = FRAME[0]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame warped to this pose relative to its camera, and which of the pixels the camera really saw.

    frame: uint8 (160, 320, c); right, forward: m; yaw: radians; end: only the rows before this one are computed, and at
    least `FIRST_ROW_WITHOUT_SKY`. Returns uint8 (end, 320, c) and bool (end, 320); a pixel that was not seen, which may
    only be ground, repeats the nearest one at the border.
    """
    ground, sky = homographies(right, forward, yaw)
    warped, seen = np.empty((end, *frame.shape[1:]), np.uint8), np.ones((end, FRAME[1]), bool)
    size = FRAME[1], FIRST_ROW_WITHOUT_SKY
    warped[:FIRST_ROW_WITHOUT_SKY] = cv2.warpPerspective(frame, sky, size, borderMode=cv2.BORDER_REFLECT_101)
    matrix, size = _shifted(FIRST_GROUND_ROW) @ ground, (FRAME[1], end - FIRST_GROUND_ROW)
    mask = ground_mask()[FIRST_GROUND_ROW:end]
    cv2.copyTo(_warp_ground(frame, matrix, size), mask, warped[FIRST_GROUND_ROW:])
    seen[FIRST_GROUND_ROW:] = (cv2.warpPerspective(road_mask(), matrix, size) == 255) | (mask == 0)
    return warped, seen


def with_alpha(image: np.ndarray) -> np.ndarray:
    """Return an image, uint8 (rows, columns, 3), as RGBA, which OpenCV warps alike in two thirds of the time."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2RGBA)


def _warp_ground(rows: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a frame's rows, warped by a homography, (3, 3), to this many columns and rows: uint8."""
    return cv2.warpPerspective(rows, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def fill_ground(view: np.ndarray, missing: np.ndarray, rows: np.ndarray, matrix: np.ndarray) -> None:
    """Fill in the ground that is missing in a view from another frame.

    view: uint8 (k, 320, c), is changed; missing: uint8 (k, 320), not 0 where ground is missing; rows: of the other
    frame, uint8 (n, 320, c); matrix: float64 (3, 3), the homography from these rows to the view, for the ground.
    """
    left, top, width, height = cv2.boundingRect(missing)
    box = slice(top, top + height), slice(left, left + width)
    other = _warp_ground(rows, _shifted(top, left) @ matrix, (width, height))  # no more: it takes the longest
    cv2.copyTo(other, missing[box], view[box])


class CroppedView:
    """Warps recorded frames to the rows that a network sees, as from another pose.

    To be fast enough for every training image, it computes only those rows, from a frame's `ROAD_ROWS`.
    """

    def __init__(self, crop: tuple[int, int]) -> None:
        """Prepare the warps; crop: the rows that the network cuts off the top and the bottom of a frame."""
        top, bottom = crop
        self.columns, self.rows = FRAME[1], FRAME[0] - top - bottom
        self.sky_rows = FIRST_ROW_WITHOUT_SKY - top
        to_view = _shifted(top) @ CAMERA_MATRIX
        # The second matrix is for the mirrored world. A flipped frame does not show what the cameras would see of it,
        # because they are turned and rolled.
        self.to_pixels = np.stack([to_view, to_view @ np.diag([-1.0, 1, 1])])
        self.from_pixels = FROM_PIXELS @ _shifted(-ROAD_ROWS.start)
        ground = [_shows_ground((self.sky_rows, self.columns), np.linalg.inv(matrix)) for matrix in self.to_pixels]
        self.sky = [np.where(mask, 0, 255).astype(np.uint8) for mask in ground]

    def homographies(
        self, position: np.ndarray, heading: np.ndarray, axle: np.ndarray, offset: np.ndarray, mirrored: np.ndarray
    ) -> np.ndarray:
        """Return the homographies from n recorded frames to n views: float64 (n, 2, 3, 3), for the ground and the sky.

        position: (n, 2), m right and forward, and heading: (n,), radians, of the view; axle: (n, 3), right, forward,
        heading of the recorded car's rear axle; offset: (n,), m, the mounting of the camera that took the frame;
        mirrored: bool (n,), whether the view is of the mirrored world.
        """
        along = forward_vector(axle[:, 2])
        away = position - axle[:, :2] - camera_position(np.zeros(2), along, offset)
        right, forward = components(away, along).T
        to_pixels = self.to_pixels[mirrored.astype(int)]
        return homographies(right, forward, heading - axle[:, 2], to_pixels, self.from_pixels)

    def warp(self, rows: np.ndarray, matrices: np.ndarray, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return a view, uint8 (75, 320, c), and a mask, uint8 (75, 320): 255 where the camera really saw it.

        rows: uint8 (90, 320, c), `ROAD_ROWS` of a frame; matrices: float64 (2, 3, 3), of `homographies`; mirrored:
        whether they are for the mirrored world.
        """
        ground, sky = matrices
        size, sky_size = (self.columns, self.rows), (self.columns, self.sky_rows)
        view = _warp_ground(rows, ground, size)
        seen = cv2.warpPerspective(road_mask()[ROAD_ROWS], ground, size, flags=cv2.INTER_NEAREST)  # 0 beyond the border
        far = cv2.warpPerspective(rows, sky, sky_size, borderMode=cv2.BORDER_REFLECT_101)
        cv2.copyTo(far, self.sky[mirrored], view[: self.sky_rows])
        np.bitwise_or(seen[: self.sky_rows], self.sky[mirrored], out=seen[: self.sky_rows])
        return view, seen
