"""Recorded frames as seen from beside the lane's centre, and the steering that brings the car back onto it: NVIDIA's
shifts and rotations by viewpoint transform (arXiv 1604.07316, section 5), for `model.py --robust`.

A pose is that of the rear axle's middle: metres to the right of the lane's centre, radians to the lane's heading,
right positive. The lane's frame of a row has its origin on the lane's centre beside the recorded car's rear axle.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import cv2
import numpy as np

from cloning.lane.place import read_lane
from cloning.pilot.network import CROP
from cloning.recordings.log import Recording
from cloning.road.camera import CAMERA_OFFSETS, EARLIER_FRAME, camera_position
from cloning.road.motion import (
    AXLE_TO_CAMERA,
    MIN_TRUSTED,
    OFF_ROAD,
    REAR_AXLE,
    forward_vector,
    steering_for,
    stretches,
)
from cloning.road.warp import SOURCE_ROWS, CroppedView

AHEAD = 6.0  # m along the lane's centre: the point that the car is steered for
STEEP = 1.0  # m: from further off the car comes back no steeper than from here, at up to STEEP / AHEAD radians
CHORD = 3.0  # m before and after: the lane's heading is that of the chord between
RIGHT, YAW = 2.0, np.radians(8)  # poses: metres drawn evenly from - to + this; the yaw's standard deviation
FURTHEST = np.radians(25)  # of yaw
SHARE = 0.2  # where the lane is straight, of what a row counts where it takes all steering more
REACH = 2.4  # m from the human's way: further to the side too little was seen
NEARBY = 1.7  # m: a camera within this distance from a pose may show it
TINTED = 0.5  # of the views
STRENGTH, TINTS = (0.1, 1.5), (0.85, 1.15)  # of their colours, and factors of red, green and blue
ROWS = SOURCE_ROWS  # of a recorded frame: what views are warped from
VIEW = CroppedView(CROP)


@dataclass
class Lanes:
    """Beside each of n rows of recordings: where the car stood in its lane, where the lane goes, and an earlier row.

    offset, yaw  float32 (n,): the recorded car's pose
    goal         float32 (n, 2): metres to the right and forward, in the lane's frame, of the lane's centre `AHEAD` on
    known        bool (n,): whether all this is known; what else stands there means nothing where it is not
    before       int32 (n,): the recording's row that was `EARLIER_FRAME` metres earlier, or this one
    moved        float32 (n, 3): the earlier row's rear axle as seen from this one: right, forward in metres, heading
    """

    offset: np.ndarray
    yaw: np.ndarray
    goal: np.ndarray
    known: np.ndarray
    before: np.ndarray
    moved: np.ndarray

    @staticmethod
    def empty(n: int) -> "Lanes":
        goal = np.tile(np.float32([0, AHEAD]), (n, 1))
        return Lanes(
            np.zeros(n, np.float32),
            np.zeros(n, np.float32),
            goal,
            np.zeros(n, bool),
            np.arange(n, dtype=np.int32),
            np.zeros((n, 3), np.float32),
        )

    @staticmethod
    def beside(recording: Recording) -> "Lanes":
        """Of a recording's every row, from what is read of its frames."""
        whole = stretches(recording)
        read = read_lane(recording, whole)
        lanes = Lanes.empty(len(recording))
        for stretch in whole:
            rows, heading, driven = stretch.rows, stretch.heading, stretch.driven
            axle = np.stack([stretch.right, stretch.forward], axis=1)
            place, centre, beside = driven, axle, np.zeros(len(driven))
            sure = np.flatnonzero(read.trusted[rows])
            if len(sure) >= MIN_TRUSTED * len(driven):
                beside = np.interp(np.arange(len(driven)), sure, read.offset[rows][sure])
                place = driven + REAR_AXLE  # the reading is that of the car's middle
                centre = axle + REAR_AXLE * ahead(heading) - beside[:, None] * across(np.interp(place, driven, heading))

            def lane(metres, place=place, centre=centre):
                return np.stack([np.interp(metres, place, centre[:, i]) for i in (0, 1)], axis=1)

            # The lane's heading is that of its centre, which agrees with the way that is driven; a reading would not.
            along = np.arctan2(*(lane(driven + CHORD) - lane(driven - CHORD)).T)
            away = axle - lane(driven)
            lanes.offset[rows] = (away * across(along)).sum(1)
            lanes.yaw[rows] = np.angle(np.exp(1j * (heading - along)))
            goal = lane(driven + AHEAD) - axle + lanes.offset[rows, None] * across(along)
            goal = np.stack([(goal * across(along)).sum(1), (goal * ahead(along)).sum(1)], axis=1)
            known = (driven >= 2 * CHORD) & (driven + AHEAD <= driven[-1]) & (np.abs(beside) < OFF_ROAD)
            lanes.goal[rows], lanes.known[rows] = np.where(known[:, None], goal, lanes.goal[rows]), known
            before = np.maximum(np.searchsorted(driven, driven - EARLIER_FRAME, "right") - 1, 0)
            lanes.before[rows] = rows.start + before
            back = axle[before] - axle
            lanes.moved[rows] = np.stack(
                [(back * across(heading)).sum(1), (back * ahead(heading)).sum(1), heading[before] - heading], axis=1
            )
        return lanes

    @staticmethod
    def joined(parts: list["Lanes"]) -> "Lanes":
        return Lanes(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Lanes)))

    def take(self, rows: np.ndarray) -> "Lanes":
        return Lanes(*(getattr(self, one.name)[rows] for one in fields(self)))

    def steering(self, right: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """What leads each row's car from a pose onto the lane's centre: float32 (n,), -1..1 (pure pursuit)."""
        away = self.goal[:, 0] - np.clip(right, -STEEP, STEEP)
        beside = away * np.cos(yaw) - self.goal[:, 1] * np.sin(yaw)
        return steering_for(2 * beside / (away**2 + self.goal[:, 1] ** 2)).astype(np.float32)

    def weights(self) -> np.ndarray:
        """How often each row is to be drawn, float64 (n,), sum 1: the more, the harder the lane turns there."""
        here = np.zeros(len(self.yaw))
        weights = SHARE + np.abs(self.steering(here, here).astype(float))
        return weights / weights.sum()

    def beside_cameras(self, row: int) -> np.ndarray:
        """The steering back from where each camera stands, as if it were the centre one: float32 (3,)."""
        one, sides = self.take(np.array([row])), np.array(list(CAMERA_OFFSETS.values()))
        return one.steering(one.offset + sides, one.yaw)

    def drawn(self, rng: np.random.Generator, mirrored: np.ndarray) -> "Poses":
        """Each row from a place drawn at random, by one of the cameras that are not too far from there.

        Which one is chance, too, so that what warping leaves in a frame does not tell where it was taken from.
        """
        n = len(self.yaw)
        right = np.clip(rng.uniform(-RIGHT, RIGHT, n), self.offset - REACH, self.offset + REACH)
        yaw = np.clip(rng.normal(0, YAW, n), -FURTHEST, FURTHEST)
        eye = right - self.offset + AXLE_TO_CAMERA * (np.sin(yaw) - np.sin(self.yaw))
        distance = np.abs(eye[:, None] - list(CAMERA_OFFSETS.values()))
        near = distance <= np.maximum(NEARBY, distance.min(1, keepdims=True))
        poses = Poses.of(self, right, yaw, np.argmax(near * rng.uniform(1, 2, (n, 3)), axis=1), mirrored)
        poses.colours = np.where((rng.random(n) < TINTED)[:, None, None], other_colours(rng, n), poses.colours)
        return poses


@dataclass
class Poses:
    """Where n rows are seen from, and how.

    camera    int (n,): centre, left or right: whose frame is warped
    mirrored  bool (n,): whether the view is that of the mirror world, seen by the camera as it is
    warps     float64 (n, 2, 2, 3, 3): from the rows `ROWS` of a frame to what the network sees; by the row itself and
              the one before, for the ground and for what is infinitely far
    steering  float32 (n,): what leads back from there, -1..1
    colours   float32 (n, 3, 3): what becomes of red, green and blue
    """

    camera: np.ndarray
    mirrored: np.ndarray
    warps: np.ndarray
    steering: np.ndarray
    colours: np.ndarray

    @staticmethod
    def of(lanes: Lanes, right, yaw, camera: np.ndarray, mirrored: np.ndarray) -> "Poses":
        turn = yaw - lanes.yaw
        # Of the camera, from the recorded rear axle, along the recorded car.
        away = right - lanes.offset
        axle = np.stack([away * np.cos(lanes.yaw), away * np.sin(lanes.yaw)], axis=1)
        eye = camera_position(axle, forward_vector(turn))
        side = np.array(list(CAMERA_OFFSETS.values()))[camera]
        warps = [
            VIEW.homographies(eye, turn, moved, side, mirrored) for moved in (np.zeros_like(lanes.moved), lanes.moved)
        ]
        steering = lanes.steering(right, yaw)
        colours = np.tile(np.eye(3, dtype=np.float32), (len(turn), 1, 1))
        return Poses(camera, mirrored, np.stack(warps, axis=1), np.where(mirrored, -steering, steering), colours)

    def take(self, rows: np.ndarray) -> "Poses":
        return Poses(*(getattr(self, one.name)[rows] for one in fields(self)))

    def view(self, at: int, read: Callable[[int, bool], np.ndarray]) -> np.ndarray:
        """What the network sees of one row, uint8 (75, 320, 3), RGB.

        read(camera, before): the row's frame, or that of the earlier row, by this camera: uint8, its rows `ROWS`.
        """
        camera, mirrored = int(self.camera[at]), bool(self.mirrored[at])
        made, seen = VIEW.warp(read(camera, False), self.warps[at, 0], mirrored)
        if not seen.all():
            before, _ = VIEW.warp(read(camera, True), self.warps[at, 1], mirrored)
            cv2.copyTo(before, cv2.bitwise_not(seen), made)
        return cv2.transform(made, self.colours[at])


def other_colours(rng: np.random.Generator, n: int) -> np.ndarray:
    """Paler or stronger, and tinted: float32 (n, 3, 3)."""
    strength = rng.uniform(*STRENGTH, n)[:, None, None]
    tints = rng.uniform(*TINTS, (n, 3, 1))
    return (tints * (strength * np.eye(3) + (1 - strength) / 3)).astype(np.float32)


def across(heading: np.ndarray) -> np.ndarray:
    """The unit vector to the right of a heading: (n, 2), right and forward where the heading is 0."""
    return np.stack([np.cos(heading), -np.sin(heading)], axis=1)


def ahead(heading: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(heading), np.cos(heading)], axis=1)
