"""Looks: everything that may differ between two renderings of a road, such as light, weather, soil and colours."""

from dataclasses import dataclass

import numpy as np

from simulator.scenery.shade import ShadeStyle
from simulator.scenery.shapes import Colour, Light
from simulator.scenery.textures import ASPHALT_LEVEL

Palette = dict[str, Colour]
SHADOWED = 10_000  # look n + SHADOWED is look n with shadows; with n + 2 * SHADOWED and so on, they are other ones
# The first two styles of look 0's shadows resemble two real recordings of the jungle, in which the road's median colour
# in the shade is (0.26, 0.30, 0.39) and (0.18, 0.22, 0.30) of that in the sun; in these it is (0.29, 0.31, 0.34) and
# (0.20, 0.22, 0.25).
REAL_STYLES = (ShadeStyle(depth=1.35, softness=0.08), ShadeStyle(depth=1.75, softness=0.08))
# The least and the greatest depth of the other, random ones. With depths of up to 6, in one of ten looks, of 400, the
# jungle's road came out black in the shade; with these it keeps at least a twelfth of its light.
DEPTHS = (0.8, 3)
# The least mean value, of 255, of the road where it is darkest. In the darkest of 135 real frames its median value is
# 29, and hardly a pixel is black; without this limit it came out black in one of fifty looks with shadows.
DARKEST = 29
# Paint on a road is at least so many times as bright as its asphalt, by the brightest of red, green and blue; on the
# real tracks it is 1.45 to 1.8 times as bright. Without this limit, one look in six had lines darker than the
# road, as neither of these has, and there the network steered restlessly.
PAINT = ("line", "outer line", "white", "yellow")
PAINT_CONTRAST = 1.35


@dataclass(frozen=True)
class Look:
    """The appearance of a track; the defaults resemble the real simulator."""

    light: Light
    palette: Palette  # colours by name
    grain: float = 1.0  # factor of the contrast of the asphalt's grain
    spots: float = 1.0  # factor of the contrast of larger spots in the asphalt
    sheen: float = 0.28  # relative gain in brightness of asphalt far ahead
    stripes: float = 0.6  # metres of kerb for one red and one white stripe
    relief: float = 1.0  # factor of the heights next to the road
    shift: float = 0.0  # metres by which hills, soils and water are shifted along the road
    plants: float = 1.0  # factor of the number of trees and bushes
    shadows: int | None = None  # number of shadows anywhere on the road; None: those of the real simulator
    tone: np.ndarray | None = None  # float32 (3, 4): the camera's colour matrix, applied to (r, g, b, 1), 0..255


def make_look(look: int, light: Light, palette: Palette) -> Look:
    """Return a look of a track; light and palette are those of the real simulator, which look 0 uses as they are."""
    if not look:
        return Look(light, palette)
    rng = np.random.default_rng([look, 7])
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(18, 70))
    sun = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    overcast = rng.uniform(0, 0.7)  # share of the sunlight that clouds scatter over the sky
    strength = rng.uniform(0.65, 1.15) * rng.uniform(0.92, 1.08, 3)
    sunlight = np.array(light.sunlight) * strength * (1 - overcast)
    fill = (np.array(light.fill) * rng.uniform(0.8, 1.1) + 0.5 * overcast * np.array(light.sunlight)) * strength
    colours = {name: vary(rng, np.array(colour)) for name, colour in palette.items()}
    colours |= {name: brighten(colours[name], colours["asphalt"]) for name in PAINT if name in colours}
    contrast, saturation = rng.uniform(0.75, 1.25), rng.uniform(0.1, 1.3)
    return Look(
        Light(sun, tuple(sunlight), tuple(fill)),
        colours,
        grain=rng.uniform(0.25, 1.3),
        spots=rng.uniform(0.3, 2.5),
        sheen=rng.uniform(0, 0.5),
        stripes=rng.uniform(0.4, 1.6),
        relief=rng.uniform(0.2, 1.5),
        shift=rng.uniform(0, 1000),
        plants=rng.uniform(0.3, 1.2),
        shadows=int(rng.integers(5, 60)),
        tone=tone_matrix(contrast, saturation, rng.uniform(-18, 18) + rng.uniform(-4, 4, 3)),
    )


def make_shade_style(look: int) -> ShadeStyle | None:
    """Return the shadows of a look, random except for look 0's first two; None for a look without shadows."""
    edition, base = divmod(look, SHADOWED)
    if not edition:
        return None
    if not base and edition <= len(REAL_STYLES):
        return REAL_STYLES[edition - 1]
    rng = np.random.default_rng([look, 11])
    return ShadeStyle(
        depth=float(np.exp(rng.uniform(*np.log(DEPTHS)))),
        softness=float(np.exp(rng.uniform(*np.log((0.05, 0.8))))),
        elevation=rng.uniform(0.7, 1.2),
    )


def expose(tone: np.ndarray | None, darkest: np.ndarray) -> np.ndarray | None:
    """Return a tone as in `Look`, brighter if it would make the road darker than DARKEST.

    darkest: the road's colour where it is darkest, (3,), 0..255.
    """
    matrix = np.eye(3, 4, dtype=np.float32) if tone is None else tone
    lacking = DARKEST - float((matrix @ np.r_[darkest, 1]).mean())
    return tone if lacking <= 0 else np.c_[matrix[:, :3], matrix[:, 3] + lacking].astype(np.float32)


def vary(rng: np.random.Generator, colour: np.ndarray) -> Colour:
    """Return a variant of a colour (3,): darker or lighter, greyer, and tinted.

    It is greyer, because a network that recognises the road only by its grey fails on the real road, whose edges are
    grey or blue, too.
    """
    greyer = rng.uniform(0, 0.9)
    colour = (1 - greyer) * colour + greyer * colour.mean()
    red, green, blue = np.clip(colour * rng.uniform(0.5, 1.3) * rng.uniform(0.92, 1.08, 3), 0, 1)
    return red, green, blue


def brighten(paint: Colour, asphalt: Colour) -> Colour:
    """Return the colour of painted lines, brighter if they would stand out less than PAINT_CONTRAST from the road."""
    least = PAINT_CONTRAST * ASPHALT_LEVEL * max(asphalt)
    red, green, blue = np.minimum(np.array(paint) * max(1, least / max(paint)), 1)
    return red, green, blue


def tone_matrix(contrast: float, saturation: float, brightness: np.ndarray) -> np.ndarray:
    """Return the camera's colour matrix, float32 (3, 4).

    contrast, saturation: factors about middle grey; brightness: (3,), added to values 0..255.
    """
    grey = np.full((3, 3), 1 / 3)
    colours = contrast * (saturation * np.eye(3) + (1 - saturation) * grey)
    return np.c_[colours, 128 * (1 - contrast) + np.broadcast_to(brightness, 3)].astype(np.float32)
