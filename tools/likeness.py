"""Compare rendered frames with real ones: a table of differences, and a picture with both.

    python -m tools.likeness data/lake-ccw --picture side_by_side.png

`cloning.lane.localise` locates a real recording on a known road, and the stand-in simulator renders the same
places. The table compares mean colours, mean colours of image rows, and the columns of the lake's inner yellow lines
relative to where they would be on flat ground.
"""

import argparse
from pathlib import Path

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("likeness")  # also while the libraries below are loaded

import cv2
import numpy as np

from cloning.base.arguments import number
from cloning.base.errors import RecordingError, UserError
from cloning.base.frame import FRAME
from cloning.lane.localise import localise_all
from cloning.lane.reader import estimate_centres, read_strips
from cloning.recordings.format import CAMERAS
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.road.camera import CAMERA_OFFSETS, camera_position, project_ground
from cloning.road.motion import REAR_AXLE, stretches
from cloning.road.track import LEFT, RIGHT, Pose, Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.run import Run
from simulator.scenery.lake import INNER_LINE
from simulator.world import Scene

COMPARED_ROWS = (10, 30, 50, 60, 70, 80, 90, 100, 115, 130, 145)
LINE_ROWS = (range(76, 82), range(86, 94), range(104, 116))  # image rows that are searched for lines: far, middle, near
SEARCH = np.arange(-14, 14.1, 0.5)  # columns around the expected one that are searched


def rear_axle(track: Track, position: np.ndarray) -> tuple[Pose, np.ndarray]:
    """Return the pose of the rear axle's middle, with the car's heading, and the unit vector ahead, (2,).

    position: s, metres to the right, heading error, as in `cloning.lane.localise.Localisation`.
    """
    s, right, yaw = position
    place = track.at(s, right)
    heading = place.heading - yaw
    return Pose(place.x, place.y, place.z, heading, place.grade), np.array([np.cos(heading), np.sin(heading)])


def line_columns(track: Track, position: np.ndarray, offset: float, camera: str, rows: range) -> np.ndarray:
    """Return the columns where a line on flat ground would be in these rows, nan where it is out of view.

    offset: metres from the centre line to the line, right positive.
    """
    axle, forward = rear_axle(track, position)
    right = np.array([forward[1], -forward[0]])
    eye = camera_position(np.array([axle.x, axle.y]), forward, CAMERA_OFFSETS[camera])
    near = (round(position[0] / track.step) + np.arange(45)) % len(track.points)
    line = track.points[near, :2] + offset * track.rightward[near] - eye
    ahead = line @ forward
    pixels = project_ground(line[ahead > 2] @ right, ahead[ahead > 2])[::-1]  # from the horizon down
    return np.interp(rows, pixels[:, 1], pixels[:, 0], left=np.nan, right=np.nan)


def line_offset(frames: np.ndarray, columns: list[np.ndarray], rows: range) -> tuple[float, int]:
    """Return the mean distance in columns from the expected to the yellow ones, right positive, and the number of rows.

    frames: uint8 (n, 160, 320, 3) RGB; columns: the expected column for each frame and row.
    """
    profiles = []
    for frame, expected in zip(frames.astype(np.float32), columns, strict=True):
        yellow = frame[..., 0] + frame[..., 1] - 2 * frame[..., 2]
        for row, column in zip(rows, expected, strict=True):
            if SEARCH[-1] < column < FRAME[1] - 1 - SEARCH[-1]:
                profiles.append(np.interp(column + SEARCH, np.arange(FRAME[1]), yellow[row]))
    if not profiles:
        return np.nan, 0
    mean = np.mean(profiles, axis=0)
    mean -= np.linspace(mean[:8].mean(), mean[-8:].mean(), len(mean))
    weight = np.clip(mean - mean.max() / 2, 0, None) * (np.abs(SEARCH - SEARCH[mean.argmax()]) < 5)
    return float((weight * SEARCH).sum() / weight.sum()), len(profiles)


def render(track: Track, look: int, positions: np.ndarray) -> np.ndarray:
    """Render the three cameras at positions (n, 3), as `rear_axle` takes them: uint8 (n, 3, 160, 320, 3), RGB."""
    run, cameras = Run(track), Cameras(Scene(scenery.build(track.name, look)))
    rendered = []
    for position in positions:
        axle, forward = rear_axle(track, position)
        x, y = (axle.x, axle.y) + REAR_AXLE * forward
        run.car.place(Pose(x, y, axle.z + REAR_AXLE * axle.grade, axle.heading, axle.grade))
        run.car.settle()
        rendered.append([decode(jpeg(frame)) for frame in cameras.frames(run.car.node.get_transform())])
    return np.array(rendered)


