"""Objects around the lake: trees, bushes, boulders, pylons and distant hills."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from cloning.road.track import LEFT, RIGHT
from simulator.scenery import textures
from simulator.scenery.lake_terrain import WATER_LEVEL, LakeTerrain
from simulator.scenery.looks import Palette
from simulator.scenery.shapes import Colour, Light, Mesh, boulder, grid, illuminate, merge, plants, quads


class Boulder(NamedTuple):
    """A boulder next to the road: side, m along the road, m from its centre line, and half axes in m."""

    side: int
    s: float
    distance: float
    width: float
    height: float


BOULDERS = (
    Boulder(LEFT, 330, 32, 20, 7),
    Boulder(RIGHT, 170, 40, 12, 8),
    Boulder(RIGHT, 195, 34, 9, 7),
    Boulder(RIGHT, 155, 60, 14, 8),
    Boulder(LEFT, 30, 70, 10, 4),
    Boulder(RIGHT, 868, 60, 16, 7),
    Boulder(RIGHT, 905, 60, 18, 8),
    Boulder(LEFT, 960, 45, 12, 5),
    Boulder(LEFT, 975, 90, 16, 6),
    Boulder(LEFT, 750, 60, 16, 4),
    Boulder(LEFT, 720, 120, 22, 6),
    Boulder(RIGHT, 60, 45, 14, 5),
    Boulder(LEFT, 600, 150, 25, 8),
    Boulder(RIGHT, 700, 160, 40, 9),
    Boulder(RIGHT, 1060, 60, 18, 6),
)


def pines(terrain: LakeTerrain, random: Generator, palette: Palette, density: float) -> list[Mesh]:
    """Return a forest on the hills to the right and scattered pines elsewhere; density: factor of their number."""
    points = terrain.track.points[:, :2]
    low, high = points.min(axis=0) - 210, points.max(axis=0) + 210
    positions = random.uniform(low, high, (round(5200 * density), 2))
    distance, s, side = terrain.nearest_road(positions)
    z = terrain.height(positions)
    forest = (side == RIGHT) & ((s > 120) & (s < 545))
    chance = np.where(forest, 0.9, 0.22) * np.clip((distance - 11) / 20, 0, 1) * np.clip((z + 0.6) * 2, 0, 1)
    chance = np.where(distance > 150, chance * 0.5, chance)
    keep = (random.uniform(size=len(positions)) < chance) & (distance > 13) & (distance < 210)
    feet = np.c_[positions, z - 0.3][keep]
    heights = random.uniform(8, 15, len(feet))
    tone = random.uniform(0.75, 1.2, (len(feet), 1))
    colours = np.clip(np.array(palette["pine"]) * tone, 0, 1)
    meshes = []
    for kind, low_branches in enumerate((0.62, 0.5, 0.75)):
        chosen = np.arange(len(feet)) % 3 == kind
        texture = textures.pine(random, low=low_branches)
        height = heights[chosen]
        meshes.append(plants(feet[chosen], height, 0.52 * height, colours[chosen], texture, random))
    return meshes


def undergrowth(terrain: LakeTerrain, random: Generator, palette: Palette, density: float) -> list[Mesh]:
    """Return bushes and reeds in clumps next to the road; density: factor of their number."""
    track = terrain.track
    meshes = []
    for texture, colour, count, near, far, tallest in (
        (textures.bush(random), palette["bush"], round(900 * density), 9.5, 28, 1.4),
        (textures.reeds(random), palette["reeds"], round(260 * density), 9.5, 16, 2.6),
    ):
        s = random.uniform(0, track.length, count)
        s = (s // 22) * 22 + random.normal(0, 4, count)
        right = random.choice((RIGHT, LEFT), count) * random.uniform(near, far, count)
        index = np.floor(s / track.step).astype(int) % len(track.points)
        positions = track.points[index, :2] + track.rightward[index] * right[:, None]
        z = terrain.height(positions)
        clear = (terrain.nearest_road(positions)[0] > near - 0.5) & (z > WATER_LEVEL)
        positions, z = positions[clear], z[clear]
        heights = random.uniform(0.5, 1.0, len(positions)) * tallest
        colours = np.clip(np.array(colour) * random.uniform(0.7, 1.15, (len(positions), 1)), 0, 1)
        meshes.append(plants(np.c_[positions, z - 0.1], heights, 1.9 * heights, colours, texture, random))
    return meshes


def pylons() -> list[Mesh]:
    """Return the line of pylons behind the bridge."""
    positions = np.array([[-150.0, -230.0], [-60, -205], [30, -190], [125, -175], [205, -95], [150, 5], [90, 75]])
    feet = np.c_[positions, np.zeros(len(positions))]
    colour, texture = (0.22, 0.30, 0.42), textures.plain()
    beams = []
    for foot in feet:
        for corner in ((-2.2, -2.2), (2.2, -2.2), (2.2, 2.2), (-2.2, 2.2)):
            for start, end in ((0.0, 0.5), (0.5, 1.0)):
                a = foot + np.array([*(np.array(corner) * (1 - 0.8 * start)), 26 * start])
                b = foot + np.array([*(np.array(corner) * (1 - 0.8 * end)), 26 * end])
                beams.append(beam(a, b, 0.13, colour, texture))
        for height in (5, 10, 15, 20):
            half_width = 2.2 * (1 - 0.8 * height / 26)
            for side in (half_width, -half_width):
                a, b = np.array([[side, -half_width, height], [-side, half_width, height + 4]])
                beams.append(beam(foot + a, foot + b, 0.09, colour, texture))
        for height in (19, 23):
            a, b = np.array([[-4.5, 0, height], [4.5, 0, height]])
            beams.append(beam(foot + a, foot + b, 0.12, colour, texture))
    return [merge(beams)]


def beam(a: np.ndarray, b: np.ndarray, half_width: float, colour: Colour, texture: np.ndarray) -> Mesh:
    """Return a beam from point a to point b as two crossed strips."""
    corners: list[np.ndarray] = []
    for sideways in np.array([(half_width, 0, 0), (0, half_width, 0)]):
        corners += [a - sideways, a + sideways, b + sideways, b - sideways]
    uv, faces = quads(2)
    return Mesh(np.array(corners), np.tile(np.array(colour), (8, 1)), uv, faces, texture)


def boulders(terrain: LakeTerrain, random: Generator, light: Light, palette: Palette) -> Mesh:
    """Return the boulders, except those that would lie on the road because the land is shifted."""
    texture = textures.rock(random)
    meshes = []
    for side, s, distance, width, height in BOULDERS:
        place = terrain.track.at(s - terrain.shift, side * distance)
        position = np.array([[place.x, place.y]])
        if terrain.nearest_road(position)[0] < width + 12:
            continue
        z = max(float(terrain.height(position)[0]), WATER_LEVEL)
        half_axes = (width, 0.7 * width, height)
        meshes.append(boulder((place.x, place.y, z), half_axes, random, palette["rock"], texture))
    return illuminate(merge(meshes), light)


def mountains(random: Generator, light: Light, palette: Palette, soil: np.ndarray) -> Mesh:
    """Return a ring of distant hills."""
    turn = np.linspace(0, 2 * np.pi, 121)
    crest = 14 + 16 * np.abs(textures.clouds(random, 256, 24, 4)[0, :120] + 0.5)
    crest = np.r_[crest, crest[:1]]
    radius = np.array([430.0, 520.0, 640.0])[:, None]
    heights = np.stack([np.full(121, -2.0), 0.6 * crest, crest])
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), heights], axis=-1).reshape(-1, 3)
    uv = np.stack(np.broadcast_arrays(turn * 8, np.array([0, 1, 2.0])[:, None]), axis=-1).reshape(-1, 2)
    colours = np.tile(np.array(palette["grass"]), (len(points), 1))
    return illuminate(Mesh(points, colours, uv, grid(3, 121), soil), light, face_up=True)
