"""Steers for where the car is now, though its frames come late, or some of them are lost.

At 30 mph a frame that is 0.3 s late shows where the car was 4 m before. Steered by such frames it weaves more and more,
until it leaves the road. But what it has done since is known: it has driven as it was steered. From there the steering
is computed as the network would change it: by the law of the recovery steering that it has learned (pure pursuit of a
point on the lane's centre). Such a prediction from a delayed measurement is a Smith predictor (Smith, "Closer control
of loops with dead time", 1957).

How late frames are, they tell themselves: their far background moves to one side as the car turns to the other (the
visual compass of Milford and Wyeth, "Mapping a suburb with a single camera", 2008), and follows the steering that was
sent so many frames later. Where this is not certain, and where frames are in time, the network's steering remains.
"""

import math
from collections import deque
from typing import NamedTuple

import cv2
import numpy as np

from cloning.lane.recovery import LOOKAHEAD
from cloning.road.camera import CAMERA_MATRIX
from cloning.road.motion import curvature, lagged_curvature, steering_for

# By how much the network steers to the left, as a curvature in 1/m, for each m and radian that the car is further to
# the right: pure pursuit of a point LOOKAHEAD ahead of the rear axle, for small angles.
FOR_OFFSET, FOR_HEADING = 2 / LOOKAHEAD**2, 2 / LOOKAHEAD
# m without a new frame from which the prediction counts, by a share of this over REACH, and at most wholly. Over a
# short distance the last steering fits, as it aims LOOKAHEAD ahead.
NEAR, REACH = LOOKAHEAD / 3, 2 * LOOKAHEAD
LEAST_NEW = 5  # new frames after which one that repeats is a lost one; before, the camera may never show another
LONGEST_PAUSE = 1.0  # s: after a longer one nothing is known of what the car has done
LONGEST_GAP, FASTEST = 60.0, 50.0  # m without a new frame, and m/s: more counts as so much

MOST_LATE = 8  # frames
BACKGROUND = slice(20, 60)  # the rows of a frame that show it
MARGIN, FARTHEST = 16, 24  # columns at each edge that are left out, and by which the background moves at most
CLEAR = 0.3  # least share by which the best match of two backgrounds is better than their median match
MEMORY, STEADY = 4.0, 0.7  # s over which turns are compared, and over which their mean is taken, which does not count
LEAST_FRAMES, LEAST_TURN = 20, 0.5  # that tell how late frames are, and columns by which they turn (root mean square)
# The correlation from which a delay is certain, and how much it leaves unexplained of the variance, at most, as a share
# of what the delay so far leaves, and any by more than NEXT frames more or less: frames that recur fit at several.
CERTAIN, BETTER, NEXT = 0.8, 0.6, 2
AGAIN = 5  # frames, one after another, that must tell the same, because the time of each is known to some 10 ms only


class Delay:
    """How many frames late those of one drive are."""

    def __init__(self) -> None:
        self.frames = self.found = self.times = 0  # the delay that is told, and another, found so many times running
        self.background = np.empty(0, np.float32)  # of the last frame
        self.turns = np.zeros(MOST_LATE + 1)  # without their mean, the newest first
        self.means = np.zeros(2)  # of turns and movements
        # Running sums over the frames, for each delay if the turns have a part in it
        self.squares, self.products, self.moved, self.count = np.zeros(MOST_LATE + 1), np.zeros(MOST_LATE + 1), 0.0, 0.0

    def __call__(self, frame: np.ndarray, turn: float, pause: float) -> int:
        """Return it, 0 if it is unknown, after the next frame, uint8 (160, 320, 3) RGB.

        turn: columns by which the background moves to the left if the car has turned as it was steered since the last
        frame; pause: s since then.
        """
        before, self.background = self.background, _background(frame)
        fading, memory = math.exp(-pause / STEADY), math.exp(-pause / MEMORY)
        self.means[0] = turn + fading * (self.means[0] - turn)
        self.turns = np.r_[turn - self.means[0], self.turns[:-1]]
        movement = _movement(before, self.background) if before.size else None
        if movement is None:
            return self.frames
        self.means[1] = movement + fading * (self.means[1] - movement)
        movement -= float(self.means[1])
        self.squares = self.turns**2 + memory * self.squares
        self.products = self.turns * movement + memory * self.products
        self.moved, self.count = movement**2 + memory * self.moved, 1 + memory * self.count
        correlation = self.products / np.sqrt(self.squares * self.moved + 1e-9)
        best = int(correlation.argmax())
        unexplained = 1 - np.maximum(correlation, 0) ** 2
        rivals = np.append(unexplained[np.abs(np.arange(MOST_LATE + 1) - best) > NEXT], unexplained[self.frames])
        enough = self.count > LEAST_FRAMES and self.moved > LEAST_TURN**2 * self.count
        certain = enough and correlation[best] > CERTAIN and unexplained[best] < BETTER * rivals.min()
        self.times = (self.times + 1 if best == self.found else 1) if certain else 0
        self.found = best
        if self.times >= AGAIN:
            self.frames = best
        return self.frames


def _background(frame: np.ndarray) -> np.ndarray:
    """Return how the brightness of a frame's background changes from column to column: float32 (1, 319)."""
    columns = cv2.blur(cv2.reduce(frame[BACKGROUND], 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F), (3, 1))
    return np.diff(columns.sum(axis=2), axis=1)


