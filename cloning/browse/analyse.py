"""Analyse each row of a recording: where the car is on the road, or how a model steers or drives; see `analyses.py`.

python -m cloning.browse.analyse RECORDING lane                 # lateral offset, and the position on a known track
python -m cloning.browse.analyse RECORDING steering model.pt    # the model's steering
python -m cloning.browse.analyse RECORDING replay model.pt 1    # a drive with the model as the driver, at 1 m
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("analyse")

import argparse
import itertools
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from cloning.base.cores import threads
from cloning.base.errors import ModelError
from cloning.browse.analyses import PROGRESS, Analysis, Result, stamp, write_result
from cloning.lane.known import known_position
from cloning.lane.localise import localise_recording, shipped_networks
from cloning.lane.reader import LaneNetwork, detect_centres, read_strips
from cloning.lane.recovery import LaneAhead
from cloning.network.compute import one_thread
from cloning.network.network import load_model, steer
from cloning.recordings.check import check_images
from cloning.recordings.columns import Finding
from cloning.recordings.images import read_frame
from cloning.recordings.log import SHOWN_REJECTED, Recording, read_uncut
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import Drive, ReplayFrame, drive, load_recording, reference_lines
from cloning.replay.score import drive_metrics, reference_metrics
from cloning.road.motion import stretches

PART_ROWS = 256  # that are analysed at once: with their strips, 12 MB
LANE_COLUMNS = ("offset", "label", "x", "y", "road")  # of an analysis of the lane
NOTHING = np.empty(0, np.float32)


def main() -> int:
    """Analyse a recording and write the result; return the exit status. Raises UserError or OSError."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="folder with a driving_log.csv")
    parser.add_argument("kind", choices=("lane", "steering", "replay"))
    parser.add_argument("model", nargs="?", default="", help="its file, for steering and replay")
    parser.add_argument("limit", nargs="?", type=float, default=0.0, help="m from the reference line, for replay")
    arguments = parser.parse_args()
    if hasattr(os, "nice"):
        os.nice(10)  # the page, and whatever else the user does, goes first
    folder, analysis = arguments.recording, Analysis(arguments.kind, arguments.model, arguments.limit)
    before = stamp(folder, analysis)
    if analysis.kind == "replay":
        result = replayed(load_recording(folder), analysis)
    else:
        recording = check_images(read_uncut(folder), threads(), show_progress=False).without_copies()
        result = lane(recording) if analysis.kind == "lane" else steering(recording, analysis.model)
    write_result(folder, analysis, before, result)
    return program.DONE


def lane(recording: Recording) -> Result:
    """Return the columns offset (m, right positive), label, x and y (m, on a known track), road, and the tracks.

    label is the steering of `model.py --robust`, -1..1, as it learns it for the recorded images; road is an index into
    about["roads"], -1 where the track is not known; offset is nan where it is not trusted, label where there is none. A
    `lane.csv` has the offset, but not the track.
    """
    if not len(recording):
        return Result(recording.images[:, 0], dict.fromkeys(LANE_COLUMNS, NOTHING), {"roads": []} | rejected(recording))
    known = known_position(recording)  # first, since the rest takes long

    def detect(network: LaneNetwork) -> np.ndarray:
        return np.concatenate([detect_centres(part, network) for part in parts(recording)])

    strips = partial(read_strips, recording)
    driven = stretches(recording)
    position, localised = localise_recording(recording, driven, detect, strips, shipped_networks())
    position = known or position
    x, y = np.full((2, len(recording)), np.nan, np.float32)
    road, roads = np.full(len(recording), -1, np.float32), []
    for rows, localisation in localised:
        track = localisation.track
        found = {"name": track.name, "direction": track.direction, "outline": track.points[:, :2].round(1).tolist()}
        if found not in roads:
            roads.append(found)
        road[rows] = roads.index(found)
        poses = [track.at(s, right) for s, right, _ in localisation.states.tolist()]
        x[rows], y[rows] = np.array([(pose.x, pose.y) for pose in poses]).T
    offset = np.where(position.trusted, position.lateral_offset, np.nan).astype(np.float32)
    label = np.full(len(recording), np.nan, np.float32)
    for stretch in itertools.chain.from_iterable(position.pieces(recording, each) for each in driven):
        rows = stretch.rows
        ahead = LaneAhead.of_stretch(stretch, position.lateral_offset[rows], position.trusted[rows])
        label[rows] = np.where(ahead.known, ahead.steering(ahead.offset, ahead.yaw), np.nan)
    columns = dict(zip(LANE_COLUMNS, (offset, label, x, y, road), strict=True))
    return Result(recording.images[:, 0], columns, {"roads": roads} | rejected(recording))


