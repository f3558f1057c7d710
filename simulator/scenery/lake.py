"""The lake's scenery, from its centre line: distances along it and features were read off the real
simulator's frames."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from cloning.road.track import Track
from simulator.scenery import looks, textures
from simulator.scenery import planting as lakeside
from simulator.scenery.looks import Look
from simulator.scenery.parts import Haze, Scenery, body, bonnet, dome
from simulator.scenery.shapes import Light, Mesh, around, grid, lit, ribbon, roadside, stretch

ASPHALT, EDGE = 4.95, 7.0  # m from the centre line: where the asphalt ends, and the concrete beside it
BRIDGE = (674, 783)
CELL = 7.0  # m between the ground's points
# (side, from, to): +1 is left of the listed direction
KERBS = (
    (1, -45, 50),
    (-1, -45, 55),
    (1, 465, 545),
    (-1, 478, 545),
    (1, 815, 892),
    (-1, 825, 845),
    (-1, 860, 885),
    (1, 965, 1022),
    (-1, 958, 1022),
)
CLIFF = (-1, -45, 55)  # dark rock close to the road
VERGES = ((-1, 62, 106), (-1, 845, 860))  # no concrete here: red earth up to the asphalt
# Height in metres of the land 25 m beside the road, by distance along it
RIGHT = (
    (-60, 7),
    (-40, 9),
    (40, 9),
    (62, 5),
    (75, 2),
    (110, 3),
    (150, 7),
    (200, 11),
    (300, 14),
    (420, 15),
    (500, 13),
    (535, 5),
    (560, 0),
    (585, -3),
    (790, -3),
    (805, 1),
    (850, 1.5),
    (880, 4),
    (930, 6),
    (958, 1.5),
    (1000, 1.5),
    (1024, 4),
    (1075, 3.5),
)
LEFT = (
    (-20, 2),
    (25, 3),
    (60, 1.5),
    (110, 2.5),
    (135, -1),
    (160, -3),
    (215, -3),
    (245, 2.5),
    (300, 2.5),
    (350, 1.5),
    (420, 1),
    (470, 0.5),
    (500, -3),
    (790, -3),
    (805, 0.5),
    (865, 2),
    (905, 3),
    (940, 2),
    (960, -3),
    (1018, -3),
    (1032, 1.5),
    (1085, 2),
)
EARTH = (
    (-1, -45, 110),
    (-1, 215, 440),
    (1, 220, 420),
    (-1, 560, 640),
    (-1, 843, 864),
    (1, 150, 240),
)  # red earth beside
SHADOWS = (
    (22, 0, 0.5, 9),
    (29, -1.5, 0.6, 6),
    (62, 3, 0.4, 8),
    (628, 4, 5, 3.5),
    (632, 2.5, 3, 2),
    (884, 0, 4, 5),
    (915, -1, 6, 4),
    (1070, 0, 0.4, 9),
    (1104, 0, 0.5, 9),
    (1111, -2, 0.7, 8),
)  # along, left, half length, half width


def around_lap(table, s: np.ndarray, length: float) -> np.ndarray:
    """The table's values at the distances, going round."""
    at, value = np.array(table, float).T
    return np.interp(s, np.r_[at - length, at, at + length], np.tile(value, 3))


def within(stretches, s: np.ndarray, side: np.ndarray, length: float) -> np.ndarray:
    """Whether each place (s, side) lies in one of the stretches (side, from, to)."""
    inside = np.zeros(np.shape(s), bool)
    for which, start, end in stretches:
        inside |= (side == which) & ((s - start) % length <= end - start)
    return inside


