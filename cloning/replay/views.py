"""A recording's frames as the camera would have seen them from beside the path that was driven."""

import functools

import numpy as np

from cloning.recordings.images import decode
from cloning.recordings.log import Recording
from cloning.road.camera import CAMERA_OFFSETS, EARLIER_FRAME, FIRST_BONNET_ROW, camera_position
from cloning.road.motion import AXLE_TO_CAMERA, Stretch, components, forward_vector, right_of
from cloning.road.warp import warp


class Views:
    """The frames of a stretch of a recording, as seen from beside its way.

    The nearest of the three cameras is taken; what it does not see, beside the car's nose, an earlier frame of the same
    camera has seen from further back.
    """

    def __init__(self, recording: Recording, stretch: Stretch):
        self.recording, self.first = recording, stretch.rows.start
        self.right, self.forward, self.heading, self.driven = (
            stretch.right,
            stretch.forward,
            stretch.heading,
            stretch.driven,
        )

    @functools.lru_cache(maxsize=64)  # noqa: B019 - lives as long as the stretch is driven
    def frame(self, at: int, camera: int) -> np.ndarray:
        """A recorded frame, uint8 (160, 320, 3), RGB; at: from the stretch's beginning; camera: centre, left, right."""
        return decode(self.jpeg(at, camera))

    def jpeg(self, at: int, camera: int = 0) -> bytes:
        return self.recording.path(self.first + at, camera).read_bytes()

    def seen_from(self, at: int, right: float, yaw: float) -> np.ndarray:
        """The centre camera's frame if the rear axle stood `right` metres beside its way, turned by `yaw` radians.

        uint8 (160, 320, 3), RGB.
        """
        heading = self.heading[at]
        axle = self._axle(at) + right * right_of(forward_vector(heading))
        eye = camera_position(axle, forward_vector(heading + yaw))
        beside = right + AXLE_TO_CAMERA * np.sin(yaw)
        camera = int(np.argmin([abs(beside - side) for side in CAMERA_OFFSETS.values()]))
        made, seen = self._warped(at, camera, eye, heading + yaw)
        earlier = int(np.searchsorted(self.driven, self.driven[at] - EARLIER_FRAME, "right")) - 1
        missing = (~seen[:FIRST_BONNET_ROW]).nonzero()
        if earlier >= 0 and len(missing[0]):
            top, left, bottom, end = *np.min(missing, axis=1), *(np.max(missing, axis=1) + 1)
            before, _ = self._warped(earlier, camera, eye, heading + yaw, (top, bottom, left, end))
            part = made[top:bottom, left:end]
            np.copyto(part, before, where=~seen[top:bottom, left:end, None])
        made[FIRST_BONNET_ROW:] = self.frame(at, 0)[FIRST_BONNET_ROW:]
        return made

    def _axle(self, at: int) -> np.ndarray:
        """The rear axle's middle, float64 (2,): m to the right and forward in the stretch's frame."""
        return np.array([self.right[at], self.forward[at]])

    def _warped(self, at: int, camera: int, eye: np.ndarray, heading: float, *box):
        along = forward_vector(self.heading[at])
        away = eye - camera_position(self._axle(at), along, list(CAMERA_OFFSETS.values())[camera])
        return warp(self.frame(at, camera), *components(away, along), heading - self.heading[at], *box)
