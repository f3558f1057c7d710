"""A film of a drive, from behind the car, with its speed and steering."""

import cv2
import numpy as np
from panda3d.core import Camera, Vec3

from cloning.errors import SimulatorError
from cloning.film import FilmWriter
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.writer import Clock
from simulator.cameras import Buffer, lens
from simulator.run import Run
from simulator.world import OUTSIDE, Scene

ROWS, COLUMNS = 360, 640
BEHIND, ABOVE, TARGET = 7.5, 2.9, 1.0  # m


def place_chase_camera(camera, transform) -> None:
    """Put a camera behind a car that stands at the transform, level, looking over its roof."""
    ahead = transform.get_quat().get_forward()
    ahead = Vec3(ahead.x, ahead.y, 0.4 * ahead.z)
    ahead.normalize()
    camera.set_pos(transform.get_pos() - ahead * BEHIND + Vec3(0, 0, ABOVE))
    camera.look_at(transform.get_pos() + ahead * 4 + Vec3(0, 0, TARGET))


class ChaseFilm:
    """15 frames a simulated second into an mp4 file."""

    def __init__(self, path: str, scene: Scene):
        """Raises SimulatorError."""
        self.scene, self.clock = scene, Clock()
        self.camera = scene.root.attach_new_node(Camera("film", lens(ROWS, COLUMNS)))
        self.camera.node().set_camera_mask(OUTSIDE)
        self.buffer = Buffer(ROWS, COLUMNS, [self.camera])
        try:
            # Drawn frames are for looking at, and drawing is what takes time: a fifth of the size of video.py's films.
            self.film = FilmWriter(path, SAMPLE_RATE, quality=28, preset="veryfast")
        except OSError as error:
            raise SimulatorError(f"{path}: no film can be written there ({error.strerror})") from error

    def watch(self, run: Run) -> None:
        if not self.clock.due(run.time):
            return
        transform = run.car.node.get_transform()
        self.scene.move_car(transform)
        place_chase_camera(self.camera, transform)
        self.film.add(caption(self.buffer.render()[0], run))

    def close(self) -> None:
        """Put the finished film in its place."""
        self.film.close()


def caption(frame: np.ndarray, run: Run) -> np.ndarray:
    """A copy of the frame, uint8 (rows, columns, 3), RGB, with speed, steering and departures written on it."""
    frame = frame.copy()  # in one piece
    rows, columns = frame.shape[:2]
    said = f"{run.speed_mph:4.1f} mph   lap {run.laps + 1}   {run.time:5.1f} s"
    if run.departures:
        said += f"   departures {len(run.departures)}"
    cv2.putText(frame, said, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    middle, level = columns // 2, rows - 18
    cv2.line(frame, (middle - 100, level), (middle + 100, level), (255, 255, 255), 1)
    cv2.circle(frame, (middle + int(100 * run.steering), level), 6, (255, 200, 60), -1)
    return frame