class Land:
    """The ground's height and nearest road, as functions of the place."""

    WATER = -1.2  # m: the lake's level

    def __init__(self, track: Track, random, relief: float = 1.0, moved: float = 0.0):
        """relief: factor of its heights; moved: metres by which all of it lies further back along the road."""
        self.track, self.relief, self.moved = track, relief, moved
        self.tree = cKDTree(track.points[:, :2])
        self.rolling = textures.clouds(random, 256, 24, 5)  # one metre of height a unit, 4 m a pixel

    def nearest_road(self, places: np.ndarray):
        """Of places (n, 2): distance to the centre line, s as the land's tables have it, and side (+1 left)."""
        away, nearest = self.tree.query(places)
        right = np.einsum("ij,ij->i", places - self.track.points[nearest, :2], self.track.rightward[nearest])
        return away, (nearest * self.track.step + self.moved) % self.track.length, np.where(right < 0, 1, -1)

    def height(self, places: np.ndarray) -> np.ndarray:
        """Metres above the road's level, which is the lake's zero; the water stands at -1.2."""
        away, s, side = self.nearest_road(places)
        length = self.track.length
        near = np.where(side > 0, around_lap(LEFT, s, length), around_lap(RIGHT, s, length))
        near = np.where(near > 0, self.relief * near, near)
        cliff = within((CLIFF,), s, side, length)
        rise = np.clip((away - np.where(cliff, 15, 9)) / np.where(cliff, 6, 22), 0, 1)
        rise = rise * rise * (3 - 2 * rise)
        row, column = (np.floor(places / 4).astype(int) % 256).T
        roll = self.rolling[row, column]
        far = np.clip((away - 35) / 90, 0, 1)
        beyond = self.relief * np.where(near > 2.5, 14 + 9 * roll, 1.5 + 4 * roll) if len(places) else roll
        lake = (side > 0) & (away > 40)
        beyond = np.where(lake, -3 + 2.2 * roll, beyond)
        z = near * rise * (1 + 0.15 * roll) + np.where(lake, (beyond - near) * far, np.maximum(beyond, 0) * far * 0.8)
        z = np.where(near < 0, np.where(away > 60, z + 2.2 * far * (side < 0), z), z)
        return np.where(away < 8.5, -0.15, z + 0.02)


def ground(land: Land, random, light: Light, palette: dict, soil) -> list[Mesh]:
    """A fine sheet near the road and a coarse one, a little lower, beyond."""
    tone = textures.clouds(random, 256, 12, 4)
    low, high = land.track.points[:, :2].min(axis=0) - 230, land.track.points[:, :2].max(axis=0) + 230
    sheets = []
    for cell, nearest, farthest, lower in ((CELL, 0, 66, 0.0), (2.5 * CELL, 48, 400, 0.4)):
        xs, ys = (np.arange(a, b, cell) for a, b in zip(low, high, strict=True))
        places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        away, s, side = land.nearest_road(places)
        points = np.c_[places, land.height(places) - lower]
        sheet = Mesh(points, np.ones_like(points), places / 14.0, grid(len(ys), len(xs)), soil)
        facing = lit(sheet, Light((0, 0, 1), (1, 1, 1), (0, 0, 0)), faced_up=True).colours[:, :1]
        steep = np.clip((0.93 - facing) * 6, 0, 1)
        patch = tone[tuple((np.floor(places / 5).astype(int) % 256).T)][:, None]
        green = 0.35 * np.clip(0.5 + 0.35 * patch, 0, 1)
        colour = np.array(palette["grass"]) * (1 - green) + np.array(palette["green"]) * green
        earth = within(EARTH, s, side, land.track.length) & (away < 30)
        colour = np.where(earth[:, None], np.array(palette["earth"]), colour)
        colour = colour * (1 - steep) + np.array(palette["sand"]) * (1 + 0.10 * patch) * steep
        cliff = within((CLIFF,), s, side, land.track.length) & (away > 14) & (away < 32)
        sheet.colours[:] = np.where(cliff[:, None], np.array(palette["cliff"]), colour)
        corners = away[sheet.faces]
        seen = (points[sheet.faces, 2].max(axis=1) > land.WATER - 0.4) & (corners.max(axis=1) > nearest)
        seen &= corners.min(axis=1) < farthest
        sheets.append(replace(lit(sheet, light, faced_up=True), faces=sheet.faces[seen]))
    return sheets


def tarmac(random, look: Look) -> np.ndarray:
    """Asphalt as wide as the road, with its double lines; divided by the asphalt's own colour, which the
    vertices carry."""
    palette = look.palette
    texture = textures.asphalt(random, grain=0.15 * look.grain, spots=look.spots).astype(float)
    columns = texture.shape[1]
    left = ASPHALT - (np.arange(columns) + 0.5) / columns * 2 * ASPHALT
    for offset, half, name in ((3.72, 0.17, "seam"), (3.5, 0.05, "line"), (3.95, 0.04, "outer line")):
        texture[:, np.abs(np.abs(left) - offset) < half] = np.array(palette[name]) / palette["asphalt"] * 255
    return np.clip(texture, 0, 255).astype(np.uint8)


