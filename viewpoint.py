"""What the car's camera would see from another place: frames warped over flat ground (as in NVIDIA's evaluation,
arXiv 1604.07316, section 6).

Below the horizon a frame shows flat ground, above it what is infinitely far. A pose is that of the camera: metres to
the right and forward, yaw in radians, right positive.
"""

import functools
import os

import cv2
import numpy as np

from images import FRAME, decode
from motion import ARM, way
from recordings import Recording

# Fitted by carrying real centre frames over to the side cameras, on both tracks: within 0.01 m, 0.05 degrees and half a
# row the same on all recordings. The scene file says 0.7 and 1.2 degrees too.
VERTICAL_FIELD = 60.0  # degrees
FOCAL = FRAME[0] / 2 / np.tan(np.radians(VERTICAL_FIELD / 2))  # px
HEIGHT = 1.255  # m above the ground
PITCH, YAW, ROLL = 7.85, 0.7, 1.2  # degrees down, right, clockwise (the horizon falls to the right)
SIDES = {"center": 0.0, "left": -0.806, "right": 0.825}  # m to the right, in the order of a recording's images
HIDDEN = 135  # the row from which on the bonnet hides the road
FAR = 0.004  # of the focal length below the horizon: further away the ground counts as infinitely far
QUALITY = 95  # of a warped frame's JPEG: it has been through the camera's 75 already


def _turn(right: float = 0.0, down: float = 0.0, forward: float = 0.0) -> np.ndarray:
    """The rotation by an angle in radians about an axis of the level frame: (3, 3)."""
    return cv2.Rodrigues(np.array([right, down, forward]))[0]


LENS = np.array([[FOCAL, 0, (FRAME[1] - 1) / 2], [0, FOCAL, (FRAME[0] - 1) / 2], [0, 0, 1]])
# From directions in the car's level frame (right, down, forward) to pixels.
CAMERA_MATRIX = LENS @ _turn(forward=np.radians(ROLL)) @ _turn(right=np.radians(PITCH)) @ _turn(down=-np.radians(YAW))
_BACK = np.linalg.inv(CAMERA_MATRIX)


def project(right: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Columns and rows, float64 (n, 2), of points on the ground, (n,) metres right of and before a camera."""
    points = np.stack([right, np.full_like(forward, HEIGHT), forward], axis=1) @ CAMERA_MATRIX.T
    return points[:, :2] / points[:, 2:]


def homographies(right: float, forward: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """From a camera's pixels to those of one at this pose relative to it: (3, 3) for the ground, and for the sky."""
    turn = CAMERA_MATRIX @ _turn(down=-yaw)
    moved = np.eye(3)
    moved[0, 1], moved[2, 1] = -right / HEIGHT, -forward / HEIGHT
    return turn @ moved @ _BACK, turn @ _BACK


@functools.cache
def ground() -> np.ndarray:
    """uint8 (160, 320): 255 where a frame shows ground near enough to move with the camera, 0 where it does not."""
    columns, rows = np.meshgrid(np.arange(FRAME[1]), np.arange(FRAME[0]))
    directions = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ _BACK.T
    return np.where(directions[..., 1] > FAR * directions[..., 2], 255, 0).astype(np.uint8)


GROUND, SKY = 57, 66  # the first row with any ground, and the first without sky


@functools.cache
def road() -> np.ndarray:
    """uint8 (160, 320): 255 where a frame shows what lies before the car, 0 on the bonnet and at the frame's border."""
    seen = np.zeros(FRAME[:2], np.uint8)
    seen[1:HIDDEN, 1:-1] = 255
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
    if top < SKY:
        end = min(bottom, SKY)
        made[:end - top] = cv2.warpPerspective(frame, _moved(far, top, left), (width, end - top),
                                               borderMode=cv2.BORDER_REFLECT_101)
    first = max(top, GROUND)
    if first < bottom:
        matrix, size = _moved(near, first, left), (width, bottom - first)
        below = cv2.warpPerspective(frame, matrix, size, borderMode=cv2.BORDER_REPLICATE)
        mask = ground()[first:bottom, left:left + width]
        cv2.copyTo(below, mask, made[first - top:])
        seen[first - top:] = (cv2.warpPerspective(road(), matrix, size) == 255) | (mask == 0)
    return made, seen


def _moved(matrix: np.ndarray, top: int, left: int) -> np.ndarray:
    """A homography whose target begins at this row and column."""
    return np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]]) @ matrix


class Views:
    """The frames of a stretch of a recording, as seen from beside its way.

    The nearest of the three cameras is taken; what it does not see, beside the car's nose, an earlier frame of the same
    camera has seen from further back.
    """

    BACK = 3.0  # m: from so far back, all was in sight that is missing at 2 m beside the way

    def __init__(self, recording: Recording, rows: slice):
        self.recording, self.rows = recording, rows
        self.right, self.forward, self.heading, self.driven = way(recording, rows)

    @functools.lru_cache(maxsize=64)  # noqa: B019 - lives as long as the stretch is driven
    def frame(self, at: int, camera: int) -> np.ndarray:
        """A recorded frame, uint8 (160, 320, 3), RGB; at: from the stretch's beginning; camera: centre, left, right."""
        return decode(self.jpeg(at, camera))

    def jpeg(self, at: int, camera: int = 0) -> bytes:
        name = self.recording.names[self.recording.images[self.rows.start + at, camera]]
        return (self.recording.folder / "IMG" / os.fsdecode(name)).read_bytes()

    def seen_from(self, at: int, right: float, yaw: float) -> np.ndarray:
        """The centre camera's frame if the rear axle stood `right` metres beside its way, turned by `yaw` radians.

        uint8 (160, 320, 3), RGB.
        """
        heading = self.heading[at]
        eye = np.array([self.right[at] + right * np.cos(heading) + ARM * np.sin(heading + yaw),
                        self.forward[at] - right * np.sin(heading) + ARM * np.cos(heading + yaw)])
        beside = right + ARM * np.sin(yaw)
        camera = int(np.argmin([abs(beside - side) for side in SIDES.values()]))
        made, seen = self._warped(at, camera, eye, heading + yaw)
        earlier = int(np.searchsorted(self.driven, self.driven[at] - self.BACK, "right")) - 1
        missing = (~seen[:HIDDEN]).nonzero()
        if earlier >= 0 and len(missing[0]):
            top, left, bottom, end = *np.min(missing, axis=1), *(np.max(missing, axis=1) + 1)
            before, _ = self._warped(earlier, camera, eye, heading + yaw, (top, bottom, left, end))
            part = made[top:bottom, left:end]
            np.copyto(part, before, where=~seen[top:bottom, left:end, None])
        made[HIDDEN:] = self.frame(at, 0)[HIDDEN:]
        return made

    def _warped(self, at: int, camera: int, eye: np.ndarray, heading: float, *box):
        s, c = np.sin(self.heading[at]), np.cos(self.heading[at])
        side = list(SIDES.values())[camera]
        stands = np.array([self.right[at] + ARM * s + side * c, self.forward[at] + ARM * c - side * s])
        away = eye - stands
        return warp(self.frame(at, camera), away @ (c, -s), away @ (s, c), heading - self.heading[at], *box)
