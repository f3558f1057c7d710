"""The networks of the study, and how they differ."""

import re
from dataclasses import replace
from typing import NamedTuple

import model
from cloning.training.recipe import Recipe

# A network is to take a minute on one core. The report's 43 steps an epoch would teach it little in so few images, so
# the recipe's networks take other steps than the report's: of 16 observations, not 128, at a rate of 5e-4, not 1e-4.
EPOCH_IMAGES = 2528  # an eighth of the report's epoch
RECIPE = replace(model.REPORT, batch_size=16, learning_rate=5e-4, epochs=8)
ROBUST = replace(model.ROBUST, epochs=6)
RENDERED = "rendered-lake"  # the recording of a lap in the stand-in simulator


class Track(NamedTuple):
    """What the networks of one track are trained on, and how they are measured."""

    train: str  # the real recording that they are trained on if nothing else is said
    held_out: str  # the real recording that none of them is trained on
    speed: float  # mph, of the laps in the stand-in simulator
    directions: tuple[str, ...]  # of these laps, one each


TRACKS = {
    "lake": Track("lake-ccw", "lake-cw", 30, ("ccw", "cw")),
    "jungle": Track("jungle", "jungle-shadows", 15, ("ccw",)),
}


class Variant(NamedTuple):
    """One network of the study."""

    method: str  # how it is trained, in words: that of networks which differ by their seed only
    recipe: Recipe  # the same, in figures
    track: str  # key of TRACKS
    recordings: tuple[str, ...]  # names of the recordings that it is trained on
    seed: int = 0  # of the training
    recovers: bool = False  # whether its recovery is measured, too

    @property
    def name(self) -> str:
        """The network's name, which is also that of its folder."""
        return re.sub(r"[^a-z0-9.]+", "-", f"{self.track} {self.method} seed {self.seed}")


UNLIT = replace(ROBUST, tinted=0.0, shaded=0.0)  # the light is changed by the report's augmentations alone
RECOVERING = {  # by method; each has five seeds
    "centre camera": replace(RECIPE, side_cameras=False),
    "recipe": RECIPE,
    "shifts": replace(UNLIT, pose_yaw=0.0),
    "shifts, rotations": UNLIT,
    "robust": ROBUST,
}
OTHERS = {  # by method; on each track
    **{f"recipe, {n} epochs": replace(RECIPE, epochs=n) for n in (1, 2, 4, 20)},
    **{f"robust, {n} epochs": replace(ROBUST, epochs=n) for n in (1, 2, 20)},
    **{f"side correction {side:g}": replace(RECIPE, side_correction=side) for side in (0.0, 0.1, 0.3, 0.4)},
    "no flip": replace(RECIPE, flip=0.0),
    "no shadow": replace(RECIPE, shadow=0.0),
    "no resampling": replace(RECIPE, keep_straight=1.0, turn=(2.0, 2.0)),  # no |steering| is above 1
    "no throttle filter": replace(RECIPE, throttle_threshold=-1.0),
}


def plan() -> list[Variant]:
    """Return all networks of the study, those first whose recovery is measured."""
    both = {"recipe": RECIPE, "robust": ROBUST}
    lake, jungle = ((TRACKS[track].train,) for track in ("lake", "jungle"))
    found = [
        Variant(method, recipe, "lake", lake, seed, recovers=True)
        for seed in range(5)
        for method, recipe in RECOVERING.items()
    ]
    found += [Variant(method, recipe, "jungle", jungle, seed) for seed in range(3) for method, recipe in both.items()]
    for track, usual, other in (("jungle", jungle, lake), ("lake", lake, jungle)):
        found += [Variant(method, recipe, track, usual) for method, recipe in OTHERS.items()]
        for words, recordings in (("both tracks", usual + other), ("other track", other)):
            found += [Variant(f"{method}, {words}", recipe, track, recordings) for method, recipe in both.items()]
    for words, recordings in (("rendered", (RENDERED,)), ("real + rendered", (*lake, RENDERED))):
        found.append(Variant(f"recipe, {words}", RECIPE, "lake", recordings))
    return found
