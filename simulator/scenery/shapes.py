"""Meshes as arrays: ribbons along the road, sheets of ground, rocks, posts, and pictures of plants on crossed
quads."""

from dataclasses import dataclass, replace

import numpy as np

from cloning.road.track import Track


@dataclass(frozen=True)
class Mesh:
    """points (n, 3) in metres; colours (n, 3), 0..1, which the texture is multiplied with; uv (n, 2); faces
    (m, 3) indices.

    texture: uint8 (rows, columns, 3 or 4); with 4 channels, parts whose alpha is under half are not drawn. sheen: by
    how much it is brighter where it is seen at a slant, far ahead.
    """

    points: np.ndarray
    colours: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    texture: np.ndarray
    sheen: float = 0.0


@dataclass(frozen=True)
class Light:
    """sun: unit vector towards it; colours of the sun and of the shaded side's fill, 0..1."""

    sun: tuple[float, float, float]
    sunlight: tuple[float, float, float]
    fill: tuple[float, float, float]

    def on(self, normals: np.ndarray) -> np.ndarray:
        """(n, 3): what a white surface shows for unit normals (n, 3)."""
        facing = np.clip(normals @ np.array(self.sun), 0, 1)[:, None]
        return np.array(self.fill) + facing * np.array(self.sunlight)


def grid(rows: int, columns: int) -> np.ndarray:
    """Faces of a sheet of rows x columns points, counter-clockwise seen with rows to the north and columns to
    the east."""
    a = np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)
    b = a + columns
    return np.stack([a, a + 1, b + 1, a, b + 1, b], axis=-1).reshape(-1, 3)


def normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals at the points, (n, 3), each the area-weighted mean of its faces'."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    each = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, faces[:, corner], each)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)


def lit(mesh: Mesh, light: Light, faced_up: bool = False) -> Mesh:
    """The mesh with its colours under the light; faced_up: normals are turned to look upwards."""
    facing = normals(mesh.points, mesh.faces)
    if faced_up:
        facing *= np.where(facing[:, 2:] < 0, -1.0, 1.0)
    return replace(mesh, colours=np.clip(mesh.colours * light.on(facing), 0, 1))


def ribbon(track: Track, s, offsets, heights, colour, texture, metres: float, across=None) -> Mesh:
    """A strip along the road: at each of the distances s, points at `offsets` metres left of the centre line.

    offsets, heights (above the road): (k,), left to right, the same everywhere. colour: (3,), or (len(s), k, 3).
    metres: of road that one texture covers; across: the texture's coordinate at each offset, else by the same metres.
    """
    s, offsets = np.asarray(s, float), np.asarray(offsets, float)
    n, k = len(s), len(offsets)
    index = np.round(s / track.step).astype(int) % len(track.points)
    points = np.empty((n, k, 3))
    points[:, :, :2] = track.points[index, None, :2] - track.rightward[index, None] * offsets[None, :, None]
    points[:, :, 2] = track.points[index, None, 2] + np.broadcast_to(heights, (n, k))
    across = -offsets / metres if across is None else np.asarray(across, float)
    uv = np.stack(np.broadcast_arrays(across[None, :], (s / metres)[:, None]), axis=-1)
    colours = np.broadcast_to(np.asarray(colour, float), (n, k, 3))
    return Mesh(points.reshape(-1, 3), colours.reshape(-1, 3).copy(), uv.reshape(-1, 2), grid(n, k), texture)


def roadside(track: Track, s, side: int, offsets, heights, colour, texture, metres: float, across=None) -> Mesh:
    """A ribbon beside the road, on its left (side 1) or mirrored to its right (-1); offsets from the road
    outwards."""
    offsets, heights = side * np.array(offsets, float), np.array(heights, float)
    across = -offsets / metres if across is None else np.array(across, float)
    if side > 0:  # ribbons run from left to right
        offsets, heights, across = offsets[::-1], heights[::-1], across[::-1]
    return ribbon(track, s, offsets, heights, colour, texture, metres, across)


def around(track: Track, every: float = 1.0) -> np.ndarray:
    """Distances once round the whole track, the first point again at the end."""
    return np.linspace(0, track.length, round(track.length / every) + 1)


def stretch(start: float, end: float, every: float = 1.0) -> np.ndarray:
    return np.linspace(start, end, max(2, round((end - start) / every) + 1))


def plants(places: np.ndarray, heights: np.ndarray, widths: np.ndarray, colours: np.ndarray, texture, random) -> Mesh:
    """Two crossed upright pictures at each of the places (n, 3); heights and widths (n,) in metres, colours
    (n, 3)."""
    turn = random.uniform(0, np.pi, len(places))[:, None] + np.array([0, np.pi / 2])
    aside = (
        np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1) * (widths / 2)[:, None, None]
    )  # (n, 2, 3)
    foot, up = places[:, None], np.zeros((len(places), 1, 3))
    up[:, 0, 2] = heights
    corners = np.stack([foot - aside, foot + aside, foot + aside + up, foot - aside + up], axis=2)  # (n, 2, 4, 3)
    quads = 2 * len(places)
    faces = np.arange(quads)[:, None, None] * 4 + np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.tile(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), (quads, 1))
    return Mesh(corners.reshape(-1, 3), np.repeat(colours, 8, axis=0), uv, faces.reshape(-1, 3), texture)


def boulder(centre, size, random, colour, texture, lumps: float = 0.15, detail: int = 9) -> Mesh:
    """A lumpy ellipsoid; size: its half axes in metres."""
    polar, turn = np.meshgrid(np.linspace(0, np.pi, detail), np.linspace(0, 2 * np.pi, 2 * detail), indexing="ij")
    waves = sum(
        random.normal() * np.cos(random.integers(1, 4) * turn + random.uniform(0, 6)) * np.sin(polar) ** 2
        for _ in range(5)
    )
    radius = 1 + lumps * waves / 2
    ball = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    points = (ball * radius[..., None] * np.array(size) + np.array(centre)).reshape(-1, 3)
    uv = np.column_stack([turn.ravel() / np.pi * 2, -polar.ravel() / np.pi])
    faces = grid(*polar.shape)
    return Mesh(points, np.tile(np.array(colour, float), (len(points), 1)), uv, faces, texture)


def box(centre, size, heading: float, colour, texture) -> Mesh:
    """An upright box: centre of its foot, (length, width, height) in metres, its length along `heading`."""
    length, width, height = size
    corner = np.array([[x, y, z] for z in (0, 1) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))])
    sides = ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7))
    points = corner[np.array(sides).ravel()] * (length, width, height)
    cos, sin = np.cos(heading), np.sin(heading)
    points[:, :2] = points[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    faces = np.arange(5)[:, None, None] * 4 + np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.tile(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), (5, 1))
    return Mesh(
        points + np.array(centre),
        np.tile(np.array(colour, float), (20, 1)),
        uv,
        faces.reshape(-1, 3),
        texture,
    )


def together(meshes: list[Mesh]) -> Mesh:
    """Meshes that share one texture, as one."""
    first = np.cumsum([0] + [len(mesh.points) for mesh in meshes[:-1]])
    return replace(
        meshes[0],
        points=np.vstack([mesh.points for mesh in meshes]),
        colours=np.vstack([mesh.colours for mesh in meshes]),
        uv=np.vstack([mesh.uv for mesh in meshes]),
        faces=np.vstack([mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]),
    )
