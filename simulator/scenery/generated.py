"""The scenery of roads of points, generated or one's own: one of five lands, and what the road's marking puts at it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.distance import cdist

from cloning.road.generated import PointRoad
from cloning.road.track import LEFT, RIGHT, Track
from simulator.scenery import looks, planting, shapes, textures
from simulator.scenery.jungle import CLEAR_DISTANCE, DASH, GAP
from simulator.scenery.looks import Look, Palette
from simulator.scenery.parts import Haze, Scenery, assemble
from simulator.scenery.shapes import Colour, Light, Material, Mesh
from simulator.scenery.textures import Line

GRID_SPACING = 5.0  # m between the ground's points around the road
GROUND_MARGIN, FARTHEST = 45.0, 330.0  # m of such ground around the road; m from there on to the end of the land
VERGE_EDGE = 9.8  # m from the centre line to the end of the verge, which hides the ground's steps
HARD_SHOULDER = 0.35  # m of asphalt beyond the lines
KERB_WIDTH, WALL_HEIGHT, RAIL_DISTANCE = 0.7, 0.8, 0.5  # m; the last from the edge of the road
POST_SPACING = 8.0  # m between a rail's posts
SHADOW_ELEVATION = 24.0  # degrees: of the sun that casts the shadows of shadowed looks, as low as the lake's
PLANT_TEXTURES = {"pine": textures.pine, "palm": textures.palm, "bush": textures.bush, "reeds": textures.reeds}


@dataclass(frozen=True)
class Plant:
    """A species in a land."""

    species: str  # key of PLANT_TEXTURES
    colour: Colour
    count: int
    height: tuple[float, float]  # m: least and greatest
    width: float  # relative to the height
    nearest: float  # least distance from the road's centre line, m


@dataclass(frozen=True)
class Land:
    """The land around a road."""

    ground: tuple[Colour, Colour, Colour]  # colours of level ground, of patches on it, and of steep ground
    hills: tuple[float, float]  # m: mean and spread of the hills' heights above the road
    slope: tuple[float, float]  # m from the centre line to the hills' feet, and from there to their full height
    plants: tuple[Plant, ...]
    terrace: float = 0.0  # m: height of the hills' steps; 0 for none
    boulders: int = 0  # how many there are
    haze: float = 0.6  # largest share of the haze


MEADOW = Land(
    ((0.62, 0.70, 0.30), (0.86, 0.80, 0.42), (0.80, 0.68, 0.48)),
    hills=(1.5, 3.0),
    slope=(11, 50),
    plants=(
        Plant("bush", (0.28, 0.34, 0.12), 900, (0.5, 2.2), 1.6, 10.5),
        Plant("reeds", (0.50, 0.54, 0.20), 700, (0.4, 1.0), 1.6, 9.0),
        Plant("pine", (0.42, 0.48, 0.22), 260, (6, 12), 0.7, 14),
    ),
)
FOREST = Land(
    ((0.42, 0.46, 0.22), (0.58, 0.46, 0.28), (0.52, 0.46, 0.36)),
    hills=(5.0, 6.0),
    slope=(11, 26),
    plants=(
        Plant("pine", (0.36, 0.40, 0.20), 750, (8, 16), 0.55, 12),
        Plant("pine", (0.36, 0.40, 0.20), 750, (6, 14), 0.5, 12),
        Plant("bush", (0.24, 0.30, 0.10), 600, (0.5, 1.6), 1.8, 9.5),
    ),
    haze=0.7,
)
DESERT = Land(
    ((0.96, 0.82, 0.58), (0.88, 0.66, 0.44), (0.84, 0.60, 0.42)),
    hills=(3.0, 5.0),
    slope=(11, 45),
    plants=(
        Plant("bush", (0.46, 0.44, 0.24), 900, (0.4, 1.1), 1.9, 9.5),
        Plant("palm", (0.46, 0.48, 0.22), 120, (5, 9), 0.9, 13),
    ),
    boulders=16,
    haze=0.8,
)
CANYON = Land(
    ((0.78, 0.52, 0.34), (0.66, 0.56, 0.32), (0.74, 0.42, 0.28)),
    hills=(13.0, 9.0),
    slope=(12, 5),
    plants=(
        Plant("bush", (0.34, 0.36, 0.16), 1200, (0.4, 1.5), 1.8, 9.5),
        Plant("pine", (0.38, 0.42, 0.22), 300, (4, 9), 0.6, 11),
    ),
    terrace=4.0,
    haze=0.4,
)
HIGHLAND = Land(
    ((0.56, 0.58, 0.42), (0.68, 0.66, 0.56), (0.62, 0.62, 0.60)),
    hills=(2.0, 15.0),
    slope=(11, 38),
    plants=(
        Plant("reeds", (0.58, 0.56, 0.30), 1100, (0.3, 0.9), 1.8, 9.0),
        Plant("pine", (0.30, 0.36, 0.26), 500, (4, 10), 0.5, 13),
    ),
    boulders=14,
)
LANDS = {"meadow": MEADOW, "forest": FOREST, "desert": DESERT, "canyon": CANYON, "highland": HIGHLAND}
COMMON_COLOURS: Palette = {
    "zenith": (0.20, 0.33, 0.57),
    "horizon": (0.62, 0.73, 0.88),
    "yellow": (0.88, 0.76, 0.26),
    "white": (0.97, 0.97, 0.95),
    "seam": (0.36, 0.35, 0.32),
    "kerb": (1.0, 0.98, 0.95),
    "grass": (0.52, 0.58, 0.28),
    "dirt": (0.72, 0.54, 0.36),
    "wall": (0.74, 0.72, 0.67),
    "rail": (0.72, 0.73, 0.74),
    "rock": (0.86, 0.82, 0.74),
    "bonnet": (0.55, 0.54, 0.50),
}
SUNLIGHT, FILL = np.array((0.80, 0.75, 0.62)), np.array((0.48, 0.51, 0.54))


def weather(rng: Generator, land: Land) -> tuple[Light, Palette]:
    """Draw a road's own light and colours."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(28, 65))
    sun = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    sunlight, fill = (colour * rng.uniform(0.9, 1.05) for colour in (SUNLIGHT, FILL))
    base = COMMON_COLOURS | dict(zip(("ground", "patch", "steep"), land.ground, strict=True))
    base |= {plant.species: plant.colour for plant in land.plants}
    palette = {name: tuple(np.clip(np.array(c) * rng.uniform(0.94, 1.06, 3), 0, 1)) for name, c in base.items()}
    palette["asphalt"] = tuple(rng.uniform(0.55, 0.9) * rng.uniform(0.97, 1.03, 3))
    return Light(sun, tuple(sunlight), tuple(fill)), palette


