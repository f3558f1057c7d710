"""Looks: what may differ between two drawings of the same road, as hour, weather, soil and cameras do."""

from dataclasses import dataclass

import numpy as np

from simulator.scenery.shapes import Light


@dataclass(frozen=True)
class Look:
    """The defaults are the real simulator's.

    palette: colours, RGB 0..1, by name. grain, spots: factors of the contrast of the asphalt's stones, and of what is
    larger in it. sheen: by how much the asphalt is brighter far ahead. stripes: metres of kerb for a red and a white
    one. relief: factor of the heights beside the road; moved: metres along the road by which the land, its hills, soils
    and water, lies elsewhere. plants: factor of the number of trees and bushes. shadows: None for the real ones, else
    how many trees and posts cast one on the road. tone: what the camera makes of colours (r, g, b, 1), float32 (3, 4),
    None for nothing.
    """

    light: Light
    palette: dict[str, tuple[float, float, float]]
    grain: float = 1.0
    spots: float = 1.0
    sheen: float = 0.28
    stripes: float = 0.6
    relief: float = 1.0
    moved: float = 0.0
    plants: float = 1.0
    shadows: int | None = None
    tone: np.ndarray | None = None


def make_look(number: int, light: Light, palette: dict) -> Look:
    """A track's look of this number from its real light and colours; number 0 changes nothing."""
    if not number:
        return Look(light, palette)
    random = np.random.default_rng([number, 7])
    turn, rise = random.uniform(0, 2 * np.pi), np.radians(random.uniform(18, 70))
    sun = (np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise))
    overcast = random.uniform(0, 0.7)  # how much of the sun's light comes from the whole sky instead
    strength = random.uniform(0.65, 1.15) * random.uniform(0.92, 1.08, 3)
    sunlight = np.array(light.sunlight) * strength * (1 - overcast)
    fill = (np.array(light.fill) * random.uniform(0.8, 1.1) + 0.5 * overcast * np.array(light.sunlight)) * strength
    colours = {name: other(random, np.array(colour)) for name, colour in palette.items()}
    contrast, saturation = random.uniform(0.75, 1.25), random.uniform(0.1, 1.3)
    return Look(
        Light(sun, tuple(sunlight), tuple(fill)),
        colours,
        grain=random.uniform(0.25, 1.3),
        spots=random.uniform(0.3, 2.5),
        sheen=random.uniform(0, 0.5),
        stripes=random.uniform(0.4, 1.6),
        relief=random.uniform(0.2, 1.5),
        moved=random.uniform(0, 1000),
        plants=random.uniform(0.3, 1.2),
        shadows=int(random.integers(5, 60)),
        tone=tone(contrast, saturation, random.uniform(-18, 18) + random.uniform(-4, 4, 3)),
    )


def other(random, colour: np.ndarray) -> tuple:
    """Another colour in this one's place: darker or lighter, greyer, and tinted. A network that tells the road by its
    being greyer than the land does not see the real one, whose edges are grey or blue too."""
    greyer = random.uniform(0, 0.9)
    colour = (1 - greyer) * colour + greyer * colour.mean()
    return tuple(np.clip(colour * random.uniform(0.5, 1.3) * random.uniform(0.92, 1.08, 3), 0, 1))


def tone(contrast: float, saturation: float, brighter) -> np.ndarray:
    """The matrix of a camera's tone about middle grey: float32 (3, 4); brighter: (3,), of 255."""
    grey = np.full((3, 3), 1 / 3)
    colours = contrast * (saturation * np.eye(3) + (1 - saturation) * grey)
    return np.c_[colours, 128 * (1 - contrast) + np.broadcast_to(brighter, 3)].astype(np.float32)
