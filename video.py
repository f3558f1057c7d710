"""Make a film of the frames that drive.py saved.

python video.py run1                        # run1.mp4, at the rate at which the frames were taken
python video.py run1 --fps 60
python video.py run1 --overlay model.pt     # with the model's steering and what it looks at
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from datetime import datetime
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

from cloning import program

if __name__ == "__main__":
    program.end_on_interrupt("video.py", "stopped; no film was written")  # also while the libraries below are loaded

import cv2
import numpy as np
from tqdm import tqdm

from cloning.errors import UserError, message_of
from cloning.film import FilmWriter
from cloning.recordings import saved_frames
from cloning.recordings.format import FRAME, SAMPLE_RATE
from cloning.recordings.images import jpeg_size

MAX_FRAME_GAP = 1.0  # s: a longer gap between two frames is a pause, which does not count for the rate
MAX_RATE = 240.0  # frames/s that a film is given without --fps

Overlay = Callable[[np.ndarray], np.ndarray]  # from a frame to the film's picture, both uint8 (rows, columns, 3), RGB


class FilmError(UserError):
    """A film that cannot be made; the message names the folder and the remedy."""


def find_frames(folder: Path) -> list[tuple[datetime, Path]]:
    """Return the folder's frames and their times, sorted by time. Raises FilmError if there are none."""
    if not folder.is_dir():
        raise FilmError(f"{folder}: no such folder; `python drive.py model.pt {folder}` saves frames in it")
    frames: list[tuple[datetime, Path]] = []
    others: list[str] = []
    for path in folder.iterdir():
        time = saved_frames.taken_at(path.name)
        if time and path.is_file():
            frames.append((time, path))
        else:
            others.append(path.name)
    if not frames:
        raise FilmError(
            f"{folder}: no frames (files with names like 2018_07_16_17_11_43_382.jpg); "
            f"`python drive.py model.pt {folder}` saves frames in it"
        )
    if others:
        print_note(f"left out, not frames: {abbreviated(sorted(others))}")
    return sorted(frames)


def abbreviated(names: list[str]) -> str:
    """Return the first three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def print_note(message: str) -> None:
    """Print a message about something that was left out or changed."""
    print(f"video.py: {message}", file=sys.stderr)


def frame_rate(times: list[datetime]) -> Fraction:
    """Return frames per second, 1..240, from the frames' times without pauses; for a single frame, that of recordings.

    It is the mean, not the median, because frames arrive in bunches of two or three.
    """
    gaps = [(after - before).total_seconds() for before, after in pairwise(times)]
    gaps = [gap for gap in gaps if gap < MAX_FRAME_GAP]
    rate = min(MAX_RATE, max(1.0, len(gaps) / sum(gaps))) if sum(gaps) else SAMPLE_RATE
    return Fraction(rate).limit_denominator(1000)


def read_saved_frame(path: Path) -> np.ndarray | None:
    """Return a frame of any size, uint8 (rows, columns, 3), RGB; None if it is unreadable or cut short."""
    try:
        jpeg = path.read_bytes()
        jpeg_size(jpeg)
    except (OSError, ValueError):
        return None
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)


def make_film(folder: Path, fps: Fraction | None = None, overlay: Overlay | None = None) -> Path:
    """Write `folder`.mp4 next to the folder, and return its path.

    fps: frames/s; None: from the frames' times. overlay: makes each frame's picture; all pictures must have one size.
    Frames of another size than the first are scaled to it. Raises FilmError, OSError.
    """
    frames = find_frames(folder)
    fps = fps or frame_rate([time for time, _ in frames])
    path = folder.with_name(folder.name + ".mp4")
    unreadable: list[str] = []
    sizes: Counter[tuple[int, ...]] = Counter()
    writer = FilmWriter(path, fps)
    try:
        for _, frame_path in tqdm(frames, unit="frame", disable=None):
            frame = read_saved_frame(frame_path)
            if frame is None:
                unreadable.append(frame_path.name)
                continue
            sizes[frame.shape] += 1
            first = next(iter(sizes))
            if frame.shape != first:
                frame = cv2.resize(frame, (first[1], first[0]), interpolation=cv2.INTER_AREA)
            writer.add(overlay(frame) if overlay else frame)
        writer.close()
    finally:
        writer.discard()
    if not sizes:
        raise FilmError(f"{folder}: none of its {len(frames)} frames is readable; save new ones with drive.py")
    if unreadable:
        print_note(f"left out, unreadable: {abbreviated(unreadable)}")
    if len(sizes) > 1:
        print_note(f"{sizes.total() - sizes[first]} frames of another size were scaled to {first[1]}x{first[0]}")
    print(f"{path}: {sizes.total()} frames at {float(fps):.4g} frames/s")
    return path


def load_overlay(model_file: Path) -> Overlay:
    """Return the overlay that shows a model's steering and what it looks at. Raises ModelError."""
    from cloning.pilot import attention  # imports torch, which takes longer than making a short film
    from cloning.pilot.network import load_model

    network = load_model(model_file)

    def overlay(frame: np.ndarray) -> np.ndarray:
        if frame.shape != FRAME:
            raise FilmError(
                f"the frames have {frame.shape[1]}x{frame.shape[0]} pixels, but a model reads "
                f"{FRAME[1]}x{FRAME[0]}; leave out --overlay"
            )
        try:
            return attention.overlay(frame, *attention.visual_backprop(network, frame))
        except ArithmeticError as error:
            raise FilmError(f"{model_file}: {error}; train the model again with `python model.py`") from None

    return overlay


def parse_rate(text: str) -> Fraction:
    """Parse a rate in frames per second. Raises ArgumentTypeError unless it is above 0 and at most 1000."""
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0 and up to 1000")
    return rate


def main() -> None:
    """Parse the command line and make the film."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the folder with the frames; the film is FOLDER.mp4")
    parser.add_argument(
        "--fps", type=parse_rate, help="frames per second, up to 1000 (default: from the frames' times)"
    )
    parser.add_argument("--overlay", metavar="MODEL", type=Path, help="draw this model's steering and attention")
    args = parser.parse_args()
    folder = args.folder if args.folder.name not in ("", "..") else args.folder.resolve()  # a name for "."
    try:
        make_film(folder, args.fps, load_overlay(args.overlay) if args.overlay else None)
    except (UserError, OSError) as error:
        sys.exit(f"video.py: {message_of(error)}")


if __name__ == "__main__":
    program.run(main)
