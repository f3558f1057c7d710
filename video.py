"""Make a film of the frames that drive.py saved.

python video.py run1                        # run1.mp4, at the rate at which the frames were taken
python video.py run1 --fps 60
python video.py run1 --overlay model.pt     # with the steering and what the network looks at
"""

import argparse
import sys
from collections import Counter
from datetime import datetime
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from cloning.errors import UserError
from cloning.film import FilmWriter
from cloning.recordings import saved_frames as frames
from cloning.recordings.format import FRAME
from cloning.recordings.images import jpeg_size

PAUSE = 1.0  # seconds between two frames from which it is a pause, which says nothing about the rate


class FilmError(UserError):
    """A film that cannot be made; the message names the folder and the remedy."""


def find(folder: Path) -> list[tuple[datetime, Path]]:
    """The folder's frames and their times, in order. Raises FilmError if there are none."""
    if not folder.is_dir():
        raise FilmError(f"{folder}: no such folder; `python drive.py model.pt {folder}` saves frames in it")
    found, foreign = [], []
    for path in folder.iterdir():
        time = frames.taken_at(path.name)
        if time and path.is_file():
            found.append((time, path))
        else:
            foreign.append(path.name)
    if not found:
        raise FilmError(
            f"{folder}: no frames, which have names like 2018_07_16_17_11_43_382.jpg; "
            f"`python drive.py model.pt {folder}` saves some"
        )
    if foreign:
        print(f"left out, no frames: {listed(sorted(foreign))}", file=sys.stderr)
    return sorted(found)


def listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def rate(times: list[datetime]) -> Fraction:
    """Frames per second by the frames' times, pauses left out, between 1 and 240; 15, a recording's, for one frame.

    The mean, for frames arrive two or three at once: the median gap would be that within such a bunch.
    """
    gaps = [(after - before).total_seconds() for before, after in pairwise(times)]
    gaps = [gap for gap in gaps if gap < PAUSE]
    return Fraction(min(240.0, max(1.0, len(gaps) / sum(gaps))) if sum(gaps) else 15).limit_denominator(1000)


def read(path: Path) -> np.ndarray | None:
    """A frame of any size, uint8 (rows, columns, 3), RGB; None if it is unreadable or cut short."""
    try:
        jpeg = path.read_bytes()
        jpeg_size(jpeg)
    except (OSError, ValueError):
        return None
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)


def film(folder: Path, fps: Fraction | None = None, overlay=None) -> Path:
    """Write `folder`.mp4 beside the folder.

    overlay: a function from a frame to its picture. Raises FilmError.
    """
    found = find(folder)
    fps = fps or rate([time for time, _ in found])
    path = folder.with_name(folder.name + ".mp4")
    unreadable, sizes = [], Counter()
    made = FilmWriter(path, fps)
    try:
        for _, frame_path in tqdm(found, unit="frame", disable=None):
            frame = read(frame_path)
            if frame is None:
                unreadable.append(frame_path.name)
                continue
            sizes[frame.shape] += 1
            shape = next(iter(sizes))
            if frame.shape != shape:
                frame = cv2.resize(frame, shape[1::-1], interpolation=cv2.INTER_AREA)
            made.add(overlay(frame) if overlay else frame)
        made.close()
    finally:
        made.discard()
    if not sizes:
        raise FilmError(f"{folder}: none of its {len(found)} frames is readable")
    if unreadable:
        print(f"left out, unreadable: {listed(unreadable)}", file=sys.stderr)
    if len(sizes) > 1:
        others = sum(list(sizes.values())[1:])
        print(f"{others} frames of another size were scaled to {shape[1]}x{shape[0]}", file=sys.stderr)
    print(f"{path}: {sum(sizes.values())} frames at {float(fps):.4g} frames/s")
    return path


def overlay_of(model_file: str):
    """The overlay with the network's own steering and what it looks at. Raises FilmError."""
    from cloning.errors import ModelError
    from cloning.pilot import attention  # which loads torch, and that takes longer than a short film
    from cloning.pilot.network import load_model

    try:
        network = load_model(model_file)
    except ModelError as error:
        raise FilmError(error) from None

    def overlay(frame: np.ndarray) -> np.ndarray:
        if frame.shape != FRAME:
            raise FilmError(
                f"the frames are {frame.shape[1]}x{frame.shape[0]} where a model sees "
                f"{FRAME[1]}x{FRAME[0]}; leave out --overlay"
            )
        return attention.overlay(frame, *attention.visual_backprop(network, frame))

    return overlay


def frame_rate(text: str) -> Fraction:
    rate = Fraction(text)
    if not 0 < rate <= 1000:
        raise ValueError
    return rate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the frames; its film is FOLDER.mp4")
    parser.add_argument("--fps", type=frame_rate, help="frames per second, up to 1000 (default: by the frames' times)")
    parser.add_argument("--overlay", metavar="MODEL", help="draw this model's steering and what it looks at")
    args = parser.parse_args()
    folder = args.folder if args.folder.name not in ("", "..") else args.folder.resolve()  # "." has a name, too
    try:
        film(folder, args.fps, overlay_of(args.overlay) if args.overlay else None)
    except (FilmError, OSError) as error:
        sys.exit(f"video.py: {error}")
    except KeyboardInterrupt:
        sys.exit("video.py: stopped; no film was written")


if __name__ == "__main__":
    main()
