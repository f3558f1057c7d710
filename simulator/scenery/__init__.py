"""The scenery of the two tracks, the lake and the jungle: meshes, textures and plants, in any look."""

from simulator.scenery import jungle, lake
from simulator.scenery.parts import Scenery


def build(track: str, look: int = 0) -> Scenery:
    """Return the scenery of a track, "lake" or "jungle".

    Look 0 resembles the real simulator; any other number gives other light, textures and plants on the same road.
    """
    return {"lake": lake, "jungle": jungle}[track].scenery(look)
