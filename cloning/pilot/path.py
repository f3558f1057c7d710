"""Draw the path ahead of the car at a steering, over a frame or as a layer of its own."""

import cv2
import numpy as np

from cloning.recordings.format import FRAME
from cloning.road.camera import project_ground
from cloning.road.motion import curvature

GREEN = (60, 255, 60)  # RGB
WIDTH = 1.5  # px of a frame
FRACTION_BITS = 4  # of the points' coordinates, as OpenCV takes them


def draw_path(picture: np.ndarray, steering: float, colour: tuple[int, ...] = GREEN) -> None:
    """Draw the path ahead at a steering, -1..1, on a picture: uint8 (160 k, 320 k) or (160 k, 320 k, channels)."""
    scale = picture.shape[0] / FRAME[0]
    ahead = np.linspace(2.5, 25, 40)  # m; the bonnet hides the nearer part
    points = project_ground(curvature(steering) * ahead**2 / 2, ahead) * scale
    fixed = np.round(points * 2**FRACTION_BITS).astype(np.int32)
    cv2.polylines(picture, [fixed], False, colour, round(WIDTH * scale), cv2.LINE_AA, FRACTION_BITS)
