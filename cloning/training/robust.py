"""The training of `model.py --robust`: recovery steering, learned from frames warped to other poses of the car.

These are NVIDIA's shifts and rotations by viewpoint transform (arXiv 1604.07316, section 5). The label of a warped
frame, the recovery steering, drives the car from its pose back to the lane's centre.

Poses and the lane's frame are those of `cloning/lane/recovery.py`.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import cv2
import numpy as np

from cloning.lane.known import lane_position
from cloning.lane.recovery import LOOKAHEAD, LaneAhead
from cloning.network.network import CROP
from cloning.recordings.format import CAMERAS, LANE_FILE
from cloning.recordings.log import CheckedRecording, Recording
from cloning.road.camera import CAMERA_OFFSETS, EARLIER_FRAME, camera_position
from cloning.road.motion import (
    AXLE_TO_CAMERA,
    REAR_AXLE,
    Stretch,
    components,
    forward_vector,
    stretches,
)
from cloning.road.warp import CroppedView, fill_ground, with_alpha
from cloning.training import light
from cloning.training.observations import SEEN_SHAPE, Example, Observations, ValidationSet, Views, center_digests
from cloning.training.options import Arguments

MAX_POSE_OFFSET = 2.0  # m: sampled poses are at most this far from the lane's centre, most often near it
# Radians: standard deviation and limit of the heading errors of sampled poses, which are normally distributed.
YAW_DEVIATION, MAX_POSE_YAW = np.radians(8), np.radians(25)
MAX_SHIFT = 2.4  # m from the recorded trajectory: further away the frames show too little of the road
CAMERA_REACH = 1.7  # m: a camera this near to a pose may supply its image
STRAIGHT_WEIGHT = 0.2  # sampling weight on a straight; elsewhere |steering along the lane| is added
MIRRORED_SHARE = 0.5  # of the images in a batch
VIEW = CroppedView(CROP)


# ----------------------------------------------------------------------------------------------------------------------
# The lane next to the recorded car


@dataclass
class Lanes(LaneAhead):
    """The lane ahead at each of n rows of recordings, and an earlier row that shows what a warped frame lacks.

    earlier  int32 (n,): the recording's row EARLIER_FRAME metres earlier, or the first one of the stretch
    moved    float32 (n, 3): the rear axle in the earlier row, relative to this one: m right, m forward, radians
    """

    earlier: np.ndarray
    moved: np.ndarray

    @staticmethod
    def unknown(n: int) -> "Lanes":
        """Return n rows whose lane ahead is unknown, with the values of a car centred on a straight."""
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
        """Return the lane at every row of a recording, known or estimated from its frames.

        Raises OSError, and the errors of `lane_position`.
        """
        whole = stretches(recording)
        position = lane_position(recording, whole)
        lanes = Lanes.unknown(len(recording))
        for stretch in whole:
            lanes._fill(stretch, position.lateral_offset[stretch.rows], position.trusted[stretch.rows])
        return lanes

    def _fill(self, stretch: Stretch, offset: np.ndarray, trusted: np.ndarray) -> None:
        """Set the rows of a stretch; offset: of the car's middle, m; trusted: rows where it can be relied on."""
        rows, heading, driven = stretch.rows, stretch.heading, stretch.driven
        ahead = LaneAhead.of_stretch(stretch, offset, trusted)
        for column in fields(LaneAhead):
            getattr(self, column.name)[rows] = getattr(ahead, column.name)
        earlier = np.maximum(np.searchsorted(driven, driven - EARLIER_FRAME, "right") - 1, 0)
        self.earlier[rows] = rows.start + earlier
        axle = np.stack([stretch.right, stretch.forward], axis=1)
        back = components(axle[earlier] - axle, forward_vector(heading))
        self.moved[rows] = np.column_stack([back, heading[earlier] - heading])

    @staticmethod
    def joined(parts: list["Lanes"]) -> "Lanes":
        """Return the rows of all parts, one part after the other."""
        return Lanes(*(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(Lanes)))

    def weights(self) -> np.ndarray:
        """Return the probability of sampling each row, higher in bends: float64 (n,), sum 1."""
        centred = np.zeros(len(self))
        weights = STRAIGHT_WEIGHT + np.abs(self.steering(centred, centred).astype(float))
        return weights / weights.sum()

    def camera_labels(self, row: int) -> np.ndarray:
        """Return the recovery steering if the centre camera were where each of the three cameras is: float32 (3,)."""
        lane = self.take(np.array([row]))
        return lane.steering(lane.offset + np.array(list(CAMERA_OFFSETS.values())), lane.yaw)

    def sample_poses(self, rng: np.random.Generator, mirrored: np.ndarray) -> "Poses":
        """Sample a pose for each row, and a camera near it whose frame will be warped; mirrored: bool (n,).

        The camera is random, so that traces of warping in an image do not tell the side from which it was taken.
        """
        n = len(self)
        offset = np.clip(
            rng.triangular(-MAX_POSE_OFFSET, 0, MAX_POSE_OFFSET, n), self.offset - MAX_SHIFT, self.offset + MAX_SHIFT
        )
        yaw = np.clip(rng.normal(0, YAW_DEVIATION, n), -MAX_POSE_YAW, MAX_POSE_YAW)
        eye = offset - self.offset + AXLE_TO_CAMERA * (np.sin(yaw) - np.sin(self.yaw))
        distance = np.abs(eye[:, None] - list(CAMERA_OFFSETS.values()))
        near = distance <= np.maximum(CAMERA_REACH, distance.min(1, keepdims=True))
        poses = Poses.of(self, offset, yaw, np.argmax(near * rng.uniform(1, 2, (n, 3)), axis=1), mirrored)
        poses.colours, poses.shade = light.tints(rng, n), light.sample_shades(rng, n)
        return poses


