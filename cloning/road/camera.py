"""What the car's camera would see from another place: frames warped over flat ground (as in NVIDIA's evaluation,
arXiv 1604.07316, section 6).

Below the horizon a frame shows flat ground, above it what is infinitely far. A pose is that of the camera: metres to
the right and forward, yaw in radians, right positive.
"""

import functools

import cv2
import numpy as np

from cloning.recordings.format import FRAME

# Fitted by carrying real centre frames over to the side cameras, on both tracks: within 0.01 m, 0.05 degrees and half a
# row the same on all recordings. The scene file says 0.7 and 1.2 degrees too.
VERTICAL_FIELD = 60.0  # degrees
FOCAL_LENGTH = FRAME[0] / 2 / np.tan(np.radians(VERTICAL_FIELD / 2))  # px
CAMERA_HEIGHT = 1.255  # m above the ground
# Degrees down, right and clockwise (the horizon falls to the right).
CAMERA_PITCH, CAMERA_YAW, CAMERA_ROLL = 7.85, 0.7, 1.2
CAMERA_OFFSETS = {"center": 0.0, "left": -0.806, "right": 0.825}  # m to the right, in the order of a recording's images
BONNET_ROW = 135  # the row from which on the bonnet hides the road
FAR_SLOPE = 0.004  # of the focal length below the horizon: further away the ground counts as infinitely far
EARLIER_FRAME = 3.0  # m: a frame from so far back shows all that is missing at 2 m beside the way
VIEW_JPEG_QUALITY = 95  # of a warped frame's JPEG: it has been through the camera's 75 already


def _turn(right: float = 0.0, down: float = 0.0, forward: float = 0.0) -> np.ndarray:
    """The rotation by an angle in radians about an axis of the level frame: (3, 3)."""
    return cv2.Rodrigues(np.array([right, down, forward]))[0]


INTRINSICS = np.array([[FOCAL_LENGTH, 0, (FRAME[1] - 1) / 2], [0, FOCAL_LENGTH, (FRAME[0] - 1) / 2], [0, 0, 1]])
# From directions in the car's level frame (right, down, forward) to pixels.
CAMERA_MATRIX = (
    INTRINSICS
    @ _turn(forward=np.radians(CAMERA_ROLL))
    @ _turn(right=np.radians(CAMERA_PITCH))
    @ _turn(down=-np.radians(CAMERA_YAW))
)
_BACK = np.linalg.inv(CAMERA_MATRIX)


def project(right: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Columns and rows, float64 (n, 2), of points on the ground, (n,) metres right of and before a camera."""
    points = np.stack([right, np.full_like(forward, CAMERA_HEIGHT), forward], axis=1) @ CAMERA_MATRIX.T
    return points[:, :2] / points[:, 2:]


def homographies(right: float, forward: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """From a camera's pixels to those of one at this pose relative to it: (3, 3) for the ground, and for the sky."""
    turn = CAMERA_MATRIX @ _turn(down=-yaw)
    moved = np.eye(3)
    moved[0, 1], moved[2, 1] = -right / CAMERA_HEIGHT, -forward / CAMERA_HEIGHT
    return turn @ moved @ _BACK, turn @ _BACK


@functools.cache
def ground_mask() -> np.ndarray:
    """uint8 (160, 320): 255 where a frame shows ground near enough to move with the camera, 0 where it does not."""
    columns, rows = np.meshgrid(np.arange(FRAME[1]), np.arange(FRAME[0]))
    directions = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ _BACK.T
    return np.where(directions[..., 1] > FAR_SLOPE * directions[..., 2], 255, 0).astype(np.uint8)


FIRST_GROUND_ROW, FIRST_ROW_WITHOUT_SKY = 57, 66  # the first row with any ground, and the first without sky


@functools.cache
def road_mask() -> np.ndarray:
    """uint8 (160, 320): 255 where a frame shows what lies before the car, 0 on the bonnet and at the frame's border."""
    seen = np.zeros(FRAME[:2], np.uint8)
    seen[1:BONNET_ROW, 1:-1] = 255
    return seen


def warp(frame: np.ndarray, right: float, forward: float, yaw: float, box=(0, FRAME[0], 0, FRAME[1])):
    """A frame, uint8 (160, 320, 3), as seen from this pose relative to its camera, and where it was really seen.

    box: the rows and columns, first and behind the last, that are asked for. What was not seen, bool (rows, columns)
    False, is the nearest border's, for want of better.
    """
    top, bottom, left, width = *box[:3], box[3] - box[2]
    near, far = homographies(right, forward, yaw)
    made = np.empty((bottom - top, width, 3), np.uint8)
    seen = np.ones(made.shape[:2], bool)
    if top < FIRST_ROW_WITHOUT_SKY:
        end = min(bottom, FIRST_ROW_WITHOUT_SKY)
        made[: end - top] = cv2.warpPerspective(
            frame, _moved(far, top, left), (width, end - top), borderMode=cv2.BORDER_REFLECT_101
        )
    first = max(top, FIRST_GROUND_ROW)
    if first < bottom:
        matrix, size = _moved(near, first, left), (width, bottom - first)
        below = cv2.warpPerspective(frame, matrix, size, borderMode=cv2.BORDER_REPLICATE)
        mask = ground_mask()[first:bottom, left : left + width]
        cv2.copyTo(below, mask, made[first - top :])
        seen[first - top :] = (cv2.warpPerspective(road_mask(), matrix, size) == 255) | (mask == 0)
    return made, seen


def _moved(matrix: np.ndarray, top: int, left: int) -> np.ndarray:
    """A homography whose target begins at this row and column."""
    return np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]]) @ matrix


# --------------------------------------------------------------------------------------------------
# The stand-in's cameras in its car

# Right, forward and up of the car's middle, m. The car rests 0.025 m above the ground: fitted to real recordings the
# cameras are 1.26 m above it.
CAMERA_POSITIONS = {
    "center": (CAMERA_OFFSETS["center"], 1.0, 1.235),
    "left": (CAMERA_OFFSETS["left"], 0.984, 1.235),
    "right": (CAMERA_OFFSETS["right"], 0.999, 1.235),
}
# Degrees down, in the car: with the body's own pitch on its springs the horizon lies at row 60 in the middle, 57 at the
# left edge and 63 at the right one, as in real frames. (The scene file has 9.5.)
MOUNT_PITCH = 8.0


def mounting_rotation() -> np.ndarray:
    """(3, 3): a direction in the car, (right, forward, up), times this is the camera's (right, ahead, up)."""
    yaw, pitch, roll = np.radians((CAMERA_YAW, MOUNT_PITCH, CAMERA_ROLL))
    heading = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    nodding = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    leaning = np.array([[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]])
    return leaning @ nodding @ heading


def height_at_rows(rows, aside, forward) -> np.ndarray:
    """How high, in metres in the car, a point at `aside` and `forward` is that the centre camera sees at these rows."""
    _, ahead, up = mounting_rotation()
    x, y, z = np.array(CAMERA_POSITIONS["center"])
    slope = (FRAME[0] / 2 - np.asarray(rows, float)) / FOCAL_LENGTH
    level = up - slope[..., None] * ahead  # zero times the point, seen from the camera
    return z - (level[..., 0] * (aside - x) + level[..., 1] * (forward - y)) / level[..., 2]
