"""Shadows that hills, plants and buildings cast, computed once for a scene, because the renderer has no shaders.

Everything is projected along the sun's rays onto the ground plane z = 0, where a picture keeps the height of the
highest thing on each ray (a shadow map). A point lies in the shade if something higher lies on its ray.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cloning.road.track import Track
from simulator.scenery.shapes import Light, Mesh, normals, quads

STRETCH, OVERLAP = 120.0, 4.0  # m of road with a picture of its own, and m by which that reaches beyond both ends
LENGTH = STRETCH + 2 * OVERLAP  # m of road in a picture
HALF_WIDTH = 10.0  # m on each side of the centre line in a picture; its edges extend outwards
PICTURE_SHAPE = (1024, 128)  # rows along the road, columns across it: the engine wants powers of two
FINE, COARSE = 0.125, 1.0  # m: pixels of the shadow maps of a stretch of road and of the whole scene
FINE_MARGIN, COARSE_MARGIN = 0.3, 1.0  # m by which things must be higher than a point to shade it
TALL, SPLITS = 2.0, 4  # m: higher triangles are divided, at most so often, because each is painted at a single height
SUBPIXEL = 4  # binary digits after the point of the coordinates that OpenCV takes
OPAQUE = 128  # alpha from which a plant's pixel casts a shadow
CAR_SHADOW, CAR_SHADOW_HEIGHT = (2.3, 5.0), 0.04  # m: width and length with the soft edges; above the ground
CAR_HEIGHT = 0.75  # m above the ground: the highest part of the car that is as wide and as long as the car
THINNEST = 0.05  # m: plants' images that the sun sees narrower than this cast no shadow


@dataclass(frozen=True)
class ShadeStyle:
    """How dark, how soft and how long shadows are."""

    depth: float  # exponent of the share of light that the sky alone gives: 1 is physical, more is darker
    softness: float  # standard deviation of the blur of the shadows' edges on the road, m
    elevation: float = 1.0  # factor of the elevation of the sun that casts them; below 1 they are longer


class ShadowMap:
    """The height of the highest thing on each of the sun's rays through a rectangle of the plane z = 0."""

    def __init__(self, low: np.ndarray, high: np.ndarray, pixel: float):
        """low, high: (2,), the rectangle's corners in m; pixel: m."""
        self.low, self.high, self.pixel = low, high, pixel
        columns, rows = np.ceil((high - low) / pixel).astype(int) + 1
        self.height = np.full((rows, columns), -np.inf, np.float32)

    def paint(self, triangles: np.ndarray, heights: np.ndarray) -> None:
        """Paint triangles, float (n, 3 corners, 3: position on the plane, height), each at a single height (n,)."""
        order = np.argsort(heights, kind="stable")
        corners = np.round((triangles[order, :, :2] - self.low) / self.pixel * 2**SUBPIXEL).astype(np.int32)
        for polygon, height in zip(corners, heights[order].tolist(), strict=True):
            cv2.fillConvexPoly(self.height, polygon, height, shift=SUBPIXEL)

    def touched(self, polygons: np.ndarray) -> np.ndarray:
        """Return for polygons (n, corners, 3) whether each may touch the rectangle: bool (n,)."""
        flat = polygons[..., :2]
        return ((flat.max(axis=1) >= self.low) & (flat.min(axis=1) <= self.high)).all(axis=1)

    def paint_plants(self, corners: np.ndarray, texture: np.ndarray) -> None:
        """Paint upright images of plants, float (n, 4, 3) from the bottom left corner on, at their middles' heights."""
        rows, columns = texture.shape[:2]
        alpha = np.ascontiguousarray(texture[..., 3])
        for quad in corners[self.touched(corners)]:
            left, right, _, top = (quad[:, :2] - self.low) / self.pixel
            foot = np.array([right - left, left - top]).T  # per image, towards its right and its bottom
            if abs(np.linalg.det(foot)) < np.linalg.norm(foot[:, 1]) * THINNEST / self.pixel:
                continue
            outline = np.array([left, right, top, top + right - left])
            first = np.maximum(np.floor(outline.min(axis=0)).astype(int), 0)
            last = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 1, self.height.shape[::-1])
            width, height = last - first
            if width <= 0 or height <= 0:
                continue
            turn = np.diag([columns, rows]) @ np.linalg.inv(foot)
            matrix = np.c_[turn, turn @ (first - top)]
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            shadow = cv2.warpAffine(alpha, matrix, (int(width), int(height)), flags=flags) >= OPAQUE
            part = self.height[first[1] : last[1], first[0] : last[0]]
            np.maximum(part, quad[:, 2].mean(), out=part, where=shadow)

    def shaded(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Return which points (n, 3), projected as the triangles, have something on their ray `margin` m above them."""
        rows, columns = self.height.shape
        column, row = np.round((points[:, :2] - self.low) / self.pixel).astype(int).T
        return self.height[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] > points[:, 2] + margin


def car_shadow(darkness: float) -> Mesh:
    """Return the car's own shadow, a dark rectangle with soft edges, in the car's coordinates under its middle.

    darkness: share of the ground's light that is lost, 0..1. The texture's alpha is meant for blending.
    """
    x, y = np.array([-1, 1, 1, -1]) * CAR_SHADOW[0] / 2, np.array([-1, -1, 1, 1]) * CAR_SHADOW[1] / 2
    texture = np.zeros((64, 32, 4), np.uint8)
    texture[6:-6, 6:-6, 3] = round(255 * darkness)
    corners = np.c_[x, y, np.full(4, CAR_SHADOW_HEIGHT)]
    return quads(corners[None], (1, 1, 1), cv2.GaussianBlur(texture, (0, 0), 2))


class Shade:
    """The shadows of a scene."""

    def __init__(self, track: Track, meshes: Sequence[Mesh], light: Light, style: ShadeStyle, elevation: float):
        """meshes: of the scene; those with transparent parts are plants as `shapes.plants` makes them.

        elevation: of the sun that casts the shadows, degrees; its azimuth is that of the light's.
        """
        self.track, self.softness = track, style.softness
        azimuth = np.array(light.sun[:2]) / np.hypot(*light.sun[:2])
        # m that a shadow lies beside a point, per m of the point's height
        self.slope = azimuth / np.tan(np.radians(elevation * style.elevation))
        self.light, self.depth = light, style.depth
        self.factor = self.factors(np.array([[0.0, 0.0, 1.0]]))[0]  # (3,), of the colours of a level road in the shade
        self.plants: list[tuple[np.ndarray, np.ndarray]] = []
        solid = []
        for mesh in meshes:
            points = self.project(mesh.points)
            if mesh.texture.shape[2] == 4:
                self.plants.append((points.reshape(-1, 4, 3), mesh.texture))
            else:
                solid.append(points[mesh.faces])
        self.triangles = np.concatenate(solid)
        near = np.concatenate([self.project(track.points)[:, :2], track.points[:, :2]])
        self.map = ShadowMap(near.min(axis=0) - 250, near.max(axis=0) + 250, COARSE)
        self.map.paint(self.triangles, self.triangles[..., 2].min(axis=1))  # so that no slope shades its own foot
        self.pictures: dict[int, np.ndarray | None] = {}

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return points (n, 3) with their first two coordinates moved along the sun's ray to z = 0."""
        return np.c_[points[:, :2] - points[:, 2:] * self.slope, points[:, 2]]

    def factors(self, facing: np.ndarray) -> np.ndarray:
        """Return the factors of the colours of surfaces in the shade, (n, 3); facing: their unit normals, (n, 3)."""
        return (np.array(self.light.fill) / self.light.on(facing)) ** self.depth

    def on_mesh(self, mesh: Mesh) -> np.ndarray:
        """Return the factors of the colours of a mesh's points, float (n, 3); plants cast no shadows on it."""
        plant = mesh.texture.shape[2] == 4
        factors = self.factor if plant else self.factors(normals(mesh.points, mesh.faces))
        shaded = self.map.shaded(self.project(mesh.points), COARSE_MARGIN)
        return np.where(shaded[:, None], factors, 1.0)

    def under_car(self, position: np.ndarray) -> np.ndarray | None:
        """Return how far the car's shadow lies beside the car, (2,), m; None in the shade of hills or buildings.

        position: the car's, (3,), m.
        """
        shaded = self.map.shaded(self.project(position[None]), COARSE_MARGIN)[0]
        return None if shaded else -CAR_HEIGHT * self.slope

    def on_road(self, stretch: int) -> np.ndarray | None:
        """Return the factors of the colours on a stretch of road, 255 for 1, or None if it has no shadow.

        stretch: its number; stretch 0 begins at s = 0. uint8 (1024, 128, 3): rows from its end to its start, beyond
        both by OVERLAP, and columns from left to right.
        """
        if stretch in self.pictures:
            return self.pictures[stretch]
        rows, columns = PICTURE_SHAPE
        s = stretch * STRETCH - OVERLAP + (np.arange(rows)[::-1] + 0.5) / rows * LENGTH
        offset = ((np.arange(columns) + 0.5) / columns * 2 - 1) * HALF_WIDTH
        track, (index, part) = self.track, np.divmod(s / self.track.step, 1)
        i, j, part = track.wrap(index.astype(int)), track.wrap(index.astype(int) + 1), part[:, None]
        middle = track.points[i] * (1 - part) + track.points[j] * part
        across = track.rightward[i] * (1 - part) + track.rightward[j] * part
        points = np.repeat(middle[:, None], columns, axis=1)
        points[..., :2] += across[:, None] * offset[:, None]
        points = self.project(points.reshape(-1, 3))
        shadows = ShadowMap(points[:, :2].min(axis=0), points[:, :2].max(axis=0), FINE)
        above = self.triangles[..., 2].max(axis=1) > points[:, 2].min()
        triangles = self.triangles[above]
        triangles = divide(triangles[shadows.touched(triangles)])
        shadows.paint(triangles, triangles[..., 2].mean(axis=1))
        for corners, texture in self.plants:
            shadows.paint_plants(corners, texture)
        shaded, picture = shadows.shaded(points, FINE_MARGIN).reshape(PICTURE_SHAPE).astype(np.float32), None
        if shaded.any():
            blur = self.softness / np.array([2 * HALF_WIDTH / columns, LENGTH / rows])
            soft = cv2.GaussianBlur(shaded, (0, 0), blur[0], sigmaY=blur[1])
            picture = np.round(255 * (1 - (1 - self.factor) * soft[..., None])).astype(np.uint8)
        self.pictures[stretch] = picture
        return picture

    def coordinates(self, road: np.ndarray, stretch: int) -> np.ndarray:
        """Return the texture coordinates, (n, 2), in a stretch's picture of points (n, 2: s, lateral offset)."""
        along = (road[:, 0] - stretch * STRETCH + OVERLAP) / LENGTH
        return np.c_[road[:, 1] / (2 * HALF_WIDTH) + 0.5, along]


def divide(triangles: np.ndarray) -> np.ndarray:
    """Divide triangles (n, 3, 3) that are TALL into four each, again and again, and return all of them."""
    for _ in range(SPLITS):
        tall = np.ptp(triangles[..., 2], axis=1) > TALL
        a, b, c = np.moveaxis(triangles[tall], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        triangles = np.concatenate([triangles[~tall], *parts])
    return triangles
