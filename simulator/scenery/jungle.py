"""The jungle's scenery: a road through dark cliffs that climbs 30 m and crosses over itself.

Positions of features along the road were read off frames of the real simulator, as were the colours.
"""

import numpy as np
from numpy.random import Generator
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from cloning.road.track import LEFT, RIGHT, ROADS, Section, Track
from simulator.scenery import looks, shapes, textures
from simulator.scenery.looks import Look, Palette
from simulator.scenery.parts import Scenery, assemble
from simulator.scenery.shapes import Light, Material, Mesh
from simulator.scenery.textures import Line

ROAD = ROADS["jungle"]  # its bridge crosses the road at 1350 m, 20 m below
EDGE_LINE = ROAD.edge  # m from the centre line to the white line along the road's edge
ASPHALT_EDGE = 4.7  # m from the centre line to the end of the asphalt
DASH, GAP = 6.0, 6.0  # m, of the dashed centre line
# Sections with guard rails
RAILS = (Section(LEFT, 0, 45), Section(RIGHT, 880, 940), Section(LEFT, 1440, 1493))
# Sections with marker posts, in addition to sharp bends
POSTS = (
    Section(LEFT, 395, 470),
    Section(RIGHT, 395, 470),
    Section(LEFT, 770, 872),
    Section(RIGHT, 770, 872),
    Section(LEFT, 1075, 1110),
)
SHARP_CURVATURE = 1 / 18  # 1/m: sharper bends have marker posts on their outer side
GRID_SPACING = 4.0  # m between the ground's points
GROUND_MARGIN = 75.0  # m of ground around the track
CLIFF_DISTANCE, CLIFF_WIDTH = 12.0, 4.0  # m from the centre line to the cliffs' feet, and from there to their tops
CLEAR_DISTANCE = 9.5  # m from the centre line within which the ground stays below the road

PALETTE: Palette = {
    "zenith": (0.22, 0.35, 0.59),
    "horizon": (0.59, 0.71, 0.88),
    "asphalt": (0.90, 0.89, 0.86),
    "line": (0.98, 0.98, 0.97),
    "grass": (0.44, 0.49, 0.25),
    "cliff": (0.44, 0.47, 0.36),
    "palm": (0.36, 0.42, 0.16),
    "post": (0.86, 0.86, 0.88),
    "board": (0.90, 0.28, 0.26),
    "rail": (0.70, 0.70, 0.70),
    "deck": (0.30, 0.30, 0.30),
    "bonnet": (0.48, 0.46, 0.42),
}
# Degrees: elevation of the sun that casts the shadows of shadowed looks. Lower than LIGHT has it, because these cliffs
# are lower than the real ones: so 16 % of look 10,000's road lie in the shade, as in a real recording with shadows.
SHADOW_ELEVATION = 36.0
LIGHT = Light(sun=(0.62, 0.35, 0.70), sunlight=(0.86, 0.82, 0.72), fill=(0.40, 0.42, 0.42))


