"""Measure what a network gets wrong: its error at random poses, by pose, bend and light.

    python -m tools.pose_errors model.pt data/jungle data/jungle-shadows

From each recording's frames, views from random poses are made as `model.py --robust` makes them, but in the recorded
light. The tables have the root mean square of the network's steering minus the recovery steering, the slope of a line
through 0 that leads from the latter to the former (below 1, the network steers too little), and how much the recovery
steering itself would change if the lane's centre were SHIFT away from where it was estimated: its own uncertainty.
"""

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("pose_errors")  # also while the libraries below are loaded

import numpy as np
import torch

from cloning.base.arguments import number
from cloning.base.errors import RecordingError, UserError
from cloning.network.network import Network, load_model
from cloning.recordings.log import CheckedRecording
from cloning.replay.replay import load_recording
from cloning.training.options import Arguments
from cloning.training.robust import Poses, RobustObservations

SHIFT = 0.15  # m: the lane's centre is known so well
PIECE = 32  # views that the network is given at once
# Where the groups of each table begin; the last number is where the last one ends.
OFFSETS = (0, 0.5, 1, 1.5, 2.5)  # m from the lane's centre, either side
YAWS = (0, 5, 10, 90)  # degrees, either side
BENDS = (0, 0.1, 0.3, 2)  # |steering| along the lane's centre
BRIGHTNESS = (0, 50, 80, 110, 140, 256)  # mean of the view

Sample = dict[str, np.ndarray]  # by column, one value for each view


def sample(network: Network, recording: CheckedRecording, views: int, seed: int) -> Sample:
    """Return what the network and the recovery steering say at random poses, and where these are: float64 (views,).

    wanted, shifted: the recovery steering, and with the lane's centre SHIFT further left; steering: the network's;
    offset, yaw, bend, brightness: as in the tables. Raises RecordingError, ModelError.
    """
    observations = RobustObservations.select(recording, Arguments(robust=True))
    if not len(observations):
        raise RecordingError(f"{recording.folder}: {RobustObservations.too_few}")
    rng = np.random.default_rng(seed)
    rows = rng.integers(len(observations), size=views)
    lanes = observations.lanes.take(rows)
    drawn = lanes.sample_poses(rng, np.zeros(views, bool))
    poses = Poses.of(lanes, drawn.offset, drawn.yaw, drawn.camera, drawn.mirrored)  # in the recorded light
    steering, brightness = [], []
    for start in range(0, views, PIECE):
        part = np.arange(start, min(start + PIECE, views))
        images = observations.warped(rows[part], [poses.take(part)])[0]
        with torch.inference_mode():
            steering.append(network(torch.from_numpy(images)).numpy().clip(-1, 1))
        brightness.append(images.mean((1, 2, 3)))
    centred = np.zeros(views)
    found = {
        "wanted": poses.steering,
        "shifted": lanes.steering(poses.offset + SHIFT, poses.yaw),
        "steering": np.concatenate(steering),
        "offset": np.abs(poses.offset),
        "yaw": np.degrees(np.abs(poses.yaw)),
        "bend": np.abs(lanes.steering(centred, centred)),
        "brightness": np.concatenate(brightness),
    }
    return {name: values.astype(float) for name, values in found.items()}


def figures(found: Sample) -> str:
    """Return a table's cells: number of views, error, slope, uncertainty and deviation of the recovery steering."""
    wanted, steering = found["wanted"], found["steering"]
    error, unsure = (np.sqrt(np.mean((other - wanted) ** 2)) for other in (steering, found["shifted"]))
    slope = (steering @ wanted) / max(wanted @ wanted, 1e-9)
    return f"{len(wanted)} | {error:.3f} | {slope:.2f} | {unsure:.3f} | {wanted.std():.3f}"


def tables(name: str, found: Sample) -> str:
    """Return a recording's tables, in Markdown; name: of the recording."""
    rows = [
        f"| {name} | views | error | slope | error of a lane {SHIFT:g} m off | deviation of the steering |",
        "|---|---|---|---|---|---|",
        f"| all | {figures(found)} |",
    ]
    groups: Sequence[tuple[str, str, Sequence[float]]] = (
        ("offset", "{:g} to {:g} m off", OFFSETS),
        ("yaw", "turned by {:g} to {:g}°", YAWS),
        ("bend", "steering along the lane {:g} to {:g}", BENDS),
        ("brightness", "brightness {:g} to {:g}", BRIGHTNESS),
    )
    for column, title, edges in groups:
        for least, most in itertools.pairwise(edges):
            chosen = (found[column] >= least) & (found[column] < most)
            if chosen.any():
                cells = figures({key: values[chosen] for key, values in found.items()})
                rows.append(f"| {title.format(least, most)} | {cells} |")
    return "\n".join(rows)


def main(argv: list[str] | None = None) -> int:
    """Print the tables of each recording; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="pose_errors", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", help="a model file of model.py")
    parser.add_argument("recordings", nargs="+", type=Path, help="folders of recordings, each with a driving_log.csv")
    parser.add_argument(
        "--views", type=number(int, 1, 10**6), default=3000, help="of each recording (default %(default)s)"
    )
    parser.add_argument("--seed", type=number(int, 0), default=0, help="of the poses (default %(default)s)")
    args = parser.parse_args(argv)
    try:
        network = load_model(args.model)
        for folder in args.recordings:
            recording = load_recording(folder)
            print(f"\n{tables(recording.folder.name, sample(network, recording, args.views, args.seed))}", flush=True)
    except (UserError, OSError) as error:
        return program.failed("pose_errors", error)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
