"""The lake's scenery: a flat road on asphalt with kerbs, concrete edges and a cobbled bridge.

Positions of features along the road were read off frames of the real simulator, as were the colours.
"""

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from cloning.road.track import LEFT, RIGHT, ROADS, Section, Track
from simulator.scenery import lake_terrain, looks, planting, textures
from simulator.scenery.looks import Look, Palette
from simulator.scenery.parts import Haze, Scenery, assemble
from simulator.scenery.shapes import Light, Material, Mesh, distances, illuminate, ribbon, roadside, surface, wall
from simulator.scenery.textures import Line

ROAD = ROADS["lake"]
ASPHALT_EDGE = ROAD.kerb_edge  # m from the centre line to the end of the asphalt, under the kerbs
SLAB_EDGE = 7.0  # m from the centre line to the end of the concrete slabs next to the asphalt
INNER_LINE = 3.5  # m from the centre line to the middle of the inner yellow line
# Sections with red earth instead of concrete next to the asphalt
VERGES = (Section(RIGHT, 62, 106), Section(RIGHT, 845, 860))


PALETTE: Palette = {
    "zenith": (0.19, 0.31, 0.55),
    "horizon": (0.62, 0.74, 0.88),
    "asphalt": (0.67, 0.69, 0.625),
    "line": (0.88, 0.76, 0.26),
    "outer line": (0.72, 0.63, 0.28),
    "seam": (0.36, 0.35, 0.32),
    "slab": (0.93, 0.92, 0.86),
    "kerb": (1.0, 0.98, 0.95),
    "cobbles": (0.80, 0.72, 0.66),
    "grass": (1.0, 0.87, 0.45),
    "green": (0.50, 0.50, 0.18),
    "earth": (0.88, 0.64, 0.40),
    "sand": (0.96, 0.84, 0.62),
    "cliff": (0.46, 0.54, 0.48),
    "rock": (0.96, 0.94, 0.86),
    "pine": (0.40, 0.42, 0.21),
    "bush": (0.24, 0.28, 0.10),
    "reeds": (0.26, 0.36, 0.12),
    "water": (0.60, 0.72, 0.87),
    "bonnet": (0.62, 0.61, 0.56),
}
# Degrees: elevation of the sun that casts the shadows of shadowed looks, lower than LIGHT has it: 7 % of look 10,000's
# road lie in the shade, 2 % of a real recording's, too few to learn from.
SHADOW_ELEVATION = 24.0
LIGHT = Light(sun=(0.78, -0.10, 0.62), sunlight=(0.74, 0.68, 0.50), fill=(0.56, 0.61, 0.68))
HAZE = Haze((0.41, 0.60, 0.85), (100, 600), 0.8)


def road_texture(rng: Generator, look: Look) -> np.ndarray:
    """Return asphalt as wide as the road, with its double lines and the seam between them."""
    palette = look.palette
    lines = (
        Line(3.72, 0.17, palette["seam"]),
        Line(INNER_LINE, 0.05, palette["line"]),
        Line(ROAD.edge, 0.04, palette["outer line"]),
    )
    asphalt = textures.asphalt(rng, grain=0.15 * look.grain, spots=look.spots)
    return textures.paint_lines(asphalt, palette["asphalt"], ASPHALT_EDGE, lines)


def road(track: Track, rng: Generator, look: Look, soil: np.ndarray, shadows: np.ndarray) -> list[Mesh]:
    """Return the asphalt with its lines, the roadside, the kerbs and the bridge.

    shadows: ellipses on the asphalt with soft edges, (n, 4): s and lateral offset of the centre, and half axes, m.
    """
    s, palette = distances(0, track.length, 2.0), look.palette
    offsets = np.linspace(-ASPHALT_EDGE, ASPHALT_EDGE, 7)
    shade = np.ones((len(s), len(offsets), 3))
    for middle, right, half_length, half_width in shadows:
        along = ((s - middle + track.length / 2) % track.length - track.length / 2)[:, None] / half_length
        inside = np.clip(1.6 - np.hypot(along, (offsets - right) / half_width) * 1.2, 0, 1)[..., None]
        shade *= 1 - 0.5 * inside
    asphalt = Material(np.array(palette["asphalt"]) * shade, road_texture(rng, look), 2 * ASPHALT_EDGE)
    slabs = Material(palette["slab"], textures.concrete(rng), 3.0, across=(0, 0.5, 0.9, 1))
    stripes = Material(palette["kerb"], textures.kerb(), look.stripes, across=(0, 1))
    kerbs = [(distances(kerb.start, kerb.end), kerb.side) for kerb in ROAD.kerbs]
    return [
        replace(surface(track, s, ASPHALT_EDGE, asphalt), sheen=look.sheen),
        *slabs_and_verges(track, look, slabs, soil),
        *(roadside(track, *kerb, (3.86, 4.93), (0.03, 0.06), stripes) for kerb in kerbs),
        *bridge(track, rng, palette, offsets),
    ]