def _movement(before: np.ndarray, after: np.ndarray) -> float | None:
    """Return by how many columns a background has moved to the left, None if it is not clear."""
    part = before[:, MARGIN + FARTHEST : -MARGIN - FARTHEST]
    difference = cv2.matchTemplate(after[:, MARGIN:-MARGIN], part, cv2.TM_SQDIFF)[0]
    best = int(difference.argmin())
    if not 0 < best < len(difference) - 1 or difference[best] > (1 - CLEAR) * np.median(difference):
        return None
    left, middle, right = difference[best - 1 : best + 2].tolist()
    bend = left - 2 * middle + right
    return FARTHEST - best - (0.5 * (left - right) / bend if bend > 0 else 0.0)


class Step(NamedTuple):
    """How the car has moved since the last frame."""

    seconds: float
    bend: float  # the mean curvature, 1/m, right positive
    metres: float


class Predictor:
    """Knows how the car of one drive has moved, and corrects its steering, one frame after the other."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self.delay = Delay()
        self.frame, self.time = np.empty(0, np.uint8), 0.0
        self.step: Step | None = None  # since the frame before, None if that is not known
        self.sent = self.bend = 0.0  # the steering that was sent last, -1..1; the curvature that the car drives, 1/m
        # What was driven in the time by which frames are late, the newest last: curvature, 1/m, and m
        self.since = deque[tuple[float, float]]()
        # The pose before that, and that which the last new frame shows: m and radians from the lane's centre and
        # direction, right positive
        self.pose = self.seen = (0.0, 0.0)
        self.road, self.gap, self.new = 0.0, 0.0, 0  # the lane's curvature, 1/m; m since the last of so many new frames

    def move(self, time: float, speed: float) -> Step | None:
        """Return how the car has moved since the last frame, None at the first one and after a long pause.

        time: of the next frame, s; speed: m/s.
        """
        pause = time - self.time
        if not (self.frame.size and 0 <= pause <= LONGEST_PAUSE):
            self._begin()
        else:
            before, metres = self.bend, min(max(speed, 0.0), FASTEST) * pause
            self.bend = lagged_curvature(before, curvature(self.sent), pause)
            self.step = Step(pause, (before + self.bend) / 2, metres)
        self.time = time
        return self.step

    def correct(self, steering: float | np.floating, frame: np.ndarray) -> np.float32:
        """Return the steering for where the car is now: just the network's if the frame is new and in time.

        steering: the network's, -1..1, for this frame, uint8 (160, 320, 3) RGB, for whose time `move` was called.
        """
        if self.step is None:
            self.road = curvature(float(steering))
            self.frame, self.sent = frame, float(steering)
            return np.float32(steering)
        pause, driven, metres = self.step
        self.since.append((driven, metres))
        self.gap = min(self.gap + metres, LONGEST_GAP)
        new = not np.array_equal(frame, self.frame)
        late = self.delay(frame, CAMERA_MATRIX[0, 0] * driven * metres, pause)
        self.frame = frame
        while len(self.since) > late:
            self.pose = self._after(self.pose, *self.since.popleft())
        if new:
            self._see(curvature(float(steering)))
        corrected = np.float32(steering)
        if late or (self.gap > NEAR and self.new >= LEAST_NEW):
            offset, heading = self.pose
            for bend, length in self.since:
                offset, heading = self._after((offset, heading), bend, length)
            change = FOR_OFFSET * (self.seen[0] - offset) + FOR_HEADING * (self.seen[1] - heading)
            if change:
                weight = 1.0 if late else min(1.0, self.gap / REACH)
                corrected = np.float32(steering_for(curvature(float(steering)) + weight * change))
        self.sent = float(corrected)
        return corrected

    def _after(self, pose: tuple[float, float], bend: float, metres: float) -> tuple[float, float]:
        """Return the pose after so many metres of a curvature from this one."""
        offset, heading = pose
        turn = (bend - self.road) * metres
        return offset + (heading + turn / 2) * metres, heading + turn

    def _see(self, aim: float) -> None:
        """Correct what is known of the lane by the curvature, 1/m, with which the network steers.

        What is new is that the lane bends otherwise, since some place since the frame before: so the car is also turned
        and beside its centre otherwise than expected, by as much as is likely for a random walk of the curvature.
        """
        gap, a, b = self.gap, FOR_OFFSET, FOR_HEADING
        faded = math.exp(-gap / LOOKAHEAD)  # the pose, which is an integral, gathers errors
        offset, heading = faded * self.pose[0], faded * self.pose[1]
        shares = (
            -(gap**2 / 6 + b * gap**3 / 8 + a * gap**4 / 20),
            -(gap / 2 + b * gap**2 / 3 + a * gap**3 / 8),
            1 + b * gap / 2 + a * gap**2 / 6,
        )
        surprise = aim - (self.road - a * offset - b * heading)
        surprise /= shares[2] - a * shares[0] - b * shares[1]
        self.pose = self.seen = offset + surprise * shares[0], heading + surprise * shares[1]
        self.road += surprise * shares[2]
        self.gap, self.new = 0.0, self.new + 1