class JungleTerrain:
    """The height of the ground around the road, on a grid, and the shadows that it casts.

    positions  float64 (rows, columns, 2): m
    distance   float64 (rows, columns): m to the centre line on the ground
    height     float64 (rows, columns): m
    bridge     float64 (n, 3): the centre line's points on the bridge, m; `distance` leaves them out
    """

    def __init__(self, track: Track, rng: Generator):
        self.track = track
        self.positions = shapes.ground_grid(track, GROUND_MARGIN, GRID_SPACING)
        on_ground = np.ones(len(track.points), bool)
        on_ground[np.round(shapes.distances(*ROAD.bridge) / track.step).astype(int)] = False
        self.bridge, points = track.points[~on_ground], track.points[on_ground]
        away, near = cKDTree(points[:, :2]).query(self.positions, k=24)
        weight = 1 / np.maximum(away, 1.0) ** 3
        level = (weight * points[near, 2]).sum(axis=-1) / weight.sum(axis=-1)
        self.distance = away[..., 0]
        rows, columns = self.distance.shape
        rough = textures.clouds(rng, 256, 16, 5)[:rows, :columns]
        slow = textures.clouds(rng, 256, 40, 3)[:rows, :columns]
        rise = np.clip((self.distance - CLIFF_DISTANCE - 4 * np.clip(slow, -0.6, 1.5)) / CLIFF_WIDTH, 0, 1)
        tall = 9 + 8 * np.clip(slow + 0.8, 0, 2.5) + 2 * rough
        crest = np.clip((self.distance - 38) / 12, 0, 1) * (12 + 9 * np.abs(rough))
        cliff = rise * np.round(tall / 4) * 4 + crest  # in terraces of 4 m
        self.height = level + cliff + 0.35 * rough * np.clip((self.distance - 6) / 8, 0, 1)
        lowest = np.where(away < CLEAR_DISTANCE, points[near, 2], np.inf).min(axis=-1)
        lowest = np.minimum(lowest, self.deck_at(self.positions))  # otherwise cliffs would stand on the bridge
        self.height = np.minimum(self.height, lowest - 0.7)

    def deck_at(self, positions: np.ndarray) -> np.ndarray:
        """Return the height of the bridge, (...), above positions (..., 2), in m; inf beyond CLEAR_DISTANCE from it."""
        away, nearest = cKDTree(self.bridge[:, :2]).query(positions)
        return np.where(away < CLEAR_DISTANCE, self.bridge[nearest, 2], np.inf)

    def grid_coordinates(self, positions: np.ndarray) -> np.ndarray:
        """Return the column and the row on the grid, (2, n), fractions included, of positions (n, 2)."""
        return ((positions - self.positions[0, 0]) / GRID_SPACING).T

    def height_at(self, positions: np.ndarray) -> np.ndarray:
        """Interpolate the height, (n,), at positions (n, 2), in m."""
        return map_coordinates(self.height, self.grid_coordinates(positions)[::-1], order=1, mode="nearest")

    def sunlit(self, points: np.ndarray, light: Light) -> np.ndarray:
        """Return, for points (n, 3), 1 where the sun reaches them and 0 in the ground's shadow: (n,)."""
        sun = np.array(light.sun)
        reached = np.ones(len(points), bool)
        for step in range(2, 32):
            ray = points + sun * (1.7 * step)
            reached &= ray[:, 2] > self.height_at(ray[:, :2]) - 0.5
        return reached.astype(float)

    def cast_shadows(self, mesh: Mesh, light: Light, darkest: float) -> Mesh:
        """Multiply the mesh's colours by `darkest` where the ground casts a shadow, and return the mesh."""
        sunlit = self.sunlit(mesh.points + np.array([0, 0, 0.8]), light)[:, None]
        mesh.colours[:] *= darkest + (1 - darkest) * sunlit
        return mesh


def ground(terrain: JungleTerrain, rng: Generator, light: Light, palette: Palette) -> Mesh:
    """Return the ground: grass where it is level, rock where it is steep."""
    rows, columns = terrain.distance.shape
    points = np.concatenate([terrain.positions, terrain.height[..., None]], axis=-1)
    mesh = shapes.sheet(points, (1, 1, 1), terrain.positions / 9.0, textures.rock(rng, streak=1.0))
    steep = np.clip((0.86 - shapes.flatness(mesh)) * 5, 0, 1)
    tone = 1 + 0.16 * textures.clouds(rng, 256, 10, 4)[:rows, :columns].reshape(-1, 1)
    mesh.colours[:] = (np.array(palette["grass"]) * (1 - steep) + np.array(palette["cliff"]) * steep) * tone
    return terrain.cast_shadows(shapes.illuminate(mesh, light, face_up=True), light, 0.55)


def road_texture(rng: Generator, look: Look) -> np.ndarray:
    """Return asphalt with its lines, as wide as the road and as long as a dash and a gap of the centre line."""
    white = look.palette["line"]
    lines = (Line(EDGE_LINE, 0.10, white), Line(0.0, 0.11, white, share=DASH / (DASH + GAP)))
    asphalt = textures.asphalt(rng, grain=0.03 * look.grain, spots=0.35 * look.spots)
    return textures.paint_lines(asphalt, look.palette["asphalt"], ASPHALT_EDGE, lines)


def road(terrain: JungleTerrain, rng: Generator, look: Look) -> list[Mesh]:
    """Return the asphalt with its lines, the grassy verges, and the sides of the bridge."""
    track, plain, soil = terrain.track, textures.plain(), textures.soil(rng)
    light, palette = look.light, look.palette
    asphalt = Material(palette["asphalt"], road_texture(rng, look), DASH + GAP)
    meshes = [shapes.surface(track, shapes.distances(0, track.length, 1.5), ASPHALT_EDGE, asphalt)]
    grass, deck = Material(palette["grass"], soil, 9.0), Material(palette["deck"], plain, 4.0, across=(0, 1))
    for start, end in ((0.0, ROAD.bridge[0]), (ROAD.bridge[1], track.length)):
        for side in (LEFT, RIGHT):
            s = shapes.distances(start, end, 2.5)
            verge = shapes.roadside(track, s, side, (ASPHALT_EDGE, 6.2, 9.8), (-0.01, -0.08, -0.75), grass)
            meshes.append(shapes.illuminate(verge, light, face_up=True))
    on_bridge, outer = shapes.distances(*ROAD.bridge), ASPHALT_EDGE + 0.25
    for side in (LEFT, RIGHT):
        faces = (((outer, outer), (0.15, -1.3)), ((ASPHALT_EDGE, outer), (0.15, 0.15)), ((0, outer), (-1.3, -1.3)))
        meshes += [shapes.roadside(track, on_bridge, side, face, heights, deck) for face, heights in faces]
    return [terrain.cast_shadows(mesh, light, 0.68) for mesh in meshes]