def slabs_and_verges(track: Track, look: Look, slabs: Material, soil: np.ndarray) -> list[Mesh]:
    """Return the concrete slabs on both sides of the road and the verges between them."""
    light = look.light
    bright = Light(light.sun, tuple(1.25 * np.array(light.sunlight)), tuple(0.75 * np.array(light.fill)))
    earth = Material(look.palette["earth"], soil, 9.0)
    meshes = []
    for side in (LEFT, RIGHT):
        verges = [(verge.start, verge.end) for verge in VERGES if verge.side == side]
        breaks = sorted([*verges, ROAD.bridge])
        starts, ends = [0.0, *(end for _, end in breaks)], [*(start for start, _ in breaks), track.length]
        for start, end in zip(starts, ends, strict=True):
            s, offsets = distances(start, end, 3.0), (ASPHALT_EDGE, 5.9, SLAB_EDGE, SLAB_EDGE + 0.2)
            low = roadside(track, s, side, offsets, (0.01, 0.05, 0.08, -0.5), slabs)
            # Lit as if they rose steeply, because the real slabs look white or blue although they are low.
            steep = illuminate(roadside(track, s, side, offsets, (0, 0.9, 1.9, 2.0), slabs), bright, face_up=True)
            meshes.append(replace(low, colours=steep.colours))
        for start, end in verges:
            offsets, heights = (3.35, 3.8, 6.0, 12.0), (0.012, 0.016, 0.02, 0.1)
            verge_mesh = roadside(track, distances(start, end, 2.0), side, offsets, heights, earth)
            meshes.append(illuminate(verge_mesh, light, face_up=True))
    return meshes


def bridge(track: Track, rng: Generator, palette: Palette, offsets: np.ndarray) -> list[Mesh]:
    """Return the cobbles on the bridge and its low black walls."""
    s = distances(*ROAD.bridge)
    cobbles = Material(palette["cobbles"], textures.cobbles(rng), 4.5)
    black, grey = (Material((level,) * 3, textures.plain(), 4.0, across=(0, 1)) for level in (0.03, 0.14))
    meshes = [ribbon(track, s, offsets, 0.02, cobbles)]
    for side in (LEFT, RIGHT):
        meshes += wall(track, s, side, [(4.9, 0), (4.9, 0.75)], black)
        meshes += wall(track, s, side, [(4.9, 0.75), (5.5, 0.75)], grey)  # the sky on its top
        meshes += wall(track, s, side, [(5.5, 0.75), (5.5, -2)], black)
    return meshes


def scenery(look: int) -> Scenery:
    """Return the lake's scenery in a look; the calls draw from one generator, so their order matters."""
    rng = np.random.default_rng(look)
    track, appearance = Track("lake"), looks.make_look(look, LIGHT, PALETTE)
    light, palette = appearance.light, appearance.palette
    terrain = lake_terrain.LakeTerrain(track, rng, appearance.relief, appearance.shift)
    water = lake_terrain.water(rng, palette)
    soil = textures.soil(rng)
    if appearance.shadows is None:
        shadows = lake_terrain.read_table("lake_shadows.csv")
    else:
        shadows, half_lengths = np.empty((appearance.shadows, 4)), (0.5, 0.5, 3.0, 5.0, 12.0)
        for row in shadows:
            row[:] = rng.uniform(0, track.length), -rng.uniform(-4, 4), rng.choice(half_lengths), rng.uniform(2, 9)
    meshes = [
        *lake_terrain.ground(terrain, rng, light, palette, soil),
        *road(track, rng, appearance, soil, shadows),
        water,
        planting.mountains(rng, light, palette["grass"], soil),
        planting.boulders(terrain, rng, light, palette),
        *planting.pines(terrain, rng, palette, appearance.plants),
        *planting.undergrowth(terrain, rng, palette, appearance.plants),
        planting.pylons(),
    ]
    return assemble(meshes, appearance, HAZE)
