"""Pictures to lay over frames."""

import cv2
import numpy as np

from cloning.pilot.path import GREEN, draw_path
from cloning.recordings.format import FRAME


def layer(colour: tuple[int, int, int], opacity: np.ndarray) -> bytes:
    """Return a PNG of one colour, RGB; opacity: uint8 (rows, columns)."""
    picture = np.empty((*opacity.shape, 4), np.uint8)
    picture[..., :3] = colour[::-1]  # BGR, as OpenCV writes it
    picture[..., 3] = opacity
    return cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def path_layer(steering: float) -> bytes:
    """Return a PNG of a frame's size with the path ahead at a steering, -1..1."""
    opacity = np.zeros(FRAME[:2], np.uint8)
    draw_path(opacity, steering, (255,))
    return layer(GREEN, opacity)
