"""The scenery of the two tracks, the lake and the jungle: meshes, textures and plants, in any look."""

from dataclasses import replace

from cloning.road.track import Track
from simulator.scenery import jungle, lake
from simulator.scenery.looks import SHADOWED, make_shade_style
from simulator.scenery.parts import Scenery
from simulator.scenery.shade import Shade


def build(track: str, look: int = 0) -> Scenery:
    """Return the scenery of a track, "lake" or "jungle".

    Look 0 resembles the real simulator; any other number gives other light, textures and plants on the same road. Look
    n + SHADOWED is look n with shadows.
    """
    scenes = {"lake": lake, "jungle": jungle}[track]
    scenery = scenes.scenery(look % SHADOWED)
    style = make_shade_style(look)
    if style is None:
        return scenery
    shade = Shade(Track(track), scenery.meshes, scenery.light, style, scenes.SHADOW_ELEVATION)
    return replace(scenery, shade=shade)
