"""A track in the engine: the ground that the car drives on and the scene that the cameras see."""

import functools
import math
import sys
from dataclasses import replace
from typing import Self

import numpy as np
from panda3d import bullet, core

from cloning.road.generated import PointRoad
from cloning.road.motion import FULL_LOCK
from cloning.road.track import LEFT, RIGHT, Track
from simulator import scenery
from simulator.scenery.body import RADIUS, WHEELS
from simulator.scenery.parts import Haze, Scenery
from simulator.scenery.shade import STRETCH, Shade, car_shadow
from simulator.scenery.shapes import Mesh, merge

GRAVITY = 9.81  # m/s²
GROUND_HALF_WIDTH = 8.0  # m of ground on each side of a road with climbs; the car is set back before it gets so far
CELL = 120.0  # m: meshes are divided into square cells, so that the engine can skip those that are out of view
# Squares with fewer faces share a cell with the next ones: each cell in view costs the engine as much as 70 vertices.
FACES = 150
UNDER_CAR = 0.6  # share of the light that the ground under the car lacks, as seen from outside
UNDER_CAR_SIZE = 1.45, 1.2  # times the width and length of the car's shadow, so that it is seen around the car
# Cameras in the car, which see its bonnet; others, which see its body.
INSIDE, OUTSIDE = core.BitMask32.bit(0), core.BitMask32.bit(1)
HAZE_STEP, SHEEN_STEP = 25.0, 2.0  # m of camera movement after which haze and sheen are computed again
SHADE = core.InternalName.get_texcoord_name("shade")  # texture coordinates in the pictures of the shadows on the road
SHEEN_START = 3.0  # m from the camera: closer asphalt, seen from above, has no sheen


@functools.cache
def configure_engine() -> None:
    """Set up panda3d for this process, before it makes anything; simulated cars and rendered scenes call this.

    The transform cache is off, because it replaces transforms by nearly equal earlier ones: a frame would depend on the
    frames before it. Bounds are boxes, because spheres around flat cells reach into views that do not show them. On
    macOS the software renderer, which the cameras use, has no window.
    """
    window = "pandagl" if sys.platform == "darwin" else "p3tinydisplay"
    core.load_prc_file_data(
        "",
        "window-type none\naudio-library-name null\nsync-video false\nprint-pipe-types false\n"
        "notify-level-display error\nnotify-level-device fatal\n"
        f"load-display {window}\nuniquify-transforms false\ntransform-cache false\nbounds-type box\n",
    )


def build_physics(track: Track) -> bullet.BulletWorld:
    """Return a physics world with the track's ground: a plane for a level track, else a mesh along it."""
    configure_engine()
    physics = bullet.BulletWorld()
    physics.set_gravity(core.Vec3(0, 0, -GRAVITY))
    body = bullet.BulletRigidBodyNode("ground")
    heights = track.points[:, 2]
    if np.ptp(heights):
        mesh = bullet.BulletTriangleMesh()
        across = np.c_[track.rightward, np.zeros(len(track.rightward))] * GROUND_HALF_WIDTH
        edges = (track.points + side * across for side in (LEFT, RIGHT))
        left, right = ([core.Point3(*point) for point in edge.tolist()] for edge in edges)
        for i in range(len(left) if track.closed else len(left) - 1):
            j = (i + 1) % len(left)
            mesh.add_triangle(left[i], right[i], right[j])
            mesh.add_triangle(left[i], right[j], left[j])
        body.add_shape(bullet.BulletTriangleMeshShape(mesh, False))
    else:
        body.add_shape(bullet.BulletPlaneShape(core.Vec3(0, 0, 1), float(heights[0])))
    physics.attach(body)
    return physics


