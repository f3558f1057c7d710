"""Measure how closely a network's steering follows the human driver's on recordings.

    python -m tools.follow_driver model.pt data/lake-ccw data/lake-cw

For each recording it prints the correlation between the network's steering on the centre frames and the driver's,
frame by frame and with both smoothed over nine frames (0.6 s), because drivers steer less evenly than the road bends.
It also prints the mean and the standard deviation of both, smoothed. For a model trained only on rendered recordings,
this shows how similar rendered and real roads are.
"""

import argparse
from pathlib import Path

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("follow_driver")  # also while the libraries below are loaded

import numpy as np
import torch

from cloning.base.errors import UserError
from cloning.network.network import Network, load_model
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording, read_recording

SMOOTHED_FRAMES = 9
FRAMES_PER_BATCH = 32


def smooth(steering: np.ndarray) -> np.ndarray:
    """Return the moving average over SMOOTHED_FRAMES frames: (n,) -> (n - 8,)."""
    return np.convolve(steering, np.ones(SMOOTHED_FRAMES) / SMOOTHED_FRAMES, "valid")


def predict(network: Network, recording: Recording) -> np.ndarray:
    """Return a network's steering on a recording's centre frames: float32 (n,). Raises RecordingError."""
    paths = [recording.path(row) for row in range(len(recording))]
    predicted = []
    for start in range(0, len(paths), FRAMES_PER_BATCH):
        frames = np.stack([read_frame(path) for path in paths[start : start + FRAMES_PER_BATCH]])
        with torch.inference_mode():
            predicted.append(network(torch.from_numpy(frames)).numpy())
    return np.concatenate(predicted)


def main(argv: list[str] | None = None) -> int:
    """Print a row of metrics for each recording; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="follow_driver", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", help="a model file of model.py")
    parser.add_argument("recordings", nargs="+", type=Path, help="folders of recordings, each with a driving_log.csv")
    args = parser.parse_args(argv)
    try:
        network = load_model(args.model)
        print(f"{'':24} correlation, smoothed    network: mean, deviation    driver: mean, deviation")
        for folder in args.recordings:
            recording = read_recording(folder)
            predicted, driven = predict(network, recording), recording.steering
            predicted_smoothed, driven_smoothed = smooth(predicted), smooth(driven)
            correlation = np.corrcoef(predicted, driven)[0, 1]
            smoothed = np.corrcoef(predicted_smoothed, driven_smoothed)[0, 1]
            cells = [f"{values.mean():+.3f} {values.std():.3f}" for values in (predicted_smoothed, driven_smoothed)]
            print(f"{folder.name:24} {correlation:11.2f} {smoothed:9.2f}    {cells[0]:28}{cells[1]}")
    except (UserError, OSError) as error:
        return program.failed("follow_driver", error)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
