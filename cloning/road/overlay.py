"""Draw over a frame the path ahead at a steering, and what the network looks at."""

import cv2
import numpy as np

from cloning.base.frame import FRAME
from cloning.road.camera import project_ground
from cloning.road.motion import AXLE_TO_CAMERA, REAR_AXLE, curvature

GREEN, MAGENTA = (60, 255, 60), (255, 0, 200)  # RGB: of the path, and of what the network looks at
WIDTH = 1.5  # px of a frame
FRACTION_BITS = 4  # of the points' coordinates, as OpenCV takes them


def draw_path(picture: np.ndarray, steering: float, colour: tuple[int, ...] = GREEN) -> None:
    """Draw the path ahead at a steering, -1..1, on a picture: uint8 (160 k, 320 k) or (160 k, 320 k, channels).

    The car's middle drives it: a circle about a point beside the rear axle, drawn up to where it turns back.
    """
    scale, bend = picture.shape[0] / FRAME[0], curvature(steering)
    ahead = np.linspace(2.5, 25, 91)  # m; the bonnet hides the nearer part
    square = (ahead + AXLE_TO_CAMERA) ** 2 - REAR_AXLE**2
    root = np.sqrt(np.maximum(1 - bend**2 * square, 0))
    points = project_ground(bend * square / (1 + root), ahead)[root > 0] * scale
    fixed = np.round(points * 2**FRACTION_BITS).astype(np.int32)
    cv2.polylines(picture, [fixed], False, colour, round(WIDTH * scale), cv2.LINE_AA, FRACTION_BITS)


def overlay(frame: np.ndarray, steering: float, mask: np.ndarray | None = None) -> np.ndarray:
    """Return a frame at twice its size, uint8 (320, 640, 3), RGB, with the path ahead at this steering in green.

    frame: uint8 (160, 320, 3), RGB; steering: -1..1; mask: of `visual_backprop`, shown in magenta, or None.
    """
    picture = frame.astype(np.float32)
    if mask is not None:
        strength = opacity(mask)[..., None]
        picture = picture * (1 - strength) + np.asarray(MAGENTA, np.float32) * strength
    enlarged = cv2.resize(picture.astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    draw_path(enlarged, steering)
    return enlarged


def opacity(mask: np.ndarray) -> np.ndarray:
    """Return how strongly MAGENTA covers a frame, 0..1, where the network looks at it; mask: of `visual_backprop`."""
    return np.sqrt(mask) * 0.7  # the square root makes weak attention visible