def sample(image: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the pixels of a texture laid over the land, GRID_SPACING m each, at positions (..., 2)."""
    column, row = np.moveaxis(np.floor(positions / GRID_SPACING).astype(int), -1, 0)
    return image[row % len(image), column % len(image)]


class Terrain:
    """The height of the ground around the road, on a grid that is finer near the road.

    positions    float64 (rows, columns, 2): m
    distance     float64 (rows, columns): m to the centre line
    height       float64 (rows, columns): m
    distance_at  functions that interpolate these two at positions (n, 2) given as y, x: (n,)
    height_at
    """

    def __init__(self, track: Track, land: Land, rng: Generator, relief: float):
        """relief: factor of the hills' heights."""
        road = track.points[::3]
        low, high = road[:, :2].min(axis=0) - GROUND_MARGIN, road[:, :2].max(axis=0) + GROUND_MARGIN
        self.axes = [grid_axis(*ends) for ends in zip(low, high, strict=True)]
        self.positions = np.stack(np.meshgrid(*self.axes), axis=-1)
        # Row by row, because a road of some kilometres has gigabytes of distances.
        away = (cdist(row, road[:, :2]) for row in self.positions)
        nearest = [self._near(distances, road[:, 2]) for distances in away]
        self.distance, level, lowest = np.moveaxis(np.array(nearest), 1, 0)
        slow = sample(textures.clouds(rng, 256, 24, 4), self.positions)
        rough = sample(textures.clouds(rng, 256, 6, 3), self.positions)
        foot, reach = land.slope
        rise = np.clip((self.distance - foot) / reach, 0, 1)
        rise = rise * rise * (3 - 2 * rise)
        mean, spread = land.hills
        tall = relief * (mean + spread * slow)
        if land.terrace:
            tall = np.round(np.maximum(tall, 0) / land.terrace) * land.terrace
        bumps = 0.3 * rough * np.clip((self.distance - 8) / 8, 0, 1)
        self.height = np.minimum(level - 0.3 + tall * rise + bumps, lowest - 0.8)
        self.height_at = RegularGridInterpolator(self.axes[::-1], self.height)
        self.distance_at = RegularGridInterpolator(self.axes[::-1], self.distance)

    @staticmethod
    def _near(away: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for positions at distances (n, k) m from a road's points their distance from it, and its height there.

        heights: (k,), m; the height is a mean with more weight to nearer points, and then the lowest of near ones.
        """
        weight = 1 / np.maximum(away, 1.0) ** 4
        level = (weight * heights).sum(axis=-1) / weight.sum(axis=-1)
        return away.min(axis=-1), level, np.where(away < CLEAR_DISTANCE, heights, np.inf).min(axis=-1)


def grid_axis(low: float, high: float) -> np.ndarray:
    """Return coordinates GRID_SPACING apart from low to high, and ever wider apart beyond them, in m."""
    steps = GRID_SPACING * 1.25 ** np.arange(1, 40)
    outside = np.cumsum(steps)
    outside = outside[: np.searchsorted(outside, FARTHEST) + 1]
    inside = np.arange(low, high + GRID_SPACING, GRID_SPACING)
    return np.r_[low - outside[::-1], inside, inside[-1] + outside]


def ground(terrain: Terrain, rng: Generator, light: Light, palette: Palette, soil: np.ndarray) -> Mesh:
    """Return the ground: level or steep, in patches of two colours."""
    points = np.concatenate([terrain.positions, terrain.height[..., None]], axis=-1)
    mesh = shapes.sheet(points, (1, 1, 1), terrain.positions / 11.0, soil)
    steep = np.clip((0.90 - shapes.flatness(mesh)) * 5, 0, 1)
    tone = sample(textures.clouds(rng, 256, 12, 5), terrain.positions).reshape(-1, 1)
    patch = np.clip(0.25 + 0.5 * tone, 0, 1)
    level = np.array(palette["ground"]) * (1 - patch) + np.array(palette["patch"]) * patch
    mesh.colours[:] = (level * (1 - steep) + np.array(palette["steep"]) * steep) * (1 + 0.08 * tone)
    return shapes.illuminate(mesh, light, face_up=True)


def road(track: Track, marking: str, rng: Generator, look: Look, soil: np.ndarray) -> list[Mesh]:
    """Return the asphalt with its lines, what stands or lies at its edges, and the verges."""
    palette, light, edge = look.palette, look.light, float(track.edges[0, 0])
    end = edge + (HARD_SHOULDER if marking in ("yellow double", "white", "rail") else 0.0)
    lines = {
        "yellow double": (
            Line(edge - 0.22, 0.16, palette["seam"]),
            Line(edge - 0.44, 0.05, palette["yellow"]),
            Line(edge - 0.05, 0.05, palette["yellow"]),
        ),
        "white": (Line(edge - 0.12, 0.12, palette["white"]), Line(0.0, 0.11, palette["white"], DASH / (DASH + GAP))),
    }.get(marking, ())
    asphalt = textures.asphalt(rng, grain=rng.uniform(0.03, 0.12) * look.grain, spots=look.spots)
    s, painted = shapes.distances(*track.extent, 2.0), textures.paint_lines(asphalt, palette["asphalt"], end, lines)
    material = Material(palette["asphalt"], painted, DASH + GAP)
    meshes = [replace(shapes.surface(track, s, end, material), sheen=look.sheen)]
    for side in (LEFT, RIGHT):
        inner = (end - 0.02, end + 1.4) if marking != "dirt" else (end + 1.2, end + 2.0)
        verge = Material(palette["grass" if marking == "grass" else "ground"], soil, 6.0)
        verge_mesh = shapes.roadside(track, s, side, (*inner, VERGE_EDGE), (-0.01, -0.06, -0.8), verge)
        beside = [verge_mesh, *border(track, marking, side, look, soil)]
        meshes += [shapes.illuminate(mesh, light, face_up=True) for mesh in beside]
    return meshes + (posts(track, look) if marking == "rail" else [])


def border(track: Track, marking: str, side: int, look: Look, soil: np.ndarray) -> list[Mesh]:
    """Return what marks the road's edge on one side, where lines or grass do not."""
    s, edge, palette = shapes.distances(*track.extent, 2.0), float(track.edges[0, 0]), look.palette
    if marking == "kerb":
        stripes = Material(palette["kerb"], textures.kerb(), look.stripes, across=(0, 1))
        along = shapes.distances(*track.extent)
        return [shapes.roadside(track, along, side, (edge - KERB_WIDTH, edge), (0.03, 0.06), stripes)]
    if marking == "dirt":
        dirt = Material(palette["dirt"], soil, 5.0)
        return [shapes.roadside(track, s, side, (edge - 0.02, edge + 1.3), (0.0, -0.02), dirt)]
    if marking == "wall":
        stone = Material(palette["wall"], soil, 3.0, across=(0, 0.3))
        outline = [(0.0, 0.0), (0.0, WALL_HEIGHT), (0.4, WALL_HEIGHT), (0.4, -2 * WALL_HEIGHT)]
        return shapes.wall(track, s, side, np.add(outline, (edge, 0)), stone)
    if marking == "rail":
        metal = Material(palette["rail"], textures.plain(), 4.0, across=(0, 1))
        rail = edge + RAIL_DISTANCE
        return [shapes.roadside(track, s, side, (rail, rail), (0.45, 0.8), metal)]
    return []


def posts(track: Track, look: Look) -> list[Mesh]:
    """Return the posts of the rails on both sides."""
    offset, white, boxes = float(track.edges[0, 0]) + RAIL_DISTANCE + 0.06, textures.plain(), []
    start, end = track.extent
    for s in np.arange(start, end - POST_SPACING / 2, POST_SPACING):
        for side in (LEFT, RIGHT):
            pose = track.at(s, side * offset)
            foot = (pose.x, pose.y, pose.z - 0.5)
            boxes.append(shapes.box(foot, (0.10, 0.10, 1.3), pose.heading, look.palette["rail"], white))
    return [shapes.illuminate(shapes.merge(boxes), look.light)]


def vegetation(terrain: Terrain, land: Land, rng: Generator, palette: Palette, density: float) -> list[Mesh]:
    """Return the land's plants, most of them near the road; density: factor of their number."""
    meshes = []
    low, high = terrain.positions[0, 0], terrain.positions[-1, -1]
    for plant in land.plants:
        positions = rng.uniform(low, high, (12 * round(plant.count * density), 2))
        distance = terrain.distance_at(positions[:, ::-1])
        chance = np.clip(1.5 - distance / 60, 0.05, 1)
        keep = (distance > plant.nearest) & (distance < 160) & (rng.uniform(size=len(distance)) < chance)
        positions = positions[keep][: round(plant.count * density)]
        feet = np.c_[positions, terrain.height_at(positions[:, ::-1]) - 0.1]
        heights = rng.uniform(*plant.height, len(feet))
        colours = np.clip(np.array(palette[plant.species]) * rng.uniform(0.75, 1.25, (len(feet), 1)), 0, 1)
        texture = PLANT_TEXTURES[plant.species](rng)
        meshes.append(shapes.plants(feet, heights, plant.width * heights, colours, texture, rng))
    return meshes


def boulders(terrain: Terrain, land: Land, rng: Generator, light: Light, palette: Palette) -> list[Mesh]:
    """Return boulders on the land beside the road."""
    texture = textures.rock(rng)
    meshes: list[Mesh] = []
    low, high = terrain.positions[0, 0], terrain.positions[-1, -1]
    while len(meshes) < land.boulders:
        (x, y), size = rng.uniform(low, high), rng.uniform(2, 8)
        if size + 12 < terrain.distance_at((y, x)).item() < 90:
            z = terrain.height_at((y, x)).item()
            meshes.append(shapes.boulder((x, y, z), (size, 0.8 * size, 0.6 * size), rng, palette["rock"], texture))
    return [shapes.illuminate(shapes.merge(meshes), light)] if meshes else []


def scenery(source: PointRoad, look: int) -> Scenery:
    """Return a road's scenery in a look, 0: its own; the calls draw from one generator, so their order matters."""
    track, land = Track(source), LANDS[source.land]
    appearance = looks.make_look(look, *weather(np.random.default_rng([source.seed, 1]), land))
    light, palette = appearance.light, appearance.palette
    rng = np.random.default_rng([source.seed, look])
    terrain = Terrain(track, land, rng, appearance.relief)
    soil = textures.soil(rng)
    meshes = [
        ground(terrain, rng, light, palette, soil),
        *road(track, source.marking, rng, appearance, soil),
        planting.mountains(rng, light, palette["ground"], soil),
        *boulders(terrain, land, rng, light, palette),
        *vegetation(terrain, land, rng, palette, appearance.plants),
    ]
    return assemble(meshes, appearance, Haze(palette["horizon"], (100, 600), land.haze))
