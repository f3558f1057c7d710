"""The recipe of `model.py --robust`: recovery steering, learned from frames warped to other poses of the car.

These are NVIDIA's shifts and rotations by viewpoint transform (arXiv 1604.07316, section 5). The label of a warped
frame, the recovery steering, drives the car from its pose back to the lane's centre.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator, default_rng

from cloning.base.errors import printable
from cloning.network.network import CROP, SEEN_SHAPE
from cloning.recordings.format import LANE_FILE
from cloning.recordings.log import CheckedRecording
from cloning.road.camera import CAMERA_OFFSETS
from cloning.road.warp import with_alpha
from cloning.training.lanes import Lanes, Poses
from cloning.training.observations import Example, Observations, ValidationSet
from cloning.training.recipe import Recipe, Words


def robust(report: Recipe) -> Recipe:
    """Return the recipe of --robust: the report's, but for what is named here."""
    return replace(
        report,
        name="robust",
        words=Words(
            dropped="repeated, lane ahead unknown",
            too_few="the drives are too short, or not faster than 2 mph",
            label_source="recovery steering",
            aimed_at="the lane's centre",
            remedy="train longer, or record more",
            val_loss="\nThese are the recorded images; val_loss is of them and of as many views from other poses.",
        ),
        # The label is the recovery steering; instead of a filter by throttle and resampling, bends are sampled more.
        select=select_known_lane,
        resample=all_observations,
        order=sample_bends_more,
        straight_weight=0.2,
        # Each augmentation has a view from a pose of its own.
        views=PoseViews,
        validation_sets=centre_and_poses,
        pose_offset=2.0,
        pose_yaw=np.radians(8).item(),
        max_pose_yaw=np.radians(25).item(),
        max_shift=2.4,
        camera_reach=1.7,
        mirrored=0.5,
        tinted=0.5,
        saturation=(0.1, 1.5),
        tint=(0.85, 1.15),
        dimmed=(0.5, 1.15),
        shaded=0.4,
        # Frames have a mean of 80 to 150, in deep shade 20 to 40, and deviations of 20 to 60, in fog and the like less.
        exposure=(80.0, 20.0),
        # As in NVIDIA's paper. No image is seen twice; with dropout val_loss was higher after as many images.
        dropout=False,
        # Many small steps learn most from the warped images. After 30,000 of the jungle, Muon had a val_loss of 0.065,
        # 0.056, 0.051 and 0.053 at 5e-4, 1e-3, 2e-3 and 4e-3, which learned most (Adam at 1e-3: 0.068); after 8,000 of
        # a lake lap 0.013, 0.008 and 0.007 at 2e-3, 4e-3 and 8e-3. tools/experiments.md has more.
        optimizer="muon",
        learning_rate=4e-3,
        cosine_decay=True,
        momentum=0.95,
        # Each step adds a matrix of full rank, so without decay the weights keep growing: the largest layer's spectral
        # norm was 0.7 at first, 13 after 60,000 images (with it: 4), and a training on 72 recordings broke down.
        weight_decay=1.0,
        # So that the few views that are warped beyond recognition do not decide what is learned from all the others.
        huber=0.1,
        batch_size=16,
        samples_per_epoch=45_000,
        epochs=3,
        best_by="val_loss",  # which, unlike the report's, counts steering back
    )


def select_known_lane(recording: CheckedRecording, recipe: Recipe) -> Observations:
    """Keep the rows whose lane ahead is known, labelled with the recovery steering from the recorded pose."""
    is_known = (recording.folder / LANE_FILE).exists()
    print(f"{'reading' if is_known else 'estimating'} the lane in {printable(str(recording.folder))}", flush=True)
    recording = recording.without_copies()  # each would end a stretch
    all_lanes = Lanes.of(recording)
    rows = np.flatnonzero(all_lanes.known)
    lanes = all_lanes.take(rows)
    return Observations.of_rows(recording, rows, lanes.steering(lanes.offset, lanes.yaw), lanes)


