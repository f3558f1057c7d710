"""Record, train and drive in the stand-in simulator, and show the result in a report: 4 to 8 minutes on 2 cores.

    make demo                                          # installs what is needed first
    python -m tools.demo                               # the same in an environment that has it
    python -m tools.demo data/mine                     # train on recordings of your own, and drive the lake
    python -m tools.demo data/mine --track jungle      # or the jungle

Everything is written to the folder demo/, with recordings of your own to demo/own/; git ignores both. A demo that was
stopped continues when it is started again; without the folder it begins anew.

Exit status: 0 if every lap was driven without leaving the road, 1 if the car left it, 2 if a step failed.
"""

import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from cloning.base import program
from cloning.base.arguments import command_line
from cloning.base.cores import threads
from cloning.base.errors import SimulatorError, UserError
from cloning.base.outputs import read_json
from cloning.network.network import SHIPPED_MODEL
from cloning.recordings.log import find_folders
from cloning.road.autonomy import lap_in_words
from tools.command import ROOT, ServerProcess, python
from tools.shipped import Lap, render

FOLDER, OWN = Path("demo"), Path("demo", "own")  # the second one: with recordings of one's own
IMAGES = 20_000  # to train on: such a network drove both laps at 30 mph at most 0.25 m off the centre line
RECORDED = [Lap("lake", "ccw", look=0), Lap("lake", "cw", look=0)]
SPEEDS = {"lake": 30, "jungle": 15}  # mph
# Printed at the end: what to type, and what it does.
NEXT = (
    ("python -m simulator window", "drive yourself: the arrow keys steer, R records to data/, F1 shows all keys"),
    ("python drive.py {}/model.pt", "drive the real simulator: then start it in AUTONOMOUS MODE"),
    ("python -m tools.demo data", "train on your own recordings, all those below data/, drive and report"),
)


class Drive(NamedTuple):
    """A lap that a network drives."""

    title: str  # of its files in the report: a report (JSON), a picture (PNG) and a film (MP4)
    model: Path  # the network's file
    track: str  # the road's name
    direction: str
    folder: Path  # of the demo

    @property
    def picture(self) -> Path:
        """The last file that is written, so that the lap is driven once it exists."""
        return self.folder / "laps" / f"{self.title}.png"

    def report(self) -> dict[str, Any]:
        """Return the lap report, once the lap is driven."""
        return read_json(self.picture.with_suffix(".json"))


def drives(folder: Path, track: str = "lake") -> list[Drive]:
    """Return the laps of a demo: by its network, in both directions, and in the first demo by the project's, too."""
    model = folder / "model.pt"
    laps = [
        Drive(f"The {track}, by the network just trained", model, track, "ccw", folder),
        Drive(f"The {track} the other way round", model, track, "cw", folder),
    ]
    project = "The jungle, by the network that comes with the project"
    return laps + [Drive(project, SHIPPED_MODEL, "jungle", "cw", folder)] * (folder == FOLDER)


def check(folder: Path, recordings: list[Path]) -> None:
    """Raise UserError if a demo in the folder was begun with other recordings."""
    arguments = folder / "training_arguments.json"
    trained_on = read_json(arguments)["recordings"] if arguments.exists() else []
    if trained_on and [Path(each).resolve() for each in trained_on] != [each.resolve() for each in recordings]:
        raise UserError(f"{folder} has a demo with other recordings, {', '.join(trained_on)}: delete the folder first")


def train(folder: Path, recordings: list[Path]) -> None:
    """Train a network on recordings, or continue to. Raises SimulatorError."""
    model = folder / "model.pt"
    options = ["--robust", "--epochs", 1, "--samples-per-epoch", IMAGES, "--output", model]
    if model.exists():  # written at the end of the only epoch
        return
    if model.with_stem(f"{model.stem}-resume").exists():
        options.append("--resume")
    if python(ROOT / "model.py", *recordings, *options).returncode != program.DONE:
        raise SimulatorError("the training did not finish; start the demo again to continue it")


