"""The simulator's car on the road: how steering turns it, and the trajectory that a recorded car drove."""

import itertools
import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording

MPH = 0.44704  # m/s
TOP_SPEED_MPH = 30  # the simulator clamps the car's speed to it
SET_SPEED_MPH = 9.0  # as in Udacity's drive.py
FULL_LOCK = 25.0  # degrees of the front wheels at steering 1
WHEELBASE = 2.87  # m
REAR_AXLE = 1.6  # m behind the car's middle
CAMERA_FORWARD = 1.0  # m from the car's middle forward to the cameras
AXLE_TO_CAMERA = REAR_AXLE + CAMERA_FORWARD  # m from the rear axle's middle, about which the car turns, to the cameras
MAX_GAP = 0.4  # s: rows further apart do not belong to one drive
MIN_STRETCH_ROWS = 2 * SAMPLE_RATE  # two seconds
MAX_ACCELERATION = 30.0  # m/s²: no car accelerates or brakes like this, so it was reset or crashed
YAW_LAG = 0.15  # s: time constant with which the curvature follows the wheels, the same in three recordings
SLIP = 0.005  # radians per m/s² of lateral acceleration, to the outside of a bend: see `Stretch`
OFF_ROAD = 4.5  # m from the lane's centre: further away the car has left the road, and frames show no lane
MIN_TRUSTED = 0.7  # share of a stretch's rows whose lane is trusted; below it, the human driver's path is used instead
MIN_SPEED = 1.0  # m/s: slower rows are standstills, whose frames tell nothing about steering
TURNED_RIGHT = np.array([1, -1])  # signs of a vector's components, exchanged, of the vector to its right

Values = TypeVar("Values", float, np.ndarray)


def forward_vector(heading: np.ndarray | float) -> np.ndarray:
    """Return the unit vector along a heading: (…, 2), (right, forward) in the frame in which headings are measured."""
    return np.stack([np.sin(heading), np.cos(heading)], axis=-1)


def right_of(forward: np.ndarray) -> np.ndarray:
    """Return the unit vector to the right of another: (…, 2); both (right, forward) or both (x east, y north)."""
    return forward[..., ::-1] * TURNED_RIGHT


def wrap_angle(angle: Values) -> Values:
    """Return the same angle in the range -pi to pi; radians."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def components(vector: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return a vector's components to the right of and along a unit vector: (…, 2); all in the same frame."""
    right = vector[..., 0] * forward[..., 1] - vector[..., 1] * forward[..., 0]
    return np.stack([right, vector[..., 0] * forward[..., 0] + vector[..., 1] * forward[..., 1]], axis=-1)


def curvature(steering: Values) -> Values:
    """Return the curvature of the path at a steering, 1/m, right positive; steering: -1..1.

    Over a whole lap, three real recordings turn by 1.06, 1.05 and 0.99 times this, at 30 mph as at 15, judged by the
    tracks' centre lines: the car does not understeer noticeably.
    """
    return np.tan(np.radians(FULL_LOCK) * steering) / WHEELBASE


def steering_for(bend: Values) -> Values:
    """Return the steering, -1..1, that drives a curvature in 1/m, right positive."""
    return np.clip(np.degrees(np.arctan(WHEELBASE * bend)) / FULL_LOCK, -1, 1)


def lagged_curvature(turning: float, bend: float, pause: float) -> float:
    """Return the curvature that the car drives after `pause` seconds with its wheels set to the curvature `bend`.

    turning: the curvature driven before; all in 1/m. The yaw between successive frames, measured in their far
    background, fits a first-order lag of 0.15 s in three real recordings; where a keyboard steered, the lag halves the
    residual.
    """
    return turning + (bend - turning) * (1 - math.exp(-pause / YAW_LAG))


@dataclass(frozen=True)
class Stretch:
    """Consecutive rows of a recording without a break, and the car's trajectory over them.

    In a bend the rear axle slides outwards. In the stand-in simulator its path turns off the car's heading by 0.007
    radians per m/s² of lateral acceleration; a recorded car is localised on the track best with 0.005, and what its
    cameras show fits the track better with it than without in two real recordings of the jungle, too. Only the
    localisation on a track counts it: the trajectory and the recovery steering are those of a car that does not slide.
    """

    rows: slice  # of the recording
    right: np.ndarray  # float64 (n,): m, of the rear axle's middle, in the frame of its pose in the first row
    forward: np.ndarray  # likewise
    heading: np.ndarray  # float64 (n,): radians, right positive, 0 in the first row
    driven: np.ndarray  # float64 (n,): m since the first row
    slip: np.ndarray  # float64 (n - 1,): radians from the heading to the path, between rows, right positive

    def __len__(self) -> int:
        return len(self.driven)

    @staticmethod
    def of(recording: "Recording", rows: slice) -> "Stretch":
        """Integrate the trajectory from the rows' steering, speed and time stamps."""
        speed = recording.speed[rows].astype(float) * MPH
        pause = np.diff(recording.time[rows])
        step, bends = speed[:-1] * pause, curvature(recording.steering[rows].astype(float))
        turning = [float(bends[0])]
        for bend, seconds in zip(bends[:-1].tolist(), pause.tolist(), strict=True):
            turning.append(lagged_curvature(turning[-1], bend, seconds))
        bends = np.array(turning[1:])
        turn, slip = bends * step, -SLIP * bends * speed[:-1] ** 2
        heading = np.r_[0.0, np.cumsum(turn)]
        middle = heading[:-1] + turn / 2
        right, forward = (np.r_[0.0, np.cumsum(step * function(middle))] for function in (np.sin, np.cos))
        return Stretch(rows, right, forward, heading, np.r_[0.0, np.cumsum(step)], slip)


def stretches(recording: "Recording") -> list[Stretch]:
    """Split a recording at gaps in time, jumps in speed and standstills; each stretch is at least 2 s long."""
    return [Stretch.of(recording, rows) for rows in stretch_rows(recording)]


def stretch_rows(recording: "Recording") -> list[slice]:
    """Return the rows of each of a recording's `stretches`."""
    speed = recording.speed.astype(float) * MPH
    pause = np.diff(recording.time)
    steady = np.abs(np.diff(speed)) < MAX_ACCELERATION * np.maximum(pause, 1 / SAMPLE_RATE)
    moving = speed > MIN_SPEED
    joined = (pause > 0) & (pause < MAX_GAP) & steady & moving[1:] & moving[:-1]
    edges = [*np.flatnonzero(np.r_[True, ~joined]).tolist(), len(speed)]
    return [slice(*ends) for ends in itertools.pairwise(edges) if ends[1] - ends[0] >= MIN_STRETCH_ROWS]
