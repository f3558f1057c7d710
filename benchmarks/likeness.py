"""How much the drawn frames are like real ones: a table of figures, and frames side by side.

    python benchmarks/likeness.py data/lake-ccw --track lake --direction ccw --picture side_by_side.png

The real recording is laid along the track by its steering and speeds, and the same places are drawn. Of every
camera:
mean colour, brightness by rows, and where the lane's yellow lines lie: their columns at row 100 and where
they meet.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from motion import MPH, curvature  # noqa: E402
from recordings import CAMERAS, read_recording  # noqa: E402
from simulator import scenery  # noqa: E402
from simulator.cameras import Cameras, jpeg  # noqa: E402
from simulator.run import Run  # noqa: E402
from simulator.track import Track  # noqa: E402
from simulator.world import Scene  # noqa: E402

ROWS = (10, 30, 50, 60, 70, 80, 90, 100, 115, 130, 145)


def read(folder: Path) -> tuple[list[list[Path]], np.ndarray, np.ndarray, np.ndarray]:
    """Paths of each row's three images, its steering, speed (m/s) and time (s)."""
    recording = read_recording(folder)
    paths = [[folder / "IMG" / recording.names[image].decode() for image in row] for row in recording.images]
    return paths, recording.numbers[:, 0].astype(float), recording.numbers[:, 3] * float(MPH), recording.time


def along(track: Track, steering, speed, moments) -> tuple[np.ndarray, float]:
    """Where on the track each row was taken, m, and how much the car turns for what its wheels' angle says.

    Of all starts (and slightly different lengths) the one that fits the turning best.
    """
    pause = np.clip(np.diff(moments, prepend=moments[0]), 0, 0.2)
    turned = np.cumsum(-curvature(steering) * speed * pause)
    driven = np.cumsum(speed * pause)
    lap, whole = track.length, 2 * np.pi * round((track.heading[-1] - track.heading[0]) / (2 * np.pi))
    best = (np.inf,)
    for scale in np.arange(0.96, 1.07, 0.01):
        for start in np.arange(0, lap, 3.0):
            s = start + driven * scale
            heading = np.interp(
                s % lap, np.arange(len(track.heading)) * track.step, track.heading
            ) + whole * (s // lap)
            gain, level = np.polyfit(turned, heading, 1)
            off = float(np.square(heading - gain * turned - level).mean())
            best = min(best, (off, start, scale, gain))
    _, start, scale, gain = best
    return (start + driven * scale) % lap, gain


def lines(frame: np.ndarray) -> tuple[float, float, float, float] | None:
    """Columns at row 100 of the left and right inner yellow line, and the column and row where they meet.

    Of all pairs of lines that meet near the horizon, the pair that is most yellow against its surroundings.
    frame: uint8 (160, 320, 3) RGB. None if the lines cannot be made out.
    """
    colours = frame.astype(np.float32)
    yellow = colours[..., 0] + colours[..., 1] - 2 * colours[..., 2]
    yellow = np.clip(yellow - cv2.blur(yellow, (15, 1)), -20, 60)
    rows = np.arange(78, 132)
    steep = np.arange(0.6, 5.0, 0.06)  # columns a row
    best = (9.0, None)
    for row in np.arange(56, 66):
        for column in range(146, 174, 2):
            found = []
            for side in (-1, 1):
                at = column + side * steep[:, None] * (rows - row)
                inside = (at >= 0) & (at < 319.5)
                value = yellow[rows, np.clip(np.round(at), 0, 319).astype(int)] * inside
                score = value.sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
                score[inside.sum(axis=1) < 14] = -np.inf
                k = int(np.argmax(score))
                found.append((score[k], steep[k]))
            total = min(found[0][0], found[1][0])
            if total > best[0]:
                best = (
                    total,
                    (column - found[0][1] * (100 - row), column + found[1][1] * (100 - row), column, row),
                )
    return best[1]


def load(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path, help="a real recording of one lap or more")
    parser.add_argument("--track", default="lake")
    parser.add_argument("--direction", default="ccw")
    parser.add_argument("--frames", type=int, default=120, help="places to compare (default 120)")
    parser.add_argument("--picture", help="write frames side by side: real above, drawn below")
    args = parser.parse_args()
    track = Track(args.track, args.direction)
    paths, steering, speed, moments = read(args.recording)
    place, gain = along(track, steering, speed, moments)
    print(f"over the whole recording the car turns {gain:.2f} times what its wheels' angle says")
    chosen = np.linspace(0, len(paths) - 1, args.frames).astype(int)
    run, cameras = Run(track), Cameras(Scene(scenery.build(args.track)))
    real, drawn = [], []
    for i in chosen:
        real.append([load(path) for path in paths[i]])
        run.s = float(place[i])
        run.set_back()
        frames = cameras.frames(run.car.node.get_transform())
        decoded = [cv2.imdecode(np.frombuffer(jpeg(frame), np.uint8), cv2.IMREAD_COLOR) for frame in frames]
        drawn.append([cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) for frame in decoded])
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
    if args.track == "lake":
        straight = np.flatnonzero(np.abs(steering[chosen]) < 0.03)[::2]
        for c, camera in enumerate(CAMERAS):
            found = [
                [line for frame in frames[straight, c] if (line := lines(frame))] for frames in (real, drawn)
            ]
            names = (
                "left line at row 100",
                "right line at row 100",
                "lines meet at column",
                "lines meet at row",
            )
            for k, name in enumerate(names):
                cells = "".join(
                    f"{np.median([f[k] for f in one]):>17.1f} (n={len(one):3})" if one else f"{'-':>24}"
                    for one in found
                )
                print(f"{camera + ', ' + name:28}{cells}")
    if args.picture:
        strips = []
        for i in np.linspace(0, len(chosen) - 1, 8).astype(int):
            strips.append(np.vstack([np.hstack(real[i][[1, 0, 2]]), np.hstack(drawn[i][[1, 0, 2]])]))
        columns = [np.vstack(strips[:4]), np.vstack(strips[4:])]
        cv2.imwrite(args.picture, cv2.cvtColor(np.hstack(columns), cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
