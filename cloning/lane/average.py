"""Averages the frames of a drive where they are noisy, as in snow, heavy rain or at night.

The frame before shows the same ground from where the car was; how it has moved since is known from its steering and
speed. Warped to where the car is, it is averaged with the new one, and so are, less and less, those before it. What is
on the ground stays, flakes and noise go. Where frames are clear, they are left as they are.
"""

import math

import cv2
import numpy as np

from cloning.lane.predict import Step
from cloning.road.camera import FIRST_BONNET_ROW, homographies
from cloning.road.motion import AXLE_TO_CAMERA
from cloning.road.warp import FIRST_ROW_WITHOUT_SKY, warp

MEMORY = 15  # new frames over which the noise is averaged
# The noise from which frames are averaged, and that from which the mean before counts as much as the new frame. Clear
# frames of real recordings have 0.12 to 0.26, never more than 0.33 (on grainy, steep roads at 25 mph up to 0.51); snow
# and night have 0.45 to 0.5 at strength 3, 0.6 to 0.75 at 5.
LEAST, MOST, SHARE = 0.48, 0.58, 0.5
EVERY = 2  # of the rows and columns by which the noise is told
ROWS = slice(FIRST_ROW_WITHOUT_SKY, FIRST_BONNET_ROW)
# From a grey frame's pixels to those by which the noise is told
TO_FEW = np.array([[1 / EVERY, 0, 0], [0, 1 / EVERY, -ROWS.start / EVERY], [0, 0, 1]])


class Average:
    """The mean of one drive's noisy frames, which it is given one after the other."""

    def __init__(self) -> None:
        self.frame = np.empty(0, np.uint8)  # the last one
        self.mean, self.grey = self.frame, self.frame  # what takes its place, and itself in grey
        self.turned = self.metres = 0.0  # radians to the right and m since then
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
        before, grey = self.mean, self.grey
        self.frame, self.mean, self.grey = frame, frame, np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
        if step and before.size:
            half = self.turned / 2
            right = self.metres * math.sin(half) + AXLE_TO_CAMERA * math.sin(self.turned)
            forward = self.metres * math.cos(half) + AXLE_TO_CAMERA * (math.cos(self.turned) - 1)
            pose = right, forward, self.turned
            self.noise += (_noise(grey, self.grey, *pose) - self.noise) / MEMORY
            if (share := float(np.interp(self.noise, (LEAST, MOST), (0, SHARE)))) > 0:
                self.mean = _mean(frame, before, share, *pose)
        self.turned = self.metres = 0.0
        return self.mean


def _noise(before: np.ndarray, now: np.ndarray, right: float, forward: float, yaw: float) -> float:
    """Return by how much a grey frame's ground differs from what the one before lets expect, of its contrast."""
    seen = now[ROWS][::EVERY, ::EVERY]
    expected = cv2.warpPerspective(
        before, TO_FEW @ homographies(right, forward, yaw)[0], seen.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    return float(np.median(cv2.absdiff(expected, np.ascontiguousarray(seen))) / (seen.std() + 1))


def _mean(frame: np.ndarray, before: np.ndarray, share: float, right: float, forward: float, yaw: float) -> np.ndarray:
    """Return a frame averaged with the one before, of whose camera this is the pose, as `warp` takes it.

    share: of the one before, where that shows the same.
    """
    warped, seen = warp(before, right, forward, yaw, FIRST_BONNET_ROW)
    mean = frame.copy()
    road = mean[:FIRST_BONNET_ROW]
    cv2.copyTo(cv2.addWeighted(warped, share, road, 1 - share, 0), seen.view(np.uint8), road)
    return mean
