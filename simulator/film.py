"""A film of a drive, from behind the car, with its speed and steering."""

from pathlib import Path

import cv2
import numpy as np
from panda3d.core import Camera, Vec3

from . import SimulatorError
from .cameras import Buffer, lens
from .recording import RATE, Clock
from .run import Run
from .world import OUTSIDE, Scene

ROWS, COLUMNS = 360, 640
BEHIND, ABOVE, TARGET = 7.5, 2.9, 1.0  # m


def follow(camera, transform) -> None:
    """Put a camera behind a car that stands at the transform, level, looking over its roof."""
    ahead = transform.get_quat().get_forward()
    ahead = Vec3(ahead.x, ahead.y, 0.4 * ahead.z)
    ahead.normalize()
    camera.set_pos(transform.get_pos() - ahead * BEHIND + Vec3(0, 0, ABOVE))
    camera.look_at(transform.get_pos() + ahead * 4 + Vec3(0, 0, TARGET))


class Film:
    """15 frames a simulated second into an mp4 file."""

    def __init__(self, path: str, scene: Scene):
        """Raises SimulatorError."""
        self.path, self.scene, self.clock = Path(path), scene, Clock()
        self.camera = scene.root.attach_new_node(Camera("film", lens(ROWS, COLUMNS)))
        self.camera.node().set_camera_mask(OUTSIDE)
        self.buffer = Buffer(ROWS, COLUMNS, [self.camera])
        self.beside = self.path.with_name(f".{self.path.name}.part.mp4")
        self.writer = cv2.VideoWriter(
            str(self.beside), cv2.VideoWriter_fourcc(*"mp4v"), RATE, (COLUMNS, ROWS)
        )
        if not self.writer.isOpened():
            raise SimulatorError(f"{path}: no film can be written there; give a name that ends in .mp4")

    def watch(self, run: Run) -> None:
        if not self.clock.due(run.time):
            return
        transform = run.car.node.get_transform()
        self.scene.car.set_transform(transform)
        self.scene.look_from(*transform.get_pos())
        follow(self.camera, transform)
        self.writer.write(caption(self.buffer.draw()[0], run))

    def close(self) -> None:
        """Put the finished film in its place."""
        self.writer.release()
        self.beside.replace(self.path)


def caption(frame: np.ndarray, run: Run) -> np.ndarray:
    """The frame, uint8 (rows, columns, 3) RGB, as BGR with speed, steering and departures written on it."""
    frame = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    rows, columns = frame.shape[:2]
    said = f"{run.speed_mph:4.1f} mph   lap {run.laps + 1}   {run.time:5.1f} s"
    if run.departures:
        said += f"   departures {len(run.departures)}"
    cv2.putText(frame, said, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    middle, level = columns // 2, rows - 18
    cv2.line(frame, (middle - 100, level), (middle + 100, level), (255, 255, 255), 1)
    cv2.circle(frame, (middle + int(100 * run.steering), level), 6, (60, 200, 255), -1)
    return frame
