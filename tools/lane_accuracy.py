"""Measure how accurately `cloning/lane` estimates the car's position in its lane.

    python -m tools.lane_accuracy RECORDING …    # on rendered drives, and on these real recordings

For rendered drives the true position is known. They are in looks that the network was not trained on; with --edges,
there are also some along each kind of edge. For real recordings only the position of the side cameras in the car is
known.
"""

import itertools
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.lane.localise import estimate_lane_position
from cloning.lane.reader import (
    DISTANCES_AHEAD,
    MOUNT_OFFSETS,
    LaneNetwork,
    detect_centres,
    fuse_detections,
    load_network,
)
from cloning.recordings.log import Recording, find_folders, read_recording
from cloning.road.generated import COURSES, generate
from cloning.road.motion import MPH, stretches
from cloning.road.track import ROADS, Track
from simulator.car import STEP
from simulator.record import record
from tools.lane_frames import shadowed

UNSEEN_LOOKS = (998, 999, 1000)  # no network was trained on looks from 101 to 1000, nor on these roads
UNSEEN_ROADS = tuple(f"road-{k}" for k in range(1, 9))
FIRST_EDGES, EDGES_SECONDS, EDGES_SPEEDS = 201, 27, (15, 25)  # number of the first road, length of a drive, mph
EDGES_LOOK = 700  # plus a road's number: its look
NEAR = 0.3  # m: a reading no further from the truth is good


@contextmanager
def rendered_drive(track: Track, laps: float, speed: float, look: int) -> Iterator[tuple[Recording, np.ndarray]]:
    """Record a drive of the expert; give it, and the true lateral offsets, float64 (n,), m. speed: mph."""
    with tempfile.TemporaryDirectory() as folder:
        run, _ = record(folder, track, laps, speed, seed=look, look=look)
        recording = read_recording(folder)
        step = np.round((recording.time - recording.time[0]) / STEP).astype(int)
        yield recording, np.array(run.trajectory.offset)[step]


def measure_drives(network: LaneNetwork, laps: float) -> None:
    """Print the errors on recordings of the stand-in simulator, which logs the true position."""
    plain = [(name, look) for name in ROADS for look in UNSEEN_LOOKS]
    plain += [(road, 990 + k) for k, road in enumerate(UNSEEN_ROADS)]
    for name, look in plain + [(name, shadowed(look)) for name, look in plain]:
        with rendered_drive(Track(name), laps, 30 if name == "lake" else 15, look) as (recording, true):
            position = fuse_detections(recording, detect_centres(recording, network))
            located = estimate_lane_position(recording, stretches(recording), network)
        error = position.lateral_offset - true
        print(
            f"{f'rendered drive, {name}, look {look}':34}{len(error):6} rows, error {spread(error)}, "
            f"bias {error.mean():+.2f}, "
            f"slope {np.polyfit(true, position.lateral_offset, 1)[0]:.2f}; trusted {position.trusted.mean():.1%}; "
            f"localised, if possible: error {np.abs(located.lateral_offset - true).mean():.2f} m"
        )


def measure_edges(network: LaneNetwork, roads: int) -> None:
    """Print how certain and how exact readings are by what marks a road's edges; roads: of each kind."""
    found = defaultdict(list)
    courses = [(course, k) for course in COURSES for k in range(FIRST_EDGES, FIRST_EDGES + roads)]
    for (course, k), speed in itertools.product(courses, EDGES_SPEEDS):
        road, look, direction = generate(f"{course}-{k}"), EDGES_LOOK + k, ("ccw", "cw")[k // 2 % 2]
        look = look if k % 2 else shadowed(look)
        assert road  # of a name that generates one
        track = Track(road, direction)
        laps = EDGES_SECONDS * speed * MPH / track.length
        with rendered_drive(track, laps, speed, look) as (recording, true):
            position = fuse_detections(recording, detect_centres(recording, network))
        for group in (f"{course}s", f"{course}s, {road.marking}, {speed} mph"):
            found[group].append((position.lateral_offset - true, position.trusted))
    for group, drives in sorted(found.items()):
        error, certain = (np.concatenate(each) for each in zip(*drives, strict=True))
        print(f"{group:34}{len(error):6} rows, error {spread(error)}; {certainty(error, certain)}")


def certainty(error: np.ndarray, certain: np.ndarray) -> str:
    """Return the share of certain readings, bool (n,), and how many of these have an error, in m, of at most NEAR."""
    near = np.mean(np.abs(error[certain]) <= NEAR) if certain.any() else np.nan
    return f"certain {certain.mean():.1%}, {near:.1%} of them within {NEAR:g} m"


def spread(values: np.ndarray) -> str:
    """Return the mean and a percentile of distances to either side, in m."""
    return f"{np.abs(values).mean():.2f} m, 95th percentile {np.quantile(np.abs(values), 0.95):.2f}"


def measure_recording(folder: Path, network: LaneNetwork) -> None:
    """Print the estimated positions of a real recording's side cameras, and its lateral offsets."""
    recording = read_recording(folder)
    centres = detect_centres(recording, network)
    position = fuse_detections(recording, centres)
    apart = centres[:, :1] - centres[:, 1:]
    print(f"{folder}, {len(recording)} rows")
    near = ", ".join(f"{distance:g}" for distance in DISTANCES_AHEAD[:3])
    for side, name in enumerate(("left", "right")):
        cells = ", ".join(f"{np.mean(at):+.2f} ± {np.std(at):.2f}" for at in apart[:, side, :3].T)
        mounted = f"mounted at {MOUNT_OFFSETS[side + 1]:+.2f}"
        print(f"  {name + ' camera appears to be at':32}{cells} m, from {near} m ahead ({mounted})")
    offset = position.lateral_offset
    print(
        f"  {'lateral offset':32}{spread(offset)}, mean {offset.mean():+.2f}; "
        f"heading error {np.degrees(position.heading_error).std():.1f} degrees; trusted {position.trusted.mean():.1%}"
    )


def main(argv: list[str] | None = None) -> int:
    """Print the measurements; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.lane_accuracy", __doc__)
    add = parser.add_argument
    add("recordings", nargs="*", help="folders of real recordings, each with a driving_log.csv")
    add("--network", metavar="lane.pt", help="file with the weights (default: those that come with the project)")
    laps = "length of each rendered drive; 0: none (default %(default)s)"
    add("--laps", type=number(float, 0, 1e5), default=0.3, help=laps)
    edges = "generated roads of each kind to render by their edges, two drives each (default %(default)s)"
    add("--edges", type=number(int, 0), default=0, metavar="ROADS", help=edges)
    options = parser.parse_args(argv)
    network, folders = load_network(options.network), find_folders(options.recordings)
    if options.laps:
        measure_drives(network, options.laps)
    if options.edges:
        measure_edges(network, options.edges)
    for folder in folders:
        measure_recording(folder, network)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
