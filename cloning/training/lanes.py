"""The lane next to the recorded car, and poses from which a recording's frames are seen with --robust.

Poses and the lane's frame are those of `cloning/lane/recovery.py`.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import cv2
import numpy as np
import torch

from cloning.base.errors import printable
from cloning.base.outputs import plural
from cloning.base.table import Column, Table
from cloning.lane.known import lane_position
from cloning.lane.recovery import LOOKAHEAD, LaneAhead
from cloning.network.network import CROP
from cloning.recordings.format import DRIVING_LOG
from cloning.recordings.log import Recording
from cloning.road.camera import CAMERA_OFFSETS, EARLIER_FRAME, camera_position
from cloning.road.motion import AXLE_TO_CAMERA, MIN_TRUSTED, REAR_AXLE, components, forward_vector, stretches
from cloning.road.warp import CroppedView, fill_ground
from cloning.training import light
from cloning.training.gpu import GpuViews
from cloning.training.recipe import Recipe

VIEW = CroppedView(CROP)


@dataclass(frozen=True)
class Lanes(LaneAhead):
    """The lane ahead at each of n rows of recordings, and an earlier row that shows what a warped frame lacks."""

    earlier: Column  # int32 (n,): the recording's row EARLIER_FRAME metres earlier, or the first one of the stretch
    moved: Column  # float32 (n, 3): rear axle in the earlier row, relative to this one: m right, m forward, radians

    @classmethod
    def unknown(cls, n: int) -> Self:
        """Return n rows whose lane ahead is unknown, with the values of a car centred on a straight."""
        offset, yaw, moved = np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros((n, 3), np.float32)
        point = np.tile(np.array([0, LOOKAHEAD], np.float32), (n, 1))
        return cls(offset, yaw, point, np.zeros(n, bool), np.arange(n, dtype=np.int32), moved)

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """Return the lane at every row of a recording. Raises OSError, and the errors of `lane_position`.

        Where the driven path counts as the lane's centre, it is printed.
        """
        lanes = cls.unknown(len(recording))
        if not len(lanes):  # no image is usable
            return lanes
        whole = stretches(recording)
        position = lane_position(recording, whole)
        pieces = [piece for each in whole for piece in position.pieces(recording, each)]
        if unsure := [piece for piece in pieces if position.trusted[piece.rows].mean() < MIN_TRUSTED]:
            line, count = recording.lines[unsure[0].rows.start], plural(sum(map(len, unsure)), "row")
            told = f"the lane is not seen for certain; in {count} from here on, the driven path counts as its centre"
            remedy = "if it is far from it, cut them; if steering, speed or images are wrong, mend them"
            print(printable(f"{recording.folder / DRIVING_LOG}: line {line}: {told}: {remedy}"), flush=True)
        for stretch in pieces:
            rows, heading, driven = stretch.rows, stretch.heading, stretch.driven
            ahead = LaneAhead.of_stretch(stretch, position.lateral_offset[rows], position.trusted[rows])
            for column in fields(LaneAhead):
                getattr(lanes, column.name)[rows] = getattr(ahead, column.name)
            earlier = np.maximum(np.searchsorted(driven, driven - EARLIER_FRAME, "right") - 1, 0)
            lanes.earlier[rows] = rows.start + earlier
            axle = np.stack([stretch.right, stretch.forward], axis=1)
            back = components(axle[earlier] - axle, forward_vector(heading))
            lanes.moved[rows] = np.column_stack([back, heading[earlier] - heading])
        return lanes

    def from_middle(self) -> np.ndarray:
        """Return how far right of the recorded car's middle that of a car would be which drives as the labels aim.

        Its rear axle is on the lane's centre, and it heads along the lane: float (n,), m; 0 where the lane is unknown.
        """
        return -(self.offset + REAR_AXLE * np.sin(self.yaw))

    def weights(self, straight: float) -> np.ndarray:
        """Return the probability of sampling each row: float64 (n,), sum 1; straight: `Recipe.straight_weight`."""
        centred = np.zeros(len(self))
        weights = straight + np.abs(self.steering(centred, centred).astype(float))
        return weights / weights.sum()

    def sample_poses(self, recipe: Recipe, rng: np.random.Generator, mirrored: np.ndarray) -> "Poses":
        """Sample a pose for each row, and a camera near it whose frame will be warped; mirrored: bool (n,).

        The camera is random, so that traces of warping in an image do not tell the side from which it was taken.
        """
        n = len(self)
        offset = rng.triangular(-recipe.pose_offset, 0, recipe.pose_offset, n)
        offset = offset.clip(self.offset - recipe.max_shift, self.offset + recipe.max_shift)
        yaw = np.clip(rng.normal(0, recipe.pose_yaw, n), -recipe.max_pose_yaw, recipe.max_pose_yaw)
        eye = offset - self.offset + AXLE_TO_CAMERA * (np.sin(yaw) - np.sin(self.yaw))
        distance = np.abs(eye[:, None] - list(CAMERA_OFFSETS.values()))
        near = distance <= np.maximum(recipe.camera_reach, distance.min(1, keepdims=True))
        camera = np.argmax(near * rng.uniform(1, 2, (n, 3)), axis=1)
        colours, shade = light.tints(recipe, rng, n), light.sample_shades(recipe.shaded, rng, n)
        seen = light.sample_disturbances(recipe.disturbed, rng, n)
        return replace(Poses.of(self, offset, yaw, camera, mirrored), colours=colours, shade=shade, disturbance=seen)


@dataclass(frozen=True)
class Poses(Table):
    """The poses from which n rows are seen, with everything that is needed to make their images."""

    offset: Column  # float (n,): lateral offset from the lane's centre, m; as the next, before the world is mirrored
    yaw: Column  # float (n,): heading error, radians
    camera: Column  # int (n,): the camera whose frame is warped: 0 centre, 1 left, 2 right
    mirrored: Column  # bool (n,): whether the image shows the mirrored world, seen by the same, slightly rolled camera
    # float64 (n, 2, 2, 3, 3): homographies from a frame's `ROAD_ROWS` to what the network sees, from the row's own
    # frame and from the earlier one, for the ground and for the sky.
    warps: Column
    steering: Column  # float32 (n,): the label, -1..1
    colours: Column  # float32 (n, 3, 3): matrices by which (red, green, blue) is multiplied, see `light.tints`
    shade: Column  # int16 (n,): shadows, see `light.sample_shades`
    disturbance: Column  # int32 (n,): foul weather and the like, see `light.sample_disturbances`

    @classmethod
    def of(cls, lanes: Lanes, offset: np.ndarray, yaw: np.ndarray, camera: np.ndarray, mirrored: np.ndarray) -> Self:
        """Return the poses at the rows of `lanes`, in unchanged light; the others are columns."""
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
        colours = np.tile(np.eye(3, dtype=np.float32), (len(turn), 1, 1))
        shade, disturbance = (np.full(len(turn), -1, kind) for kind in (np.int16, np.int32))
        return cls(offset, yaw, camera, mirrored, np.stack(warps, axis=1), labels, colours, shade, disturbance)

    def view(self, at: int, read: Callable[[int, bool], np.ndarray]) -> np.ndarray:
        """Return what the network sees of one row, undisturbed: uint8 (75, 320, 3), RGB.

        at: index of the row; read(camera, earlier): returns the `ROAD_ROWS` of the camera's frame in the row or in the
        earlier one, uint8 (90, 320, 4), RGBA, which is warped faster.
        """
        camera, mirrored = int(self.camera[at]), bool(self.mirrored[at])
        image, seen = VIEW.warp(read(camera, False), self.warps[at, 0], mirrored)
        if not seen.all():  # only ground can be missing
            fill_ground(image, cv2.bitwise_not(seen), read(camera, True), self.warps[at, 1, 0])
        return light.relight(cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), self.colours[at], int(self.shade[at]))

    def disturbed(self, images: Any) -> Any:
        """Return the rows' images, uint8 (n, 75, 320, 3), as they are seen under their disturbances, if there are any.

        All else that changes an image comes before: light falls on the road, the weather is in front of it.
        """
        if (self.disturbance < 0).all():
            return images
        return np.stack([light.disturbed(*one) for one in zip(images, self.disturbance.tolist(), strict=True)])

    def on_gpu(self, road: torch.Tensor, earlier: torch.Tensor) -> torch.Tensor:
        """Return what `view` does for each row, made on a GPU: uint8 (n, 75, 320, 3).

        road, earlier: uint8 (n, 90, 320, 3), the `ROAD_ROWS` of the camera's frame in each row and in the earlier one.
        """
        return _views_on(road.device)(road, earlier, self)

    def title(self, at: int) -> str:
        """Return the pose that an image shows in words, such as `0.8 m left, turned 5° right`; at: index of the row."""
        sign = -1 if self.mirrored[at] else 1
        metres, degrees = sign * round(float(self.offset[at]), 1), sign * round(math.degrees(self.yaw[at]))
        side = f"{abs(metres):.1f} m {'left' if metres < 0 else 'right'}" if metres else "in the middle"
        turn = f"turned {abs(degrees)}° {'left' if degrees < 0 else 'right'}" if degrees else "not turned"
        weather = light.name_of(int(self.disturbance[at]))
        return f"{side}, {turn}{weather and f', {weather}'}"


@functools.cache
def _views_on(device: torch.device) -> GpuViews:
    return GpuViews(VIEW, light.shades(), device)