@dataclass
class Poses:
    """The poses from which n rows are seen, with everything that is needed to make their images.

    offset    float (n,): lateral offset from the lane's centre, m; as the next, before the world is mirrored
    yaw       float (n,): heading error, radians
    camera    int (n,): the camera whose frame is warped: 0 centre, 1 left, 2 right
    mirrored  bool (n,): whether the image shows the mirrored world, as seen by the same, slightly rolled camera
    warps     float64 (n, 2, 2, 3, 3): homographies from a frame's `ROAD_ROWS` to what the network sees: from the
              row's own frame and from the earlier one, for the ground and for the sky
    steering  float32 (n,): the label, -1..1
    colours   float32 (n, 3, 3): matrices by which (red, green, blue) is multiplied, see `light.tints`
    shade     int16 (n,): shadows, see `light.sample_shades`
    """

    offset: np.ndarray
    yaw: np.ndarray
    camera: np.ndarray
    mirrored: np.ndarray
    warps: np.ndarray
    steering: np.ndarray
    colours: np.ndarray
    shade: np.ndarray

    @staticmethod
    def of(lanes: Lanes, offset: np.ndarray, yaw: np.ndarray, camera: np.ndarray, mirrored: np.ndarray) -> "Poses":
        """Return the poses at the rows of `lanes`, in unchanged light; offset, yaw: float (n,), the poses."""
        turn = yaw - lanes.yaw
        # The pose relative to the recorded rear axle, in the recorded car's frame: m right, m forward.
        away = offset - lanes.offset
        axle = np.stack([away * np.cos(lanes.yaw), away * np.sin(lanes.yaw)], axis=1)
        eye = camera_position(axle, forward_vector(turn))
        side = np.array(list(CAMERA_OFFSETS.values()))[camera]
        own_frame = np.zeros_like(lanes.moved)
        warps = [VIEW.homographies(eye, turn, moved, side, mirrored) for moved in (own_frame, lanes.moved)]
        steering = lanes.steering(offset, yaw)
        labels = np.where(mirrored, -steering, steering)
        colours, shade = np.tile(np.eye(3, dtype=np.float32), (len(turn), 1, 1)), np.full(len(turn), -1, np.int16)
        return Poses(offset, yaw, camera, mirrored, np.stack(warps, axis=1), labels, colours, shade)

    def take(self, rows: np.ndarray) -> "Poses":
        """Return these rows, in this order; rows: indices."""
        return Poses(*(getattr(self, column.name)[rows] for column in fields(self)))

    def view(self, at: int, read: Callable[[int, bool], np.ndarray]) -> np.ndarray:
        """Return what the network sees of one row: uint8 (75, 320, 3), RGB.

        at: index of the row; read(camera, earlier): returns the `ROAD_ROWS` of the camera's frame in the row or in the
        earlier one, uint8 (90, 320, 4), RGBA, which is warped faster.
        """
        camera, mirrored = int(self.camera[at]), bool(self.mirrored[at])
        image, seen = VIEW.warp(read(camera, False), self.warps[at, 0], mirrored)
        if not seen.all():  # only ground can be missing
            fill_ground(image, cv2.bitwise_not(seen), read(camera, True), self.warps[at, 1, 0])
        return light.relight(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), self.colours[at], int(self.shade[at]))

    def title(self, at: int) -> str:
        """Return the pose that an image shows in words, such as `0.8 m left, turned 5° right`; at: index of the row."""
        seen = (-1 if self.mirrored[at] else 1) * np.array([self.offset[at], np.degrees(self.yaw[at])])
        sides = ["left" if value < 0 else "right" for value in seen]
        return f"{abs(seen[0]):.1f} m {sides[0]}, turned {abs(seen[1]):.0f}° {sides[1]}"


# ----------------------------------------------------------------------------------------------------------------------
# The steps in which --robust differs from the report


