"""The land around the lake; heights and soils next to the road were read off frames of the real simulator."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from cloning.road.track import LEFT, RIGHT, Section, Track
from simulator.scenery import textures
from simulator.scenery.looks import Palette
from simulator.scenery.shapes import Light, Mesh, flatness, ground_grid, illuminate, sheet

GRID_SPACING = 7.0  # m between the ground's points
WATER_LEVEL = -1.2  # m
CLIFF = Section(RIGHT, -45, 55)  # dark rock close to the road
# Red earth next to the road
EARTH = (
    Section(RIGHT, -45, 110),
    Section(RIGHT, 215, 440),
    Section(LEFT, 220, 420),
    Section(RIGHT, 560, 640),
    Section(RIGHT, 843, 864),
    Section(LEFT, 150, 240),
)


def read_table(name: str) -> np.ndarray:
    """Return what was read off frames of the real simulator, from a csv file beside this one: float64 (rows, columns).

    Lengths, heights and distances are in m, s along the road; side -1 is left of it, 1 right.
    """
    return np.loadtxt(Path(__file__).with_name(name), delimiter=",", skiprows=1)


def in_sections(sections: Iterable[Section], s: np.ndarray, side: np.ndarray, length: float) -> np.ndarray:
    """Return whether each s and side lies in one of the sections of a closed track of this length."""
    inside = np.zeros(np.shape(s), bool)
    for section in sections:
        inside |= (side == section.side) & ((s - section.start) % length <= section.end - section.start)
    return inside


class LakeTerrain:
    """The height of the ground, and the nearest point of the road, at any position."""

    def __init__(self, track: Track, rng: Generator, relief: float = 1.0, shift: float = 0.0):
        """relief: factor of the heights; shift: m by which the land is shifted backwards along the road."""
        self.track, self.relief, self.shift = track, relief, shift
        self.tree = cKDTree(track.points[:, :2])
        heights = read_table("lake_heights.csv")  # of the land 25 m from the road
        self.heights = [heights[heights[:, 0] == side, 1:].T for side in (LEFT, RIGHT)]
        self.rolling = textures.clouds(rng, 256, 24, 5)  # a pixel is 4 m; `height` scales the values

    def nearest_road(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distance to the centre line, s in the land's tables, and side, for positions (n, 2), all in m."""
        distance, nearest = self.tree.query(positions)
        right = np.einsum("ij,ij->i", positions - self.track.points[nearest, :2], self.track.rightward[nearest])
        return distance, (nearest * self.track.step + self.shift) % self.track.length, np.where(right < 0, LEFT, RIGHT)

    def height(self, positions: np.ndarray) -> np.ndarray:
        """Return the heights above the road, (n,), at positions (n, 2), in m."""
        distance, s, side = self.nearest_road(positions)
        length = self.track.length
        left, right = (np.interp(s, known, heights, period=length) for known, heights in self.heights)
        near = np.where(side == LEFT, left, right)
        near = np.where(near > 0, self.relief * near, near)
        cliff = in_sections((CLIFF,), s, side, length)
        rise = np.clip((distance - np.where(cliff, 15, 9)) / np.where(cliff, 6, 22), 0, 1)
        rise = rise * rise * (3 - 2 * rise)
        row, column = (np.floor(positions / 4).astype(int) % 256).T
        roll = self.rolling[row, column]
        far = np.clip((distance - 35) / 90, 0, 1)
        beyond = self.relief * np.where(near > 2.5, 14 + 9 * roll, 1.5 + 4 * roll) if len(positions) else roll
        lake = (side == LEFT) & (distance > 40)
        beyond = np.where(lake, -3 + 2.2 * roll, beyond)
        z = near * rise * (1 + 0.15 * roll) + np.where(lake, (beyond - near) * far, np.maximum(beyond, 0) * far * 0.8)
        z = np.where(near < 0, np.where(distance > 60, z + 2.2 * far * (side == RIGHT), z), z)
        return np.where(distance < 8.5, -0.15, z + 0.02)


def ground(terrain: LakeTerrain, rng: Generator, light: Light, palette: Palette, soil: np.ndarray) -> list[Mesh]:
    """Return two sheets of ground: a fine one near the road, and a coarse one further away and slightly lower."""
    tone = textures.clouds(rng, 256, 12, 4)
    length = terrain.track.length
    sheets = []
    for spacing, nearest, farthest, lower in ((GRID_SPACING, 0, 66, 0.0), (2.5 * GRID_SPACING, 48, 400, 0.4)):
        positions = ground_grid(terrain.track, 230, spacing)
        shape, positions = positions.shape, positions.reshape(-1, 2)
        distance, s, side = terrain.nearest_road(positions)
        points = np.c_[positions, terrain.height(positions) - lower]
        mesh = sheet(points.reshape(*shape[:2], 3), (1, 1, 1), positions.reshape(shape) / 14.0, soil)
        steep = np.clip((0.93 - flatness(mesh)) * 6, 0, 1)
        patch = tone[tuple((np.floor(positions / 5).astype(int) % 256).T)][:, None]
        green = 0.35 * np.clip(0.5 + 0.35 * patch, 0, 1)
        colour = np.array(palette["grass"]) * (1 - green) + np.array(palette["green"]) * green
        earth = in_sections(EARTH, s, side, length) & (distance < 30)
        colour = np.where(earth[:, None], np.array(palette["earth"]), colour)
        colour = colour * (1 - steep) + np.array(palette["sand"]) * (1 + 0.10 * patch) * steep
        cliff = in_sections((CLIFF,), s, side, length) & (distance > 14) & (distance < 32)
        mesh.colours[:] = np.where(cliff[:, None], np.array(palette["cliff"]), colour)
        corners = distance[mesh.faces]
        visible = (points[mesh.faces, 2].max(axis=1) > WATER_LEVEL - 0.4) & (corners.max(axis=1) > nearest)
        visible &= corners.min(axis=1) < farthest
        sheets.append(replace(illuminate(mesh, light, face_up=True), faces=mesh.faces[visible]))
    return sheets


def water(rng: Generator, palette: Palette) -> Mesh:
    """Return the lake's surface."""
    side = np.linspace(-760, 760, 27)
    points = np.stack(np.meshgrid(side, side, WATER_LEVEL), axis=-1)[:, :, 0]
    texture = textures.grey(0.97, 0.02 * textures.noise(rng, 64, 3))
    return sheet(points, palette["water"], points[..., :2] / 40, texture)
