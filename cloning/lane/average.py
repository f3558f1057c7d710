"""Averages the frames of a drive where they are noisy, as in snow, heavy rain or at night.

The frame before shows the same ground from where the car was; how it has moved since is known from its steering and
speed. Warped to where the car is, it is averaged with the new one, and so are, less and less, those before it. What is
on the ground stays, flakes and noise go. Where frames are clear, they are left as they are.
"""

import cv2
import numpy as np

from cloning.lane.predict import Step
from cloning.road.camera import FIRST_BONNET_ROW, camera_position, homographies
from cloning.road.motion import forward_vector
from cloning.road.warp import FIRST_ROW_WITHOUT_SKY, warp

# Of so many new frames one tells the noise, and in so many the mean of what they tell forgets.
TOLD, MEMORY = 3, 15
# The noise from which frames are averaged, and that from which the mean before counts as much as the new frame. Clear
# frames of real recordings have 0.12 to 0.26, never more than 0.33 (on grainy, steep roads at 25 mph up to 0.51); snow
# and night have 0.45 to 0.5 at strength 3, 0.6 to 0.75 at 5.
LEAST, MOST, SHARE = 0.48, 0.58, 0.5
EVERY = 2  # of so many rows and columns one tells the noise
ROWS = slice(FIRST_ROW_WITHOUT_SKY, FIRST_BONNET_ROW)
# From a grey frame's pixels to those by which the noise is told
TO_FEW = np.array([[1 / EVERY, 0, 0], [0, 1 / EVERY, -ROWS.start / EVERY], [0, 0, 1]])
CAMERA_BEFORE = camera_position(np.zeros(2), forward_vector(0.0))  # m right and forward, from the axle then


class Average:
    """The mean of one drive's noisy frames, which it is given one after the other."""

    def __init__(self) -> None:
        self.frame = self.mean = np.empty(0, np.uint8)  # the last one, and what takes its place
        self.frames = 0  # new ones
        self.turned = self.metres = 0.0  # radians to the right and m since the last new one
        self.noise = 0.0  # by how much a frame differs from what is expected, of its contrast

    def __call__(self, frame: np.ndarray, step: Step | None) -> np.ndarray:
        """Return the next frame, uint8 (160, 320, 3) RGB, or the mean that takes its place.

        step: how the car has moved since the last one, None if that is not known: then nothing is averaged.
        """
        if step:
            self.turned += step.bend * step.metres
            self.metres += step.metres
            if np.array_equal(frame, self.frame):
                return self.mean
        last, before, self.frame, self.mean = self.frame, self.mean, frame, frame
        self.frames += 1
        tells = self.frames % TOLD == 0
        if step and last.size and (tells or self.noise > LEAST):
            axle = self.metres * forward_vector(self.turned / 2)
            right, forward = (camera_position(axle, forward_vector(self.turned)) - CAMERA_BEFORE).tolist()
            pose = right, forward, self.turned
            if tells:
                self.noise += (_noise(last, frame, *pose) - self.noise) * TOLD / MEMORY
            if self.noise > LEAST:
                share = np.interp(self.noise, (LEAST, MOST), (0, SHARE))
                self.mean = _mean(frame, before, float(share), *pose)
        self.turned = self.metres = 0.0
        return self.mean


def _noise(before: np.ndarray, now: np.ndarray, right: float, forward: float, yaw: float) -> float:
    """Return by how much a frame's ground differs from what the one before lets expect, of its contrast; in grey.

    At most 1, more than foul weather's: else one frame without contrast would have seconds of clear ones averaged.
    right, forward, yaw: m, m and radians, of the camera since then.
    """
    seen = cv2.cvtColor(np.ascontiguousarray(now[ROWS][::EVERY, ::EVERY]), cv2.COLOR_RGB2GRAY)
    to_few = TO_FEW @ homographies(right, forward, yaw)[0]
    grey = cv2.cvtColor(before, cv2.COLOR_RGB2GRAY)
    expected = cv2.warpPerspective(grey, to_few, seen.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    return min(1.0, float(np.median(cv2.absdiff(expected, seen)) / (seen.std() + 1)))


def _mean(frame: np.ndarray, before: np.ndarray, share: float, right: float, forward: float, yaw: float) -> np.ndarray:
    """Return a frame averaged with the mean before, which has this share where it shows the same.

    right, forward, yaw: as in `_noise`.
    """
    warped, seen = warp(before, right, forward, yaw, FIRST_BONNET_ROW)
    mean = frame.copy()
    road = mean[:FIRST_BONNET_ROW]
    cv2.copyTo(cv2.addWeighted(warped, share, road, 1 - share, 0), seen.view(np.uint8), road)
    return mean
