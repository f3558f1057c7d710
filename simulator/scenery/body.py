"""The car as seen from outside, for films and the window; the cameras in the car see only its bonnet."""

from typing import NamedTuple

import numpy as np

from simulator.scenery import textures
from simulator.scenery.shapes import Colour, Light, Mesh, box, illuminate, merge, sheet

GLASS, TYRE, RIM, RED, WHITE = (0.07, 0.08, 0.10), (0.05, 0.05, 0.05), (0.45, 0.46, 0.48), (0.5, 0.04, 0.04), (0.9,) * 3
SHINING = (1.0, 0.12, 0.08)  # brake lights
# m, from the rear to the front: y, half the width, height of the upper edge.
SHELL = [
    (-2.30, 0.70, 0.66),
    (-2.22, 0.82, 0.82),
    (-1.80, 0.88, 0.88),
    (-0.60, 0.90, 0.86),
    (0.70, 0.90, 0.82),
    (1.40, 0.87, 0.74),
    (1.90, 0.80, 0.62),
    (2.05, 0.68, 0.48),
]
# y, half the width at the foot and at the roof, height of the roof.
CABIN = [
    (-1.95, 0.66, 0.62, 0.88),
    (-1.15, 0.76, 0.58, 1.24),
    (-0.45, 0.78, 0.58, 1.31),
    (0.05, 0.78, 0.58, 1.27),
    (0.95, 0.70, 0.64, 0.80),
]
WHEELS = [(x, y) for x in (-0.80, 0.80) for y in (1.27, -1.40)]  # m: the middles of their axles
RADIUS, TREAD, SPOKES = 0.34, 0.24, 24


class Body(NamedTuple):
    """The car's body in the coordinates of the bonnet: x right, y forward, z up, in metres."""

    body: Mesh
    wheel: Mesh  # one of the four, about the middle of its axle, which is the origin
    brake: Mesh  # the brake lights as they shine


def body(colour: Colour, light: Light) -> Body:
    """Return the car's body."""
    parts = [shell(colour), cabin(colour)]
    lamps = [(-2.27, RED, 0.62), (2.00, WHITE, 0.44)]  # behind and in front: y, colour, height
    for y, lamp, height in lamps:
        parts += [box((x, y, height), (0.30, 0.12, 0.10), 0.0, lamp, textures.plain()) for x in (-0.55, 0.55)]
    parts.append(box((0, -2.28, 0.40), (0.50, 0.10, 0.12), 0.0, WHITE, textures.plain()))  # number plate
    shining = [box((x, -2.29, 0.61), (0.34, 0.14, 0.14), 0.0, SHINING, textures.plain()) for x in (-0.55, 0.55)]
    return Body(illuminate(merge(parts), light), illuminate(wheel(), light), merge(shining))


def loft(sections: np.ndarray, colours: np.ndarray) -> Mesh:
    """Return a surface through cross-sections, closed at both ends.

    sections: (n, k, 3), from the rear to the front, each clockwise as seen from behind; colours: (n, k, 3).
    """
    ends = [np.broadcast_to(end.mean(axis=0), end.shape) for end in (sections[0], sections[-1])]
    points = np.concatenate([ends[:1], sections, ends[1:]])
    return sheet(points, np.concatenate([colours[:1], colours, colours[-1:]]), (0, 0), textures.plain())


def shell(colour: Colour) -> Mesh:
    """Return the body below the windows."""
    sections = []
    for y, width, top in SHELL:
        left = [(width * 0.96, 0.20), (width, 0.42), (width * 0.98, top - 0.08), (width * 0.86, top)]
        right = [(x, z) for x, z in reversed(left)]
        across = [(0.0, 0.20), *((-x, z) for x, z in left), (0.0, top + 0.03), *right, (0.0, 0.20)]
        sections.append([(x, y, z) for x, z in across])
    colours = np.broadcast_to(np.array(colour, float), (len(SHELL), 11, 3)).copy()
    colours[:, [0, 1, -2, -1]] *= 0.35  # the floor and the sills
    return loft(np.array(sections), colours)


def cabin(colour: Colour) -> Mesh:
    """Return windows and roof."""
    sections, colours = [], []
    for i, (y, foot, roof, top) in enumerate(CABIN):
        across = [(-foot, 0.78), (-roof, top - 0.05), (-roof * 0.86, top), (0.0, top + 0.02)]
        across += [(-x, z) for x, z in reversed(across[:3])]
        sections.append([(x, y, z) for x, z in across])
        has_roof = 0 < i < len(CABIN) - 1
        colours.append([colour if has_roof and 1 < column < 5 else GLASS for column in range(7)])
    return loft(np.array(sections), np.array(colours, float))


def wheel() -> Mesh:
    """Return a wheel about the middle of its axle."""
    angle = np.linspace(0, 2 * np.pi, SPOKES + 1)
    # From the left hub over the tread to the right hub: x from the wheel's middle, and radius.
    profile = [(-0.40, 0.62), (-0.48, 0.66), (-0.50, 1.0), (0.50, 1.0), (0.48, 0.66), (0.40, 0.62)]
    colours = np.array([RIM, TYRE, TYRE, TYRE, TYRE, RIM])
    sections = [[(TREAD * side, -RADIUS * r * np.cos(a), RADIUS * r * np.sin(a)) for side, r in profile] for a in angle]
    tread = sheet(np.array(sections), colours, (0, 0), textures.plain())
    return merge([tread, *(hub(TREAD * side, side > 0) for side in (-0.40, 0.40))])


def hub(x: float, outwards_right: bool) -> Mesh:
    """Return the disc in a wheel."""
    angle = np.linspace(0, 2 * np.pi, SPOKES + 1)[:-1]
    rim = np.stack([np.full(SPOKES, x), -0.62 * RADIUS * np.cos(angle), 0.62 * RADIUS * np.sin(angle)], axis=1)
    points = np.vstack([[(x, 0, 0)], rim])
    here = np.arange(SPOKES) + 1
    faces = np.stack([np.zeros(SPOKES, int), here, here % SPOKES + 1], axis=1)
    colours = np.tile(np.array(RIM), (len(points), 1))
    colours[1::3] *= 0.5  # spokes
    faces = faces[:, ::-1] if outwards_right else faces
    return Mesh(points, colours, np.zeros((len(points), 2)), faces, textures.plain())
