"""A recording's frames as the camera would have seen them from beside the path that was driven."""

import functools

import numpy as np

from cloning.recordings.images import decode
from cloning.recordings.log import Recording
from cloning.road.camera import BONNET_ROW, CAMERA_OFFSETS, EARLIER_FRAME, warp
from cloning.road.motion import AXLE_TO_CAMERA, Stretch


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
        eye = np.array(
            [
                self.right[at] + right * np.cos(heading) + AXLE_TO_CAMERA * np.sin(heading + yaw),
                self.forward[at] - right * np.sin(heading) + AXLE_TO_CAMERA * np.cos(heading + yaw),
            ]
        )
        beside = right + AXLE_TO_CAMERA * np.sin(yaw)
        camera = int(np.argmin([abs(beside - side) for side in CAMERA_OFFSETS.values()]))
        made, seen = self._warped(at, camera, eye, heading + yaw)
        earlier = int(np.searchsorted(self.driven, self.driven[at] - EARLIER_FRAME, "right")) - 1
        missing = (~seen[:BONNET_ROW]).nonzero()
        if earlier >= 0 and len(missing[0]):
            top, left, bottom, end = *np.min(missing, axis=1), *(np.max(missing, axis=1) + 1)
            before, _ = self._warped(earlier, camera, eye, heading + yaw, (top, bottom, left, end))
            part = made[top:bottom, left:end]
            np.copyto(part, before, where=~seen[top:bottom, left:end, None])
        made[BONNET_ROW:] = self.frame(at, 0)[BONNET_ROW:]
        return made

    def _warped(self, at: int, camera: int, eye: np.ndarray, heading: float, *box):
        s, c = np.sin(self.heading[at]), np.cos(self.heading[at])
        side = list(CAMERA_OFFSETS.values())[camera]
        stands = np.array(
            [self.right[at] + AXLE_TO_CAMERA * s + side * c, self.forward[at] + AXLE_TO_CAMERA * c - side * s]
        )
        away = eye - stands
        return warp(self.frame(at, camera), away @ (c, -s), away @ (s, c), heading - self.heading[at], *box)
