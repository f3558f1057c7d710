"""Carry data between this project and LeRobot or donkeycar; make a recording of a drive that drive.py saved.

    python -m cloning.lerobot data/lake-ccw data/lake-cw --output lake    # recordings -> a data set for LeRobot
    python -m cloning.lerobot lake --output data/lake                     # LeRobot's data set -> a recording
    python -m cloning.lerobot mycar/data --output data/mycar              # donkeycar's tub -> a recording
    python -m cloning.lerobot run1 --output run1-recording                # a drive that drive.py saved -> a recording

What does not fit into a recording is told. Parquet needs pyarrow: pip install pyarrow
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("lerobot")

import argparse
from collections import Counter
from pathlib import Path

from cloning.base.arguments import command_line, number
from cloning.base.errors import OutputError, RecordingError, UserError, printable
from cloning.base.outputs import as_typed, plural
from cloning.lerobot.drives import MANIFEST, read_driven, read_tub
from cloning.lerobot.source import write_recording
from cloning.recordings.check import check_images
from cloning.recordings.format import LANE_FILE
from cloning.recordings.log import find_folders, folders_below, print_findings, read_recording
from cloning.recordings.saved_frames import DRIVEN, taken_at

OPTIONS = {"camera": ("data set", "tub"), "steering": ("data set",), "full_lock": ("data set", "tub")}  # of what


def parse_arguments() -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = command_line("python -m cloning.lerobot", __doc__)
    source = "recordings, or folders with recordings; or one data set, tub or drive"
    add = parser.add_argument
    add("source", nargs="+", help=source)
    add("--output", type=Path, required=True, metavar="FOLDER", help="new folder to write")
    add("--camera", metavar="NAME", help="of a data set or tub: the camera that looks ahead")
    add("--steering", metavar="NAME", help="of a data set: the number that is the steering")
    lock = "of a data set or tub: its steering at 25 degrees to the right (default 1)"
    add("--full-lock", type=number(float), metavar="VALUE", help=lock)
    arguments = parser.parse_args()
    if arguments.full_lock == 0:
        parser.error("argument --full-lock: 0 is straight ahead")
    return arguments


def kind_of(folder: Path) -> str:
    """Return what a folder is, by the files in it."""
    files = {"tub": MANIFEST, "drive": DRIVEN, "data set": "meta/info.json"}
    return next((kind for kind, name in files.items() if (folder / name).is_file()), "recording")


def main() -> int:
    """Write the data set or recording; return the exit status."""
    arguments = parse_arguments()
    source, output, notes = Path(arguments.source[0]), arguments.output, Counter[str]()
    kind = kind_of(source)
    if not source.exists():
        raise UserError(f"{source}: no such folder; name a recording, data set, tub or drive")
    if any(source.glob("record_*.json")):
        remedy = "donkeycar's scripts/convert_to_tub_v2.py makes one of version 2"
        raise UserError(f"{source}: a tub of version 1; {remedy}")
    if output.exists():
        raise OutputError(f"{output}: exists already; name another folder, or delete this one")
    if kind != "recording" and len(arguments.source) > 1:
        raise UserError(f"{source} is a {kind}: name it alone")
    for option, kinds in OPTIONS.items():
        if getattr(arguments, option) is not None and kind not in kinds:
            raise UserError(f"--{option.replace('_', '-')} is of a {' or '.join(kinds)}, not of a {kind}; leave it out")
    if kind == "drive":
        samples = read_driven(source, notes)
    elif kind == "tub":
        samples = read_tub(source, arguments.camera, notes)
    else:
        from cloning.lerobot.dataset import write_data_set
        from cloning.lerobot.reader import read_data_set

        if kind == "recording":
            if any(taken_at(path.name) for path in source.glob("[0-9]*.jpg")):
                why = f"saved frames without {DRIVEN}, as earlier versions and Udacity's drive.py leave them"
                raise UserError(f"{source}: {why}, so their steering is unknown; `python video.py` films them")
            inner = [str(folder) for folder in sorted(source.glob("*")) if kind_of(folder) in ("tub", "data set")]
            if inner and not any(folders_below(source)):
                raise UserError(f"{source}: name one alone: {', '.join(inner)}")
            recordings = [check_images(read_recording(folder)) for folder in find_folders(arguments.source)]
            for recording in recordings:
                print_findings(recording)
                if (lane := recording.folder / LANE_FILE).exists():
                    print(f"{lane}: left out; of what comes back, --robust will have to estimate the lane")
            recordings = [recording for recording in recordings if len(recording)]
            if not recordings:
                raise RecordingError(f"{source}: no usable row is left")
            print(f"{output}: {write_data_set(recordings, output)}")
            return program.DONE
        samples = read_data_set(source, arguments.camera, arguments.steering)
    try:
        rows = write_recording(samples, output, arguments.full_lock or 1.0, notes)
    except RecordingError as error:
        raise RecordingError(f"{source}: {error}") from None
    finally:  # also why there is no usable row
        for note, times in notes.items():
            print(f"{source}: {printable(note)} ({plural(times, 'time')})")
    browse = program.in_commands(as_typed("python", "-m", "cloning.browse", output))
    print(f"{output}: {plural(rows, 'row')}; look at them with `{browse}`")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
