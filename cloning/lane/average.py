"""Averages the frames of a drive where they are noisy, as in snow, heavy rain or at night.

The frame before shows the same ground from where the car was; how it has moved since is known from its steering and
speed, and how it has pitched, rolled and been shaken is found by comparing both (enhanced correlation coefficient:
Evangelidis and Psarakis, "Parametric image alignment", 2008). Warped to where the car is, it is averaged with the new
one, and so are, less and less, those before it. What is on the ground stays, flakes and noise go. Where frames are
clear, they are left as they are.
"""

import cv2
import numpy as np

from cloning.lane.predict import Step
from cloning.road.camera import FIRST_BONNET_ROW, camera_position, homographies
from cloning.road.motion import forward_vector
from cloning.road.warp import FIRST_ROW_WITHOUT_SKY, warp

# Of so many new frames one tells the noise, and in so many the mean of what they tell forgets.
TOLD, MEMORY = 3, 15
# The noise from which frames are averaged, that from which the mean before counts most, and by how much. Clear frames
# of real recordings have 0.09 to 0.26 on average, at most 0.32; snow, noise and night 0.4 to 0.55 at strength 3.
LEAST, MOST, SHARE = 0.36, 0.46, 0.4
EVERY = 2  # of so many rows and columns one tells the noise
ROWS = slice(FIRST_ROW_WITHOUT_SKY, FIRST_BONNET_ROW)
# From a grey frame's pixels to those by which the noise is told
TO_FEW = np.array([[1 / EVERY, 0, 0], [0, 1 / EVERY, -ROWS.start / EVERY], [0, 0, 1]])
# Columns or rows: noisy frames move by up to 5 against what is expected, more is the camera's shaking.
FARTHEST = 6.0
STEPS, CLOSE = 5, 1e-3  # in which a movement is found, and the gain of correlation in one that ends the search
CAMERA_BEFORE = camera_position(np.zeros(2), forward_vector(0.0))  # m right and forward, from the axle then

Pose = tuple[float, float, float]  # m to the right, m forward and radians to the right, of the camera since a frame


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
                self.noise += (_noise(last, frame, pose) - self.noise) * TOLD / MEMORY
            if self.noise > LEAST:
                share = np.interp(self.noise, (LEAST, MOST), (0, SHARE))
                self.mean = _mean(frame, before, float(share), pose)
        self.turned = self.metres = 0.0
        return self.mean


def _noise(before: np.ndarray, now: np.ndarray, pose: Pose) -> float:
    """Return by how much a frame's ground differs from what the one before lets expect, of its contrast; in grey.

    At most 1, more than foul weather's: else one frame without contrast would have seconds of clear ones averaged.
    """
    expected, seen = _expected(before, now, pose)
    noise = _difference(expected, seen)
    if noise > LEAST:
        movement = _movement(expected, seen)
        if movement is None:
            return 0.0  # the camera was shaken: what differs is no noise
        noise = _difference(_moved(expected, movement), seen)
    return min(1.0, noise)


def _expected(before: np.ndarray, now: np.ndarray, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return the ground as the frame before lets it expect, and as a frame shows it: grey, few pixels.

    before, now: uint8 (160, 320, 3). Returns two pictures, uint8 (35, 160): every second column, and row of `ROWS`.
    """
    seen = cv2.cvtColor(np.ascontiguousarray(now[ROWS][::EVERY, ::EVERY]), cv2.COLOR_RGB2GRAY)
    grey = cv2.cvtColor(before, cv2.COLOR_RGB2GRAY)
    to_few = TO_FEW @ homographies(*pose)[0]
    return cv2.warpPerspective(grey, to_few, seen.shape[::-1], borderMode=cv2.BORDER_REPLICATE), seen


def _difference(expected: np.ndarray, seen: np.ndarray) -> float:
    """Return by how much two grey pictures of the ground differ, of the contrast of the second."""
    return float(np.median(cv2.absdiff(expected, seen)) / (seen.std() + 1))


def _movement(expected: np.ndarray, seen: np.ndarray) -> np.ndarray | None:
    """Return the matrix, (2, 3), from `_expected`'s pixels as seen to those that are expected: a turn and a shift.

    None if they have moved by more than FARTHEST, or do not show the same.
    """
    start, until = np.eye(2, 3, dtype=np.float32), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, STEPS, CLOSE)
    try:
        found = np.asarray(cv2.findTransformECC(seen, expected, start.copy(), cv2.MOTION_EUCLIDEAN, until)[1])
    except cv2.error:  # nothing in common, or one of them has no contrast
        return None
    middle = np.array([seen.shape[1] / 2, 0, 1])  # of the first row
    return found if np.abs((found - start) @ middle).max() < FARTHEST / EVERY else None


def _moved(image: np.ndarray, movement: np.ndarray) -> np.ndarray:
    """Return a picture moved back by what `_movement` has found in pixels of this size."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, movement, image.shape[1::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _mean(frame: np.ndarray, before: np.ndarray, share: float, pose: Pose) -> np.ndarray:
    """Return a frame averaged with the mean before, which has this share where it shows the same.

    Flakes and drops are lighter than what they hide, so no pixel counts as much lighter than before.
    """
    movement = _movement(*_expected(before, frame, pose))
    if movement is None:
        return frame
    warped, seen = warp(before, *pose, FIRST_BONNET_ROW)
    warped = _moved(warped, (np.linalg.inv(TO_FEW) @ np.vstack([movement, [0, 0, 1]]) @ TO_FEW)[:2])
    mean = frame.copy()
    road = mean[:FIRST_BONNET_ROW]
    usual = 1 + float(np.median(cv2.absdiff(road, warped)[FIRST_ROW_WITHOUT_SKY::EVERY, ::EVERY]))
    new = cv2.min(road, cv2.convertScaleAbs(warped, beta=usual))
    cv2.copyTo(cv2.addWeighted(warped, share, new, 1 - share, 0), seen.view(np.uint8), road)
    return mean