@dataclass
class RobustObservations(Observations):
    """Observations labelled with the recovery steering, instead of the report's throttle filter and resampling.

    lanes  the lane at each observation
    """

    lanes: Lanes

    label_source: ClassVar[str] = "recovery steering"
    too_few: ClassVar[str] = "the drives are too short"
    # As in NVIDIA's paper. No image is seen twice; with dropout val_loss was higher after the same number of images.
    dropout: ClassVar[bool] = False
    best_by: ClassVar[str] = "val_loss"  # which, unlike the report's, counts steering back
    aimed_at: ClassVar[str] = "the lane's centre"
    remedy: ClassVar[str] = "train longer, or record more"

    @staticmethod
    def dropped(arguments: Arguments) -> str:
        """Return what `select` drops, as the title of a column."""
        return "lane ahead unknown"

    @classmethod
    def select(cls, recording: CheckedRecording, arguments: Arguments) -> Self:
        """Keep the rows whose lane ahead is known, labelled with the recovery steering from the recorded pose."""
        is_known = (recording.folder / LANE_FILE).exists()
        print(f"{'reading' if is_known else 'estimating'} the lane in {recording.folder}", flush=True)
        all_lanes = Lanes.of(recording)
        rows = np.flatnonzero(all_lanes.known).astype(np.int32)
        lanes = all_lanes.take(rows)
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
        """Return these observations, in this order; rows: indices; steering: float32, other labels if given."""
        return replace(super().take(rows, steering), lanes=self.lanes.take(rows))

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """Join the observations of several recordings; parts: those of one recording each."""
        return replace(super().joined(parts), lanes=Lanes.joined([part.lanes for part in parts]))

    def resample(self, seed: int, repeats: int) -> Self:
        """Return all observations once, because `shuffle` samples bends more often."""
        return self

    def shuffle(self, rng: np.random.Generator, repeats: int) -> np.ndarray:
        """Sample as many observations as there are, with replacement: int (n,), indices.

        Bends are sampled more often, and recordings of problem areas, as in the report.
        """
        weights = self.lanes.weights() * self.counts(repeats)
        return rng.choice(len(self), len(self), p=weights / weights.sum())

    def aim(self) -> np.ndarray:
        """Return how far right of the recorded car's middle the lane's centre is: float (n,), m."""
        return -(self.lanes.offset + REAR_AXLE * np.sin(self.lanes.yaw))

    def sample_views(
        self, rows: np.ndarray, cameras: np.ndarray, side_correction: float, rng: np.random.Generator
    ) -> "PoseViews":
        """Sample a pose for each observation and each of the four kinds of image; half of the poses are mirrored."""
        lanes = self.lanes.take(rows)
        poses = [lanes.sample_poses(rng, rng.random(len(rows)) < MIRRORED_SHARE) for _ in range(4)]
        return PoseViews(self, rows, poses)

    def validation_sets(self, seed: int) -> list[ValidationSet]:
        """Return two sets: the centre images, and an image of each observation from a random pose."""
        poses = self.lanes.sample_poses(np.random.default_rng([seed, 5]), np.zeros(len(self), bool))
        return [
            ValidationSet(self.center, self.steering),
            ValidationSet(lambda rows: self.warped(rows, [poses.take(rows)])[0], poses.steering),
        ]

    @staticmethod
    def learning_rate(arguments: Arguments, progress: float) -> float:
        """Return the next step's learning rate: cosine decay to zero; progress: the finished share of the run, 0..1."""
        return arguments.learning_rate * ((1 + math.cos(math.pi * progress)) / 2)

    def warped(self, rows: np.ndarray, poses: list[Poses]) -> list[np.ndarray]:
        """Return what the network sees of these k observations, for each item of poses: uint8 (k, 75, 320, 3), RGB."""
        images = [np.empty((len(rows), *SEEN_SHAPE), np.uint8) for _ in poses]
        for i, row in enumerate(rows):
            read = functools.cache(functools.partial(self.read_source, row))
            for views, kind_poses in zip(images, poses, strict=True):
                views[i] = kind_poses.view(i, read)
        return images

    def read_source(self, at: int, camera: int, earlier: bool) -> np.ndarray:
        """Return the `ROAD_ROWS` of an observation's frame, or of the earlier row's: uint8 (90, 320, 4), RGBA."""
        row = self.lanes.earlier[at] if earlier else self.row[at]
        return with_alpha(self.road(self.recording[at], row, camera))


class PoseViews(Views):
    """Images of a batch's observations from a random pose for each kind of image."""

    def __init__(self, observations: RobustObservations, rows: np.ndarray, poses: list[Poses]):
        """rows: int (n,), indices of observations; poses: four, one for each kind of image, of n rows each."""
        self.observations, self.rows, self.poses = observations, rows, poses
        self.labels = np.stack([kind_poses.steering for kind_poses in poses], axis=1)

    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """Return the images of some observations, int (k,), for each of the four kinds: uint8 (k, 75, 320, 3)."""
        return self.observations.warped(self.rows[part], [kind_poses.take(part) for kind_poses in self.poses])

    def example(self, i: int) -> Example:
        """Return the batch's observation number i for the diagnostic pictures."""
        row = self.rows[i]
        frames = [self.observations.read(row, camera) for camera in range(len(CAMERAS))]
        labels = self.observations.lanes.camera_labels(row)
        return Example(frames, labels, self.images(np.array([i])), CROP[0], [poses.title(i) for poses in self.poses])