def steering(recording: Recording, model: str) -> Result:
    """Return the column steering, -1..1: with the arithmetic of drive.py. Raises ModelError."""
    one_thread()
    network = load_model(model)

    def steer_frame(path: Path) -> float:
        return float(steer(network, read_frame(path)))

    values: list[float] = []
    try:
        with ThreadPoolExecutor(threads(), initializer=one_thread) as pool:
            for part in parts(recording):
                values += pool.map(steer_frame, [part.path(row) for row in range(len(part))])
    except ArithmeticError as error:
        raise ModelError(f"{model}: {error}; train the model again") from None
    return Result(recording.images[:, 0], {"steering": np.array(values, np.float32)}, rejected(recording))


def replayed(recording: Recording, analysis: Analysis) -> Result:
    """Return how a model drives; see `cloning.replay.replay` and `Drive`. Raises UserError.

    The columns are offset and human, the cars' lateral offset in m from the reference line, right positive; right and
    yaw, the pose of `ReplayedCar`; steering, the model's, -1..1; line, the index of the reference line. about has the
    metrics; the interventions as [index in the columns, offset in m]; and where the lane is not known, as [the first
    row's centre image, rows, why].
    """
    one_thread()
    lines = reference_lines(recording)
    total = sum(len(line.stretch) for line in lines)
    poses: list[tuple[float, float]] = []

    def watch(frame: ReplayFrame, done: Drive) -> None:
        if len(poses) % PART_ROWS == 0:
            print(f"{PROGRESS}{len(poses) / total:.3f}", flush=True)
        poses.append(frame.pose)

    done = drive(recording, lines, analysis.limit, ModelDriver(analysis.model), watch)
    offset = np.array(done.offset)
    right, yaw = np.array(poses).T
    columns = {
        "offset": offset,
        "human": offset - done.offset_from_human,
        "right": right,
        "yaw": yaw,
        "steering": np.array(done.steering),
        "line": np.repeat(np.arange(len(lines)), [len(line.stretch) for line in lines]),
    }
    known = reference_metrics(recording, lines)
    image_of = {recording.name(row): int(image) for row, image in enumerate(recording.images[:, 0])}
    about = {
        **drive_metrics(lines, done),
        **known,
        "unknown": [[image_of[each["first"]], each["rows"], each["why"]] for each in known["unknown"]],
        "human_mean_m": round(float(np.abs(columns["human"]).mean()), 3),
        "where": [[at, round(metres, 2)] for at, metres in done.interventions.items()],
        "by_lane": sum(len(line.stretch) for line in lines if line.is_lane_centre),
    }
    return Result(recording.images[done.row, 0], columns, about)


def parts(recording: Recording) -> Iterator[Recording]:
    """Yield a recording in parts of PART_ROWS, and print how much of it is done before each."""
    for start in range(0, len(recording), PART_ROWS):
        print(f"{PROGRESS}{start / len(recording):.3f}", flush=True)
        yield recording.take(slice(start, start + PART_ROWS))


def rejected(recording: Recording) -> dict[str, object]:
    """Return how many rows have an unusable image, and the first of them: [line, detail]."""
    of_images = (Finding.IMAGE_MISSING, Finding.IMAGE_UNUSABLE)
    unusable = [(row.line, row.detail) for row in recording.rejected if row.finding in of_images]
    return {"unusable": len(unusable), "first_unusable": unusable[:SHOWN_REJECTED]}


if __name__ == "__main__":
    program.run(main)
