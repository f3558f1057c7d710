"""Observations: the rows that are trained on or validated with, their labels, and access to their images."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np

from cloning.errors import RecordingError
from cloning.pilot.network import CROP
from cloning.recordings.format import FRAME
from cloning.recordings.images import decode
from cloning.recordings.log import Recording
from cloning.training.image_cache import ImageCache
from cloning.training.options import Arguments

SEEN_ROWS = slice(CROP[0], FRAME[0] - CROP[1])  # the rows of a frame that the network sees
SEEN_SHAPE = (SEEN_ROWS.stop - SEEN_ROWS.start, *FRAME[1:])  # (75, 320, 3)


class ValidationSet(NamedTuple):
    """Images and labels to validate with.

    images  rows -> uint8 (len(rows), 75, 320, 3), RGB
    labels  float32 (n,): steering of all rows, -1..1
    """

    images: Callable[[np.ndarray], np.ndarray]
    labels: np.ndarray


class Example(NamedTuple):
    """One observation for the diagnostic pictures.

    frames         uint8 (160, 320, 3), RGB: of the centre, left and right camera
    camera_labels  float32 (3,): their steering
    images         uint8 (1, rows, 320, 3): what the unaltered, flipped, brightened and shadowed image are made from
    first_row      the row of the full frame that is the first of `images`
    titles         of the unaltered and the flipped image
    """

    frames: list[np.ndarray]
    camera_labels: np.ndarray
    images: list[np.ndarray]
    first_row: int
    titles: list[str]


class Views(ABC):
    """The images of a batch's observations before augmentation, and their labels.

    labels  float32 (n, 4): steering of the unaltered, flipped, brightened and shadowed image of each observation
    """

    labels: np.ndarray

    @abstractmethod
    def images(self, part: np.ndarray) -> list[np.ndarray]:
        """For each of the four kinds, the images of some of the observations: uint8 (len(part), 75, 320, 3) each."""

    @abstractmethod
    def example(self, i: int) -> Example:
        """The batch's observation number i, for the diagnostic pictures."""


class Choices(NamedTuple):
    """The random choices for one batch of n observations, which give m images of four kinds.

    observation           int (n,): which observations
    camera                int (n,): the camera that represents each, 0 centre, 1 left, 2 right
    places                int (n, 4): place in the batch of each kind of image, -1 where it is not added
    keep                  bool (m, 4224): the units of the flattened layer that dropout keeps
    brightness, darkness  float64 (n,): factors of HSV value and HLS lightness
    line                  float64 (n, 2): columns where a shadow's edge meets the top and the bottom of the full frame
    left                  bool (n,): whether the shadow is left of that edge
    views                 the images before augmentation, and the labels
    """

    observation: np.ndarray
    camera: np.ndarray
    places: np.ndarray
    keep: np.ndarray
    brightness: np.ndarray
    darkness: np.ndarray
    line: np.ndarray
    left: np.ndarray
    views: Views


class Augmented(NamedTuple):
    """Images of one kind.

    which   int (k,): the observations of the batch that have one
    images  uint8 (k, rows, 320, 3), RGB
    """

    which: np.ndarray
    images: np.ndarray


