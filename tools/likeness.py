"""How much the drawn frames are like real ones: a table of figures, and frames side by side.

    python -m tools.likeness data/lake-ccw --picture side_by_side.png

`cloning/lane/place.py` tells where on a known road a real recording was driven, and the car is drawn at the same
places. Of every camera: mean colour, brightness by rows, and where the lake's inner yellow lines lie, in columns from where flat
geometry has them.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from cloning.lane.place import localise_all
from cloning.lane.reader import detect_centres
from cloning.recordings.format import CAMERAS
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.road.camera import CAMERA_OFFSETS, camera_position, project_ground
from cloning.road.motion import REAR_AXLE, stretches
from cloning.road.track import Place, Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.run import Run
from simulator.world import Scene

ROWS = (10, 30, 50, 60, 70, 80, 90, 100, 115, 130, 145)
BANDS = (range(76, 82), range(86, 94), range(104, 116))  # rows in which the lines are looked for: far, middle, near
LINE = 3.5  # m from the lake's centre line to the middle of the inner yellow line
AROUND = np.arange(-14, 14.1, 0.5)  # columns


def axle(track: Track, place: np.ndarray) -> tuple[Place, np.ndarray]:
    """The rear axle's middle at a place as `place.Localisation` has it, with the car's heading, and the way it points."""
    s, right, yaw = place
    at = track.at(s, right)
    heading = at.heading - yaw
    return Place(at.x, at.y, at.z, heading, at.grade), np.array([np.cos(heading), np.sin(heading)])


def line_columns(track: Track, place: np.ndarray, aside: float, camera: str, rows: range) -> np.ndarray:
    """Where flat geometry has the line `aside` metres left of the centre line, in some rows: columns, or nan."""
    at, forward = axle(track, place)
    right = np.array([forward[1], -forward[0]])
    eye = camera_position(np.array([at.x, at.y]), forward, CAMERA_OFFSETS[camera])
    near = (round(place[0] / track.step) + np.arange(45)) % len(track.points)
    away = track.points[near, :2] - aside * track.rightward[near] - eye
    ahead = away @ forward
    seen = project_ground(away[ahead > 2] @ right, ahead[ahead > 2])[::-1]  # from the horizon down
    return np.interp(rows, seen[:, 1], seen[:, 0], left=np.nan, right=np.nan)


def line_profile(frames: np.ndarray, columns: list[np.ndarray], rows: range) -> tuple[float, int]:
    """Where the yellow is, in columns from those given, on the mean over all rows in which they are in view.

    frames: uint8 (n, 160, 320, 3) RGB. Also how many rows those are. nan where nothing stands out.
    """
    profiles = []
    for frame, expected in zip(frames.astype(np.float32), columns, strict=True):
        yellow = frame[..., 0] + frame[..., 1] - 2 * frame[..., 2]
        for row, column in zip(rows, expected, strict=True):
            if AROUND[-1] < column < 319 - AROUND[-1]:
                profiles.append(np.interp(column + AROUND, np.arange(320), yellow[row]))
    if not profiles:
        return np.nan, 0
    mean = np.mean(profiles, axis=0)
    mean -= np.linspace(mean[:8].mean(), mean[-8:].mean(), len(mean))
    weight = np.clip(mean - mean.max() / 2, 0, None) * (np.abs(AROUND - AROUND[mean.argmax()]) < 5)
    return float((weight * AROUND).sum() / weight.sum()), len(profiles)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="a real recording of the lake or the jungle")
    parser.add_argument("--frames", type=int, default=120, help="places to compare (default 120)")
    parser.add_argument("--picture", help="write frames side by side: real above, drawn below")
    args = parser.parse_args()
    recording = read_recording(args.recording)
    drives = list(localise_all(stretches(recording), detect_centres(recording)))
    if not drives:
        raise SystemExit(f"{args.recording}: not found on a known road")
    rows, found = max(drives, key=lambda one: one[0].stop - one[0].start)
    track, name = found.track, found.track.name
    print(f"{name}, {track.direction}, {rows.stop - rows.start} rows")
    chosen = np.linspace(0, len(found.states) - 1, args.frames).astype(int)
    run, cameras = Run(track), Cameras(Scene(scenery.build(name)))
    real, drawn = [], []
    for i in chosen:
        real.append([decode(recording.path(rows.start + i, camera).read_bytes()) for camera in range(3)])
        at, forward = axle(track, found.states[i])
        x, y = (at.x, at.y) + REAR_AXLE * forward
        run.car.place(Place(x, y, at.z + REAR_AXLE * at.grade, at.heading, at.grade))
        run.car.settle()
        frames = cameras.frames(run.car.node.get_transform())
        drawn.append([decode(jpeg(frame)) for frame in frames])
    real, drawn = np.array(real), np.array(drawn)
    print(f"{'':28}{'real':>24}{'drawn':>24}")
    for c, camera in enumerate(CAMERAS):
        pair = [frames[:, c].astype(float) for frames in (real, drawn)]
        print(
            f"{camera + ', mean colour RGB':28}"
            + "".join(f"{np.array2string(p.mean((0, 1, 2)).round(0)):>24}" for p in pair)
        )
    for row in ROWS:
        pair = [frames[:, 0, row].astype(float).mean((0, 1)).round(0) for frames in (real, drawn)]
        print(f"{f'center, row {row}':28}" + "".join(f"{np.array2string(p):>24}" for p in pair))
    profile = [frames[:, 0].astype(float).mean((0, 2, 3)) for frames in (real, drawn)]
    print(
        f"{'row profile, correlation':28}{np.corrcoef(*profile)[0, 1]:>24.3f}"
        f"   mean difference {np.abs(profile[0] - profile[1]).mean():.1f}"
    )
    if name == "lake":
        for c, camera in enumerate(CAMERAS):
            for side, aside in (("left", LINE), ("right", -LINE)):
                for band in BANDS:
                    columns = [line_columns(track, found.states[i], aside, camera, band) for i in chosen]
                    pair = [line_profile(frames[:, c], columns, band) for frames in (real, drawn)]
                    print(
                        f"{f'{camera}, {side} line, row {band[len(band) // 2]}':28}"
                        + "".join(f"{at:>+15.1f} (n={n:4})" for at, n in pair)
                    )
    if args.picture:
        strips = []
        for i in np.linspace(0, len(chosen) - 1, 8).astype(int):
            strips.append(np.vstack([np.hstack(real[i][[1, 0, 2]]), np.hstack(drawn[i][[1, 0, 2]])]))
        columns = [np.vstack(strips[:4]), np.vstack(strips[4:])]
        cv2.imwrite(args.picture, cv2.cvtColor(np.hstack(columns), cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
