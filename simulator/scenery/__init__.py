"""The scenery of the tracks, the lake, the jungle and generated roads: meshes, textures and plants, in any look."""

from cloning.road.generated import road_number
from simulator.scenery import generated, jungle, lake
from simulator.scenery.parts import Scenery


def build(track: str, look: int = 0) -> Scenery:
    """Return the scenery of a track that `cloning.road.track.Track` knows.

    Look 0 resembles the real simulator, or is a generated road's own; any other number gives other light, textures and
    plants on the same road.
    """
    number = road_number(track)
    if number is not None:
        return generated.scenery(number, look)
    return {"lake": lake, "jungle": jungle}[track].scenery(look)
