"""Observations: the rows that training and validation use, their labels and images, and what a batch has of them."""

import functools
import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import cv2
import numpy as np
import torch
from numpy.random import Generator

from cloning.base.frame import ROAD_ROWS
from cloning.base.table import Column, Table
from cloning.network.network import SEEN_ROWS
from cloning.network.tensors import matching
from cloning.recordings.format import CAMERAS, DRIVE_GAP, PROBLEM_AREAS
from cloning.recordings.images import read_frame
from cloning.recordings.log import CheckedRecording
from cloning.training.gpu import GpuFrames
from cloning.training.lanes import Lanes
from cloning.training.recipe import Recipe

RESTORE = "the image was usable when the run began. Restore it and continue with --resume"
SAME_LABELS = 0.03  # the most by which those of --robust differ on another processor, which rounds otherwise
read_checked = functools.partial(read_frame, remedy=RESTORE)  # of a file that may have become unusable after the check


class ValidationSet(NamedTuple):
    """Images and labels for validation."""

    images: Callable[[np.ndarray], np.ndarray]  # from indices, int (k,), to images, uint8 (k, 75, 320, 3), RGB
    labels: np.ndarray  # float32 (n,): steering of all observations, -1..1


class Example(NamedTuple):
    """One observation for the diagnostic pictures."""

    frames: list[np.ndarray]  # uint8 (160, 320, 3), RGB: of the centre, left and right camera
    camera_labels: np.ndarray  # float32 (3,): their labels
    images: list[np.ndarray]  # uint8 (1, rows, 320, 3) for each augmentation: before it changes them
    first_row: int  # the row of the full frame that is the first of `images`
    titles: list[str]  # of these images


class Views(Protocol):
    """The images of a batch's observations before augmentation, one for each augmentation, and their labels."""

    labels: np.ndarray  # float32 (n, augmentations): steering, -1..1

    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """Return the images of some observations, for each augmentation uint8 (k, 75, 320, 3), RGB.

        part: int (k,), indices into the batch. They may share memory, and are not to be changed.
        """

    def finished(self, augmentation: int, images: Any, part: np.ndarray) -> Any:
        """Return the images of some observations, augmented, as they are learned from; part: as for `images`."""

    def example(self, i: int) -> Example:
        """Return one observation for the diagnostic pictures; i: its index in the batch."""


class Choices(NamedTuple):
    """The random choices for one batch: n observations, from which m images are made."""

    observation: np.ndarray  # int (n,): indices of the observations
    camera: np.ndarray  # int (n,): the camera whose image is used, 0 centre, 1 left, 2 right
    slots: np.ndarray  # int (n, augmentations): where in the batch each image is, -1 if it is not made
    keep: np.ndarray | None  # bool (m, 4224): the units of the flattened layer that dropout keeps; None: all
    augmenting: list[tuple[np.ndarray, ...]]  # each augmentation's choices: arrays of n entries each
    views: Views  # the images before augmentation, and the labels