def rails_and_posts(track: Track, light: Light, palette: Palette) -> list[Mesh]:
    """Return guard rails, marker posts with their boards, and the piers of the bridge."""
    white, meshes = textures.plain(), []

    def add_box(s: float, right: float, bottom: float, size: tuple[float, float, float], colour: str) -> None:
        """Add a box aligned with the road; bottom: metres above the road."""
        pose = track.at(s, right)
        meshes.append(shapes.box((pose.x, pose.y, pose.z + bottom), size, pose.heading, palette[colour], white))

    rail = Material(palette["rail"], white, 4.0, across=(0, 1))
    for section in RAILS:
        s = shapes.distances(section.start, section.end, 2.0)
        meshes.append(shapes.ribbon(track, s, (section.side * 5.3, section.side * 5.3), (0.45, 0.8), rail))
        for post_s in np.arange(section.start, section.end, 4.0):
            add_box(post_s, section.side * 5.35, -0.2, (0.12, 0.25, 1.1), "post")
    bends = [
        (-int(np.sign(track.curvature[i])), i * track.step)
        for i in range(0, len(track.points), 9)
        if abs(track.curvature[i]) > SHARP_CURVATURE
    ]
    marked = [(section.side, s) for section in POSTS for s in np.arange(section.start, section.end, 7.0)]
    for side, post_s in bends + marked:
        add_box(post_s, side * 5.2, -0.5, (0.09, 0.09, 3.1), "post")
        add_box(post_s, side * 5.2, 2.3, (0.10, 0.55, 0.30), "board")
    for pier_s in np.arange(ROAD.bridge[0] + 6, ROAD.bridge[1], 18.0):
        for side in (LEFT, RIGHT):
            add_box(pier_s, side * 4.6, -26, (0.7, 0.7, 25.0), "deck")
    return [shapes.illuminate(shapes.merge(meshes), light)]


def palms(terrain: JungleTerrain, rng: Generator, light: Light, palette: Palette) -> list[Mesh]:
    """Return palms and bushes on the grass next to the road and on the cliffs."""
    low, high = terrain.positions[0, 0], terrain.positions[-1, -1]
    positions = rng.uniform(low, high, (5200, 2))
    column, row = terrain.grid_coordinates(positions).astype(int)
    distance = terrain.distance[row, column]
    chance = np.where(distance < 10.5, 0, np.where(distance < 20, 0.22, 0.16))
    keep = rng.uniform(size=len(positions)) < chance
    feet = np.c_[positions, terrain.height_at(positions) - 0.2][keep]
    sunlit = terrain.sunlit(feet + np.array([0, 0, 4]), light)[:, None]
    heights = rng.uniform(4.5, 9.0, len(feet))
    fits = feet[:, 2] + heights < terrain.deck_at(feet[:, :2])  # others would grow through the bridge
    brightness = rng.uniform(0.8, 1.5, (len(feet), 1))
    colours = np.clip(np.array(palette["palm"]) * brightness * (0.55 + 0.75 * sunlit), 0, 1)
    meshes = []
    for i, (draw, tall, wide) in enumerate([(textures.palm, 1.0, 0.9)] * 3 + [(textures.bush, 0.3, 2.0)]):
        chosen = fits & (np.arange(len(feet)) % 4 == i)
        height = tall * heights[chosen]
        meshes.append(shapes.plants(feet[chosen], height, wide * height, colours[chosen], draw(rng), rng))
    return meshes


def scenery(look: int) -> Scenery:
    """Return the jungle's scenery in a look; the calls draw from one generator, so their order matters."""
    rng = np.random.default_rng(look)
    appearance = looks.make_look(look, LIGHT, PALETTE)
    light, palette = appearance.light, appearance.palette
    terrain = JungleTerrain(Track("jungle"), rng)
    meshes = [
        ground(terrain, rng, light, palette),
        *road(terrain, rng, appearance),
        *rails_and_posts(terrain.track, light, palette),
        *palms(terrain, rng, light, palette),
    ]
    return assemble(meshes, appearance)
