"""The networks of the study: how they differ, and the training of one."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

import model
from cloning.training import light, robust
from cloning.training.observations import Views

# A network is to take a minute on one core. The report's 43 steps an epoch would teach it little in so few images, so
# the recipe's networks take other steps than the report's: of 16 observations, not 128, at a rate of 5e-4, not 1e-4.
EPOCH_IMAGES = 2528  # an eighth of the report's epoch
RECIPE = ("--batch-size", "16", "--learning-rate", "5e-4", "--epochs", "8")
ROBUST = ("--robust", "--epochs", "6")
DRAWN = "drawn-lake"  # the recording of a lap in the stand-in simulator
SEEDS = range(5)


class Track(NamedTuple):
    """What the networks of one track are trained on, and how they are measured.

    train       the real recording that they are trained on if nothing else is said
    held_out    the real recording that none of them is trained on
    speed       mph, of the laps in the stand-in simulator
    directions  of these laps, one each
    """

    train: str
    held_out: str
    speed: float
    directions: tuple[str, ...]


TRACKS = {
    "lake": Track("lake-ccw", "lake-cw", 30, ("ccw", "cw")),
    "jungle": Track("jungle", "jungle-shadows", 15, ("ccw",)),
}


class Variant(NamedTuple):
    """One network of the study.

    kind        what it has in common with those that differ by their seed only
    track       key of TRACKS
    recordings  names of the recordings that it is trained on
    options     of model.py
    seed        of the training
    alteration  key of ALTERATIONS, or "": model.py as it is
    recovers    whether its recovery is measured, too
    """

    kind: str
    track: str
    recordings: tuple[str, ...]
    options: tuple[str, ...]
    seed: int
    alteration: str = ""
    recovers: bool = False

    @property
    def name(self) -> str:
        """The network's name, which is also that of its folder."""
        return re.sub(r"[^a-z0-9.]+", "-", f"{self.track} {self.kind} seed {self.seed}")


# ----------------------------------------------------------------------------------------------------------------------
# What model.py has no option for, because nobody should train like that, except to see what it is worth


def no_flip() -> None:
    """Make no mirrored images."""
    model.FLIP = 0.0


def no_shadow() -> None:
    """Make no shadowed images."""
    model.SHADOW = 0.0


def no_resampling() -> None:
    """Keep every observation once."""
    model.KEEP_STRAIGHT, model.TURN = 1.0, (2.0, 2.0)  # no |steering| is above 1


def centre_only() -> None:
    """Use the centre camera alone."""
    views = model.ReportObservations.sample_views

    def centred(
        self: model.ReportObservations,
        rows: np.ndarray,
        cameras: np.ndarray,
        side_correction: float,
        rng: np.random.Generator,
    ) -> Views:
        return views(self, rows, np.zeros_like(cameras), side_correction, rng)

    model.ReportObservations.sample_views = centred  # type: ignore[method-assign]


def same_light() -> None:
    """Leave out what --robust does to the light, beyond the recipe's own two kinds of image."""
    light.TINTED_SHARE = light.SHADED_SHARE = 0.0


def shifts_only() -> None:
    """Shift the car, but don't turn it, and leave the light as it is."""
    robust.YAW_DEVIATION = 0.0
    same_light()


ALTERATIONS: dict[str, Callable[[], None]] = {
    "centre camera": centre_only,
    "no flip": no_flip,
    "no shadow": no_shadow,
    "no resampling": no_resampling,
    "shifts": shifts_only,
    "shifts, rotations": same_light,
}


# ----------------------------------------------------------------------------------------------------------------------
# The plan


def plan() -> list[Variant]:
    """Return all networks of the study, those first whose kinds have five seeds."""
    return [*recovering(), *others("jungle"), *others("lake")]


def recovering() -> list[Variant]:
    """Return the networks whose recovery is measured: five kinds, from the centre camera alone to --robust."""
    kinds = {"centre camera": RECIPE, "recipe": RECIPE, "shifts": ROBUST, "shifts, rotations": ROBUST, "robust": ROBUST}
    usual = (TRACKS["lake"].train,)
    return [
        Variant(kind, "lake", usual, options, seed, kind if kind in ALTERATIONS else "", recovers=True)
        for seed in SEEDS
        for kind, options in kinds.items()
    ]


def others(name: str) -> list[Variant]:
    """Return a track's other networks, one or three seeds each."""
    usual = (TRACKS[name].train,)
    other = (TRACKS["jungle" if name == "lake" else "lake"].train,)

    def recipe(
        kind: str, *more: str, alteration: str = "", recordings: tuple[str, ...] = usual, seed: int = 0
    ) -> Variant:
        return Variant(kind, name, recordings, (*RECIPE, *more), seed, alteration)

    def robust_kind(kind: str, *more: str, recordings: tuple[str, ...] = usual, seed: int = 0) -> Variant:
        return Variant(kind, name, recordings, (*ROBUST, *more), seed)

    variants = []
    if name == "jungle":  # the lake's are those of `recovering`
        for seed in SEEDS[:3]:
            variants += [recipe("recipe", seed=seed), robust_kind("robust", seed=seed)]
    variants += [recipe(f"recipe, {epochs} epochs", "--epochs", epochs) for epochs in ("1", "2", "4", "20")]
    variants += [robust_kind(f"robust, {epochs} epochs", "--epochs", epochs) for epochs in ("1", "2", "20")]
    variants += [recipe(f"side correction {value}", "--side-correction", value) for value in ("0", "0.1", "0.3", "0.4")]
    variants += [recipe(kind, alteration=kind) for kind in ("no flip", "no shadow", "no resampling")]
    variants += [
        recipe("no throttle filter", "--throttle-threshold", "-1"),
        recipe("recipe, both tracks", recordings=usual + other),
        robust_kind("robust, both tracks", recordings=usual + other),
        recipe("recipe, other track", recordings=other),
        robust_kind("robust, other track", recordings=other),
    ]
    if name == "lake":
        variants += [
            recipe("recipe, drawn", recordings=(DRAWN,)),
            recipe("recipe, real + drawn", recordings=(*usual, DRAWN)),
        ]
    return variants


def train(variant: Variant, recordings: Path, folder: Path, epoch_images: int) -> int:
    """Train a network into `folder`, continuing if it was begun there; return model.py's exit status.

    recordings: the folder of the real recordings; the drawn one is beside `folder`. Alters modules of this process,
    which is to train no other network.
    """
    if variant.alteration:
        ALTERATIONS[variant.alteration]()
    folder.mkdir(parents=True, exist_ok=True)
    sources = [str((folder.parent if name == DRAWN else recordings) / name) for name in variant.recordings]
    more = ["--samples-per-epoch", str(epoch_images), "--seed", str(variant.seed), "--device", "cpu", "--resume"]
    return model.main([*sources, *variant.options, *more, "--output", str(folder / "model.pt")])
