"""The training of `model.py --robust`: recovery steering, learned from frames warped to other poses of the car.

NVIDIA's shifts and rotations by viewpoint transform (arXiv 1604.07316, section 5). The label of a warped frame is the
steering that drives the car from there back onto the centre of its lane.

A pose is that of the middle of the rear axle: metres to the right of the lane's centre and radians to the right of the
lane's heading. The lane's frame of a row has its origin on the lane's centre next to the recorded car's rear axle.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import cv2
import numpy as np

from cloning.lane.place import estimate_lane_position
from cloning.pilot.network import CROP
from cloning.recordings.format import CAMERAS
from cloning.recordings.log import Recording
from cloning.road.camera import CAMERA_OFFSETS, EARLIER_FRAME, camera_position
from cloning.road.motion import (
    AXLE_TO_CAMERA,
    MIN_TRUSTED,
    OFF_ROAD,
    REAR_AXLE,
    Stretch,
    components,
    forward_vector,
    right_of,
    steering_for,
    stretches,
)
from cloning.road.warp import SOURCE_ROWS, CroppedView
from cloning.training.observations import SEEN_SHAPE, Example, Observations, ValidationSet, Views, center_digests
from cloning.training.options import Arguments

LOOKAHEAD = 6.0  # m along the lane's centre, to the point that the label steers for
STEEPEST_FROM = 1.0  # m of lateral offset: from further away the car returns at the same angle as from here
HEADING_CHORD = 3.0  # m before and behind: the lane's heading is that of the chord between
MAX_POSE_OFFSET = 2.0  # m: the lateral offsets of sampled poses are uniform between - and + this
YAW_DEVIATION, MAX_POSE_YAW = (
    np.radians(8),
    np.radians(25),
)  # of the heading errors of sampled poses, normally distributed
MAX_SHIFT = 2.4  # m from the recorded trajectory: further to the side the frames show too little of the road
CAMERA_REACH = 1.7  # m: a camera within this distance of a pose may supply its image
STRAIGHT_WEIGHT = 0.2  # of an observation whose label is 0; |label| is added to it
TINTED_SHARE = 0.5  # of the images
SATURATION, TINT = (0.1, 1.5), (0.85, 1.15)  # ranges of their factors; TINT of red, green and blue each
MIRRORED_SHARE = 0.5  # of the images in a batch
VIEW = CroppedView(CROP)


# ----------------------------------------------------------------------------------------------------------------------
# The lane next to the recorded car, and the label


@dataclass
class Lanes:
    """The lane next to each of n rows of recordings, and an earlier row that shows what a warped frame lacks.

    offset, yaw  float32 (n,): the recorded car's pose
    goal         float32 (n, 2): the lane's centre `LOOKAHEAD` further on: metres right and forward in the lane's frame
    known        bool (n,): whether the lane ahead is known; the other columns mean nothing where it is not
    earlier      int32 (n,): the recording's row `EARLIER_FRAME` metres earlier, or the first one of the drive
    moved        float32 (n, 3): the rear axle in the earlier row, seen from this one: m right, m forward, heading
    """

    offset: np.ndarray
    yaw: np.ndarray
    goal: np.ndarray
    known: np.ndarray
    earlier: np.ndarray
    moved: np.ndarray

    def __len__(self) -> int:
        return len(self.yaw)

    @staticmethod
    def unknown(n: int) -> "Lanes":
        """Rows without a known lane ahead, as if the car were centred on a straight."""
        return Lanes(
            np.zeros(n, np.float32),
            np.zeros(n, np.float32),
            np.tile(np.array([0, LOOKAHEAD], np.float32), (n, 1)),
            np.zeros(n, bool),
            np.arange(n, dtype=np.int32),
            np.zeros((n, 3), np.float32),
        )

    @staticmethod
    def of(recording: Recording) -> "Lanes":
        """The lane at every row of a recording, estimated from its frames.

        Raises OSError, RecordingError for images that can't be read, ModelError without a usable lane network.
        """
        whole = stretches(recording)
        estimated = estimate_lane_position(recording, whole)
        lanes = Lanes.unknown(len(recording))
        for stretch in whole:
            lanes._fill(stretch, estimated.lateral_offset[stretch.rows], estimated.trusted[stretch.rows])
        return lanes

    def _fill(self, stretch: Stretch, offset: np.ndarray, trusted: np.ndarray) -> None:
        """Set the rows of a stretch; offset: of the car's middle, m right of the lane's centre, where it is trusted."""
        rows, heading, driven = stretch.rows, stretch.heading, stretch.driven
        axle = np.stack([stretch.right, stretch.forward], axis=1)
        # Of the lane's centre: points in the stretch's frame, and the metres driven at which the car passes them.
        centre, passed, to_centre = axle, driven, np.zeros(len(driven))
        sure = np.flatnonzero(trusted)
        if len(sure) >= MIN_TRUSTED * len(driven):
            to_centre = np.interp(np.arange(len(driven)), sure, offset[sure])
            passed = driven + REAR_AXLE  # the estimate holds at the car's middle
            side = right_of(forward_vector(np.interp(passed, driven, heading)))
            centre = axle + REAR_AXLE * forward_vector(heading) - to_centre[:, None] * side

        def centre_at(metres: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(metres, passed, centre[:, i]) for i in (0, 1)], axis=1)

        # The heading of the estimated centre line agrees with the driven trajectory; the estimated yaw would not.
        chord = centre_at(driven + HEADING_CHORD) - centre_at(driven - HEADING_CHORD)
        lane_heading = np.arctan2(*chord.T)
        along = forward_vector(lane_heading)
        self.offset[rows] = components(axle - centre_at(driven), along)[:, 0]
        self.yaw[rows] = np.angle(np.exp(1j * (heading - lane_heading)))
        goal = centre_at(driven + LOOKAHEAD) - axle + self.offset[rows, None] * right_of(along)
        goal = components(goal, along)
        known = (driven >= 2 * HEADING_CHORD) & (driven + LOOKAHEAD <= driven[-1]) & (np.abs(to_centre) < OFF_ROAD)
        self.goal[rows], self.known[rows] = np.where(known[:, None], goal, self.goal[rows]), known
        earlier = np.maximum(np.searchsorted(driven, driven - EARLIER_FRAME, "right") - 1, 0)
        self.earlier[rows] = rows.start + earlier
        back = components(axle[earlier] - axle, forward_vector(heading))
        self.moved[rows] = np.column_stack([back, heading[earlier] - heading])

    @staticmethod
    def joined(parts: list["Lanes"]) -> "Lanes":
        """The rows of all parts, one part after the other."""
        return Lanes(*(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(Lanes)))

    def take(self, rows: np.ndarray) -> "Lanes":
        """These rows, in this order."""
        return Lanes(*(getattr(self, column.name)[rows] for column in fields(self)))

    def steering(self, offset: float | np.ndarray, yaw: float | np.ndarray) -> np.ndarray:
        """The recovery steering from a pose at each row, by pure pursuit of the goal: float32 (n,), -1..1."""
        across = self.goal[:, 0] - np.clip(offset, -STEEPEST_FROM, STEEPEST_FROM)
        aside = across * np.cos(yaw) - self.goal[:, 1] * np.sin(yaw)
        return steering_for(2 * aside / (across**2 + self.goal[:, 1] ** 2)).astype(np.float32)

    def weights(self) -> np.ndarray:
        """The probability with which each row is sampled, higher in bends: float64 (n,), sum 1."""
        centred = np.zeros(len(self))
        weights = STRAIGHT_WEIGHT + np.abs(self.steering(centred, centred).astype(float))
        return weights / weights.sum()

    def camera_labels(self, row: int) -> np.ndarray:
        """The recovery steering of the car if its centre camera were where each of the three is: float32 (3,)."""
        lane = self.take(np.array([row]))
        return lane.steering(lane.offset + np.array(list(CAMERA_OFFSETS.values())), lane.yaw)

    def sample_poses(self, rng: np.random.Generator, mirrored: np.ndarray) -> "Poses":
        """A random pose for each row, seen by one of the cameras that are not too far from it; mirrored: bool (n,).

        The camera is random, too, so that traces of warping in an image do not tell the side that it was taken from.
        """
        n = len(self)
        offset = np.clip(
            rng.uniform(-MAX_POSE_OFFSET, MAX_POSE_OFFSET, n), self.offset - MAX_SHIFT, self.offset + MAX_SHIFT
        )
        yaw = np.clip(rng.normal(0, YAW_DEVIATION, n), -MAX_POSE_YAW, MAX_POSE_YAW)
        eye = offset - self.offset + AXLE_TO_CAMERA * (np.sin(yaw) - np.sin(self.yaw))
        distance = np.abs(eye[:, None] - list(CAMERA_OFFSETS.values()))
        near = distance <= np.maximum(CAMERA_REACH, distance.min(1, keepdims=True))
        poses = Poses.of(self, offset, yaw, np.argmax(near * rng.uniform(1, 2, (n, 3)), axis=1), mirrored)
        poses.colours = np.where((rng.random(n) < TINTED_SHARE)[:, None, None], tints(rng, n), poses.colours)
        return poses


@dataclass
class Poses:
    """From where n rows are seen, and how.

    camera    int (n,): the camera whose frame is warped: 0 centre, 1 left, 2 right
    mirrored  bool (n,): whether the image shows the mirrored world, seen by the same, slightly tilted camera
    warps     float64 (n, 2, 2, 3, 3): homographies from the `SOURCE_ROWS` of a frame to what the network sees; by the
              row's own frame and the earlier one, for the ground and for what is infinitely far
    steering  float32 (n,): the label, -1..1
    colours   float32 (n, 3, 3): matrices by which red, green and blue are multiplied
    """

    camera: np.ndarray
    mirrored: np.ndarray
    warps: np.ndarray
    steering: np.ndarray
    colours: np.ndarray

    @staticmethod
    def of(lanes: Lanes, offset: np.ndarray, yaw: np.ndarray, camera: np.ndarray, mirrored: np.ndarray) -> "Poses":
        """These poses at the rows of `lanes`, in true colours; offset, yaw: float (n,); the others as in the class."""
        turn = yaw - lanes.yaw
        # Relative to the recorded rear axle and along the recorded car: m right, m forward.
        away = offset - lanes.offset
        axle = np.stack([away * np.cos(lanes.yaw), away * np.sin(lanes.yaw)], axis=1)
        eye = camera_position(axle, forward_vector(turn))
        side = np.array(list(CAMERA_OFFSETS.values()))[camera]
        own_frame = np.zeros_like(lanes.moved)
        warps = [VIEW.homographies(eye, turn, moved, side, mirrored) for moved in (own_frame, lanes.moved)]
        steering = lanes.steering(offset, yaw)
        colours = np.tile(np.eye(3, dtype=np.float32), (len(turn), 1, 1))
        return Poses(camera, mirrored, np.stack(warps, axis=1), np.where(mirrored, -steering, steering), colours)

    def take(self, rows: np.ndarray) -> "Poses":
        """These rows, in this order."""
        return Poses(*(getattr(self, column.name)[rows] for column in fields(self)))

    def view(self, at: int, read: Callable[[int, bool], np.ndarray]) -> np.ndarray:
        """What the network sees of one row: uint8 (75, 320, 3), RGB.

        read(camera, earlier): the `SOURCE_ROWS` of the row's frame, or of the earlier row's, by this camera, uint8.
        """
        camera, mirrored = int(self.camera[at]), bool(self.mirrored[at])
        image, seen = VIEW.warp(read(camera, False), self.warps[at, 0], mirrored)
        if not seen.all():
            earlier, _ = VIEW.warp(read(camera, True), self.warps[at, 1], mirrored)
            cv2.copyTo(earlier, cv2.bitwise_not(seen), image)
        return cv2.transform(image, self.colours[at])


def tints(rng: np.random.Generator, n: int) -> np.ndarray:
    """Random changes of saturation and tint: float32 (n, 3, 3), matrices that RGB colours are multiplied by."""
    saturation = rng.uniform(*SATURATION, n)[:, None, None]
    tint = rng.uniform(*TINT, (n, 3, 1))
    return (tint * (saturation * np.eye(3) + (1 - saturation) / 3)).astype(np.float32)


# ----------------------------------------------------------------------------------------------------------------------
# The steps in which --robust differs from the report


@dataclass
class RobustObservations(Observations):
    """Observations whose label is the recovery steering, in place of the report's throttle filter and resampling.

    lanes  the lane at each of the observations
    """

    lanes: Lanes

    cached_rows: ClassVar[slice] = SOURCE_ROWS
    label_source: ClassVar[str] = "recovery steering"
    too_few: ClassVar[str] = "the drives are too short"

    @staticmethod
    def dropped(arguments: Arguments) -> str:
        """Rows whose lane ahead is not known are dropped."""
        return "lane ahead unknown"

    @classmethod
    def select(cls, recording: Recording, arguments: Arguments) -> Self:
        """Keep the rows whose lane ahead is known, with the steering that drives along it as label."""
        print(f"estimating the lane in {recording.folder}", flush=True)
        every = Lanes.of(recording)
        rows = np.flatnonzero(every.known).astype(np.int32)
        lanes = every.take(rows)
        return cls(
            [recording],
            np.zeros(len(rows), np.int16),
            rows,
            lanes.steering(lanes.offset, lanes.yaw),
            center_digests(recording, rows),
            recording.time[rows],
            lanes,
        )

    def take(self, rows: np.ndarray, steering: np.ndarray | None = None) -> Self:
        """These observations, in this order, with other labels if given."""
        return replace(super().take(rows, steering), lanes=self.lanes.take(rows))

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """The observations of several recordings, one part each, as one."""
        return replace(super().joined(parts), lanes=Lanes.joined([part.lanes for part in parts]))

    def resample(self, seed: int) -> Self:
        """All observations, once: `shuffle` samples bends more often."""
        return self

    def shuffle(self, rng: np.random.Generator) -> np.ndarray:
        """As many as there are, sampled with replacement, bends more often: int (n,), indices."""
        return rng.choice(len(self), len(self), p=self.lanes.weights())

    def sample_views(
        self, rows: np.ndarray, cameras: np.ndarray, side_correction: float, rng: np.random.Generator
    ) -> "PoseViews":
        """A random pose for each of the four kinds of image, half of them in the mirrored world."""
        lanes = self.lanes.take(rows)
        poses = [lanes.sample_poses(rng, rng.random(len(rows)) < MIRRORED_SHARE) for _ in range(4)]
        return PoseViews(self, rows, poses)

    def validation_sets(self, seed: int) -> list[ValidationSet]:
        """The centre images, and as many images from other poses."""
        poses = self.lanes.sample_poses(np.random.default_rng([seed, 5]), np.zeros(len(self), bool))
        return [
            ValidationSet(self.center, self.steering),
            ValidationSet(lambda rows: self.warped(rows, [poses.take(rows)])[0], poses.steering),
        ]

    @staticmethod
    def learning_rate(arguments: Arguments, progress: float) -> float:
        """Cosine decay to zero over the whole run."""
        return arguments.learning_rate * ((1 + math.cos(math.pi * progress)) / 2)

    def warped(self, rows: np.ndarray, poses: list[Poses]) -> list[np.ndarray]:
        """What the network sees of these rows from each of the poses: uint8 (len(rows), 75, 320, 3), RGB, each."""
        images = [np.empty((len(rows), *SEEN_SHAPE), np.uint8) for _ in poses]
        for i, row in enumerate(rows):
            read = functools.cache(functools.partial(self.read_source, row))
            for into, places in zip(images, poses, strict=True):
                into[i] = places.view(i, read)
        return images

    def read_source(self, at: int, camera: int, earlier: bool) -> np.ndarray:
        """The `SOURCE_ROWS` of an observation's frame, or of the earlier one's: uint8 (90, 320, 3), RGB."""
        return self.crop(self.recording[at], self.lanes.earlier[at] if earlier else self.row[at], camera)


class PoseViews(Views):
    """Images of a batch's observations from a random pose for each kind of image."""

    def __init__(self, observations: RobustObservations, rows: np.ndarray, poses: list[Poses]):
        """rows: int (n,), indices of observations; poses: one for each row, for each of the four kinds of image."""
        self.observations, self.rows, self.poses = observations, rows, poses
        self.labels = np.stack([places.steering for places in poses], axis=1)

    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """For each of the four kinds, the images of some of the observations: uint8 (len(part), 75, 320, 3) each."""
        return self.observations.warped(self.rows[part], [places.take(part) for places in self.poses])

    def example(self, i: int) -> Example:
        """The batch's observation number i, for the diagnostic pictures."""
        row = self.rows[i]
        frames = [self.observations.read(row, camera) for camera in range(len(CAMERAS))]
        labels = self.observations.lanes.camera_labels(row)
        return Example(frames, labels, self.images(np.array([i])), CROP[0], ["from a pose", "from another"])
