"""What stands around the lake: trees, bushes, rocks, pylons and far hills; `land` is the lake's."""

import numpy as np

from simulator.scenery import textures
from simulator.scenery.shapes import Light, Mesh, boulder, grid, lit, plants, together

BOULDERS = (
    (1, 330, 32, 20, 7),
    (-1, 170, 40, 12, 8),
    (-1, 195, 34, 9, 7),
    (-1, 155, 60, 14, 8),
    (1, 30, 70, 10, 4),
    (-1, 868, 60, 16, 7),
    (-1, 905, 60, 18, 8),
    (1, 960, 45, 12, 5),
    (1, 975, 90, 16, 6),
    (1, 750, 60, 16, 4),
    (1, 720, 120, 22, 6),
    (-1, 60, 45, 14, 5),
    (1, 600, 150, 25, 8),
    (-1, 700, 160, 40, 9),
    (-1, 1060, 60, 18, 6),
)


def pines(land, random, palette: dict, many: float) -> list[Mesh]:
    """Forest on the hills to the right, single trees and bushes elsewhere, reeds at the water; many: factor of their
    number."""
    track, length = land.track, land.track.length
    low, high = track.points[:, :2].min(axis=0) - 210, track.points[:, :2].max(axis=0) + 210
    places = random.uniform(low, high, (round(5200 * many), 2))
    away, s, side = land.nearest_road(places)
    z = land.height(places)
    forest = (side < 0) & ((s > 120) & (s < 545))
    chance = np.where(forest, 0.9, 0.22) * np.clip((away - 11) / 20, 0, 1) * np.clip((z + 0.6) * 2, 0, 1)
    chance = np.where(away > 150, chance * 0.5, chance)
    keep = (random.uniform(size=len(places)) < chance) & (away > 13) & (away < 210)
    places = np.c_[places, z - 0.3][keep]
    tall = random.uniform(8, 15, len(places))
    tone = random.uniform(0.75, 1.2, (len(places), 1))
    colours = np.clip(np.array(palette["pine"]) * tone, 0, 1)
    meshes = []
    for kind in range(3):
        mine = np.arange(len(places)) % 3 == kind
        meshes.append(
            plants(
                places[mine],
                tall[mine],
                0.52 * tall[mine],
                colours[mine],
                textures.pine(random, low=(0.62, 0.5, 0.75)[kind]),
                random,
            )
        )
    for texture, colour, count, near, far, tallest in (
        (textures.bush(random), palette["bush"], round(900 * many), 9.5, 28, 1.4),
        (textures.reeds(random), palette["reeds"], round(260 * many), 9.5, 16, 2.6),
    ):
        along = random.uniform(0, length, count)
        along = (along // 22) * 22 + random.normal(0, 4, count)  # in clumps
        left = random.choice((-1, 1), count) * random.uniform(near, far, count)
        index = np.floor(along / track.step).astype(int) % len(track.points)
        spot = track.points[index, :2] - track.rightward[index] * left[:, None]
        z = land.height(spot)
        clear = (land.nearest_road(spot)[0] > near - 0.5) & (z > land.WATER)
        spot, z = spot[clear], z[clear]
        size = random.uniform(0.5, 1.0, len(spot)) * tallest
        colours = np.clip(np.array(colour) * random.uniform(0.7, 1.15, (len(spot), 1)), 0, 1)
        meshes.append(plants(np.c_[spot, z - 0.1], size, 1.9 * size, colours, texture, random))
    return meshes


def pylons(land, light: Light) -> list[Mesh]:
    """The line of pylons behind the bridge, and its wires."""
    feet = np.array([[-150.0, -230.0], [-60, -205], [30, -190], [125, -175], [205, -95], [150, 5], [90, 75]])
    feet = np.c_[feet, np.full(len(feet), 0.0)]
    blue, line = (0.22, 0.30, 0.42), textures.line()
    beams = []
    for foot in feet:
        for lean in ((-2.2, -2.2), (2.2, -2.2), (2.2, 2.2), (-2.2, 2.2)):
            for start, end in ((0.0, 0.5), (0.5, 1.0)):
                a = foot + np.array([*(np.array(lean) * (1 - 0.8 * start)), 26 * start])
                b = foot + np.array([*(np.array(lean) * (1 - 0.8 * end)), 26 * end])
                beams.append(beam(a, b, 0.13, blue, line))
        for height in (5, 10, 15, 20):
            reach = 2.2 * (1 - 0.8 * height / 26)
            for side in (reach, -reach):
                start, end = np.array([[side, -reach, height], [-side, reach, height + 4]])
                beams.append(beam(foot + start, foot + end, 0.09, blue, line))
        for height in (19, 23):
            start, end = np.array([[-4.5, 0, height], [4.5, 0, height]])
            beams.append(beam(foot + start, foot + end, 0.12, blue, line))
    return [together(beams)]


def beam(a, b, half, colour, texture) -> Mesh:
    """A thin upright strip from a to b, crossed with another."""
    quads = []
    for aside in ((half, 0, 0), (0, half, 0)):
        quads += [a - np.array(aside), a + np.array(aside), b + np.array(aside), b - np.array(aside)]
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    return Mesh(np.array(quads), np.tile(np.array(colour), (8, 1)), np.zeros((8, 2)), faces, texture)


def rocks(land, random, light: Light, palette: dict) -> Mesh:
    track, texture = land.track, textures.rock(random)
    made = []
    for side, s, away, wide, tall in BOULDERS:
        place = track.at(s - land.moved, -side * away)
        here = np.array([[place.x, place.y]])
        if land.nearest_road(here)[0] < wide + 12:  # moved onto the road
            continue
        z = float(land.height(here)[0])
        made.append(
            boulder(
                (place.x, place.y, max(z, land.WATER)),
                (wide, 0.7 * wide, tall),
                random,
                palette["rock"],
                texture,
            )
        )
    return lit(together(made), light)


def mountains(random, light: Light, palette: dict, soil) -> Mesh:
    """A ring of far hills, which the haze turns blue."""
    turn = np.linspace(0, 2 * np.pi, 121)
    crest = 14 + 16 * np.abs(textures.clouds(random, 256, 24, 4)[0, :120] + 0.5)
    crest = np.r_[crest, crest[:1]]
    radius = np.array([430.0, 520.0, 640.0])[:, None]
    points = np.stack(
        [
            radius * np.cos(turn),
            radius * np.sin(turn),
            np.stack([np.full(121, -2.0), 0.6 * crest, 0.0 * crest + crest]),
        ],
        axis=-1,
    ).reshape(-1, 3)
    uv = np.stack(np.broadcast_arrays(turn * 8, np.array([0, 1, 2.0])[:, None]), axis=-1).reshape(-1, 2)
    colours = np.tile(np.array(palette["grass"]), (len(points), 1))
    return lit(Mesh(points, colours, uv, grid(3, 121), soil), light, faced_up=True)