def compare(folder: Path, count: int, look: int, picture: str | None) -> None:
    """Compare `count` places of a recording with a look, print the table and write the picture. Raises UserError."""
    recording = read_recording(folder)
    strips = read_strips(recording)
    drives = list(localise_all(stretches(recording), estimate_centres(strips), strips.__getitem__))
    if not drives:
        raise RecordingError(f"{folder}: not on a known road; give a recording of the lake or the jungle")
    rows, placed = max(drives, key=lambda drive: drive[0].stop - drive[0].start)
    track = placed.track
    print(f"{track.name}, {track.direction}, {rows.stop - rows.start} rows")
    chosen = np.linspace(0, len(placed.states) - 1, count).astype(int)
    positions = placed.states[chosen]
    paths = [[recording.path(rows.start + i, camera) for camera in range(len(CAMERAS))] for i in chosen]
    real = np.array([[decode(path.read_bytes()) for path in row] for row in paths])
    rendered = render(track, look, positions)
    print(f"{'':28}{'real':>24}{'rendered':>24}")
    for c, camera in enumerate(CAMERAS):
        colours = [frames[:, c].mean((0, 1, 2)) for frames in (real, rendered)]
        print_colours(f"{camera}, mean colour RGB", colours)
    for row in COMPARED_ROWS:
        print_colours(f"center, row {row}", [frames[:, 0, row].mean((0, 1)) for frames in (real, rendered)])
    profile = [frames[:, 0].mean((0, 2, 3)) for frames in (real, rendered)]
    print(
        f"{'row profile, correlation':28}{np.corrcoef(*profile)[0, 1]:>24.3f}"
        f"   mean difference {np.abs(profile[0] - profile[1]).mean():.1f}"
    )
    if track.name == "lake":
        print_lines(track, positions, real, rendered)
    if picture:
        write_picture(picture, real, rendered)


def print_colours(name: str, colours: list[np.ndarray]) -> None:
    """Print a line of the table with colours (3,)."""
    print(f"{name:28}" + "".join(f"{np.array2string(colour.round(0)):>24}" for colour in colours))


def print_lines(track: Track, positions: np.ndarray, real: np.ndarray, rendered: np.ndarray) -> None:
    """Print the columns of the inner lines relative to where they would be on flat ground."""
    for c, camera in enumerate(CAMERAS):
        for name, side in (("left", LEFT), ("right", RIGHT)):
            for rows in LINE_ROWS:
                columns = [line_columns(track, position, side * INNER_LINE, camera, rows) for position in positions]
                offsets = [line_offset(frames[:, c], columns, rows) for frames in (real, rendered)]
                print(
                    f"{f'{camera}, {name} line, row {rows[len(rows) // 2]}':28}"
                    + "".join(f"{offset:>+15.1f} (n={n:4})" for offset, n in offsets)
                )


def write_picture(path: str, real: np.ndarray, rendered: np.ndarray) -> None:
    """Write a picture of eight places, real frames above rendered ones. Raises UserError."""
    strips = []
    for i in np.linspace(0, len(real) - 1, 8).astype(int):
        strips.append(np.vstack([np.hstack(frames[i][[1, 0, 2]]) for frames in (real, rendered)]))
    image = np.hstack([np.vstack(strips[:4]), np.vstack(strips[4:])])
    if not cv2.imwrite(path, cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise UserError(f"{path}: cannot be written; give an image file in an existing folder")


def main(argv: list[str] | None = None) -> int:
    """Parse the command line, compare and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="likeness", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path, help="folder of a real recording of the lake or the jungle")
    parser.add_argument("--frames", type=number(int, 1), default=120, help="number of places to compare (default 120)")
    parser.add_argument("--look", type=number(int, 0), default=0, help="look of the rendered frames (default 0)")
    parser.add_argument("--picture", metavar="FILE.png", help="write real frames above rendered ones")
    args = parser.parse_args(argv)
    try:
        compare(args.recording, args.frames, args.look, args.picture)
    except UserError as error:
        return program.failed("likeness", error)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
