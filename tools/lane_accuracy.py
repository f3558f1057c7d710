"""Measure how accurately `cloning/lane` estimates the car's position in its lane.

    python -m tools.lane_accuracy RECORDING …                     # on rendered frames, and on these real recordings
    python -m tools.lane_accuracy RECORDING --picture lane.png    # real frames with the estimated lane drawn in

For rendered frames the true position is known. Single frames from random poses and whole drives are rendered, in looks
that the network was not trained on. For real recordings only the position of the side cameras in the car is known, and
in the jungle the line that is painted along the road's centre.
"""

import argparse
import itertools
import tempfile
import time
from pathlib import Path

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("lane_accuracy")  # also while the libraries below are loaded

import cv2
import numpy as np

from cloning.base.arguments import number
from cloning.base.errors import UserError
from cloning.base.files import write
from cloning.lane import marking
from cloning.lane.localise import (
    MIN_LOCALISED_ROWS,
    TrackFilter,
    estimate_lane_position,
    follow_line,
    line_deviations,
    localise,
)
from cloning.lane.reader import (
    DISTANCES_AHEAD,
    MOUNT_OFFSETS,
    LaneNetwork,
    LanePosition,
    detect_centres,
    estimate_centres,
    fuse_detections,
    load_network,
    read_strips,
)
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording, read_recording
from cloning.road.camera import project_ground
from cloning.road.motion import CAMERA_FORWARD, components, forward_vector, stretches
from cloning.road.track import ROADS, Track
from simulator.car import STEP
from simulator.record import record
from simulator.scenery import jungle, lake
from tools.lane_frames import RenderedScene, render_all, shadowed

UNSEEN_LOOKS = (1000, 1001, 1002)  # the network was not trained on them, nor on these roads
UNSEEN_ROADS = tuple(f"road-{number}" for number in range(1, 9))
LINE_OFFSETS = {"lake": lake.INNER_LINE, "jungle": jungle.EDGE_LINE}  # m from the lane's centre to its lines
GREEN, RED = (0, 220, 0), (0, 0, 255)  # BGR


def unseen_courses() -> dict[str, list[tuple[str, int]]]:
    """Return courses by name, each with its tracks and looks."""
    courses = {}
    for name in ROADS:
        courses[name] = [(name, look) for look in UNSEEN_LOOKS]
        courses[f"{name}, shadows"] = [(name, shadowed(look)) for look in UNSEEN_LOOKS]
    courses["roads"] = list(zip(UNSEEN_ROADS, range(1000, 1000 + len(UNSEEN_ROADS)), strict=True))
    courses["roads, shadows"] = [(road, shadowed(look)) for road, look in courses["roads"]]
    return courses


def measure_frames(network: LaneNetwork) -> None:
    """Print the errors of single rendered frames from random poses, at each distance ahead."""
    print(f"{'rendered frames, m ahead':34}" + "".join(f"{distance:>8g}" for distance in DISTANCES_AHEAD))
    for name, courses in unseen_courses().items():
        strips, true = render_all([RenderedScene(track, look, 150) for track, look in courses], seed=1)
        estimated = estimate_centres(strips, network)
        slopes = []
        for x, y in zip(true.T, estimated.T, strict=True):
            known = ~np.isnan(x)
            slopes.append(np.polyfit(x[known], y[known], 1)[0])
        rows = {
            "mean absolute error, m": np.nanmean(abs(estimated - true), 0),
            "bias, m": np.nanmean(estimated - true, 0),
            "slope": np.array(slopes),
        }
        for label, values in rows.items():
            print(f"{f'{name}, {label}':34}" + "".join(f"{value:8.2f}" for value in values))


def measure_drives(network: LaneNetwork, laps: float) -> None:
    """Print the errors on recordings of the stand-in simulator, which logs the true position."""
    for name, look in itertools.chain(*unseen_courses().values()):
        with tempfile.TemporaryDirectory() as folder:
            run, _ = record(folder, Track(name), laps, 30 if name == "lake" else 15, seed=look, look=look)
            recording = read_recording(folder)
            position = fuse_detections(recording, detect_centres(recording, network))
            placed = estimate_lane_position(recording, stretches(recording), network)
        step = np.round((recording.time - recording.time[0]) / STEP).astype(int)
        true = np.array(run.trajectory.offset)[step]
        error = position.lateral_offset - true
        print(
            f"{f'rendered drive, {name}, look {look}':34}{len(error):6} rows, error {np.abs(error).mean():.2f} m, "
            f"95th percentile {np.quantile(np.abs(error), 0.95):.2f}, bias {error.mean():+.2f}, "
            f"slope {np.polyfit(true, position.lateral_offset, 1)[0]:.2f}; trusted {position.trusted.mean():.1%}; "
            f"localised, if possible: error {np.abs(placed.lateral_offset - true).mean():.2f} m"
        )


