"""Compare rendered frames with real ones: a table of differences, and a picture with both.

    python -m tools.likeness data/lake-ccw --picture side_by_side.png

`cloning.lane.localise` locates a real recording on a known road, and the stand-in simulator renders the same poses. The
table compares mean colours, also of image rows, and what a network may notice in the road's rows: how many pixels are
dark, the saturation, and how sharp the frames are.
"""

from pathlib import Path

import cv2
import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import RecordingError
from cloning.base.frame import ROAD_ROWS
from cloning.base.outputs import check_folders, write_output
from cloning.lane.localise import localise_all
from cloning.lane.reader import estimate_centres, read_strips
from cloning.recordings.format import CAMERAS
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.road.motion import REAR_AXLE, stretches
from cloning.road.track import Pose, Track
from simulator.cameras import Cameras, jpeg
from simulator.run import Run
from simulator.world import Scene

COMPARED_ROWS = (10, 30, 50, 60, 70, 80, 90, 100, 115, 130, 145)
DARK = 50  # of 255, the largest of R, G and B
EDGE = (100, 200)  # the thresholds of OpenCV's Canny
MEASURES = ("dark pixels, %", "saturation, of 255", "edges, % of pixels", "variance of the Laplacian")


def render(track: Track, look: int, states: np.ndarray) -> np.ndarray:
    """Render the three cameras at the states of a `Localisation`, (n, 3): uint8 (n, 3, 160, 320, 3), RGB."""
    run, cameras = Run(track), Cameras(Scene.of(track.name, look))
    rendered = []
    for s, right, yaw in states:
        axle = track.at(s, right)
        heading = axle.heading - yaw
        x, y = (axle.x, axle.y) + REAR_AXLE * np.array([np.cos(heading), np.sin(heading)])
        run.car.place(Pose(x, y, axle.z + REAR_AXLE * axle.grade, heading, axle.grade))
        run.car.settle()
        rendered.append([decode(jpeg(frame)) for frame in cameras.frames(run.car.node.get_transform())])
    return np.array(rendered)


def compare(folder: Path, count: int, look: int, picture: str | None) -> None:
    """Compare `count` poses of a recording with a look, print the table and write the picture. Raises UserError."""
    check_folders(picture)
    recording = read_recording(folder)
    strips = read_strips(recording)
    drives = list(localise_all(recording, stretches(recording), estimate_centres(strips), strips.__getitem__))
    if not drives:
        raise RecordingError(f"{folder}: not on a known road; give a recording of the lake or the jungle")
    rows, located = max(drives, key=lambda drive: drive[0].stop - drive[0].start)
    track = located.track
    print(f"{track.name}, {track.direction}, {rows.stop - rows.start} rows")
    chosen = np.linspace(0, len(located.states) - 1, count).astype(int)
    paths = [[recording.path(rows.start + i, camera) for camera in range(len(CAMERAS))] for i in chosen]
    real = np.array([[decode(path.read_bytes()) for path in row] for row in paths])
    both = real, render(track, look, located.states[chosen])
    print(f"{'':28}{'real':>24}{'rendered':>24}")
    for c, camera in enumerate(CAMERAS):
        print_colours(f"{camera}, mean colour RGB", [frames[:, c].mean((0, 1, 2)) for frames in both])
    for row in COMPARED_ROWS:
        print_colours(f"center, row {row}", [frames[:, 0, row].mean((0, 1)) for frames in both])
    for name, *values in zip(MEASURES, *(measures(frames[:, 0, ROAD_ROWS]) for frames in both), strict=True):
        print(f"{name:28}" + "".join(f"{value:>24.1f}" for value in values))
    profile = [frames[:, 0].mean((0, 2, 3)) for frames in both]
    print(
        f"{'row profile, correlation':28}{np.corrcoef(*profile)[0, 1]:>24.3f}"
        f"   mean difference {np.abs(profile[0] - profile[1]).mean():.1f}"
    )
    if picture:
        write_picture(picture, *both)


def measures(images: np.ndarray) -> np.ndarray:
    """Return the MEASURES (4,), means over images, uint8 (n, rows, columns, 3) RGB."""
    found = []
    for image in images:
        _, saturation, value = cv2.split(cv2.cvtColor(image, cv2.COLOR_RGB2HSV))
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        edges, laplacian = cv2.Canny(grey, *EDGE), cv2.Laplacian(grey, cv2.CV_64F)
        found.append([100 * (value < DARK).mean(), saturation.mean(), 100 * (edges > 0).mean(), laplacian.var()])
    return np.mean(found, 0)


def print_colours(name: str, colours: list[np.ndarray]) -> None:
    """Print a line of the table with colours (3,)."""
    print(f"{name:28}" + "".join(f"{np.array2string(colour.round(0)):>24}" for colour in colours))


def write_picture(path: str, real: np.ndarray, rendered: np.ndarray) -> None:
    """Write a picture of eight poses, real frames above rendered ones. Raises OutputError."""
    strips = []
    for i in np.linspace(0, len(real) - 1, 8).astype(int):
        strips.append(np.vstack([np.hstack(frames[i][[1, 0, 2]]) for frames in (real, rendered)]))
    image = np.hstack([np.vstack(strips[:4]), np.vstack(strips[4:])])
    write_output(path, cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes())


def main(argv: list[str] | None = None) -> int:
    """Parse the command line, compare and return the exit status. Raises UserError."""
    parser = command_line("python -m tools.likeness", __doc__)
    add = parser.add_argument
    add("recording", type=Path, help="folder of a real recording of the lake or the jungle")
    add("--frames", type=number(int, 1), default=240, help="poses to compare (default %(default)s)")
    add("--look", type=number(int, 0), default=0, help="look of the rendered frames (default %(default)s)")
    add("--picture", metavar="FILE.png", help="write real frames above rendered ones")
    options = parser.parse_args(argv)
    compare(options.recording, options.frames, options.look, options.picture)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