def road(track: Track, random, look: Look, soil, shadows) -> list[Mesh]:
    """Asphalt with its double lines, kerbs, concrete edges, verges, and the bridge."""
    s, black, light, palette = around(track, 2.0), textures.line(), look.light, look.palette
    across = np.linspace(ASPHALT, -ASPHALT, 7)
    shade = np.ones((len(s), len(across), 3))
    for at, left, half_length, half_width in shadows:
        along = ((s - at + track.length / 2) % track.length - track.length / 2)[:, None] / half_length
        inside = np.clip(1.6 - np.hypot(along, (across - left) / half_width) * 1.2, 0, 1)[..., None]
        shade *= 1 - 0.5 * inside
    painted = 0.5 - across / (2 * ASPHALT)
    asphalt = np.array(palette["asphalt"]) * shade
    surface = ribbon(track, s, across, 0.0, asphalt, tarmac(random, look), 2 * ASPHALT, painted)
    meshes = [replace(surface, sheen=look.sheen)]
    slab, stripes = textures.concrete(random), textures.kerb()
    hard = Light(light.sun, tuple(1.25 * np.array(light.sunlight)), tuple(0.75 * np.array(light.fill)))
    for side in (1, -1):
        verges = [(start, end) for which, start, end in VERGES if which == side]
        begin = 0.0
        for start, end in [*sorted([*verges, BRIDGE]), (track.length, None)]:
            shape = (track, stretch(begin, start, 3.0), side, (ASPHALT, 5.9, EDGE, EDGE + 0.2))
            paint = (palette["slab"], slab, 3.0, (0, 0.5, 0.9, 1))
            # lit as if it rose steeply, which is how the real ones look, white or blue, though their edges lie low
            bright = lit(roadside(*shape, (0, 0.9, 1.9, 2.0), *paint), hard, faced_up=True)
            meshes.append(replace(bright, points=roadside(*shape, (0.01, 0.05, 0.08, -0.5), *paint).points))
            begin = end
        for start, end in verges:
            shape = (track, stretch(start, end, 2.0), side, (3.35, 3.8, 6.0, 12.0), (0.012, 0.016, 0.02, 0.1))
            meshes.append(lit(roadside(*shape, palette["earth"], soil, 9.0), light, faced_up=True))
    for side, start, end in KERBS:
        kerb = (
            track,
            stretch(start, end),
            side,
            (3.86, 4.93),
            (0.03, 0.06),
            palette["kerb"],
            stripes,
            look.stripes,
            (0, 1),
        )
        meshes.append(roadside(*kerb))
    deck = stretch(*BRIDGE)
    meshes.append(ribbon(track, deck, across, 0.02, palette["cobbles"], textures.cobbles(random), 4.5))
    for side in (1, -1):
        for offsets, heights in (
            ((4.9, 4.9), (0, 0.75)),
            ((4.9, 5.5), (0.75, 0.75)),
            ((5.5, 5.5), (0.75, -2)),
        ):
            meshes.append(roadside(track, deck, side, offsets, heights, (0.02, 0.02, 0.02), black, 4.0, (0, 1)))
    return meshes


PALETTE = {
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
LIGHT = Light(sun=(0.78, -0.10, 0.62), sunlight=(0.74, 0.68, 0.50), fill=(0.56, 0.61, 0.68))


def cast(random, length: float, count: int) -> list[tuple]:
    """Shadows of trees and posts at other places than the real simulator's."""
    return [
        (
            random.uniform(0, length),
            random.uniform(-4, 4),
            random.choice((0.5, 0.5, 3.0, 5.0, 12.0)),
            random.uniform(2, 9),
        )
        for _ in range(count)
    ]


def scenery(look: int) -> Scenery:
    random = np.random.default_rng(look)
    track, chosen = Track("lake"), looks.make_look(look, LIGHT, PALETTE)
    light, palette = chosen.light, chosen.palette
    land = Land(track, random, chosen.relief, chosen.moved)
    side = np.linspace(-760, 760, 27)
    flat = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    water = Mesh(
        np.c_[flat, np.full(len(flat), land.WATER)],
        np.tile(np.array(palette["water"]), (len(flat), 1)),
        flat / 40,
        grid(27, 27),
        textures.grey(0.97, 0.02 * textures.noise(random, (64, 64), 3)),
    )
    soil = textures.soil(random)
    shadows = SHADOWS if chosen.shadows is None else cast(random, track.length, chosen.shadows)
    meshes = [
        *ground(land, random, light, palette, soil),
        *road(track, random, chosen, soil, shadows),
        water,
        lakeside.mountains(random, light, palette, soil),
        lakeside.rocks(land, random, light, palette),
        *lakeside.pines(land, random, palette, chosen.plants),
        *lakeside.pylons(land, light),
    ]
    sky = dome(textures.sky(palette["zenith"], palette["horizon"]))
    return Scenery(
        meshes,
        sky,
        bonnet(palette["bonnet"], light),
        body(palette["bonnet"], light),
        Haze((0.41, 0.60, 0.85), (100, 600), 0.8),
        chosen.tone,
    )