@dataclass(frozen=True)
class Observations(Table):
    """Observations in columns: one entry for each row of a recording that is used, or for a copy of it."""

    recordings: list[CheckedRecording]  # that the rows come from
    recording: Column  # int16 (n,): index into `recordings`
    row: Column  # int32 (n,): row of that recording
    steering: Column  # float32 (n,): the label, -1..1, right positive
    frame: Column  # uint64 (n,): digest of the centre image's file
    time: Column  # float64 (n,): seconds
    lanes: Lanes  # the lane at each of them, which the report's training does not know
    gpu: GpuFrames | None = None  # their frames in a GPU's memory, if images are made there

    @classmethod
    def of_rows(cls, recording: CheckedRecording, rows: np.ndarray, steering: np.ndarray, lanes: Lanes) -> Self:
        """Return the observations of these rows of a recording, int (n,), with these labels."""
        frame = recording.digests[recording.images[rows, 0]]
        index = np.zeros(len(rows), np.int16)
        return cls([recording], index, rows.astype(np.int32), steering, frame, recording.time[rows], lanes)

    @classmethod
    def of_recordings(cls, parts: Sequence[Self]) -> Self:
        """Return the observations of several recordings; parts: those of one recording each."""
        recordings = [recording for part in parts for recording in part.recordings]
        index = np.repeat(np.arange(len(parts), dtype=np.int16), [len(part) for part in parts])
        return cls.joined(parts, recordings=recordings, recording=index)

    def counts(self, repeats: int) -> np.ndarray:
        """Return how often each observation counts: int (n,), `repeats` in a recording of problem areas, else 1.

        A link to the recording may have that name, or the folder itself.
        """
        names = [(each.folder.absolute().name, each.folder.resolve().name) for each in self.recordings]
        is_repeated = [any(name.endswith(PROBLEM_AREAS) for name in both) for both in names]
        return np.where(is_repeated, repeats, 1)[self.recording]

    def drives(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the drive without a break that each observation is of, and the time since its start.

        int (n,), numbered from 0 in the order of the observations; float64 (n,), seconds.
        """
        starts = np.ones(len(self), bool)
        pause = np.diff(self.time)
        starts[1:] = (np.diff(self.recording) != 0) | (pause < 0) | (pause > DRIVE_GAP)
        drive = np.cumsum(starts) - 1
        return drive, self.time - self.time[starts][drive]

    # ---- images

    def path(self, at: int, camera: int) -> Path:
        """Return the file of an observation's image; camera: 0 centre, 1 left, 2 right."""
        return self.recordings[self.recording[at]].path(self.row[at], camera)

    def frames(self, at: int) -> list[np.ndarray]:
        """Return an observation's whole frames of the centre, left and right camera, as `read_frame` does."""
        return [read_checked(self.path(at, camera)) for camera in range(len(CAMERAS))]

    def road(self, at: int, row: int, camera: int) -> np.ndarray:
        """Return the `ROAD_ROWS` of any frame of an observation's recording: uint8 (90, 320, 3), RGB.

        It is not to be changed. Raises RecordingError.
        """
        return self.recordings[self.recording[at]].road(row, camera, read_checked)

    def cropped(self, rows: np.ndarray, cameras: np.ndarray) -> Any:
        """Return what the network sees of these k frames: uint8 (k, 75, 320, 3), RGB."""
        first = SEEN_ROWS.start - ROAD_ROWS.start
        if self.gpu:
            return self.road_on_gpu(rows, self.row[rows], cameras)[:, first:]
        chosen = zip(rows, self.row[rows], cameras, strict=True)
        return np.stack([self.road(*one)[first:] for one in chosen])

    def center(self, rows: np.ndarray) -> Any:
        """Return the centre images of these observations, as `cropped` does."""
        return self.cropped(rows, np.zeros(len(rows), int))

    # ---- on a GPU

    def on_gpu(self, device: torch.device, pool: Executor) -> Self:
        """Return the observations with their frames in the GPU's memory, or as they are if these don't fit.

        pool: its threads decode the frames.
        """
        used, read = list[np.ndarray](), list[Callable[[], np.ndarray]]()
        for index, recording in enumerate(self.recordings):
            mine = self.recording == index
            rows = np.unique(np.concatenate([self.row[mine], self.lanes.earlier[mine & self.lanes.known]]))
            images, first = np.unique(recording.images[rows], return_index=True)
            used.append(np.isin(np.arange(len(recording.names)), images))
            for row, camera in zip(rows[first // len(CAMERAS)], first % len(CAMERAS), strict=True):
                read.append(functools.partial(recording.road, row, camera, read_checked))
        frames = GpuFrames(used, device)
        if not frames.fit():
            print("the frames do not fit into the GPU's memory: images are made by the CPU")
            return self
        return replace(self, gpu=frames.load(read, pool))

    def road_on_gpu(self, at: np.ndarray, row: np.ndarray, camera: np.ndarray) -> torch.Tensor:
        """Return the `ROAD_ROWS` of frames of k observations' recordings, from the GPU's memory: uint8 (k, 90, 320, 3).

        at, row, camera: int (k,), the observations, the rows of their recordings, and the cameras.
        """
        assert self.gpu
        recording = self.recording[at]
        images = [self.recordings[r].images[i, c] for r, i, c in zip(recording, row, camera, strict=True)]
        return self.gpu.road(recording, np.array(images))


class Data(NamedTuple):
    """What a run learns from, by which --resume knows it again."""

    labels: torch.Tensor  # float16 (n,), -1..1
    # Digests: of all images; and as of earlier versions, with the labels, and of these and the centre's images alone.
    fingerprints: list[str]

    @classmethod
    def of(cls, *observations: Observations) -> Self:
        """Return what is in observations."""
        images = b"".join(
            recording.digests[recording.images[part.row[part.recording == index]]].tobytes()
            for part in observations
            for index, recording in enumerate(part.recordings)
        )
        frames = b"".join(part.frame.tobytes() for part in observations)
        labelled = b"".join(part.frame.tobytes() + part.steering.tobytes() for part in observations)
        digested = (frames + images, labelled + images, labelled)
        labels = torch.from_numpy(np.concatenate([part.steering for part in observations])).half()
        return cls(labels, [hashlib.blake2b(each, digest_size=16).hexdigest() for each in digested])

    def changed(self, fingerprint: object, labels: object) -> float:
        """Return by how much labels differ from those of a saved state, at most.

        Raises ValueError if they are those of other recordings.
        """
        if fingerprint in self.fingerprints[1:]:
            return 0.0
        saved = matching({"labels": labels}, {"labels": self.labels})["labels"]
        changed = float((saved.float() - self.labels.float()).abs().max())
        if fingerprint != self.fingerprints[0] or changed > SAME_LABELS:
            raise ValueError("other recordings")
        return changed


def centre_images(observations: Observations, recipe: Recipe, seed: int) -> list[ValidationSet]:
    """Return one set to validate with: the centre images."""
    return [ValidationSet(observations.center, observations.steering)]


class CameraViews:
    """One camera's image of each observation of a batch, from which all augmentations are made."""

    def __init__(
        self, observations: Observations, rows: np.ndarray, cameras: np.ndarray, recipe: Recipe, rng: Generator
    ):
        """rows, cameras: int (n,); rng: not needed."""
        self.observations, self.rows, self.cameras = observations, rows, cameras
        self.mirrors = [augmentation.mirrors for augmentation in recipe.augmentations]
        side = recipe.side_correction
        self.corrections = np.array([0, side, -side], np.float32)  # centre, left, right
        label = observations.steering[rows] + self.corrections[cameras]
        self.labels = np.stack([-label if mirrors else label for mirrors in self.mirrors], axis=1)

    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """See Views."""
        return self._mirrored(self.observations.cropped(self.rows[part], self.cameras[part]))

    def finished(self, augmentation: int, images: Any, part: np.ndarray) -> Any:
        """See Views."""
        return images

    def _mirrored(self, images: Any) -> list[Any]:
        """Return the images, uint8 (n, rows, columns, 3), or the flipped ones, as each augmentation needs them."""
        if isinstance(images, torch.Tensor):
            flipped = images.flip(2)
        else:
            flipped = cv2.flip(images.reshape(-1, *images.shape[2:]), 1).reshape(images.shape)
        return [flipped if mirrors else images for mirrors in self.mirrors]

    def example(self, i: int) -> Example:
        """See Views."""
        row, camera, frames = self.rows[i], self.cameras[i], self.observations.frames(self.rows[i])
        labels, name = self.observations.steering[row] + self.corrections, f"{CAMERAS[camera]} camera"
        titles = [f"{name}, flipped" if mirrors else name for mirrors in self.mirrors]
        return Example(frames, labels, self._mirrored(frames[camera][None]), 0, titles)