def drive(lap: Drive) -> None:
    """Let drive.py drive a lap, unless that is done, and print its figures. Raises UserError, OSError."""
    if not lap.picture.exists():
        print(f"{lap.title}: it sets off; how it drove follows in 1 to 2 minutes", flush=True)
        with TemporaryDirectory(dir=lap.folder, prefix="unfinished-") as folder:
            files = {kind: Path(folder, f"lap.{kind}") for kind in ("json", "mp4", "png")}
            outputs = ("--report", files["json"], "--film", files["mp4"], "--picture", files["png"])
            with ServerProcess(ROOT / "drive.py", lap.model, "--speed", SPEEDS[lap.track], "--port", 0) as server:
                road = ("--track", lap.track, "--direction", lap.direction, "--port", server.port)
                done = python("-m", "simulator", "drive", *road, *outputs, capture_output=True)
            if done.returncode not in (program.DONE, program.INCOMPLETE) or not files["json"].exists():
                raise SimulatorError(f"{lap.title}: {done.stderr.strip()}; start the demo again to continue")
            lap.picture.parent.mkdir(exist_ok=True)
            for kind, file in files.items():
                file.replace(lap.picture.with_suffix(f".{kind}"))
    print(f"{lap.title}: {lap_in_words(lap.report())}", flush=True)


def drive_all(laps: list[Drive]) -> None:
    """Drive all laps, as many at the same time as there are cores. Raises UserError, OSError."""
    with ThreadPoolExecutor(threads()) as pool:
        list(pool.map(drive, reversed(laps)))  # the jungle takes as long as both laps of the lake


def report(folder: Path, laps: list[Drive]) -> None:
    """Write the report of the training, with the laps. Raises SimulatorError."""
    pictures = [lap.picture for lap in laps]
    written = python("-m", "cloning.report", folder, "--lap", *pictures, stdout=subprocess.DEVNULL)
    if written.returncode != program.DONE:
        raise SimulatorError("the report was not written; start the demo again to continue")


def main(argv: list[str] | None = None) -> int:
    """Take the steps that are left, and print what to do next; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.demo", __doc__)
    own = "recordings to train on, or folders of recordings (default: two laps that are recorded first)"
    parser.add_argument("recordings", nargs="*", metavar="FOLDER", help=own)
    track = "what is then driven, with recordings of your own (default %(default)s)"
    parser.add_argument("--track", choices=SPEEDS, default="lake", help=track)
    arguments = parser.parse_args(argv)
    if arguments.track != "lake" and not arguments.recordings:
        parser.error("--track is for recordings of your own; name their folder, too")
    own, track, folder = arguments.recordings, arguments.track, OWN if arguments.recordings else FOLDER
    recordings = find_folders(own) if own else [FOLDER / "recorded"]
    if own:
        check(folder, recordings)
    folder.mkdir(parents=True, exist_ok=True)
    laps, project = drives(folder, track), "" if own else ", and the project's network the jungle"
    steps: list[tuple[str, Callable[[], object]]] = [
        (f"train a network on {IMAGES:,} images of them (1 to 3 minutes)", lambda: train(folder, recordings)),
        (f"let it drive the {track} at {SPEEDS[track]} mph{project}; films (2 to 4 minutes)", lambda: drive_all(laps)),
        ("write a report of it all (half a minute)", lambda: report(folder, laps)),
    ]
    if not own:
        what = "record an expert who drives a lap of the lake in each direction (1 minute)"
        steps.insert(0, (what, lambda: render(FOLDER / "recorded", RECORDED)))
    for n, (text, step) in enumerate(steps, 1):
        print(f"\n{n} of {len(steps)}: {text}", flush=True)
        begin = time.perf_counter()
        step()
        print(f"{n} of {len(steps)}: done in {time.perf_counter() - begin:.0f} s", flush=True)
    following = [(command.format(folder.as_posix()), text) for command, text in NEXT]
    width = max(len(command) for command, _ in following)
    print(f"\nLook at it in a browser: {(folder / 'report.html').resolve().as_uri()}")
    print(f"\nThree things to do next, after `{program.ACTIVATE}` in every new terminal:")
    print("\n".join(f"  {command:{width}}  # {text}" for command, text in following))
    return program.INCOMPLETE if any(lap.report()["departures"] for lap in laps) else program.DONE


if __name__ == "__main__":
    program.run(main)
