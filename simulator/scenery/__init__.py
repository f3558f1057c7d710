"""What is to be seen on a track: meshes, textures and planting of the lake and of the jungle, in any look."""

from simulator.scenery import jungle, lake
from simulator.scenery.parts import Scenery


def build(track: str, look: int = 0) -> Scenery:
    """The scenery of a track; look 0 is the real simulator's, any other number another light, texture and
    planting."""
    return {"lake": lake, "jungle": jungle}[track].scenery(look)