def _vertex_format(on_road: bool) -> core.GeomVertexFormat:
    """Return a format with positions, colours and texture coordinates in one array each.

    So the colours can be replaced on their own. They are as the renderer computes with them, or it would convert each
    point in each frame. on_road: whether there are texture coordinates for shadows, too.
    """
    columns = [
        (core.InternalName.get_vertex(), 4, core.Geom.NT_float32, core.Geom.C_point),
        (core.InternalName.get_color(), 4, core.Geom.NT_float32, core.Geom.C_color),
        (core.InternalName.get_texcoord(), 2, core.Geom.NT_float32, core.Geom.C_texcoord),
        (SHADE, 2, core.Geom.NT_float32, core.Geom.C_texcoord),
    ]
    vertex_format = core.GeomVertexFormat()
    for column in columns if on_road else columns[:-1]:
        vertex_format.add_array(core.GeomVertexArrayFormat(*column))
    return core.GeomVertexFormat.register_format(vertex_format)


def make_texture(image: np.ndarray, repeat: bool, mipmaps: bool) -> core.Texture:
    """Return an engine texture with an image, uint8 (rows, columns, 3 RGB or 4 RGBA)."""
    rows, columns, channels = image.shape
    texture = core.Texture()
    texture_format = core.Texture.F_rgba if channels == 4 else core.Texture.F_rgb
    texture.setup_2d_texture(columns, rows, core.Texture.T_unsigned_byte, texture_format)
    bgr = image[::-1][..., [2, 1, 0, 3][:channels]]  # bottom row first
    texture.set_ram_image(np.ascontiguousarray(bgr).tobytes())
    wrap = core.SamplerState.WM_repeat if repeat else core.SamplerState.WM_clamp
    texture.set_wrap_u(wrap)
    texture.set_wrap_v(wrap)
    texture.set_minfilter(core.SamplerState.FT_linear_mipmap_linear if mipmaps else core.SamplerState.FT_nearest)
    texture.set_magfilter(core.SamplerState.FT_linear)
    return texture


def _rgba(colours: np.ndarray) -> np.ndarray:
    """Clip colours (3, n) to 0..255, leave out fractions, and return them as float32 RGBA (n, 4), 0..1."""
    rgba = np.full((colours.shape[1], 4), 255, np.float32)
    np.floor(np.clip(colours, 0, 255), out=rgba.T[:3])
    return rgba * np.float32(1 / 255)  # to the bit what the engine makes of bytes


def _fill(array: core.GeomVertexArrayData, values: np.ndarray) -> None:
    memoryview(array).cast("B")[:] = values.tobytes()


class MeshCell:
    """The engine's geometry for the faces of a mesh in one cell; `used` are the indices of their points."""

    def __init__(self, mesh: Mesh, faces: np.ndarray, shade_uv: np.ndarray | None = None):
        """faces: int (m, 3), indices into the mesh's points; shade_uv: (n, 2), the points' SHADE coordinates."""
        self.used, faces = np.unique(faces, return_inverse=True)
        self.data = core.GeomVertexData("cell", _vertex_format(shade_uv is not None), core.Geom.UH_static)
        self.data.unclean_set_num_rows(len(self.used))
        _fill(self.data.modify_array(0), np.c_[mesh.points[self.used], np.ones(len(self.used))].astype(np.float32))
        for i, values in ((2, mesh.uv), (3, shade_uv)):
            if values is not None:
                _fill(self.data.modify_array(i), values[self.used].astype(np.float32))
        self.set_colours(_rgba(mesh.colours[self.used].T * 255))
        triangles = core.GeomTriangles(core.Geom.UH_static)
        triangles.set_index_type(core.Geom.NT_uint32)
        index = triangles.modify_vertices()
        index.unclean_set_num_rows(faces.size)
        _fill(index, faces.astype(np.uint32))
        geom = core.Geom(self.data)
        geom.add_primitive(triangles)
        self.node = core.GeomNode("cell")
        self.node.add_geom(geom)

    def set_colours(self, colours: np.ndarray) -> None:
        """Set the used points' colours: float32 (n, 4), RGBA, 0..1."""
        _fill(self.data.modify_array(1), colours)