def all_observations(observations: Observations, recipe: Recipe, seed: int) -> Observations:
    """Return all observations once, because `sample_bends_more` balances them."""
    return observations


def sample_bends_more(observations: Observations, recipe: Recipe, rng: Generator) -> np.ndarray:
    """Sample as many observations as there are, with replacement: int (n,), indices.

    Bends are sampled more often, and recordings of problem areas, as in the report.
    """
    weights = observations.lanes.weights(recipe.straight_weight) * observations.counts(recipe.repeats)
    return rng.choice(len(observations), len(observations), p=weights / weights.sum())


class PoseViews:
    """Views of a batch's observations from a random pose for each augmentation; some of the poses are mirrored."""

    def __init__(
        self, observations: Observations, rows: np.ndarray, cameras: np.ndarray, recipe: Recipe, rng: Generator
    ):
        """rows: int (n,), indices of observations; cameras: not needed, each pose has its own."""
        self.observations, self.rows, n = observations, rows, len(rows)
        every = np.tile(rows, len(recipe.augmentations))  # sampled at once: one call takes as long for four as for one
        poses = observations.lanes.take(every).sample_poses(recipe, rng, rng.random(len(every)) < recipe.mirrored)
        self.poses = [poses.take(slice(start, start + n)) for start in range(0, len(every), n)]
        self.labels = poses.steering.reshape(-1, n).T

    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """See `observations.Views`."""
        return warped(self.observations, self.rows[part], [each.take(part) for each in self.poses])

    def finished(self, augmentation: int, images: Any, part: np.ndarray) -> Any:
        """See `observations.Views`."""
        return self.poses[augmentation].take(part).disturbed(images)

    def example(self, i: int) -> Example:
        """See `observations.Views`."""
        frames = self.observations.frames(self.rows[i])
        one = np.array([i])
        lane = self.observations.lanes.take(self.rows[one])  # the labels: as if the centre camera were at each camera
        labels = lane.steering(lane.offset + np.array(list(CAMERA_OFFSETS.values())), lane.yaw)
        images = warped(replace(self.observations, gpu=None), self.rows[one], [each.take(one) for each in self.poses])
        return Example(frames, labels, images, CROP[0], [each.title(i) for each in self.poses])


def centre_and_poses(observations: Observations, recipe: Recipe, seed: int) -> list[ValidationSet]:
    """Return two validation sets: the centre images, and an image of each observation from a random pose."""
    unmirrored = np.zeros(len(observations), bool)
    poses = observations.lanes.sample_poses(recipe, default_rng([seed, 5]), unmirrored)

    def seen(rows: np.ndarray) -> Any:
        some = poses.take(rows)
        return some.disturbed(warped(observations, rows, [some])[0])

    return [ValidationSet(observations.center, observations.steering), ValidationSet(seen, poses.steering)]


def warped(observations: Observations, rows: np.ndarray, poses: Sequence[Poses]) -> list[Any]:
    """Return what the network sees of these k observations, undisturbed, for each item of poses.

    uint8 (k, 75, 320, 3), RGB.
    """
    if observations.gpu:
        every, at = Poses.joined(poses), np.tile(rows, len(poses))
        road = observations.road_on_gpu(at, observations.row[at], every.camera)
        earlier = observations.road_on_gpu(at, observations.lanes.earlier[at], every.camera)
        return list(every.on_gpu(road, earlier).split(len(rows)))
    images = [np.empty((len(rows), *SEEN_SHAPE), np.uint8) for _ in poses]
    for i, at in enumerate(rows):

        @functools.cache
        def read(camera: int, earlier: bool, at: int = at) -> np.ndarray:
            row = observations.lanes.earlier[at] if earlier else observations.row[at]
            return with_alpha(observations.road(at, row, camera))

        for views, seen_from in zip(images, poses, strict=True):
            views[i] = seen_from.view(i, read)
    return images
