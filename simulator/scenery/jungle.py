"""The jungle's scenery, from its centre line: a road through dark cliffs that climbs 30 m and crosses over
itself."""

import numpy as np
from scipy.spatial import cKDTree

from cloning.road.track import Track
from simulator.scenery import looks, textures
from simulator.scenery.looks import Look
from simulator.scenery.parts import Scenery, body, bonnet, dome
from simulator.scenery.shapes import Light, Mesh, around, box, grid, lit, plants, ribbon, roadside, stretch, together

LINE, ROAD = 4.1, 4.45  # m from the centre line: the white edge line, the asphalt's end
DASH, GAP = 6.0, 6.0  # m
BRIDGE = (806, 872)  # over the road at 1350, 20 m below
RAILS = ((1, 0, 45), (-1, 880, 940), (1, 1440, 1493))  # side (+1 is left of the listed direction), from, to
MARKED = ((1, 395, 470), (-1, 395, 470), (1, 770, 872), (-1, 770, 872), (1, 1075, 1110))  # marker posts
CELL = 4.0  # m between the ground's points
REACH = 75.0  # m of ground around the track
CLIFFS = (12.0, 4.0)  # m from the road where cliffs begin, and over which they rise

PALETTE = {
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
LIGHT = Light(sun=(0.62, 0.35, 0.70), sunlight=(0.86, 0.82, 0.72), fill=(0.40, 0.42, 0.42))


class Land:
    """The ground's height around the road, and what lies in the cliffs' shadow."""

    def __init__(self, track: Track, random):
        self.track = track
        low, high = track.points[:, :2].min(axis=0) - REACH, track.points[:, :2].max(axis=0) + REACH
        self.xs, self.ys = (np.arange(a, b, CELL) for a, b in zip(low, high, strict=True))
        places = np.stack(np.meshgrid(self.xs, self.ys), axis=-1)
        below = np.ones(len(track.points), bool)  # all of the road but the bridge lies on the ground
        below[np.round(stretch(*BRIDGE) / track.step).astype(int)] = False
        road = track.points[below]
        away, near = cKDTree(road[:, :2]).query(places, k=24)
        weight = 1 / np.maximum(away, 1.0) ** 3
        level = (weight * road[near, 2]).sum(axis=-1) / weight.sum(axis=-1)
        self.away = away[..., 0]
        rows, columns = self.away.shape
        rough = textures.clouds(random, 256, 16, 5)[:rows, :columns]
        slow = textures.clouds(random, 256, 40, 3)[:rows, :columns]
        rise = np.clip((self.away - CLIFFS[0] - 4 * np.clip(slow, -0.6, 1.5)) / CLIFFS[1], 0, 1)
        tall = 9 + 8 * np.clip(slow + 0.8, 0, 2.5) + 2 * rough
        crest = np.clip((self.away - 38) / 12, 0, 1) * (12 + 9 * np.abs(rough))
        cliff = rise * np.round(tall / 4) * 4 + crest  # terraces
        self.height = level + cliff + 0.35 * rough * np.clip((self.away - 6) / 8, 0, 1)
        lowest = np.where(away < 9.5, road[near, 2], np.inf).min(axis=-1)
        self.height = np.minimum(self.height, np.where(np.isfinite(lowest), lowest - 0.7, np.inf))
        self.places = places

    def at(self, places: np.ndarray) -> np.ndarray:
        """Metres of height at places (n, 2), between the grid's points."""
        column = np.clip((places[:, 0] - self.xs[0]) / CELL, 0, len(self.xs) - 1.001)
        row = np.clip((places[:, 1] - self.ys[0]) / CELL, 0, len(self.ys) - 1.001)
        i, j = row.astype(int), column.astype(int)
        u, v = row - i, column - j
        z = self.height
        return (
            (1 - u) * (1 - v) * z[i, j]
            + (1 - u) * v * z[i, j + 1]
            + u * (1 - v) * z[i + 1, j]
            + u * v * z[i + 1, j + 1]
        )

    def shade(self, points: np.ndarray, light: Light) -> np.ndarray:
        """1 in the sun, 0 where the ground stands between it and the points (n, 3)."""
        sun = np.array(light.sun)
        lit_ = np.ones(len(points), bool)
        for step in range(2, 32):
            ray = points + sun * (1.7 * step)
            lit_ &= ray[:, 2] > self.at(ray[:, :2]) - 0.5
        return lit_.astype(float)


def shadowed(mesh: Mesh, land: Land, light: Light, depth: float) -> Mesh:
    """The mesh with its colours darkened in the cliffs' shadow."""
    shade = land.shade(mesh.points + np.array([0, 0, 0.8]), light)[:, None]
    mesh.colours[:] *= depth + (1 - depth) * shade
    return mesh


def ground(land: Land, random, light: Light, palette: dict) -> Mesh:
    rows, columns = land.away.shape
    points = np.concatenate([land.places, land.height[..., None]], axis=-1).reshape(-1, 3)
    faces = grid(rows, columns)
    white = Mesh(
        points,
        np.ones_like(points),
        land.places.reshape(-1, 2) / 9.0,
        faces,
        textures.rock(random, streak=1.0),
    )
    level = lit(white, Light((0, 0, 1), (1, 1, 1), (0, 0, 0)), faced_up=True).colours[:, :1]
    steep = np.clip((0.86 - level) * 5, 0, 1)
    tone = 1 + 0.16 * textures.clouds(random, 256, 10, 4)[:rows, :columns].reshape(-1, 1)
    white.colours[:] = (np.array(palette["grass"]) * (1 - steep) + np.array(palette["cliff"]) * steep) * tone
    return shadowed(lit(white, light, faced_up=True), land, light, 0.55)


def tarmac(random, look: Look) -> np.ndarray:
    """Asphalt as wide as the road, a dash and a gap long, divided by its own colour, which the vertices
    carry."""
    palette = look.palette
    texture = textures.asphalt(random, grain=0.03 * look.grain, spots=0.35 * look.spots).astype(float)
    rows, columns = texture.shape[:2]
    left = ROAD - (np.arange(columns) + 0.5) / columns * 2 * ROAD
    white = np.array(palette["line"]) / palette["asphalt"] * 255
    texture[:, np.abs(np.abs(left) - LINE) < 0.10] = white
    texture[: round(rows * DASH / (DASH + GAP)), np.abs(left) < 0.11] = white
    return np.clip(texture, 0, 255).astype(np.uint8)


def road(land: Land, random, look: Look) -> list[Mesh]:
    """Asphalt with its lines, grassy verges, and the bridge's sides."""
    track, plain, soil = land.track, textures.line(), textures.soil(random)
    light, palette = look.light, look.palette
    across = np.linspace(ROAD, -ROAD, 7)
    painted = 0.5 - across / (2 * ROAD)
    surface = (palette["asphalt"], tarmac(random, look), DASH + GAP)
    meshes = [ribbon(track, around(track, 1.5), across, 0.0, *surface, painted)]
    for start, end in ((0.0, BRIDGE[0]), (BRIDGE[1], track.length)):
        for side in (1, -1):
            shape = (track, stretch(start, end, 2.5), side, (ROAD, 6.2, 9.8), (-0.01, -0.08, -0.75))
            meshes.append(lit(roadside(*shape, palette["grass"], soil, 9.0), light, faced_up=True))
    out = ROAD + 0.25
    for side in (1, -1):
        for offsets, heights in (
            ((out, out), (0.15, -1.3)),
            ((ROAD, out), (0.15, 0.15)),
            ((0, out), (-1.3, -1.3)),
        ):
            shape = (track, stretch(*BRIDGE), side, offsets, heights)
            meshes.append(roadside(*shape, palette["deck"], plain, 4.0, (0, 1)))
    return [shadowed(mesh, land, light, 0.68) for mesh in meshes]


def furniture(track: Track, light: Light, palette: dict) -> list[Mesh]:
    """Guard rails, marker posts with their boards, and the bridge's piers."""
    white, made = textures.line(), []
    for side, start, end in RAILS:
        for low, high in ((0.45, 0.8),):
            made.append(
                ribbon(
                    track,
                    stretch(start, end, 2.0),
                    (side * 5.3, side * 5.3),
                    (low, high),
                    palette["rail"],
                    white,
                    4.0,
                    across=(0, 1),
                )
            )
        for s in np.arange(start, end, 4.0):
            place = track.at(s, -side * 5.35)
            made.append(
                box(
                    (place.x, place.y, place.z - 0.2),
                    (0.12, 0.25, 1.1),
                    place.heading,
                    palette["post"],
                    white,
                )
            )
    bends = [
        (int(np.sign(track.curvature[i])), i * track.step)
        for i in range(0, len(track.points), 9)
        if abs(track.curvature[i]) > 1 / 18
    ]
    posts = bends + [(side, s) for side, start, end in MARKED for s in np.arange(start, end, 7.0)]
    for side, s in posts:
        place = track.at(s, -side * 5.2)
        made.append(box((place.x, place.y, place.z - 0.5), (0.09, 0.09, 3.1), place.heading, palette["post"], white))
        made.append(box((place.x, place.y, place.z + 2.3), (0.10, 0.55, 0.30), place.heading, palette["board"], white))
    for s in np.arange(BRIDGE[0] + 6, BRIDGE[1], 18.0):
        for side in (1, -1):
            place = track.at(s, -side * 4.6)
            made.append(box((place.x, place.y, place.z - 26), (0.7, 0.7, 25.0), place.heading, palette["deck"], white))
    return [lit(together(made), light)]


def palms(land: Land, random, light: Light, palette: dict) -> list[Mesh]:
    """Palms on the grass beside the road and on the cliffs, and undergrowth at the cliffs' feet."""
    low, high = land.places[0, 0], land.places[-1, -1]
    places = random.uniform(low, high, (5200, 2))
    row = ((places[:, 1] - land.ys[0]) / CELL).astype(int)
    column = ((places[:, 0] - land.xs[0]) / CELL).astype(int)
    away = land.away[row, column]
    chance = np.where(away < 10.5, 0, np.where(away < 20, 0.22, 0.16))
    keep = random.uniform(size=len(places)) < chance
    places = np.c_[places, land.at(places) - 0.2][keep]
    shade = land.shade(places + np.array([0, 0, 4]), light)[:, None]
    tall = random.uniform(4.5, 9.0, len(places))
    colours = np.clip(
        np.array(palette["palm"]) * random.uniform(0.8, 1.5, (len(places), 1)) * (0.55 + 0.75 * shade), 0, 1
    )
    meshes = []
    for kind in range(4):
        mine = np.arange(len(places)) % 4 == kind
        texture = textures.palm(random) if kind < 3 else textures.bush(random)
        height = tall[mine] * (1.0 if kind < 3 else 0.3)
        meshes.append(plants(places[mine], height, (0.9 if kind < 3 else 2.0) * height, colours[mine], texture, random))
    return meshes


def scenery(look: int) -> Scenery:
    random = np.random.default_rng(look)
    chosen = looks.make_look(look, LIGHT, PALETTE)
    light, palette = chosen.light, chosen.palette
    land = Land(Track("jungle"), random)
    meshes = [
        ground(land, random, light, palette),
        *road(land, random, chosen),
        *furniture(land.track, light, palette),
        *palms(land, random, light, palette),
    ]
    sky = dome(textures.sky(palette["zenith"], palette["horizon"]))
    return Scenery(meshes, sky, bonnet(palette["bonnet"], light), body(palette["bonnet"], light), tone=chosen.tone)