class MeshGroup:
    """A mesh in the engine, divided into cells: a mesh along the road that has shadows into stretches of the road."""

    def __init__(self, mesh: Mesh, parent: core.NodePath, shade: Shade | None = None):
        """shade: the scene's shadows, if the mesh is part of the scene and the scene has any."""
        if shade and mesh.road is None:
            mesh = replace(mesh, colours=mesh.colours * shade.on_mesh(mesh))
        self.mesh = mesh
        root = parent.attach_new_node("group")
        if shade and mesh.road is not None:
            squares = np.floor(mesh.road[mesh.faces].mean(axis=1)[:, :1] / STRETCH).astype(int)
        else:
            squares = np.floor(mesh.points[mesh.faces].mean(axis=1)[:, :2] / CELL).astype(int)
        occupied, which, counts = np.unique(squares, axis=0, return_inverse=True, return_counts=True)
        # Faces at equal depths hide one another by their order, which therefore does not depend on FACES.
        ordered, before = mesh.faces[np.argsort(which.ravel(), kind="stable")], np.cumsum(counts) - counts
        if not shade or mesh.road is None:
            first = np.diff(before // FACES, prepend=-1) > 0
            occupied, before = occupied[first], before[first]
        self.cells = []
        for square, faces in zip(occupied.tolist(), np.split(ordered, before[1:]), strict=True):
            on_road, shade_uv = None, None
            if shade and mesh.road is not None and (on_road := shade.on_road(square[0])) is not None:
                shade_uv = shade.coordinates(mesh.road, square[0])
            mesh_cell = MeshCell(mesh, faces, shade_uv)
            self.cells.append(mesh_cell)
            node = root.attach_new_node(mesh_cell.node)
            if on_road is not None:
                stage = core.TextureStage("shade")  # after the default one, by whose colours its own are multiplied
                stage.set_sort(1)
                stage.set_texcoord_name(SHADE)
                node.set_texture(stage, make_texture(on_road, repeat=False, mipmaps=True))
        plant = mesh.texture.shape[2] == 4
        root.set_texture(make_texture(mesh.texture, repeat=not plant, mipmaps=not plant))
        root.set_two_sided(True)
        if plant:
            root.set_transparency(core.TransparencyAttrib.M_binary)
        self.root = root
        used = np.concatenate([cell.used for cell in self.cells])
        # (3, n), because numpy needs several times as long for (n, 3).
        self.points = np.ascontiguousarray(mesh.points[used].T, np.float32)
        self.colours = np.ascontiguousarray(mesh.colours[used].T, np.float32) * 255
        self.starts = np.cumsum([len(cell.used) for cell in self.cells])[:-1]  # of the cells after the first in these
        self.brightness = float(mesh.texture[..., :3].mean()) / 255

    def update_colours(self, eye: np.ndarray, haze: Haze | None) -> None:
        """Apply haze and sheen to the colours, as seen from `eye`: (3, 1), m."""
        colours, distance = self.colours, np.sqrt(np.square(self.points - eye).sum(axis=0))
        if haze:
            start, end = haze.range
            share = np.clip((distance - start) / (end - start), 0, haze.maximum)
            goal = np.array(haze.colour, np.float32)[:, None] * (255 / self.brightness)
            colours = colours + (goal - colours) * share
        if self.mesh.sheen:
            share = np.clip(1 - SHEEN_START / np.maximum(distance, SHEEN_START), 0, 1)
            colours = colours * (1 + self.mesh.sheen * share)
        for cell, rgba in zip(self.cells, np.split(_rgba(colours), self.starts), strict=True):
            cell.set_colours(rgba)  # the engine reads them there; told of them, it would measure all points again


def free_unused() -> None:
    """Let the engine free the textures of scenes that are not used any more, which its cache would keep."""
    core.RenderState.clear_cache()
    core.RenderState.garbage_collect()


class Scene:
    """The scenery, the car and its shadow in the engine; its renderer has no fog, so points' colours have the haze."""

    @classmethod
    def of(cls, source: str | PointRoad, look: int = 0) -> Self:
        """Return the scene of a road in a look: see `scenery.build`, whose errors are raised."""
        return cls(scenery.build(source, look))

    def __init__(self, scenery: Scenery):
        configure_engine()
        self.scenery = scenery
        self.root = core.NodePath("scene")
        shade, together = scenery.shade, dict[tuple[int, bool], list[Mesh]]()
        for mesh in scenery.meshes:
            key = (id(mesh.texture), shade is not None and mesh.road is not None)
            together.setdefault(key, []).append(mesh)
        self.groups = [MeshGroup(merge(meshes), self.root, shade) for meshes in together.values()]
        for i, group in enumerate(self.groups):
            # Without a fixed order the engine sorts by memory address, which differs from run to run.
            group.root.set_bin("fixed", i)
        self.sky = MeshGroup(scenery.sky, self.root).root
        self.sky.set_bin("background", 0)
        self.sky.set_depth_write(False)
        self.sky.set_depth_test(False)
        self.car = self.root.attach_new_node("car")
        self.car.set_bin("fixed", len(self.groups))
        MeshGroup(scenery.bonnet, self.car).root.hide(OUTSIDE)
        outside = self.car.attach_new_node("body")
        outside.hide(INSIDE)
        MeshGroup(scenery.body.body, outside)
        self.brake_lights = MeshGroup(scenery.body.brake, outside).root
        self.wheels = [MeshGroup(scenery.body.wheel, outside).root for _ in WHEELS]
        for wheel, (x, y) in zip(self.wheels, WHEELS, strict=True):
            wheel.set_pos(x, y, RADIUS)
        # The real simulator's lower qualities have no shadow, but a car seen from outside seems to float without one.
        under = self._add_shadow(self.car, UNDER_CAR)
        under.set_scale(*UNDER_CAR_SIZE, 1)
        under.hide(INSIDE)
        if shade:
            self.car_shadow = self._add_shadow(self.root, float(1 - shade.factor.mean()))
        self.move_parts()
        # Step -> the grid point for which colours were computed last.
        self.viewpoints: dict[float, tuple[int, int]] = {}

    def _add_shadow(self, parent: core.NodePath, darkness: float) -> core.NodePath:
        """Return a shadow of the car; darkness: the share of the light that it takes, 0..1."""
        shadow = parent.attach_new_node("car's shadow")
        MeshGroup(car_shadow(darkness), shadow).root.set_transparency(core.TransparencyAttrib.M_alpha)
        shadow.set_bin("fixed", len(self.groups))
        shadow.set_depth_write(False)
        return shadow

    def move_parts(self, steering: float = 0.0, distance: float = 0.0, throttle: float = 0.0) -> None:
        """Turn the wheels, switch the brake lights; steering, throttle: -1..1; distance: m that the car has driven."""
        for wheel, (_, y) in zip(self.wheels, WHEELS, strict=True):
            turned = -FULL_LOCK * steering if y > 0 else 0.0
            wheel.set_hpr(turned, -math.degrees(distance / RADIUS % math.tau), 0)
        (self.brake_lights.show if throttle < 0 else self.brake_lights.hide)()

    def move_car(self, transform: core.TransformState) -> None:
        """Move the car; haze, sheen and sky follow its position alone, not earlier ones."""
        self.car.set_transform(transform)
        x, y, z = transform.get_pos()
        self.sky.set_pos(x, y, z)
        if self.scenery.shade:
            beside = self.scenery.shade.under_car(np.array([x, y, z]))
            if beside is None:
                self.car_shadow.hide()
            else:
                self.car_shadow.show()
                self.car_shadow.set_transform(transform)
                self.car_shadow.set_pos(x + beside[0], y + beside[1], z)
        for step, changes in ((HAZE_STEP, bool(self.scenery.haze)), (SHEEN_STEP, True)):
            here = (round(x / step), round(y / step))
            if not changes or here == self.viewpoints.get(step):
                continue
            self.viewpoints[step] = here
            eye = np.array([[here[0] * step], [here[1] * step], [0]], np.float32)
            for group in self.groups:
                if bool(group.mesh.sheen) == (step == SHEEN_STEP):
                    group.update_colours(eye, self.scenery.haze)
