"""What the engine holds of a track: the ground that the car drives on, and the scene that the cameras see."""

import numpy as np
from panda3d.bullet import (
    BulletPlaneShape,
    BulletRigidBodyNode,
    BulletTriangleMesh,
    BulletTriangleMeshShape,
    BulletWorld,
)
from panda3d.core import (
    BitMask32,
    Geom,
    GeomNode,
    GeomTriangles,
    GeomVertexArrayFormat,
    GeomVertexData,
    GeomVertexFormat,
    InternalName,
    NodePath,
    Point3,
    SamplerState,
    Texture,
    TransparencyAttrib,
    Vec3,
)

from cloning.road.track import Track
from simulator.scenery.parts import Haze, Scenery
from simulator.scenery.shapes import Mesh, together

GROUND_HALF_WIDTH = 8.0  # m of ground to each side of a climbing road; the car is set back before it gets there
CELL = 120.0  # m: meshes are cut into cells so that the engine can leave out what is out of sight
INSIDE, OUTSIDE = BitMask32.bit(0), BitMask32.bit(1)  # what the car's own cameras see, and what others do
HAZE_STEP, SHEEN_STEP = 25.0, 2.0  # m: haze, and sheen, are drawn anew when the camera has moved so far
DULL = 3.0  # m away, from above, nothing is brighter


def ground(track: Track) -> BulletWorld:
    """A world of physics with the track's ground: a plane where the track is flat, else a level-sided mesh
    along it."""
    physics = BulletWorld()
    physics.set_gravity(Vec3(0, 0, -9.81))
    body = BulletRigidBodyNode("ground")
    if track.points[:, 2].any():
        mesh = BulletTriangleMesh()
        side = np.c_[track.rightward, np.zeros(len(track.rightward))] * GROUND_HALF_WIDTH
        left, right = ([Point3(*point) for point in (track.points + a * side).tolist()] for a in (-1, 1))
        for i in range(len(left)):
            j = (i + 1) % len(left)
            mesh.add_triangle(left[i], right[i], right[j])
            mesh.add_triangle(left[i], right[j], left[j])
        body.add_shape(BulletTriangleMeshShape(mesh, False))
    else:
        body.add_shape(BulletPlaneShape(Vec3(0, 0, 1), 0))
    physics.attach(body)
    return physics


def _column(name, size, kind, contents) -> GeomVertexArrayFormat:
    array = GeomVertexArrayFormat()
    array.add_column(name, size, kind, contents)
    return array


def _format() -> GeomVertexFormat:
    """Positions, colours and texture coordinates in three arrays, so that the colours can be replaced
    alone."""
    form = GeomVertexFormat()
    form.add_array(_column(InternalName.get_vertex(), 3, Geom.NT_float32, Geom.C_point))
    form.add_array(_column(InternalName.get_color(), 4, Geom.NT_uint8, Geom.C_color))
    form.add_array(_column(InternalName.get_texcoord(), 2, Geom.NT_float32, Geom.C_texcoord))
    return GeomVertexFormat.register_format(form)


def texture(image: np.ndarray, repeat: bool, mipmaps: bool) -> Texture:
    """The engine's texture of an image (rows, columns, 3 RGB or 4 RGBA)."""
    rows, columns, channels = image.shape
    made = Texture()
    made.setup_2d_texture(columns, rows, Texture.T_unsigned_byte, Texture.F_rgba if channels == 4 else Texture.F_rgb)
    made.set_ram_image(np.ascontiguousarray(image[::-1][..., [2, 1, 0, 3][:channels]]).tobytes())  # from below, BGR(A)
    wrap = SamplerState.WM_repeat if repeat else SamplerState.WM_clamp
    made.set_wrap_u(wrap)
    made.set_wrap_v(wrap)
    made.set_minfilter(SamplerState.FT_linear_mipmap_linear if mipmaps else SamplerState.FT_nearest)
    made.set_magfilter(SamplerState.FT_linear)
    return made


class Part:
    """The faces of a mesh that lie in one cell, as the engine holds them."""

    def __init__(self, mesh: Mesh, faces: np.ndarray):
        self.used, faces = np.unique(faces, return_inverse=True)
        self.data = GeomVertexData("part", _format(), Geom.UH_static)
        self.data.unclean_set_num_rows(len(self.used))
        memoryview(self.data.modify_array(0)).cast("B")[:] = mesh.points[self.used].astype(np.float32).tobytes()
        memoryview(self.data.modify_array(2)).cast("B")[:] = mesh.uv[self.used].astype(np.float32).tobytes()
        self.paint(_bytes(mesh.colours[self.used] * 255))
        triangles = GeomTriangles(Geom.UH_static)
        triangles.set_index_type(Geom.NT_uint32)
        index = triangles.modify_vertices()
        index.unclean_set_num_rows(faces.size)
        memoryview(index).cast("B")[:] = faces.astype(np.uint32).tobytes()
        geom = Geom(self.data)
        geom.add_primitive(triangles)
        self.node = GeomNode("cell")
        self.node.add_geom(geom)

    def paint(self, colours: np.ndarray) -> None:
        """colours: uint8 (n, 4), RGBA."""
        memoryview(self.data.modify_array(1)).cast("B")[:] = colours.tobytes()


