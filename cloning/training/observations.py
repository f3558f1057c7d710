"""Observations: the rows that training and validation use, with their labels and images.

From an observation of a batch up to four kinds of image are made: unaltered, flipped, brightened and shadowed.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.frame import FRAME, ROAD_ROWS
from cloning.network.network import CROP
from cloning.recordings.format import DRIVE_GAP, PROBLEM_AREAS
from cloning.recordings.images import decode, read_jpeg
from cloning.recordings.log import CheckedRecording, Recording
from cloning.training.options import Arguments

SEEN_ROWS = slice(CROP[0], FRAME[0] - CROP[1])  # the rows of a frame that the network sees
SEEN_SHAPE = (SEEN_ROWS.stop - SEEN_ROWS.start, *FRAME[1:])  # (75, 320, 3)


class ValidationSet(NamedTuple):
    """Images and labels for validation.

    images  from indices of observations, int (k,), to their images, uint8 (k, 75, 320, 3), RGB
    labels  float32 (n,): steering of all observations, -1..1
    """

    images: Callable[[np.ndarray], np.ndarray]
    labels: np.ndarray


class Example(NamedTuple):
    """One observation for the diagnostic pictures.

    frames         uint8 (160, 320, 3), RGB: of the centre, left and right camera
    camera_labels  float32 (3,): their labels
    images         uint8 (1, rows, 320, 3) each: the four kinds of image before brightening and shadowing
    first_row      the row of the full frame that is the first of `images`
    titles         of these images
    """

    frames: list[np.ndarray]
    camera_labels: np.ndarray
    images: list[np.ndarray]
    first_row: int
    titles: list[str]


class Views(ABC):
    """The four kinds of image of a batch's observations, before brightening and shadowing, and their labels.

    labels  float32 (n, 4): steering, -1..1, of the unaltered, flipped, brightened and shadowed image
    """

    labels: np.ndarray

    @abstractmethod
    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """Return the images of some observations, for each of the four kinds uint8 (k, 75, 320, 3), RGB.

        part: int (k,), indices into the batch.
        """

    @abstractmethod
    def example(self, i: int) -> Example:
        """Return the batch's observation number i for the diagnostic pictures."""


class Choices(NamedTuple):
    """The random choices for one batch: n observations, from which m images of four kinds are made.

    observation           int (n,): indices of the observations
    camera                int (n,): the camera whose image is used, 0 centre, 1 left, 2 right
    places                int (n, 4): place of each kind of image among the m images, -1 if it is not made
    keep                  bool (m, 4224): the units of the flattened layer that dropout keeps; None: all
    brightness, darkness  float64 (n,): factors of HSV value and HLS lightness
    line                  float64 (n, 2): columns at which the shadow's edge meets the top and bottom of the full frame
    left                  bool (n,): whether the shadow is left of that edge
    views                 the images before brightening and shadowing, and the labels
    """

    observation: np.ndarray
    camera: np.ndarray
    places: np.ndarray
    keep: np.ndarray | None
    brightness: np.ndarray
    darkness: np.ndarray
    line: np.ndarray
    left: np.ndarray
    views: Views


class Augmented(NamedTuple):
    """The images of one kind in a batch.

    which   int (k,): indices into the batch of the observations that have one
    images  uint8 (k, rows, 320, 3), RGB
    """

    which: np.ndarray
    images: np.ndarray


