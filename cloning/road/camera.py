"""The geometry of the car's three cameras: poses, projection, and homographies between poses.

The ground is flat and everything above the horizon is infinitely far away, as in NVIDIA's evaluation (arXiv 1604.07316,
section 6). A camera's pose relative to another is (right, forward, yaw): metres, metres, radians, yaw right positive.
"""

import cv2
import numpy as np

from cloning.base.frame import FRAME, ROAD_ROWS
from cloning.road.motion import AXLE_TO_CAMERA, CAMERA_FORWARD, right_of

# Fitted by warping real centre frames to the side cameras; recordings of both tracks agree within 0.01 m, 0.05 degrees
# and half a row. The simulator's scene file has the same yaw and roll.
VERTICAL_FIELD = 60.0  # degrees
FOCAL_LENGTH = FRAME[0] / 2 / np.tan(np.radians(VERTICAL_FIELD / 2))  # px
CAMERA_HEIGHT = 1.255  # m above the ground
# Degrees down, right and clockwise (the horizon falls to the right).
CAMERA_PITCH, CAMERA_YAW, CAMERA_ROLL = 7.85, 0.7, 1.2
CAMERA_OFFSETS = {"center": 0.0, "left": -0.806, "right": 0.825}  # m to the right, in the order of a recording's images
FIRST_BONNET_ROW = ROAD_ROWS.stop  # from this row down the bonnet hides the road
FAR_SLOPE = 0.004  # tangent of the angle below the horizon: ground nearer to the horizon counts as infinitely far
EARLIER_FRAME = 3.0  # m: a frame taken this far back shows all the road that a view 2 m to the side lacks
JPEG_QUALITY = 75  # of the real simulator's images, with colour at half resolution, as their tables show
VIEW_JPEG_QUALITY = 95  # of a warped frame, which was compressed once before, when it was recorded


def _turn(right: float = 0.0, down: float = 0.0, forward: float = 0.0) -> np.ndarray:
    """Return the rotation by an angle in radians about an axis of the level frame: float64 (3, 3)."""
    return cv2.Rodrigues(np.array([right, down, forward]))[0]


INTRINSICS = np.array([[FOCAL_LENGTH, 0, (FRAME[1] - 1) / 2], [0, FOCAL_LENGTH, (FRAME[0] - 1) / 2], [0, 0, 1]])
# From directions in the car's level frame (right, down, forward) to pixels (column, row, 1), and back.
CAMERA_MATRIX = (
    INTRINSICS
    @ _turn(forward=np.radians(CAMERA_ROLL))
    @ _turn(right=np.radians(CAMERA_PITCH))
    @ _turn(down=-np.radians(CAMERA_YAW))
)
FROM_PIXELS = np.linalg.inv(CAMERA_MATRIX)
# Of a camera at the same position that looks straight ahead and is not rolled.
LEVEL_CAMERA_MATRIX = INTRINSICS @ _turn(right=np.radians(CAMERA_PITCH))


def camera_position(axle: np.ndarray, forward: np.ndarray, offset: np.ndarray | float = 0.0) -> np.ndarray:
    """Return a camera's position for a position of the rear axle's middle: float64 (…, 2).

    axle: (…, 2), m, (right, forward) in a trajectory's frame or (x, y) on a track; forward: (…, 2), the unit vector
    along the car in the same frame; offset: (…), m, the camera's mounting to the right of the middle.
    """
    return axle + AXLE_TO_CAMERA * forward + np.asarray(offset)[..., None] * right_of(forward)


def project_ground(right: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the pixels (column, row), float64 (n, 2), of points on the ground.

    right, forward: (n,), m from the camera.
    """
    points = np.stack([right, np.full_like(forward, CAMERA_HEIGHT), forward], axis=1) @ CAMERA_MATRIX.T
    return points[:, :2] / points[:, 2:]


def homographies(
    right: np.ndarray | float,
    forward: np.ndarray | float,
    yaw: np.ndarray | float,
    to_pixels: np.ndarray = CAMERA_MATRIX,
    from_pixels: np.ndarray = FROM_PIXELS,
) -> np.ndarray:
    """Return the homographies from a camera's pixels to those of a camera at another pose: float64 (…, 2, 3, 3).

    The first of each pair is that of the ground, the second that of the sky (infinitely far).
    right, forward, yaw: (…), the second camera's pose relative to the first; to_pixels: (3, 3) or (…, 3, 3), from level
    directions to the second camera's pixels; from_pixels: (3, 3), from the first camera's pixels to level directions.
    """
    s, c, zero = np.sin(yaw), np.cos(yaw), np.zeros(np.shape(yaw))
    rotation = np.stack([c, zero, -s, zero, zero + 1, zero, s, zero, c], axis=-1).reshape(*zero.shape, 1, 3, 3)
    translation = np.tile(np.eye(3), (*zero.shape, 2, 1, 1))
    translation[..., 0, 0, 1] = -right / CAMERA_HEIGHT
    translation[..., 0, 2, 1] = -forward / CAMERA_HEIGHT
    return to_pixels[..., None, :, :] @ rotation @ translation @ from_pixels


# --------------------------------------------------------------------------------------------------
# The stand-in simulator's cameras on its car

# m to the right, forward and up from the car's middle, which is 0.025 m above the ground when the car is at rest; in
# real recordings the cameras are 1.26 m above the ground.
CAMERA_POSITIONS = {
    "center": (CAMERA_OFFSETS["center"], CAMERA_FORWARD, 1.235),
    "left": (CAMERA_OFFSETS["left"], 0.984, 1.235),
    "right": (CAMERA_OFFSETS["right"], 0.999, 1.235),
}
# Degrees down, relative to the car's body: with the body's own pitch on its springs the horizon lies at row 60 in the
# middle, 57 at the left edge and 63 at the right one, as in real frames. (The scene file has 9.5.)
MOUNT_PITCH = 8.0


def height_at_rows(rows: np.ndarray, right: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the height at which a point of the car appears in a given row of the centre camera's frame: float64, m.

    rows: of the frame; right, forward: m from the car's origin, as the height, to the point. All are broadcast.
    """
    yaw, pitch, roll = np.radians((CAMERA_YAW, MOUNT_PITCH, CAMERA_ROLL))
    by_yaw = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    by_pitch = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    by_roll = np.array([[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]])
    # From directions in the car, (right, forward, up), to those in the camera, (right, ahead, up).
    _, ahead, up = by_roll @ by_pitch @ by_yaw
    x, y, z = np.array(CAMERA_POSITIONS["center"])
    slope = (FRAME[0] / 2 - np.asarray(rows, float)) / FOCAL_LENGTH
    level = up - slope[..., None] * ahead  # its product with the direction from the camera to the point is zero
    return z - (level[..., 0] * (right - x) + level[..., 1] * (forward - y)) / level[..., 2]
