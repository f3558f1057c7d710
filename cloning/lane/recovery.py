"""The recovery steering: the label of `model.py --robust`, and the oracle of a replay.

From any pose of the car it drives back to the lane's centre. A pose is that of the rear axle's middle: lateral offset
from the lane's centre (m) and heading error (radians), both positive to the right. The lane's frame of a row has its
origin on the lane's centre next to the recorded car's rear axle, and its forward axis along the lane.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from cloning.base.table import Column, Table
from cloning.recordings.log import Recording
from cloning.road.motion import (
    MIN_STRETCH_ROWS,
    MIN_TRUSTED,
    OFF_ROAD,
    REAR_AXLE,
    Stretch,
    components,
    forward_vector,
    right_of,
    steering_for,
)

LOOKAHEAD = 6.0  # m that the recorded car drives until it is beside the point that the recovery steering aims at
MAX_LABEL_OFFSET = 1.0  # m: from a larger lateral offset the car returns at the same angle as from this one
MISHAP = -1  # a piece's number, see `LanePosition`
HEADING_CHORD = 3.0  # m: the lane's heading is that of the chord from so far behind to so far ahead


@dataclass(frozen=True)
class LanePosition(Table):
    """The car's position in its lane, one value for each row of a recording."""

    lateral_offset: Column  # float32 (n,): m from the lane's centre to the car's middle, right positive
    heading_error: Column  # float32 (n,): radians from the road's direction beside the car to its own, right positive
    # bool (n,): whether these two values can be relied on: the three cameras' detections agree with each other and over
    # time, or the row is placed.
    trusted: Column
    placed: Column  # bool (n,): whether it was localised on a known track, or the recording itself tells the position
    # int32 (n,): rows of a stretch with the same number belong together; MISHAP: the car did not move as it steered, or
    # was off the road, so that nothing can be learnt or judged by the row.
    piece: Column

    @staticmethod
    def read(offset: np.ndarray, heading_error: np.ndarray, trusted: np.ndarray) -> "LanePosition":
        """Return a position that was read from frames, in one piece."""
        n = len(trusted)
        return LanePosition(offset, heading_error, trusted, np.zeros(n, bool), np.zeros(n, np.int32))

    def pieces(self, recording: Recording, stretch: Stretch) -> list[Stretch]:
        """Return a stretch of the recording without mishaps, split where one piece ends; each is at least 2 s long."""
        rows, piece = stretch.rows, self.piece[stretch.rows]
        edges = np.flatnonzero(np.diff(piece)) + 1
        runs = itertools.pairwise([0, *edges.tolist(), len(piece)])
        kept = [(start, end) for start, end in runs if piece[start] != MISHAP and end - start >= MIN_STRETCH_ROWS]
        return [Stretch.of(recording, slice(rows.start + start, rows.start + end)) for start, end in kept]


@dataclass(frozen=True)
class LaneAhead(Table):
    """The lane ahead at each of n rows of recordings."""

    offset: Column  # float32 (n,): the recorded car's pose, as the next
    yaw: Column  # float32 (n,)
    goal: Column  # float32 (n, 2): the lane's centre LOOKAHEAD further on: m right and forward in the lane's frame
    known: Column  # bool (n,): whether the lane ahead is known; if not, ignore the other columns

    @staticmethod
    def of_stretch(stretch: Stretch, offset: np.ndarray, trusted: np.ndarray) -> "LaneAhead":
        """Return the lane ahead at each row of a stretch.

        offset: float (n,), of the car's middle from the lane's centre, m; trusted: bool (n,), rows where it can be
        relied on. If they are too few, the driven trajectory counts as the lane's centre.
        """
        heading, driven, n = stretch.heading, stretch.driven, len(stretch)
        axle = np.stack([stretch.right, stretch.forward], axis=1)
        # Points of the lane's centre in the stretch's frame, and the metres driven at which the car passes them.
        centre, passed, to_centre = axle, driven, np.zeros(n)
        sure = np.flatnonzero(trusted)
        if len(sure) >= MIN_TRUSTED * n:
            to_centre = np.interp(np.arange(n), sure, offset[sure])
            passed = driven + REAR_AXLE  # the estimate is that of the car's middle
            side = right_of(forward_vector(np.interp(passed, driven, heading)))
            centre = axle + REAR_AXLE * forward_vector(heading) - to_centre[:, None] * side

        def centre_at(metres: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(metres, passed, centre[:, i]) for i in (0, 1)], axis=1)

        # Not the estimated heading error: it would not agree with the driven trajectory as this heading does.
        chord = centre_at(driven + HEADING_CHORD) - centre_at(driven - HEADING_CHORD)
        lane_heading = np.arctan2(*chord.T)
        along = forward_vector(lane_heading)
        from_centre = components(axle - centre_at(driven), along)[:, 0].astype(np.float32)
        yaw = np.angle(np.exp(1j * (heading - lane_heading))).astype(np.float32)
        goal = centre_at(driven + LOOKAHEAD) - axle + from_centre[:, None] * right_of(along)
        known = (driven >= 2 * HEADING_CHORD) & (driven + LOOKAHEAD <= driven[-1]) & (np.abs(to_centre) < OFF_ROAD)
        goal = np.where(known[:, None], components(goal, along), (0, LOOKAHEAD)).astype(np.float32)
        return LaneAhead(from_centre, yaw, goal, known)

    def extended(self) -> Self:
        """Return the rows of one stretch, with a goal also where the lane ahead is unknown, as at its two ends.

        There the road bends as at the nearest known rows, between which it is interpolated; it is a straight if none is
        known.
        """
        known, goal = np.flatnonzero(self.known), self.goal
        if len(known):
            goal = np.stack([np.interp(np.arange(len(self)), known, goal[known, i]) for i in (0, 1)], axis=1)
        return replace(self, goal=goal.astype(np.float32))

    def steering(self, offset: float | np.ndarray, yaw: float | np.ndarray) -> np.ndarray:
        """Return the recovery steering from a pose at each row, by pure pursuit of the goal: float32 (n,), -1..1."""
        right = self.goal[:, 0] - np.clip(offset, -MAX_LABEL_OFFSET, MAX_LABEL_OFFSET)
        forward = self.goal[:, 1]
        right_of_car = right * np.cos(yaw) - forward * np.sin(yaw)
        return steering_for(2 * right_of_car / (right**2 + forward**2)).astype(np.float32)
