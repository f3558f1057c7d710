"""Objects around the lake: trees, bushes, boulders, pylons and distant hills."""

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from cloning.road.track import LEFT, RIGHT
from simulator.scenery import textures
from simulator.scenery.lake_terrain import WATER_LEVEL, LakeTerrain, read_table
from simulator.scenery.looks import Palette
from simulator.scenery.shapes import Colour, Light, Mesh, boulder, illuminate, merge, plants, quads, sheet

PYLONS = ((-150, -230), (-60, -205), (30, -190), (125, -175), (205, -95), (150, 5), (90, 75))  # m
PYLON_COLOUR = (0.22, 0.30, 0.42)


def pines(terrain: LakeTerrain, rng: Generator, palette: Palette, density: float) -> list[Mesh]:
    """Return a forest on the hills to the right and scattered pines elsewhere; density: factor of their number."""
    points = terrain.track.points[:, :2]
    low, high = points.min(axis=0) - 210, points.max(axis=0) + 210
    positions = rng.uniform(low, high, (round(5200 * density), 2))
    distance, s, side = terrain.nearest_road(positions)
    z = terrain.height(positions)
    forest = (side == RIGHT) & ((s > 120) & (s < 545))
    chance = np.where(forest, 0.9, 0.22) * np.clip((distance - 11) / 20, 0, 1) * np.clip((z + 0.6) * 2, 0, 1)
    chance = np.where(distance > 150, chance * 0.5, chance)
    keep = (rng.uniform(size=len(positions)) < chance) & (distance > 13) & (distance < 210)
    feet = np.c_[positions, z - 0.3][keep]
    heights = rng.uniform(8, 15, len(feet))
    colours = np.clip(np.array(palette["pine"]) * rng.uniform(0.75, 1.2, (len(feet), 1)), 0, 1)
    meshes = []
    for i, lowest_branches in enumerate((0.62, 0.5, 0.75)):
        texture, height = textures.pine(rng, low=lowest_branches), heights[i::3]
        meshes.append(plants(feet[i::3], height, 0.52 * height, colours[i::3], texture, rng))
    return meshes


def undergrowth(terrain: LakeTerrain, rng: Generator, palette: Palette, density: float) -> list[Mesh]:
    """Return bushes and reeds in clumps next to the road; density: factor of their number."""
    track = terrain.track
    meshes = []
    for texture, colour, count, near, far, tallest in (
        (textures.bush(rng), palette["bush"], round(900 * density), 9.5, 28, 1.4),
        (textures.reeds(rng), palette["reeds"], round(260 * density), 9.5, 16, 2.6),
    ):
        s = rng.uniform(0, track.length, count)
        s = (s // 22) * 22 + rng.normal(0, 4, count)
        right = rng.choice((RIGHT, LEFT), count) * rng.uniform(near, far, count)
        index = np.floor(s / track.step).astype(int) % len(track.points)
        positions = track.points[index, :2] + track.rightward[index] * right[:, None]
        z = terrain.height(positions)
        clear = (terrain.nearest_road(positions)[0] > near - 0.5) & (z > WATER_LEVEL)
        positions, z = positions[clear], z[clear]
        heights = rng.uniform(0.5, 1.0, len(positions)) * tallest
        colours = np.clip(np.array(colour) * rng.uniform(0.7, 1.15, (len(positions), 1)), 0, 1)
        meshes.append(plants(np.c_[positions, z - 0.1], heights, 1.9 * heights, colours, texture, rng))
    return meshes


def pylons() -> Mesh:
    """Return the line of pylons behind the bridge; each beam is two crossed strips."""
    beams = []

    def add(foot: np.ndarray, begin: ArrayLike, end: ArrayLike, half_width: float) -> None:
        a, b = foot + np.array(begin), foot + np.array(end)
        strips = [[a - side, a + side, b + side, b - side] for side in half_width * np.eye(2, 3)]
        beams.append(quads(np.array(strips), PYLON_COLOUR, textures.plain()))

    for x, y in PYLONS:
        foot = np.array([x, y, 0.0])
        for corner in ((-2.2, -2.2), (2.2, -2.2), (2.2, 2.2), (-2.2, 2.2)):
            for start, end in ((0.0, 0.5), (0.5, 1.0)):
                a, b = ([*(np.array(corner) * (1 - 0.8 * share)), 26 * share] for share in (start, end))
                add(foot, a, b, 0.13)
        for height in (5, 10, 15, 20):
            half_width = 2.2 * (1 - 0.8 * height / 26)
            for side in (half_width, -half_width):
                add(foot, (side, -half_width, height), (-side, half_width, height + 4), 0.09)
        for height in (19, 23):
            add(foot, (-4.5, 0, height), (4.5, 0, height), 0.12)
    return merge(beams)


def boulders(terrain: LakeTerrain, rng: Generator, light: Light, palette: Palette) -> Mesh:
    """Return the boulders, except those that would lie on the road because the land is shifted."""
    texture = textures.rock(rng)
    meshes = []
    for side, s, distance, width, height in read_table("lake_boulders.csv"):
        middle = terrain.track.at(s - terrain.shift, side * distance)
        position = np.array([[middle.x, middle.y]])
        if terrain.nearest_road(position)[0] < width + 12:
            continue
        z = max(float(terrain.height(position)[0]), WATER_LEVEL)
        half_axes = (width, 0.7 * width, height)
        meshes.append(boulder((middle.x, middle.y, z), half_axes, rng, palette["rock"], texture))
    return illuminate(merge(meshes), light)


def mountains(rng: Generator, light: Light, colour: Colour, soil: np.ndarray) -> Mesh:
    """Return a ring of distant hills."""
    turn = np.linspace(0, 2 * np.pi, 121)
    crest = 14 + 16 * np.abs(textures.clouds(rng, 256, 24, 4)[0, :120] + 0.5)
    crest = np.r_[crest, crest[:1]]
    radius = np.array([430.0, 520.0, 640.0])[:, None]
    heights = np.stack([np.full(121, -2.0), 0.6 * crest, crest])
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), heights], axis=-1)
    uv = np.stack(np.broadcast_arrays(turn * 8, np.array([0, 1, 2.0])[:, None]), axis=-1)
    return illuminate(sheet(points, colour, uv, soil), light, face_up=True)
