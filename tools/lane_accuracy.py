"""How well `lane.py` reads the place in the lane.

    python -m tools.lane_accuracy RECORDING …                     # on drawn frames, and on these real recordings
    python -m tools.lane_accuracy RECORDING --picture lane.png    # real frames with the lane as it is read

On drawn frames the place is known: of drives in looks that the network was not trained on, and of frames from random
places. On real ones only where the side cameras stand beside the centre one is known: 0.806 and 0.825 m.
"""

import argparse
import tempfile
import time

import cv2
import numpy as np

from cloning.lane.place import read_lane
from cloning.lane.reader import AHEAD, MOUNT_OFFSETS, STRIP, combine, estimate, load, read_strips, see
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.road.camera import CAMERA_HEIGHT, CAMERA_MATRIX
from cloning.road.motion import CAMERA_FORWARD, stretches
from cloning.road.track import Track
from simulator.car import STEP
from simulator.record import record
from tools.train_lane import TRACKS, draw

UNSEEN = range(1000, 1003)  # looks
EDGES = {"lake": 3.5, "jungle": 4.1}  # m from the centre to the lines


def places(network) -> None:
    """Frames from random places: errors at the distances ahead."""
    print(f"{'drawn frames, m ahead':34}" + "".join(f"{distance:>8g}" for distance in AHEAD))
    for name in TRACKS:
        drawn = [draw(name, look, 150, 1) for look in UNSEEN]
        true = np.concatenate([centres for _, centres in drawn])
        found = estimate(np.concatenate([strips for strips, _ in drawn]), network)
        slopes = [
            np.polyfit(t[known], f[known], 1)[0]
            for t, f in zip(true.T, found.T, strict=True)
            for known in [~np.isnan(t)]
        ]
        for figure, values in (
            ("mean absolute error, m", np.nanmean(abs(found - true), 0)),
            ("bias, m", np.nanmean(found - true, 0)),
            ("slope", slopes),
        ):
            print(f"{f'{name}, {figure}':34}" + "".join(f"{value:8.2f}" for value in values))


def drives(network, laps: float) -> None:
    """Recordings of the stand-in, whose own path is the truth."""
    for name in TRACKS:
        for look in UNSEEN:
            with tempfile.TemporaryDirectory() as folder:
                run = record(folder, Track(name), laps, 30 if name == "lake" else 15, seed=look, look=look)
                recording = read_recording(folder)
                found = combine(recording, see(recording, network))
            step = np.round((recording.time - recording.time[0]) / STEP).astype(int)
            true = np.array(run.trajectory.offset)[step]
            error = found.offset - true
            print(
                f"{f'drawn drive, {name}, look {look}':34}{len(error):6} rows, error {np.abs(error).mean():.2f} m, "
                f"95th percentile {np.quantile(np.abs(error), 0.95):.2f}, bias {error.mean():+.2f}, "
                f"slope {np.polyfit(true, found.offset, 1)[0]:.2f}; trusted {found.trusted.mean():.1%}"
            )


def real(folder: str, network) -> None:
    recording = read_recording(folder)
    started = time.perf_counter()
    strips = read_strips(recording)
    decoded = time.perf_counter()
    seen = estimate(strips.reshape(-1, *STRIP), network).reshape(-1, 3, len(AHEAD))
    estimated = time.perf_counter()
    found = combine(recording, seen)
    finished = time.perf_counter()
    beside = seen[:, :1] - seen[:, 1:]
    print(f"{folder}, {len(recording)} rows")
    for side, name in enumerate(("left", "right")):
        cells = [f"{np.mean(beside[:, side, k]):+.2f} ± {np.std(beside[:, side, k]):.2f}" for k in range(3)]
        print(
            f"  {name + ' camera stands at':32}{', '.join(cells)} m, seen {AHEAD[0]:g}, {AHEAD[1]:g}, {AHEAD[2]:g} m "
            f"ahead (mounted at {MOUNT_OFFSETS[side + 1]:+.2f})"
        )
    print(
        f"  {'off the centre':32}{np.abs(found.offset).mean():.2f} m, 95th percentile "
        f"{np.quantile(np.abs(found.offset), 0.95):.2f}, mean {found.offset.mean():+.2f}; "
        f"yaw {np.degrees(found.yaw).std():.1f} degrees; trusted {found.trusted.mean():.1%}"
    )
    spent = np.diff([started, decoded, estimated, finished]) / len(recording) * 1e3
    print(f"  {'ms a row':32}{spent.sum():.2f}: decode {spent[0]:.2f}, network {spent[1]:.2f}, together {spent[2]:.2f}")


def drawn_in(recording, found, row: int, edge: float) -> np.ndarray:
    """A centre frame with the lane's centre (green) and its edges (red) as far as 12 m ahead, taken as straight."""
    frame = cv2.cvtColor(decode(recording.path(row).read_bytes()), cv2.COLOR_RGB2BGR)
    ahead = np.linspace(CAMERA_FORWARD + 2.2, 12, 30)
    s, c = np.sin(-found.yaw[row]), np.cos(-found.yaw[row])
    for aside, colour in ((0, (0, 220, 0)), (-edge, (0, 0, 255)), (edge, (0, 0, 255))):
        right = (aside - found.offset[row]) * c + ahead * s
        forward = ahead * c - (aside - found.offset[row]) * s
        pixels = np.stack([right, np.full_like(right, CAMERA_HEIGHT), forward - CAMERA_FORWARD]).T @ CAMERA_MATRIX.T
        pixels = pixels[pixels[:, 2] > 0.3]
        points = np.round(pixels[:, :2] / pixels[:, 2:]).astype(np.int32)
        cv2.polylines(frame, [points[:, None]], False, colour, 1, cv2.LINE_AA)
    cv2.putText(frame, f"{found.offset[row]:+.2f} m {np.degrees(found.yaw[row]):+.1f}", (6, 14), 0, 0.45, (0, 0, 0), 1)
    return frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", help="real ones")
    parser.add_argument("--network", help="weights (default lane.pt)")
    parser.add_argument("--laps", type=float, default=0.3, help="of each drawn drive (default 0.3)")
    parser.add_argument("--picture", help="real frames with the lane as it is read")
    args = parser.parse_args()
    network = load(args.network) if args.network else load()
    if args.laps:
        places(network)
        drives(network, args.laps)
    pictures = []
    for folder in args.recordings:
        real(folder, network)
        if args.picture:
            recording = read_recording(folder)
            found = read_lane(recording, stretches(recording), network)
            edge = EDGES["jungle" if "jungle" in folder else "lake"]
            rows = np.linspace(30, len(recording) - 30, 12).astype(int)
            frames = [drawn_in(recording, found, row, edge) for row in rows]
            pictures += [np.hstack(frames[k : k + 4]) for k in range(0, 12, 4)]
    if pictures:
        cv2.imwrite(args.picture, np.vstack(pictures))


if __name__ == "__main__":
    main()
