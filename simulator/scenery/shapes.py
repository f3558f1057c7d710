"""Meshes as arrays: ground, ribbons along the road, boulders, boxes, and plants as crossed images."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from cloning.road.track import LEFT, Track

Colour = tuple[float, float, float]  # RGB, 0..1
Vector = tuple[float, float, float]  # x, y, z


@dataclass(frozen=True)
class Mesh:
    """Triangles with colours at their corners and one texture."""

    points: np.ndarray  # float (n, 3): m
    colours: np.ndarray  # float (n, 3): 0..1, by which the texture is multiplied
    uv: np.ndarray  # float (n, 2): texture coordinates
    faces: np.ndarray  # int (m, 3): indices into the points
    texture: np.ndarray  # uint8 (rows, columns, 3 RGB or 4 RGBA); pixels with alpha below half are transparent
    sheen: float = 0.0  # relative gain in brightness where the mesh is seen far ahead, at a grazing angle
    # float (n, 2): s along the track and lateral offset of points of a ribbon along the road, m; else None.
    road: np.ndarray | None = None


@dataclass(frozen=True)
class Light:
    """The light of a scene."""

    sun: Vector  # unit vector towards the sun
    sunlight: Colour  # colour of its light
    fill: Colour  # colour of the light that reaches shaded sides, too

    def on(self, normals: np.ndarray) -> np.ndarray:
        """Return the colours, (n, 3), of a white surface with unit normals (n, 3)."""
        facing = np.clip(normals @ np.array(self.sun), 0, 1)[:, None]
        return np.array(self.fill) + facing * np.array(self.sunlight)


@dataclass(frozen=True)
class Material:
    """The colour and texture of a ribbon."""

    colour: ArrayLike  # (3,) or (distances, offsets, 3)
    texture: np.ndarray  # as in Mesh
    metres: float  # length of road that one repetition of the texture covers
    # Texture coordinates at the ribbon's offsets; None: the texture repeats every `metres` across the road, too.
    across: ArrayLike | None = None


def grid(rows: int, columns: int) -> np.ndarray:
    """Return the faces of a sheet of rows x columns points, int (m, 3).

    They are counter-clockwise, seen with the rows towards the north and the columns towards the east.
    """
    a = np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)
    b = a + columns
    return np.stack([a, a + 1, b + 1, a, b + 1, b], axis=-1).reshape(-1, 3)


def ground_grid(track: Track, margin: float, spacing: float) -> np.ndarray:
    """Return the points of a square grid over the track and `margin` m around it: float64 (rows, columns, 2), m."""
    low, high = track.points[:, :2].min(axis=0) - margin, track.points[:, :2].max(axis=0) + margin
    xs, ys = (np.arange(start, end, spacing) for start, end in zip(low, high, strict=True))
    return np.stack(np.meshgrid(xs, ys), axis=-1)


def sheet(
    points: np.ndarray, colours: ArrayLike, uv: ArrayLike, texture: np.ndarray, road: np.ndarray | None = None
) -> Mesh:
    """Return a mesh of points (rows, columns, 3); colours, uv and road: as in Mesh, broadcast to rows and columns."""
    rows, columns = points.shape[:2]

    def column(values: ArrayLike, size: int) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, float), (rows, columns, size)).reshape(-1, size).copy()

    along = None if road is None else column(road, 2)
    return Mesh(points.reshape(-1, 3), column(colours, 3), column(uv, 2), grid(rows, columns), texture, road=along)


def quads(corners: np.ndarray, colours: ArrayLike, texture: np.ndarray) -> Mesh:
    """Return separate quadrangles (n, 4, 3), counter-clockwise from bottom left; colours: (3,), or (n, 1, 3)."""
    count = len(corners)
    uv = np.tile(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), (count, 1))
    faces = np.arange(count)[:, None, None] * 4 + np.array([[0, 1, 2], [0, 2, 3]])
    colours = np.broadcast_to(np.asarray(colours, float), corners.shape).reshape(-1, 3).copy()
    return Mesh(corners.reshape(-1, 3), colours, uv, faces.reshape(-1, 3), texture)


def normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals at the points, (n, 3): the area-weighted means of the adjacent faces' normals."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, faces[:, corner], face_normals)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)


def flatness(mesh: Mesh) -> np.ndarray:
    """Return the flatness at each point of a mesh, (n, 1): 1 where it is level, 0 where it is vertical."""
    return np.clip(np.abs(normals(mesh.points, mesh.faces)[:, 2:]), 0, 1)


def illuminate(mesh: Mesh, light: Light, face_up: bool = False) -> Mesh:
    """Return the mesh with its colours in this light; face_up turns the normals upwards."""
    facing = normals(mesh.points, mesh.faces)
    if face_up:
        facing *= np.where(facing[:, 2:] < 0, -1.0, 1.0)
    return replace(mesh, colours=np.clip(mesh.colours * light.on(facing), 0, 1))


def ribbon(track: Track, s: ArrayLike, offsets: ArrayLike, heights: ArrayLike, material: Material) -> Mesh:
    """Return a strip along the road, through the points at the distances s in metres.

    offsets, heights: (k,), its cross-section from left to right, m to the right of the centre line and above the road.
    """
    s, offsets = np.asarray(s, float), np.asarray(offsets, float)
    n, k = len(s), len(offsets)
    index = track.wrap(np.round(s / track.step).astype(int))
    points = np.empty((n, k, 3))
    points[:, :, :2] = track.points[index, None, :2] + track.rightward[index, None] * offsets[None, :, None]
    points[:, :, 2] = track.points[index, None, 2] + np.broadcast_to(heights, (n, k))
    across = offsets / material.metres if material.across is None else np.asarray(material.across, float)
    uv = np.stack(np.broadcast_arrays(across, (s / material.metres)[:, None]), axis=-1)
    road = np.stack(np.broadcast_arrays(s[:, None], offsets), axis=-1)
    return sheet(points, material.colour, uv, material.texture, road)


def surface(track: Track, s: np.ndarray, half_width: float, material: Material) -> Mesh:
    """Return the road's surface: a ribbon on both sides of the centre line, with its texture once across it."""
    offsets = np.linspace(-half_width, half_width, 7)
    return ribbon(track, s, offsets, 0.0, replace(material, across=0.5 + offsets / (2 * half_width)))