@dataclass
class Observations(ABC):
    """One entry for each row of a recording that is used, or for a copy of such a row.

    recordings  the Recordings that the rows come from
    recording   int16 (n,): index into `recordings`
    row         int32 (n,): row of that recording
    steering    float32 (n,): the label, -1..1, right positive
    frame       uint64 (n,): digest of the centre image's file
    time        float64 (n,): seconds

    The methods up to `take` are the steps in which the report's training (in model.py) and --robust (in robust.py)
    differ.
    """

    recordings: list[Recording]
    recording: np.ndarray
    row: np.ndarray
    steering: np.ndarray
    frame: np.ndarray
    time: np.ndarray

    cached_rows: ClassVar[slice] = SEEN_ROWS  # of a frame; they end where SEEN_ROWS end
    label_source: ClassVar[str]  # whose steering the label is, for the summary
    too_few: ClassVar[str]  # why few rows are left, when most were dropped by `select`

    def __post_init__(self) -> None:
        self.cache = ImageCache(self.cached_rows.stop - self.cached_rows.start)

    def __len__(self) -> int:
        return len(self.steering)

    # ---- the steps in which the kinds of observations differ

    @staticmethod
    @abstractmethod
    def dropped(arguments: Arguments) -> str:
        """What `select` drops, as the title of a column."""

    @classmethod
    @abstractmethod
    def select(cls, recording: Recording, arguments: Arguments) -> Self:
        """The observations of a recording that are worth training on. Raises RecordingError, ModelError."""

    @abstractmethod
    def resample(self, seed: int) -> Self:
        """Balance the training observations, by leaving some out and repeating others."""

    @abstractmethod
    def shuffle(self, rng: np.random.Generator) -> np.ndarray:
        """The order in which one pass takes the observations: int (n,), indices."""

    @abstractmethod
    def sample_views(
        self, rows: np.ndarray, cameras: np.ndarray, side_correction: float, rng: np.random.Generator
    ) -> Views:
        """The images of these observations and their labels; cameras: one for each, 0 centre, 1 left, 2 right."""

    def validation_sets(self, seed: int) -> list[ValidationSet]:
        """The sets of images to validate with, one image for each observation in each set: centre images, unaltered."""
        return [ValidationSet(self.center, self.steering)]

    @staticmethod
    def learning_rate(arguments: Arguments, progress: float) -> float:
        """Learning rate of the next step, constant; progress: the share of the run that is done, 0..1."""
        return arguments.learning_rate

    # ---- columns

    def take(self, rows: np.ndarray, steering: np.ndarray | None = None) -> Self:
        """These observations, in this order, with other labels if given."""
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
        """The observations of several recordings, one part each, as one."""
        return replace(
            parts[0],
            recordings=[recording for part in parts for recording in part.recordings],
            recording=np.repeat(np.arange(len(parts), dtype=np.int16), [len(part) for part in parts]),
            row=np.concatenate([part.row for part in parts]),
            steering=np.concatenate([part.steering for part in parts]),
            frame=np.concatenate([part.frame for part in parts]),
            time=np.concatenate([part.time for part in parts]),
        )

    # ---- images

    def path(self, at: int, camera: int) -> Path:
        """The file of an observation's image; camera: 0 centre, 1 left, 2 right."""
        return self.recordings[self.recording[at]].path(self.row[at], camera)

    def read(self, at: int, camera: int) -> np.ndarray:
        """An observation's whole frame: uint8 (160, 320, 3), RGB. Raises RecordingError."""
        return read_checked(self.path(at, camera))

    def read_cropped(self, at: int, camera: int) -> np.ndarray:
        """The `cached_rows` of an observation's frame: uint8, RGB, not to be changed. Raises RecordingError."""
        return self.crop(self.recording[at], self.row[at], camera)

    def crop(self, number: int, row: int, camera: int) -> np.ndarray:
        """The `cached_rows` of the frame of any row of recording `number`: uint8, RGB, not to be changed."""
        recording = self.recordings[number]
        key = number, recording.images[row, camera]  # rows may share an image
        return self.cache.get(key, lambda: read_checked(recording.path(row, camera))[self.cached_rows])

    def center(self, rows: np.ndarray) -> np.ndarray:
        """The centre images of these observations as the network sees them: uint8 (len(rows), 75, 320, 3), RGB."""
        first = SEEN_ROWS.start - self.cached_rows.start
        return np.stack([self.read_cropped(at, 0)[first:] for at in rows])


def center_digests(recording: Recording, rows: np.ndarray) -> np.ndarray:
    """The digests of the centre images of these rows of a checked recording: uint64 (len(rows),)."""
    assert recording.digests is not None, "check_images sets the digests"
    return recording.digests[recording.images[rows, 0]]


def read_checked(path: Path) -> np.ndarray:
    """A frame: uint8 (160, 320, 3), RGB. Raises RecordingError if the file is not the one that was checked."""
    try:
        return decode(path.read_bytes())
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"{path}: {error}; the image was usable when the run began. Restore it and continue with --resume"
        ) from None
