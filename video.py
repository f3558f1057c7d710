"""Make a film of the frames that drive.py saved.

python video.py run1                        # run1.mp4, at the rate at which the frames were taken
python video.py run1 --fps 60
python video.py run1 --overlay model.pt     # with the model's steering and what it looks at

Exit status: 0 if the film shows every frame, 1 if unreadable ones were left out, 2 if no film was written.
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("video.py", "stopped; no film was written")  # also while the libraries below are loaded

import sys
from collections.abc import Callable
from datetime import datetime
from fractions import Fraction
from pathlib import Path

import numpy as np

from cloning.base.arguments import command_line, number, ratio
from cloning.base.errors import UserError, printable
from cloning.base.film import FilmWriter, frame_rate
from cloning.base.outputs import as_typed
from cloning.base.progress import progress_bar
from cloning.recordings import saved_frames
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import decode, read_jpeg
from cloning.road.overlay import overlay

FPS_RANGE = 0.01, 1000.0  # frames/s that can be given

Overlay = Callable[[np.ndarray], np.ndarray]  # from a frame to the film's picture, both uint8 (rows, columns, 3), RGB


def find_frames(folder: Path) -> list[tuple[datetime, Path]]:
    """Return the folder's frames and their times, sorted by time. Raises UserError if there are none."""
    if folder.is_file():
        raise UserError(f"{folder}: a file; name the folder in which drive.py has saved frames")
    if not folder.is_dir():
        command = as_typed("python", "drive.py", "model.pt", folder)
        raise UserError(f"{folder}: no such folder; `{command}` saves frames in it")
    frames: list[tuple[datetime, Path]] = []
    others: list[str] = []
    for path in folder.iterdir():
        time = saved_frames.taken_at(path.name)
        # A link that leads nowhere is a frame that is lost; a folder or a pipe is none.
        if time and (path.is_file() or (path.is_symlink() and not path.exists())):
            frames.append((time, path))
        elif path.name != saved_frames.DRIVEN:
            others.append(path.name)
    if not frames:
        names = "files with names like 2018_07_16_17_11_43_382.jpg"
        raise UserError(f"{folder}: no frames ({names}); name the folder in which drive.py has saved frames")
    if others:
        print_note(f"left out, not frames: {abbreviated(sorted(others))}")
    return sorted(frames)


def abbreviated(names: list[str]) -> str:
    """Return the first three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def print_note(message: str) -> None:
    """Print a message about something that was left out or changed."""
    print(f"{program.name}: {printable(message)}", file=sys.stderr)


def make_film(folder: Path, fps: Fraction | None = None, draw: Overlay | None = None) -> int:
    """Write `folder`.mp4 next to the folder, and return how many unreadable frames were left out.

    fps: frames/s; None: from the frames' times. draw: makes each frame's picture; all pictures must have one size.
    A frame is readable if training could read it: a whole JPEG of 320x160 pixels. Raises UserError, OSError.
    """
    frames = find_frames(folder)
    fps = fps or frame_rate([(time - frames[0][0]).total_seconds() for time, _ in frames], SAMPLE_RATE)
    path = folder.with_name(folder.name + ".mp4")
    unreadable: list[str] = []
    reason: ValueError | None = None  # of the first unreadable frame
    with FilmWriter(path, fps) as writer, progress_bar(len(frames), "frame") as bar:
        for _, frame_path in frames:
            bar.update()
            try:
                frame = decode(read_jpeg(frame_path))
            except ValueError as error:
                unreadable.append(frame_path.name)
                reason = reason or error
                continue
            writer.add(draw(frame) if draw else frame)
    if len(unreadable) == len(frames):
        raise UserError(
            f"{folder}: none of its {len(frames)} frames is readable (the first: {reason}); save new ones with drive.py"
        )
    if unreadable:
        print_note(f"left out, unreadable (the first: {reason}): {abbreviated(unreadable)}")
    print(f"{path}: {len(frames) - len(unreadable)} frames at {float(fps):.4g} frames/s")
    return len(unreadable)


def load_overlay(model_file: Path, as_mounted: bool = False) -> Overlay:
    """Return the overlay that shows a model's steering and what it looks at; as_mounted: see `Pilot`.

    Raises ModelError.
    """
    import torch  # takes longer to import than a short film to make

    from cloning.lane.mount import Mount
    from cloning.network.attention import visual_backprop
    from cloning.network.network import load_model

    torch.set_num_threads(1)  # more threads are slower for single frames, and the encoder uses the other cores
    network, mount = load_model(model_file), None if as_mounted else Mount()

    def picture(frame: np.ndarray) -> np.ndarray:
        frame = mount(frame) if mount else frame  # as in drive.py
        try:
            return overlay(frame, *visual_backprop(network, frame))
        except ArithmeticError as error:
            raise UserError(f"{model_file}: {error}; train the model again with `python model.py`") from None

    return picture


def main() -> int:
    """Parse the command line and make the film; return the exit status."""
    parser = command_line(None, __doc__)
    parser.add_argument("folder", type=Path, help="the folder with the frames; the film is FOLDER.mp4")
    fps_help = "frames per second, such as 60 or 30000/1001 (default: from the frames' times)"
    parser.add_argument("--fps", type=number(ratio, *FPS_RANGE), help=fps_help)
    parser.add_argument("--overlay", metavar="MODEL", type=Path, help="draw this model's steering and attention")
    mounted = "with --overlay: take frames as they are, as drive.py does with this option"
    parser.add_argument("--as-mounted", action="store_true", help=mounted)
    arguments = parser.parse_args()
    folder = arguments.folder if arguments.folder.name not in ("", "..") else arguments.folder.resolve()  # "." has none
    fps = Fraction(arguments.fps).limit_denominator(1001) if arguments.fps else None
    draw = load_overlay(arguments.overlay, arguments.as_mounted) if arguments.overlay else None
    left_out = make_film(folder, fps, draw)
    return program.INCOMPLETE if left_out else program.DONE


if __name__ == "__main__":
    program.run(main)