def roadside(track: Track, s: ArrayLike, side: int, offsets: ArrayLike, heights: ArrayLike, material: Material) -> Mesh:
    """Return a ribbon on one side of the road, LEFT or RIGHT; the cross-section runs outwards from the centre line."""
    offsets, heights = side * np.array(offsets, float), np.array(heights, float)
    across = offsets / material.metres if material.across is None else np.array(material.across, float)
    if side == LEFT:  # ribbons run from left to right
        offsets, heights, across = offsets[::-1], heights[::-1], across[::-1]
    return ribbon(track, s, offsets, heights, replace(material, across=across))


def wall(track: Track, s: ArrayLike, side: int, outline: ArrayLike, material: Material) -> list[Mesh]:
    """Return the faces of a wall on one side of the road; outline: (n, 2), offset and height of its edges, outwards."""
    corners = np.array(outline, float)
    return [
        roadside(track, s, side, offsets, heights, material)
        for offsets, heights in np.stack([corners[:-1], corners[1:]], axis=-1)
    ]


def distances(start: float, end: float, spacing: float = 1.0) -> np.ndarray:
    """Return distances s about `spacing` metres apart, from start to end, both included."""
    return np.linspace(start, end, max(2, round((end - start) / spacing) + 1))


def plants(
    feet: np.ndarray, heights: np.ndarray, widths: np.ndarray, colours: np.ndarray, texture: np.ndarray, rng: Generator
) -> Mesh:
    """Return two crossed upright images of a plant at each foot, (n, 3); heights, widths: (n,), m; colours: (n, 3)."""
    turn = rng.uniform(0, np.pi, len(feet))[:, None] + np.array([0, np.pi / 2])
    sideways = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)  # (n, 2, 3)
    sideways = sideways * (widths / 2)[:, None, None]
    foot, up = feet[:, None], np.zeros((len(feet), 1, 3))
    up[:, 0, 2] = heights
    corners = np.stack([foot - sideways, foot + sideways, foot + sideways + up, foot - sideways + up], axis=2)
    return quads(corners.reshape(-1, 4, 3), np.repeat(colours, 2, axis=0)[:, None], texture)


def boulder(centre: Vector, half_axes: Vector, rng: Generator, colour: Colour, texture: np.ndarray) -> Mesh:
    """Return an uneven ellipsoid; centre and half axes in metres."""
    polar, turn = np.meshgrid(np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 18), indexing="ij")
    waves = sum(
        rng.normal() * np.cos(rng.integers(1, 4) * turn + rng.uniform(0, 6)) * np.sin(polar) ** 2 for _ in range(5)
    )
    radius = 1 + 0.15 * waves / 2
    ball = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    points = ball * radius[..., None] * np.array(half_axes) + np.array(centre)
    return sheet(points, colour, np.stack([turn / np.pi * 2, -polar / np.pi], axis=-1), texture)


def box(foot: Vector, size: Vector, heading: float, colour: Colour, texture: np.ndarray) -> Mesh:
    """Return an upright box without a bottom.

    foot: centre of its base, m; size: length along `heading` (radians), width and height, m.
    """
    corner = np.array([[x, y, z] for z in (0, 1) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))])
    sides = np.array([(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7)])
    points = corner[sides.ravel()] * size
    cos, sin = np.cos(heading), np.sin(heading)
    points[:, :2] = points[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    return quads((points + np.array(foot)).reshape(-1, 4, 3), colour, texture)


def merge(meshes: list[Mesh]) -> Mesh:
    """Return a single mesh of meshes that share a texture; `road` remains if all have it."""
    along = [mesh.road for mesh in meshes if mesh.road is not None]
    first = np.cumsum([0] + [len(mesh.points) for mesh in meshes[:-1]])
    return replace(
        meshes[0],
        points=np.vstack([mesh.points for mesh in meshes]),
        colours=np.vstack([mesh.colours for mesh in meshes]),
        uv=np.vstack([mesh.uv for mesh in meshes]),
        faces=np.vstack([mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]),
        road=np.vstack(along) if len(along) == len(meshes) else None,
    )