def _bytes(colours: np.ndarray) -> np.ndarray:
    """Colours (n, 3), 0..255 and beyond, as uint8 RGBA."""
    rgba = np.full((len(colours), 4), 255, np.uint8)
    np.clip(colours, 0, 255, out=rgba[:, :3], casting="unsafe")
    return rgba


class MeshGroup:
    """All the scene's faces with one texture, cut into cells."""

    def __init__(self, mesh: Mesh, parent: NodePath):
        self.mesh = mesh
        root = parent.attach_new_node("batch")
        cell = np.floor(mesh.points[mesh.faces].mean(axis=1)[:, :2] / CELL).astype(int)
        keys, which = np.unique(cell, axis=0, return_inverse=True)
        self.parts = [Part(mesh, mesh.faces[which.ravel() == i]) for i in range(len(keys))]
        for part in self.parts:
            root.attach_new_node(part.node)
        plant = mesh.texture.shape[2] == 4
        root.set_texture(texture(mesh.texture, repeat=not plant, mipmaps=not plant))
        root.set_two_sided(True)
        if plant:
            root.set_transparency(TransparencyAttrib.M_binary)
        self.root = root
        self.points, self.colours = mesh.points.astype(np.float32), mesh.colours.astype(np.float32) * 255
        self.brightness = float(mesh.texture[..., :3].mean()) / 255

    def cover(self, eye: np.ndarray, haze: Haze | None) -> None:
        """Bring the colours to what haze and sheen make of them for the eye, (3,)."""
        colours, away = self.colours, np.sqrt(np.square(self.points - eye).sum(axis=1))[:, None]
        if haze:
            start, end = haze.range
            share = np.clip((away - start) / (end - start), 0, haze.most)
            goal = np.array(haze.colour, np.float32) * (255 / self.brightness)
            colours = colours + (goal - colours) * share
        if self.mesh.sheen:
            colours = colours * (1 + self.mesh.sheen * np.clip(1 - DULL / np.maximum(away, DULL), 0, 1))
        colours = _bytes(colours)
        for part in self.parts:
            part.paint(colours[part.used])
            part.node.modify_geom(0).set_vertex_data(part.data)


class Scene:
    """The scenery as the engine draws it. tinydisplay knows no fog, so haze is mixed into the vertices'
    colours."""

    def __init__(self, scenery: Scenery):
        self.scenery = scenery
        self.root = NodePath("scene")
        textures: dict[int, list[Mesh]] = {}
        for mesh in scenery.meshes:
            textures.setdefault(id(mesh.texture), []).append(mesh)
        self.batches = [MeshGroup(together(meshes), self.root) for meshes in textures.values()]
        for i, batch in enumerate(self.batches):
            batch.root.set_bin("fixed", i)  # else the engine sorts by memory addresses, which differ from run to run
        self.sky = MeshGroup(scenery.sky, self.root).root
        self.sky.set_bin("background", 0)
        self.sky.set_depth_write(False)
        self.sky.set_depth_test(False)
        self.car = self.root.attach_new_node("car")
        self.car.set_bin("fixed", len(self.batches))
        MeshGroup(scenery.bonnet, self.car).root.hide(OUTSIDE)
        MeshGroup(scenery.body, self.car).root.hide(INSIDE)
        self.seen_from: dict[float, tuple] = {}

    def look_from(self, x: float, y: float, z: float) -> None:
        """Bring haze, sheen and sky to a viewer there, in metres. They depend on the place alone, not on the way to
        it."""
        self.sky.set_pos(x, y, z)
        for step, changing in ((HAZE_STEP, bool(self.scenery.haze)), (SHEEN_STEP, True)):
            here = (round(x / step), round(y / step))
            if not changing or here == self.seen_from.get(step):
                continue
            self.seen_from[step] = here
            eye = np.array([here[0] * step, here[1] * step, 0], np.float32)
            for batch in self.batches:
                if bool(batch.mesh.sheen) == (step == SHEEN_STEP):
                    batch.cover(eye, self.scenery.haze)
