"""How far a network steers as the drivers of recordings did.

    python -m tools.follow_driver model.pt data/lake-ccw data/lake-cw

Prints for each recording the correlation of the network's steering on the centre frames with the driver's, frame by
frame and with both smoothed over nine frames (0.6 s), for a driver's hands are jerky where the road is not; and mean
and spread of the smoothed steering. A model trained on drawn recordings alone tells so how like the real road the
drawn one is.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from cloning.pilot.network import load_model
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording

FRAMES = 9
PIECE = 32  # frames at once


def smooth(steering: np.ndarray) -> np.ndarray:
    """The mean over FRAMES frames: (n,) -> (n - 8,)."""
    return np.convolve(steering, np.ones(FRAMES) / FRAMES, "valid")


def predict(network, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The network's and the driver's steering on a recording's centre frames, float (n,), in the order of time."""
    recording = read_recording(folder)
    paths = [recording.path(row) for row in range(len(recording))]
    predicted = []
    for start in range(0, len(paths), PIECE):
        frames = np.stack([decode(path.read_bytes()) for path in paths[start : start + PIECE]])
        with torch.inference_mode():
            predicted.append(network(torch.from_numpy(frames)).numpy())
    return np.concatenate(predicted), recording.steering


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("recordings", nargs="+", type=Path)
    args = parser.parse_args()
    network = load_model(args.model)
    print(f"{'':24} correlation, smoothed    network: mean, spread    driver: mean, spread")
    for folder in args.recordings:
        pair = predict(network, folder)
        soft = [smooth(steering) for steering in pair]
        figures = "    ".join(f"{steering.mean():+.3f} {steering.std():.3f}        " for steering in soft)
        print(f"{folder.name:24} {np.corrcoef(*pair)[0, 1]:11.2f} {np.corrcoef(*soft)[0, 1]:9.2f}    {figures}")


if __name__ == "__main__":
    main()
