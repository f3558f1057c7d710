"""A recipe: every figure of a training, and the few functions in which trainings differ.

`model.py` has the report's, REPORT, and makes that of --robust from it, which names what it changes (`robust.py`). Any
other is made in the same way: `dataclasses.replace(REPORT, flip=0.0)`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from cloning.network.network import NETWORKS, Exposure
from cloning.network.tensors import is_number, shown
from cloning.training.optimizers import OPTIMIZERS

LIMITS: dict[str, tuple[float, float]] = {  # of figures, the least and the most
    "epochs": (1, 20_000),  # whose losses a model file has room for: see `tensors.MAX_STRUCTURE`
    "batch_size": (1, 10**5),  # 56 GB of images
    "samples_per_epoch": (1, 10**9),  # more than a lifetime of training
    "repeats": (1, 1000),  # the report's training keeps as many copies of the rows in memory
    "learning_rate": (1e-9, 10),
    "side_correction": (-1, 1),
    **dict.fromkeys(("keep_straight", "flip", "shadow", "mirrored", "tinted", "shaded", "disturbed"), (0, 1)),
}


def no_choices(recipe: "Recipe", rng: np.random.Generator, n: int) -> tuple[np.ndarray, ...]:
    """Return the choices of an augmentation that has none."""
    return ()


def unchanged(images: np.ndarray, first_row: int) -> np.ndarray:
    """Return the images, as an augmentation does that changes none."""
    return images


class Augmentation(NamedTuple):
    """A kind of image that batches contain of their observations."""

    name: str  # identifies it
    # (images, first_row, *choices) -> the changed images, uint8 (k, rows, 320, 3), RGB, as `images`, which is not to be
    # changed itself; first_row: the row of the full frame that is the images' first; choices: those of these k images.
    change: Callable[..., np.ndarray] = unchanged
    # (recipe, rng, n) -> the random choices for n observations: arrays of n entries each
    choose: Callable[["Recipe", np.random.Generator, int], tuple[np.ndarray, ...]] = no_choices
    share: float | str = 1.0  # of the observations that have it, 0..1, or the name of the recipe's field that says it
    mirrors: bool = False  # whether it begins with the mirrored image, and the negative label
    caption: str = ""  # of the diagnostic picture: a format for the choices, such as "brightness x {:.2f}"
    gpu: bool = False  # whether `change` also changes tensors, which are in a GPU's memory


class Words(NamedTuple):
    """What a run prints of its recipe."""

    dropped: str  # what `select` drops, as the title of a column; a format for `recipe`
    too_few: str  # the reason if it leaves too few rows
    label_source: str  # whose steering the label is
    aimed_at: str  # where the car should be
    remedy: str  # what helps a network that drives badly
    val_loss: str  # how it differs from the errors of the summary's table, after a line end; "" if it does not


@dataclass(frozen=True)
class Recipe:
    """How a network is trained. Shares and probabilities are 0..1, steering is -1..1, ranges are (least, most).

    A checkpoint contains the names of its functions; observations, views and sets are those of `observations.py`.
    """

    name: str
    words: Words
    # Data preprocessing
    # (recording, recipe) -> the observations of a checked recording that are used, with their labels
    select: Callable[..., Any]
    throttle_threshold: float  # rows with less throttle are dropped
    side_cameras: bool  # whether images are taken from all three cameras, not from the centre one alone
    side_correction: float  # steering added to the label of left images, subtracted from that of right ones
    resample: Callable[..., Any]  # (observations, recipe, seed) -> those for training; some left out, some repeated
    straight: float  # |steering| below which an observation is straight driving
    keep_straight: float  # probability that it is kept
    turn: tuple[float, float]  # range of |steering| in which a copy is added
    jitter: float  # by up to this share the copy's steering is changed
    repeats: int  # how often a recording of problem areas counts
    order: Callable[..., np.ndarray]  # (observations, recipe, rng) -> that of one pass over them: int (n,), indices
    # Data subdivision
    block_seconds: float  # of driving that are together for training or for validation
    folds: int  # one block of so many is for validation
    # Augmentation
    # (observations, rows, cameras, recipe, rng) -> images and labels of these rows, int (k,), before augmentation;
    # cameras: int (k,), 0 centre, 1 left, 2 right
    views: Callable[..., Any]
    augmentations: tuple[Augmentation, ...]
    flip: float  # share of the observations with a flipped image
    brightness: tuple[float, float]  # factor of the HSV value
    shadow: float  # share with a shadowed image
    darkness: tuple[float, float]  # factor of the HLS lightness in the shadow
    # Training
    network: str  # key of NETWORKS
    dropout: bool  # whether half of the units of the flattened layer are dropped
    optimizer: str  # key of OPTIMIZERS
    momentum: float  # of its average gradient
    weight_decay: float  # per step and unit of learning rate
    huber: float | None  # error beyond which the loss grows linearly, as Huber's; None: squared error
    learning_rate: float
    cosine_decay: bool  # of the learning rate, to zero at the end
    batch_size: int  # observations; each gives 3.7 images on average
    samples_per_epoch: int  # images at least; a fifth as many observations, at most 4,096, validate an epoch
    epochs: int
    validation_sets: Callable[..., list[Any]]  # (observations, recipe, seed) -> the sets to validate with
    best_by: str  # the metric of an epoch that tells best how its network drives: val_loss or val_drift
    # Recovery steering from other poses, in other light (--robust); the report has neither.
    exposure: Exposure = (0.0, 0.0)  # least mean and standard deviation of the images by which the network drives
    straight_weight: float = 1.0  # sampling weight on a straight; elsewhere |steering along the lane| is added
    mirrored: float = 0.0  # share of the poses seen in a mirrored world
    pose_offset: float = 0.0  # m: poses are at most this far from the lane's centre, most often near it
    pose_yaw: float = 0.0  # radians: standard deviation of their heading errors, which are normally distributed
    max_pose_yaw: float = 0.0  # radians
    max_shift: float = 0.0  # m from the recorded trajectory: further away the frames show too little of the road
    camera_reach: float = 0.0  # m: a camera this near to a pose may supply its image
    tinted: float = 0.0  # share of the images whose colours are changed
    saturation: tuple[float, float] = (1.0, 1.0)  # factors of the saturation,
    tint: tuple[float, float] = (1.0, 1.0)  # of red, green and blue each,
    dimmed: tuple[float, float] = (1.0, 1.0)  # and of all three
    shaded: float = 0.0  # share of the images with shadows
    disturbed: float = 0.0  # share of the images in foul weather, or of a dirty or faulty camera

    def __post_init__(self) -> None:
        """Take NumPy's numbers, of which a sweep may be made, for Python's, which a checkpoint can contain.

        Raises ValueError for a figure of another type, such as a rate for `dropout`, or beyond its LIMITS, such as
        percent for a share, and for another `best_by`, which would be asked for only after an epoch.
        """
        for item in fields(self):
            value = _python(getattr(self, item.name))
            if item.type in (bool, int, float) and type(value) not in (item.type, int if item.type is float else None):
                raise ValueError(f"{item.name} is {value!r}, not of type {item.type.__name__}")
            least, most = LIMITS.get(item.name, (-math.inf, math.inf))
            if item.type in (int, float) and not least <= value <= most:
                raise ValueError(f"{item.name} is {value!r}, not a number from {least:g} to {most:g}")
            object.__setattr__(self, item.name, value)
        for share in self.shares():
            if not 0 <= share <= 1:
                raise ValueError(f"a share of the augmentations is {share!r}, not a number from 0 to 1")
        if self.best_by not in ("val_loss", "val_drift"):
            raise ValueError(f"best_by is {self.best_by!r}, not 'val_loss' or 'val_drift'")

    def saved(self) -> dict[str, Any]:
        """Return the recipe as plain values for a checkpoint: functions and augmentations by their names."""
        return {item.name: _plain(getattr(self, item.name)) for item in fields(self) if item.name != "words"}

    def restored(self, saved: dict[str, Any]) -> "Recipe":
        """Return this recipe with the figures of `saved`; what an earlier version did not save is as it is.

        Raises ValueError for a figure that is unusable, and for other functions than this recipe's.
        """
        figures = {name: saved[name] for name in self.saved() if name in saved}
        for name, found in figures.items():
            own = getattr(self, name)
            if name in ("network", "optimizer"):
                known = NETWORKS if name == "network" else OPTIMIZERS
                if not isinstance(found, str) or found not in known:
                    raise ValueError(f"its {name} is {shown(found)}, not {' or '.join(known)}")
            elif isinstance(own, str) or callable(own) or name == "augmentations":
                if found != _plain(own):
                    raise ValueError(f"its {name} is {shown(found)}, not {_plain(own)}")
                figures[name] = own
            elif name == "huber":
                if not (found is None or is_number(found)):
                    raise ValueError(f"its huber is of type {type(found).__name__}")
            elif isinstance(own, tuple):
                if not isinstance(found, (list, tuple)) or [*map(type, found)] != [*map(type, own)]:
                    raise ValueError(f"its {name} is {shown(found)}, not {len(own)} numbers")
                figures[name] = tuple(found)
            elif type(found) is not type(own):
                raise ValueError(f"its {option_name(name)} is of type {type(found).__name__}")
        return replace(self, **figures)

    def on_gpu(self) -> bool:
        """Return whether a GPU can make the images; foul weather, and changes that take arrays alone, need the CPU."""
        return not self.disturbed and all(each.gpu or each.change is unchanged for each in self.augmentations)

    def shares(self) -> list[float]:
        """Return the share of the observations that have an image of each augmentation, 0..1."""
        found = [augmentation.share for augmentation in self.augmentations]
        return [getattr(self, share) if isinstance(share, str) else share for share in found]

    def rate(self, done: float) -> float:
        """Return the learning rate of the next step; done: the finished share of the run, 0..1."""
        return self.learning_rate * ((1 + math.cos(math.pi * done)) / 2) if self.cosine_decay else self.learning_rate


def option_name(name: str) -> str:
    """Return the option that sets a field: batch_size -> --batch-size; from_model -> --from."""
    return f"--{name.removesuffix('_model').replace('_', '-')}"


def _python(value: Any) -> Any:
    """Return NumPy's numbers as Python's, also those of a range, lists as tuples, and anything else as it is."""
    if type(value) in (tuple, list) or isinstance(value, np.ndarray):
        return tuple(map(_python, value))
    return value.item() if isinstance(value, np.generic) else value


def _plain(value: Any) -> Any:
    """Return a field's value as a checkpoint contains it."""
    if isinstance(value, Augmentation):
        return value.name
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return value.__name__ if callable(value) else value
