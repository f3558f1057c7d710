"""The scenery of the tracks, the lake, the jungle and generated roads: meshes, textures and plants, in any look."""

from dataclasses import replace

import numpy as np

from cloning.road.generated import PointRoad
from cloning.road.track import Track, find_points
from simulator.scenery import generated, jungle, lake
from simulator.scenery.looks import SHADOWED, expose, make_shade_style
from simulator.scenery.parts import Scenery
from simulator.scenery.shade import Shade


def build(source: str | PointRoad, look: int = 0) -> Scenery:
    """Return the scenery of a track; source: what `cloning.road.track.Track` takes.

    Look 0 resembles the real simulator, or is a road of points' own; any other number gives other light, textures and
    plants on the same road. Look n + SHADOWED is look n with shadows, and brighter if its road would be darker than in
    any real frame.
    """
    road_of_points, base = find_points(source), look % SHADOWED
    if road_of_points is None:
        scenes = {"lake": lake, "jungle": jungle}[str(source)]
        scenery, elevation = scenes.scenery(base), scenes.SHADOW_ELEVATION
    else:
        scenery, elevation = generated.scenery(road_of_points, base), generated.SHADOW_ELEVATION
    style = make_shade_style(look)
    if style is None:
        return scenery
    shade = Shade(Track(source), scenery.meshes, scenery.light, style, elevation)
    # The darkest 2 % of the asphalt are left out as single spots; the shade of cliffs, where it is part of the colours,
    # covers more.
    road = scenery.asphalt
    darkest = np.quantile(road.colours, 0.02, axis=0) * shade.factor * road.texture.mean()
    return replace(scenery, shade=shade, tone=expose(scenery.tone, darkest))