def measure_recording(folder: str, network: LaneNetwork) -> None:
    """Print the estimated positions of a real recording's side cameras, its lateral offsets, and the time needed."""
    recording = read_recording(folder)
    started = time.perf_counter()
    strips = read_strips(recording)
    decoded = time.perf_counter()
    centres = estimate_centres(strips, network)
    estimated = time.perf_counter()
    position = fuse_detections(recording, centres)
    finished = time.perf_counter()
    apart = centres[:, :1] - centres[:, 1:]
    print(f"{folder}, {len(recording)} rows")
    near = DISTANCES_AHEAD[:3]
    for side, name in enumerate(("left", "right")):
        cells = [f"{np.mean(apart[:, side, k]):+.2f} ± {np.std(apart[:, side, k]):.2f}" for k in range(len(near))]
        print(
            f"  {name + ' camera appears to be at':32}{', '.join(cells)} m, from {near[0]:g}, {near[1]:g}, {near[2]:g} "
            f"m ahead (mounted at {MOUNT_OFFSETS[side + 1]:+.2f})"
        )
    offset = position.lateral_offset
    print(
        f"  {'lateral offset':32}{np.abs(offset).mean():.2f} m, 95th percentile "
        f"{np.quantile(np.abs(offset), 0.95):.2f}, mean {offset.mean():+.2f}; "
        f"heading error {np.degrees(position.heading_error).std():.1f} degrees; trusted {position.trusted.mean():.1%}"
    )
    ms = np.diff([started, decoded, estimated, finished]) / len(recording) * 1e3
    print(f"  {'ms a row':32}{ms.sum():.2f}: decode {ms[0]:.2f}, network {ms[1]:.2f}, fuse {ms[2]:.2f}")
    measure_line(recording, strips, centres)


def measure_line(recording: Recording, strips: np.ndarray, centres: np.ndarray) -> None:
    """Print how far the line painted along the road is from the lane's centre, before and after this is corrected.

    strips: of `read_strips`; centres: of `estimate_centres`.
    """
    for stretch in stretches(recording):
        if len(stretch) < MIN_LOCALISED_ROWS:
            continue
        detected, seen = centres[stretch.rows], strips.__getitem__
        found = localise(stretch, detected)
        if not ROADS[found.track.name].centre_line:
            continue
        follower, followed = TrackFilter(stretch, detected, found.track), follow_line(found, stretch, detected, seen)
        for label, localisation in (("painted line, m from the centre", found), ("when followed", followed)):
            away = line_deviations(follower.lines_at(localisation.states, marking.AHEAD), stretch, seen)
            median = np.nanmedian(away)
            print(
                f"  {label:32}median {median:+.2f}, median deviation {np.nanmedian(np.abs(away - median)):.2f}; "
                f"found in {np.mean(~np.isnan(away).all(1)):.0%} of the rows"
            )


def draw_lane(recording: Recording, position: LanePosition, row: int, line_offset: float) -> np.ndarray:
    """Return a centre frame with the lane's centre (green) and lines (red) as straight lines up to 12 m ahead.

    line_offset: m from the lane's centre to its lines. Returns uint8 (160, 320, 3), BGR.
    """
    frame = cv2.cvtColor(read_frame(recording.path(row)), cv2.COLOR_RGB2BGR)
    offset, yaw = position.lateral_offset[row], position.heading_error[row]
    ahead = np.linspace(CAMERA_FORWARD + 2.2, 12, 30)  # m along the lane from the car's middle
    for line, colour in ((0, GREEN), (-line_offset, RED), (line_offset, RED)):
        points = np.stack([np.full_like(ahead, line - offset), ahead], axis=1)
        right, forward = components(points, forward_vector(yaw)).T
        visible = forward > CAMERA_FORWARD + 0.3
        pixels = project_ground(right[visible], forward[visible] - CAMERA_FORWARD)
        cv2.polylines(frame, [np.round(pixels).astype(np.int32)[:, None]], False, colour, 1, cv2.LINE_AA)
    text = f"{offset:+.2f} m {np.degrees(yaw):+.1f}"
    return cv2.putText(frame, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1)


def draw_frames(folder: str, network: LaneNetwork) -> np.ndarray:
    """Return twelve frames of a recording with the estimated lane, in three rows of four: uint8 (480, 1280, 3), BGR."""
    recording = read_recording(folder)
    position = estimate_lane_position(recording, stretches(recording), network)
    line_offset = LINE_OFFSETS["jungle" if "jungle" in folder else "lake"]
    rows = np.linspace(30, len(recording) - 30, 12).astype(int)
    frames = [draw_lane(recording, position, row, line_offset) for row in rows]
    return np.vstack([np.hstack(frames[k : k + 4]) for k in range(0, 12, 4)])


def main(argv: list[str] | None = None) -> int:
    """Print the measurements and write the picture; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="lane_accuracy", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="*", help="folders of real recordings, each with a driving_log.csv")
    parser.add_argument(
        "--network", metavar="lane.pt", help="file with the weights (default: those that come with the project)"
    )
    parser.add_argument(
        "--laps", type=number(float, 0, 1e5), default=0.3, help="length of each rendered drive; 0: none (default 0.3)"
    )
    parser.add_argument("--picture", type=Path, help="write real frames with the estimated lane drawn in")
    args = parser.parse_args(argv)
    try:
        network = load_network(args.network)
        if args.laps:
            measure_frames(network)
            measure_drives(network, args.laps)
        for folder in args.recordings:
            measure_recording(folder, network)
        if args.picture and args.recordings:
            pictures = np.vstack([draw_frames(folder, network) for folder in args.recordings])
            write(args.picture, cv2.imencode(args.picture.suffix, pictures)[1].tobytes())
    except (UserError, OSError) as error:
        return program.failed("lane_accuracy", error)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