@dataclass
class Observations(ABC):
    """Observations in columns: one entry for each row of a recording that is used, or for a copy of it.

    recordings  the Recordings that the rows come from
    recording   int16 (n,): index into `recordings`
    row         int32 (n,): row of that recording
    steering    float32 (n,): the label, -1..1, right positive
    frame       uint64 (n,): digest of the centre image's file
    time        float64 (n,): seconds

    The methods before `take` are the steps in which the report's training (in model.py) and --robust (in robust.py)
    differ.
    """

    recordings: list[Recording]
    recording: np.ndarray
    row: np.ndarray
    steering: np.ndarray
    frame: np.ndarray
    time: np.ndarray

    label_source: ClassVar[str]  # whose steering the label is, as the summary calls it
    too_few: ClassVar[str]  # the reason to print if `select` leaves too few rows
    dropout: ClassVar[bool]  # whether the network is trained with it
    best_by: ClassVar[str]  # the metric of an epoch that tells best how its network drives: val_loss or val_drift
    aimed_at: ClassVar[str]  # where the car should be, in words
    remedy: ClassVar[str]  # what helps a network that drives badly

    def __len__(self) -> int:
        return len(self.steering)

    # ---- the steps in which the kinds of observations differ

    @staticmethod
    @abstractmethod
    def dropped(arguments: Arguments) -> str:
        """Return what `select` drops, as the title of a column."""

    @classmethod
    @abstractmethod
    def select(cls, recording: CheckedRecording, arguments: Arguments) -> Self:
        """Return the observations of a recording that training uses. Raises RecordingError, ModelError."""

    @abstractmethod
    def resample(self, seed: int, repeats: int) -> Self:
        """Return the training observations balanced: some left out, others repeated; repeats: see `counts`."""

    @abstractmethod
    def shuffle(self, rng: np.random.Generator, repeats: int) -> np.ndarray:
        """Return the order of the observations in one pass over them: int (n,), indices; repeats: see `counts`."""

    @abstractmethod
    def sample_views(
        self, rows: np.ndarray, cameras: np.ndarray, side_correction: float, rng: np.random.Generator
    ) -> Views:
        """Return these observations' images and labels, with random choices of rng.

        rows: int (n,), indices of observations; cameras: int (n,), 0 centre, 1 left, 2 right; side_correction: steering
        that is added to the label of left images and subtracted from that of right ones.
        """

    def validation_sets(self, seed: int) -> list[ValidationSet]:
        """Return the sets to validate with, each with an image per observation: one set, of the centre images."""
        return [ValidationSet(self.center, self.steering)]

    @staticmethod
    def learning_rate(arguments: Arguments, progress: float) -> float:
        """Return the learning rate of the next step, a constant; progress: the finished share of the run, 0..1."""
        return arguments.learning_rate

    def aim(self) -> np.ndarray:
        """Return how far right of the recorded car a well steered one should be: float (n,), m; on the same path: 0."""
        return np.zeros(len(self))

    # ---- columns

    def take(self, rows: np.ndarray, steering: np.ndarray | None = None) -> Self:
        """Return these observations, in this order; rows: indices; steering: float32, other labels if given."""
        return replace(
            self,
            recording=self.recording[rows],
            row=self.row[rows],
            steering=self.steering[rows] if steering is None else steering,
            frame=self.frame[rows],
            time=self.time[rows],
        )

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """Join the observations of several recordings; parts: those of one recording each."""
        return replace(
            parts[0],
            recordings=[recording for part in parts for recording in part.recordings],
            recording=np.repeat(np.arange(len(parts), dtype=np.int16), [len(part) for part in parts]),
            row=np.concatenate([part.row for part in parts]),
            steering=np.concatenate([part.steering for part in parts]),
            frame=np.concatenate([part.frame for part in parts]),
            time=np.concatenate([part.time for part in parts]),
        )

    def counts(self, repeats: int) -> np.ndarray:
        """Return how often each observation counts: int (n,), `repeats` in a recording of problem areas, else 1."""
        names = [recording.folder.resolve().name for recording in self.recordings]
        return np.array([repeats if name.endswith(PROBLEM_AREAS) else 1 for name in names])[self.recording]

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

    def read(self, at: int, camera: int) -> np.ndarray:
        """Return an observation's whole frame: uint8 (160, 320, 3), RGB. Raises RecordingError."""
        return read_checked(self.path(at, camera))

    def read_cropped(self, at: int, camera: int) -> np.ndarray:
        """Return what the network sees of an observation's frame: uint8 (75, 320, 3), RGB, not to be changed."""
        return self.road(self.recording[at], self.row[at], camera)[SEEN_ROWS.start - ROAD_ROWS.start :]

    def road(self, number: int, row: int, camera: int) -> np.ndarray:
        """Return the `ROAD_ROWS` of any frame of recording `number`: uint8 (90, 320, 3), RGB, not to be changed.

        Raises RecordingError.
        """
        return self.recordings[number].road(row, camera, read_checked)

    def center(self, rows: np.ndarray) -> np.ndarray:
        """Return the centre images of these observations, cropped: uint8 (len(rows), 75, 320, 3), RGB."""
        return np.stack([self.read_cropped(at, 0) for at in rows])


def center_digests(recording: CheckedRecording, rows: np.ndarray) -> np.ndarray:
    """Return the digests of the centre images of these rows of a recording: uint64 (len(rows),)."""
    return recording.digests[recording.images[rows, 0]]


def read_checked(path: Path) -> np.ndarray:
    """Return a frame, uint8 (160, 320, 3), RGB. Raises RecordingError if it became unusable after the check."""
    try:
        return decode(read_jpeg(path))
    except ValueError as error:
        raise RecordingError(
            f"{path}: {error}; the image was usable when the run began. Restore it and continue with --resume"
        ) from None
