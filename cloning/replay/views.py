"""Show a recording's frames as the centre camera would have seen them from next to the driven path."""

import functools

import cv2
import numpy as np

from cloning.base.frame import FRAME
from cloning.recordings.images import read_image
from cloning.recordings.log import Recording
from cloning.road.camera import CAMERA_OFFSETS, EARLIER_FRAME, FIRST_BONNET_ROW, camera_position, homographies
from cloning.road.motion import AXLE_TO_CAMERA, Stretch, components, forward_vector, right_of
from cloning.road.warp import fill_ground, warp, with_alpha

WHOLE = slice(0, FRAME[0])  # rows of a frame


class StretchViews:
    """The frames of a stretch of a recording, and views from other poses of the car.

    A view is warped from the frame of the nearest of the three cameras. What this camera did not see, next to the
    bonnet, is filled from its frame EARLIER_FRAME metres further back.
    """

    def __init__(self, recording: Recording, stretch: Stretch):
        self.recording, self.stretch = recording, stretch
        self.axles = np.column_stack([stretch.right, stretch.forward])  # m, in the stretch's frame

    @functools.lru_cache(maxsize=64)  # noqa: B019 - the object lives only while its stretch is driven
    def _image(self, at: int, camera: int) -> tuple[bytes, np.ndarray]:
        """Return what `frame` and `jpeg` do: read at once, so that a file that changes meanwhile gives one of both."""
        return read_image(self.recording.path(self.stretch.rows.start + at, camera))

    def frame(self, at: int, camera: int) -> np.ndarray:
        """Return a frame, uint8 (160, 320, 3), RGB; camera: 0 centre, 1 left, 2 right. Raises RecordingError."""
        return self._image(at, camera)[1]

    def jpeg(self, at: int) -> bytes:
        """Return the bytes of the centre camera's file. Raises RecordingError if it became unusable."""
        return self._image(at, 0)[0]

    def view_from(self, at: int, right: float, yaw: float, rows: slice = WHOLE) -> np.ndarray:
        """Return what the centre camera would see from another pose than the recorded one: uint8 (k, 320, 3), RGB.

        right: m from the recorded position of the rear axle to the right; yaw: radians to the recorded heading;
        rows: of the frame, which are the same whichever others are asked for.
        """
        heading = self.stretch.heading[at] + yaw
        axle = self.axles[at] + right * right_of(forward_vector(self.stretch.heading[at]))
        position = camera_position(axle, forward_vector(heading))
        offset = right + AXLE_TO_CAMERA * np.sin(yaw)
        camera = int(np.argmin([abs(offset - mounted) for mounted in CAMERA_OFFSETS.values()]))
        pose = self._pose(at, camera, position, heading)
        # From the first row on, whichever are asked for: OpenCV rounds the sky of other rows differently.
        view, seen = warp(with_alpha(self.frame(at, camera)), *pose, FIRST_BONNET_ROW)
        driven = self.stretch.driven
        earlier = int(np.searchsorted(driven, driven[at] - EARLIER_FRAME, "right")) - 1
        if earlier >= 0 and not seen.all():
            ground, _ = homographies(*self._pose(earlier, camera, position, heading))
            fill_ground(view, (~seen).view(np.uint8), with_alpha(self.frame(earlier, camera)), ground)
        road = cv2.cvtColor(view[rows], cv2.COLOR_RGBA2RGB)
        if rows.stop <= FIRST_BONNET_ROW:
            return road  # another camera's frame may do, and the centre one need not be decoded
        return np.concatenate([road, self.frame(at, 0)[FIRST_BONNET_ROW : rows.stop]])

    def _pose(self, at: int, camera: int, position: np.ndarray, heading: float) -> tuple[float, float, float]:
        """Return a camera's position, (2,), and heading relative to a recorded one: m right, m forward, radians."""
        forward = forward_vector(self.stretch.heading[at])
        mounted = list(CAMERA_OFFSETS.values())[camera]
        moved = components(position - camera_position(self.axles[at], forward, mounted), forward)
        return float(moved[0]), float(moved[1]), float(heading - self.stretch.heading[at])
