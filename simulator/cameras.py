"""The car's cameras: they render a scene, and frames are encoded as the real simulator's JPEGs."""

import cv2
import numpy as np
from panda3d import core

from cloning.base.errors import SimulatorError
from cloning.base.frame import FRAME
from cloning.recordings.format import CAMERAS
from cloning.recordings.images import encode
from cloning.road.camera import CAMERA_POSITIONS, CAMERA_ROLL, CAMERA_YAW, JPEG_QUALITY, MOUNT_PITCH, VERTICAL_FIELD
from cloning.road.disturbances import Disturbance, Disturber
from simulator.world import INSIDE, Scene, free_unused

NEAR_PLANE, FAR_PLANE = 0.3, 1000.0  # m, as for the real simulator's cameras
ROWS, COLUMNS = FRAME[:2]
# For each row of a frame two are rendered and averaged; with one, the road far ahead flickers, unlike the real one.
FINE_ROWS = 2 * ROWS


def lens(rows: int = ROWS, columns: int = COLUMNS) -> core.PerspectiveLens:
    """Return a lens with the cameras' vertical field of view for images of this shape."""
    perspective = core.PerspectiveLens()
    perspective.set_near_far(NEAR_PLANE, FAR_PLANE)
    horizontal_field = 2 * np.degrees(np.arctan(np.tan(np.radians(VERTICAL_FIELD / 2)) * columns / rows))
    perspective.set_fov(horizontal_field, VERTICAL_FIELD)
    return perspective


def jpeg(frame: np.ndarray) -> bytes:
    """Encode a frame, uint8 (rows, columns, 3) RGB, like the real simulator."""
    return encode(frame, JPEG_QUALITY)


class Buffer:
    """An image rendered without a screen, with a region for each camera, one below another."""

    def __init__(self, rows: int, columns: int, cameras: list[core.NodePath]):
        """rows, columns: of each region. Raises SimulatorError if the renderer cannot be loaded."""
        pipe = core.GraphicsPipeSelection.get_global_ptr().make_pipe("TinyOffscreenGraphicsPipe", "p3tinydisplay")
        if not pipe:
            raise SimulatorError(
                "panda3d's software renderer cannot be loaded: on Linux it needs libX11.so.6 (apt-get install libx11-6)"
            )
        properties = core.FrameBufferProperties()
        properties.set_rgba_bits(8, 8, 8, 0)
        properties.set_depth_bits(24)
        self.shape = (len(cameras), rows, columns, 3)
        self.engine = core.GraphicsEngine(pipe)
        size = core.WindowProperties.size(columns, rows * len(cameras))
        buffer = self.engine.make_output(pipe, "buffer", 0, properties, size, core.GraphicsPipe.BF_refuse_window)
        self.image = core.Texture()
        buffer.add_render_texture(self.image, core.GraphicsOutput.RTM_copy_ram, core.GraphicsOutput.RTP_color)
        for i, camera in enumerate(cameras):
            region = buffer.make_display_region(0, 1, 1 - (i + 1) / len(cameras), 1 - i / len(cameras))
            region.set_camera(camera)

    def render(self, halve: bool = False) -> np.ndarray:
        """Render the regions: uint8 (regions, rows, columns, 3), RGB; halve: return the mean of every two rows."""
        self.engine.render_frame()
        image = np.frombuffer(self.image.get_ram_image(), np.uint8)
        pixels: np.ndarray = image.reshape(-1, self.shape[2], 4)  # bottom row first
        if halve:  # as cv2.resize by area, in a sixteenth of its time
            pixels = cv2.addWeighted(pixels[0::2], 0.5, pixels[1::2], 0.5, 0)
        return cv2.flip(cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGB), 0).reshape(self.shape[0], -1, *self.shape[2:])


class Cameras:
    """The car's cameras in a scene."""

    def __init__(
        self, scene: Scene, names: tuple[str, ...] = CAMERAS, disturbance: Disturbance | None = None, seed: int = 0
    ):
        """Mount the named cameras on the scene's car; disturbance, seed: see `disturb`."""
        self.last: np.ndarray | None = None  # what `frames` has returned last
        self.mounted = [core.NodePath(core.Camera(name, lens())) for name in names]
        for name, camera in zip(names, self.mounted, strict=True):
            camera.node().set_camera_mask(INSIDE)
            camera.set_pos(*CAMERA_POSITIONS[name])
            camera.set_hpr(-CAMERA_YAW, -MOUNT_PITCH, -CAMERA_ROLL)
        self.move(scene)
        self.buffer = Buffer(FINE_ROWS, COLUMNS, self.mounted)
        self.disturb(disturbance, seed)

    def disturb(self, disturbance: Disturbance | None, seed: int = 0) -> None:
        """Begin a drive whose frames are disturbed, or not if None; the same seed disturbs them in the same way."""
        self.disturbance = disturbance
        self.disturbers = [Disturber(disturbance, seed) for _ in self.mounted] if disturbance else []

    def move(self, scene: Scene) -> None:
        """Mount the cameras on another scene's car; the engine never frees a buffer's memory, 0.8 MB a camera."""
        self.scene = scene
        for camera in self.mounted:
            camera.reparent_to(scene.car)
        free_unused()

    def frames(self, transform: core.TransformState) -> np.ndarray:
        """Render a drive's next frames: uint8 (cameras, 160, 320, 3), RGB, in the names' order.

        transform: where the car is.
        """
        self.scene.move_car(transform)
        frames, tone = self.buffer.render(halve=True), self.scene.scenery.tone
        if tone is not None:
            frames = cv2.transform(frames.reshape(-1, COLUMNS, 3), tone).reshape(-1, ROWS, COLUMNS, 3)
        if self.disturbers:
            frames = np.stack([seen(frame) for seen, frame in zip(self.disturbers, frames, strict=True)])
        self.last = frames
        return frames

    def segments(self, transform: core.TransformState) -> np.ndarray:
        """Render the first camera's frame without mixing neighbouring pixels: uint8 (160, 320, 3), RGB."""
        self.scene.move_car(transform)
        colours = np.ascontiguousarray(self.buffer.render()[0, ::2])
        colours[colours == 254] = 255  # which the engine rounds down, though it is told more
        return colours
