"""Where the cameras sit in the car and which way they look: all three the same way."""

import numpy as np

from images import FRAME
from viewpoint import FOCAL, ROLL, SIDES, YAW

ROWS, COLUMNS = FRAME[:2]
# Right, forward and up of the car's middle, m. The car rests 0.025 m above the ground: fitted to real recordings the
# cameras are 1.26 m above it.
MOUNTS = {
    "center": (SIDES["center"], 1.0, 1.235),
    "left": (SIDES["left"], 0.984, 1.235),
    "right": (SIDES["right"], 0.999, 1.235),
}
# Degrees down, in the car: with the body's own pitch on its springs the horizon lies at row 60 in the middle, 57 at the
# left edge and 63 at the right one, as in real frames. (The scene file has 9.5.)
PITCH = 8.0


def turned() -> np.ndarray:
    """(3, 3): a direction in the car, (right, forward, up), times this is the camera's (right, ahead, up)."""
    yaw, pitch, roll = np.radians((YAW, PITCH, ROLL))
    heading = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    nodding = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    leaning = np.array([[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]])
    return leaning @ nodding @ heading


def height_seen(rows, aside, forward) -> np.ndarray:
    """How high, in metres in the car, a point at `aside` and `forward` is that the centre camera sees at these rows."""
    _, ahead, up = turned()
    x, y, z = np.array(MOUNTS["center"])
    slope = (ROWS / 2 - np.asarray(rows, float)) / FOCAL
    level = up - slope[..., None] * ahead  # zero times the point, seen from the camera
    return z - (level[..., 0] * (aside - x) + level[..., 1] * (forward - y)) / level[..., 2]
