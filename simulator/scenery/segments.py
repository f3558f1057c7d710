"""A scenery in which each thing has the colour of its kind, for images of semantic segments."""

from dataclasses import replace

import numpy as np

from simulator.scenery.parts import Scenery
from simulator.scenery.shapes import Mesh
from simulator.scenery.textures import plain

# RGB. udacity-gym's programs take a blue of 255 for the road; the other colours are those of Cityscapes (1604.01685).
ROAD, VERGE, GROUND = (0, 0, 255), (244, 35, 232), (152, 251, 152)
PLANT, SKY, CAR = (107, 142, 35), (70, 130, 180), (0, 0, 142)


def segments(scenery: Scenery) -> Scenery:
    """Return the scenery in the colours of its segments, without light, haze and shadows.

    Road is the asphalt with its lines, and a bridge's cobbles; verge is what lies or stands along one side.
    """

    def kind(mesh: Mesh) -> tuple[int, int, int]:
        if mesh.road is None:
            return PLANT if mesh.texture.shape[2] == 4 else GROUND
        return ROAD if mesh.road[:, 1].min() < 0 < mesh.road[:, 1].max() else VERGE

    return replace(
        scenery,
        meshes=[painted(mesh, kind(mesh)) for mesh in scenery.meshes],
        sky=painted(scenery.sky, SKY),
        bonnet=painted(scenery.bonnet, CAR),
        haze=None,
        tone=None,
        shade=None,
    )


def painted(mesh: Mesh, colour: tuple[int, int, int]) -> Mesh:
    """Return a mesh in one colour; of a plant's texture only its outline is left."""
    texture = plain()
    if mesh.texture.shape[2] == 4:
        texture = mesh.texture.copy()
        texture[..., :3] = 255
    shown = (np.array(colour) + 1.5) / 255  # the engine rounds down twice
    return replace(mesh, colours=np.broadcast_to(shown, mesh.points.shape), texture=texture, sheen=0.0)
