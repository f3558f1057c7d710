"""Record, train and drive in the stand-in simulator, and show the result in a report: five minutes on two cores.

    make demo                   # installs what is needed first
    python -m tools.demo        # the same in an environment that has it

Everything is written to the folder demo/, which git ignores. A demo that was stopped continues when it is started
again; without the folder it begins anew.

Exit status: 0 if every lap was driven without leaving the road, 1 if the car left it, 2 if a step failed.
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("demo", "stopped; start it again to continue")  # also while the libraries below are loaded

import json
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from cloning.base.arguments import command_line
from cloning.base.cores import threads
from cloning.base.errors import SimulatorError
from cloning.network.network import SHIPPED_MODEL
from cloning.report.content import lap_in_words
from tools.command import ROOT, python, run_tool
from tools.server_process import ServerProcess
from tools.shipped import Lap, render

FOLDER = Path("demo")
MODEL, LAPS = FOLDER / "model.pt", FOLDER / "laps"
IMAGES = 20_000  # to train on: such a network drove both laps at 30 mph at most 0.25 m off the centre line
RECORDED = [Lap("lake", "ccw", look=0), Lap("lake", "cw", look=0)]
# Printed at the end: what to type, and what it does.
ACTIVATE = "source .venv/bin/activate"  # of the environment that make installs; README.md has other systems'
NEXT = (
    ("python -m simulator window", "drive yourself: the arrow keys steer, R records to data/, F1 shows all keys"),
    (f"python drive.py {MODEL.as_posix()}", "drive the real simulator: then start it in AUTONOMOUS MODE"),
    ("python model.py --robust", "train on your own recordings, which are all those below data/"),
)


class Drive(NamedTuple):
    """A lap that a network drives.

    title             of its files in the report: a report (JSON), a picture (PNG) and a film (MP4)
    model             the network's file
    track, direction  of the road
    speed             set speed in mph
    """

    title: str
    model: Path
    track: str
    direction: str
    speed: int

    @property
    def picture(self) -> Path:
        """The last file that is written, so that the lap is driven once it exists."""
        return LAPS / f"{self.title}.png"

    def report(self) -> dict[str, Any]:
        """Return the lap report, once the lap is driven."""
        return dict(json.loads(self.picture.with_suffix(".json").read_bytes()))


DRIVES = [
    Drive("The lake, by the network just trained", MODEL, "lake", "ccw", 30),
    Drive("The lake the other way round", MODEL, "lake", "cw", 30),
    Drive("The jungle, by the network that comes with the project", SHIPPED_MODEL, "jungle", "cw", 15),
]


def record() -> None:
    """Record the laps that are not recorded yet. Raises UserError, OSError."""
    render(FOLDER / "recorded", RECORDED)


def train() -> None:
    """Train a network on the recorded laps, or continue to. Raises SimulatorError."""
    if MODEL.exists():  # written at the end of the only epoch
        return
    options = ["--robust", "--epochs", 1, "--samples-per-epoch", IMAGES, "--output", MODEL]
    if MODEL.with_stem(f"{MODEL.stem}-resume").exists():
        options.append("--resume")
    if python(ROOT / "model.py", FOLDER / "recorded", *options).returncode != program.DONE:
        raise SimulatorError("the training did not finish; start the demo again to continue it")


def drive(lap: Drive) -> None:
    """Let drive.py drive a lap, unless that is done, and print its figures. Raises UserError, OSError."""
    if not lap.picture.exists():
        with TemporaryDirectory(dir=FOLDER, prefix="unfinished-") as folder:
            files = {kind: Path(folder, f"lap.{kind}") for kind in ("json", "mp4", "png")}
            outputs = ("--report", files["json"], "--film", files["mp4"], "--picture", files["png"])
            with ServerProcess(ROOT / "drive.py", lap.model, "--speed", str(lap.speed), "--port", "0") as server:
                road = ("--track", lap.track, "--direction", lap.direction, "--port", server.port)
                done = python("-m", "simulator", "drive", *road, *outputs, capture_output=True)
            if done.returncode not in (program.DONE, program.INCOMPLETE) or not files["json"].exists():
                raise SimulatorError(f"{lap.title}: {done.stderr.strip()}; start the demo again to continue")
            LAPS.mkdir(exist_ok=True)
            for kind, file in files.items():
                file.rename(lap.picture.with_suffix(f".{kind}"))
    print(f"{lap.title}: {lap_in_words(lap.report())}", flush=True)


def drive_all() -> None:
    """Drive all laps, as many at the same time as there are cores. Raises UserError, OSError."""
    with ThreadPoolExecutor(threads()) as pool:
        list(pool.map(drive, reversed(DRIVES)))  # the jungle takes as long as both laps of the lake


def report() -> None:
    """Write the report of the training, with the laps. Raises SimulatorError."""
    laps = [drive.picture for drive in DRIVES]
    if python("-m", "cloning.report", FOLDER, "--lap", *laps, stdout=subprocess.DEVNULL).returncode != program.DONE:
        raise SimulatorError("the report was not written; start the demo again to continue")


def main(argv: list[str] | None = None) -> int:
    """Take the steps that are not done yet, write the page and print what to do next; return the exit status.

    Raises UserError, OSError.
    """
    parser = command_line("demo", __doc__)
    parser.parse_args(argv)
    steps = (
        ("record an expert who drives a lap of the lake in each direction (1 minute)", record),
        (f"train a network on {IMAGES:,} images of the two laps (1 minute)", train),
        ("let it drive the lake at 30 mph, and the project's network the jungle, with films (2 minutes)", drive_all),
        ("write a report of it all", report),
    )
    for n, (text, step) in enumerate(steps, 1):
        print(f"\n{n} of {len(steps)}: {text}", flush=True)
        begin = time.perf_counter()
        step()
        print(f"{n} of {len(steps)}: done in {time.perf_counter() - begin:.0f} s", flush=True)
    width = max(len(command) for command, _ in NEXT)
    print(f"\nLook at it in a browser: {(FOLDER / 'report.html').resolve().as_uri()}")
    print(f"\nThree things to do next, after `{ACTIVATE}` in every new terminal:")
    print("\n".join(f"  {command:{width}}  # {text}" for command, text in NEXT))
    return program.INCOMPLETE if any(lap.report()["departures"] for lap in DRIVES) else program.DONE


if __name__ == "__main__":
    run_tool(main)
