"""A film of a drive from behind the car, with speed and steering written on it."""

import cv2
import numpy as np
from panda3d.core import Camera, NodePath, TransformState, Vec3

from cloning.base.film import DriveFilm
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.writer import SampleClock
from simulator.cameras import Buffer, Cameras, lens
from simulator.run import Run
from simulator.world import OUTSIDE, Scene, free_unused

FILM_ROWS, FILM_COLUMNS = 360, 640
# bits/s: 9 MB for a lake lap of 284 s, at 9 mph. Without a limit it takes 47 MB, most of them for the asphalt's grain.
MAX_BITS = 250_000
INSET, MARGIN = (100, 200), 8  # rows and columns of what the car's camera sees, and its distance from the corner
DISTANCE_BEHIND, HEIGHT_ABOVE = 7.5, 2.9  # m from the car to the camera
TARGET_AHEAD, TARGET_HEIGHT = 4.0, 1.0  # m from the car to the point that the camera looks at


def place_chase_camera(camera: NodePath, transform: TransformState, last: Vec3 | None = None, turn: float = 1) -> Vec3:
    """Put a level camera behind the car at this transform, looking over its roof; return the direction that it looks.

    last, turn: its direction before, and which share of the way from there to the car's it turns, 0..1.
    """
    ahead = transform.get_quat().get_forward()
    ahead = Vec3(ahead.x, ahead.y, 0.4 * ahead.z)
    ahead = last + (ahead - last) * turn if last else ahead
    ahead.normalize()
    camera.set_pos(transform.get_pos() - ahead * DISTANCE_BEHIND + Vec3(0, 0, HEIGHT_ABOVE))
    camera.look_at(transform.get_pos() + ahead * TARGET_AHEAD + Vec3(0, 0, TARGET_HEIGHT))
    return ahead


class ChaseView:
    """The view from behind the car."""

    def __init__(self, scene: Scene):
        self.camera = NodePath(Camera("film", lens(FILM_ROWS, FILM_COLUMNS)))
        self.camera.node().set_camera_mask(OUTSIDE)
        self.move(scene)
        self.buffer = Buffer(FILM_ROWS, FILM_COLUMNS, [self.camera])

    def move(self, scene: Scene) -> None:
        """Look at another scene from now on."""
        self.scene = scene
        self.camera.reparent_to(scene.root)
        free_unused()

    def frame(self, run: Run) -> np.ndarray:
        """Render the view with its caption: uint8 (360, 640, 3), RGB."""
        transform = run.car.node.get_transform()
        self.scene.move_car(transform)
        self.scene.move_parts(run.steering, run.distance, run.throttle)
        place_chase_camera(self.camera, transform)
        return caption(self.buffer.render()[0], run)


class ChaseFilm(DriveFilm):
    """A film of 15 frames per simulated second."""

    def __init__(self, path: str, scene: Scene, cameras: Cameras | None = None, start: float = 0.0):
        """Open the film; cameras: the first one's frames are in a corner; start: simulated s. Raises OutputError."""
        super().__init__(path, SAMPLE_RATE, quality=28, max_bits=MAX_BITS)
        self.view, self.clock, self.cameras = ChaseView(scene), SampleClock(start), cameras

    def watch(self, run: Run) -> None:
        """Append a frame if one is due; call this after each physics step."""
        if not self.error and self.clock.due(run.time):
            frame = self.view.frame(run)
            if self.cameras and self.cameras.last is not None:
                rows, columns = INSET
                seen = cv2.resize(self.cameras.last[0], (columns, rows), interpolation=cv2.INTER_AREA)
                seen = cv2.rectangle(seen, (0, 0), (columns - 1, rows - 1), (255, 255, 255), 1)
                frame[MARGIN : MARGIN + rows, -MARGIN - columns : -MARGIN] = seen
            self.add(frame)


def caption(frame: np.ndarray, run: Run) -> np.ndarray:
    """Return a copy of a frame, uint8 (rows, columns, 3), RGB, with speed, lap, departures and steering on it."""
    frame = frame.copy()  # contiguous, as OpenCV needs it
    rows, columns = frame.shape[:2]
    text = f"{run.speed_mph:4.1f} mph   lap {run.laps + 1}   {run.time:5.1f} s"
    if run.departures:
        text += f"   departures {len(run.departures)}"
    cv2.putText(frame, text, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    middle, level = columns // 2, rows - 18
    cv2.line(frame, (middle - 100, level), (middle + 100, level), (255, 255, 255), 1)
    cv2.circle(frame, (middle + int(100 * run.steering), level), 6, (255, 200, 60), -1)
    return frame
