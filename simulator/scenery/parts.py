"""The parts that all sceneries share: sky, haze, and the car's own bonnet."""

from dataclasses import dataclass, replace

import numpy as np

from cloning.road.camera import height_at_rows
from simulator.scenery import textures
from simulator.scenery.body import Body, body
from simulator.scenery.looks import Look
from simulator.scenery.shade import Shade
from simulator.scenery.shapes import Colour, Light, Mesh, illuminate, sheet


@dataclass(frozen=True)
class Haze:
    """Haze that grows with the distance."""

    colour: Colour
    range: tuple[float, float]  # metres at which it begins, and at which it would hide everything without `maximum`
    maximum: float = 1.0  # largest share of the haze in a colour, 0..1


@dataclass(frozen=True)
class Scenery:
    """Everything that the cameras see; light and tone are those of `looks.Look`."""

    meshes: list[Mesh]
    sky: Mesh
    bonnet: Mesh  # moves with the car, as the body does
    body: Body
    light: Light
    haze: Haze | None = None
    tone: np.ndarray | None = None
    shade: Shade | None = None  # without, nothing casts shadows

    @property
    def asphalt(self) -> Mesh:
        """The road itself: of the meshes along it, the one with the most points."""
        return max((mesh for mesh in self.meshes if mesh.road is not None), key=lambda mesh: len(mesh.points))


def assemble(meshes: list[Mesh], look: Look, haze: Haze | None = None) -> Scenery:
    """Return the scenery of these meshes, with the sky and the car in the light and colours of the look."""
    palette, light = look.palette, look.light
    sky = dome(textures.sky(palette["zenith"], palette["horizon"]))
    colour = palette["bonnet"]
    return Scenery(meshes, sky, bonnet(colour, light), body(colour, light), light, haze, look.tone)


def dome(texture: np.ndarray, radius: float = 900.0) -> Mesh:
    """Return a sky around the viewer, radius in m; the bottom row of the texture lies at the horizon."""
    azimuth, elevation = np.meshgrid(np.linspace(0, 2 * np.pi, 33), np.radians([-8, 0, 5, 10, 20, 40, 88]))
    flat = np.cos(elevation)
    points = radius * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    height = np.clip(elevation / np.radians(40), 0.01, 0.99)
    return sheet(points, (1, 1, 1), np.stack([azimuth, height], axis=-1), texture)


def bonnet(colour: Colour, light: Light) -> Mesh:
    """Return the car's bonnet in the car's coordinates: x right, y forward, z up, in metres.

    Its front edge was fitted to real centre frames: `rows` are the image rows of the edge at the lateral positions x.
    """
    x = np.linspace(-0.70, 0.63, 43)
    front = 2.10 - 0.40 * (x / 0.64) ** 2
    rows = np.interp(
        x,
        [-0.70, -0.67, -0.60, -0.53, -0.36, -0.22, 0.11, 0.32, 0.49, 0.605, 0.63],
        [175, 159, 154, 147, 142.7, 137.7, 137, 141.7, 150, 158, 172],
    )
    edge = height_at_rows(rows, x, front)
    bands = np.array([0.0, 0.015, 0.03, 0.12, 0.2, 0.24, 0.28, 0.6, 1.0])  # share of the length, from the front edge
    shade = np.array([0.55, 0.85, 1.0, 0.95, 0.80, 0.45, 0.95, 1.15, 1.2])
    y = front + (1.40 - front) * bands[:, None]
    z = edge + (0.62 - edge) * bands[:, None] ** 0.8 - 0.25 * (x / 0.64) ** 4 * bands[:, None]
    points = np.stack([np.broadcast_to(x, y.shape), y, z], axis=-1)
    colours = np.clip(shade[:, None, None] * np.array(colour), 0, 1)
    colours = np.broadcast_to(colours, points.shape).copy()
    lamps = np.abs(np.abs(x + 0.03) - 0.50) < 0.035
    colours[2:4, lamps] = 0.85
    mesh = sheet(points, colours, (0, 0), textures.plain())
    return illuminate(replace(mesh, faces=mesh.faces[:, ::-1]), light, face_up=True)
