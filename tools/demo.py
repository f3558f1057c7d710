"""Record, train and drive in the stand-in simulator, and show the result on a page: five minutes on two cores.

    make demo                   # installs what is needed first
    python -m tools.demo        # the same in an environment that has it

Everything is written to the folder demo/, which git ignores. A demo that was stopped continues when it is started
again; without the folder it begins anew.

Exit status: 0 if every lap was driven without leaving the road, 1 if the car left it, 2 if a step failed.
"""

import html
import json
import shutil
import string
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("demo", "stopped; start it again to continue")  # also while the libraries below are loaded

from cloning.base.cores import threads
from cloning.base.errors import SimulatorError
from cloning.base.files import write
from cloning.network.network import SHIPPED_MODEL
from cloning.server.site import STYLE
from simulator.report import LapReport
from tools.command import ROOT, command_line, python, run_tool
from tools.server_process import ServerProcess
from tools.shipped import Lap, render

FOLDER = Path("demo")
MODEL = FOLDER / "model.pt"
IMAGES = 20_000  # to train on: such a network drove both laps at 30 mph at most 0.25 m off the centre line
RECORDED = [Lap("lake", "ccw", look=0), Lap("lake", "cw", look=0)]
TEMPLATE = Path(__file__).with_name("demo.html")
# Printed at the end, and shown on the page: what to type, and what it does.
ACTIVATE = "source .venv/bin/activate"  # of the environment that make installs; README.md has other systems'
NEXT = (
    ("python -m simulator window", "drive yourself: the arrow keys steer, R records to data/, F1 shows all keys"),
    (f"python drive.py {MODEL.as_posix()}", "drive the real simulator: then start it in AUTONOMOUS MODE"),
    ("python model.py --robust", "train on your own recordings, which are all those below data/"),
)


class Drive(NamedTuple):
    """A lap that a network drives.

    name              of its folder, which holds lap.json (report), lap.png (picture) and lap.mp4 (film)
    title             on the page
    model             the network's file
    track, direction  of the road
    speed             set speed in mph
    """

    name: str
    title: str
    model: Path
    track: str
    direction: str
    speed: int

    @property
    def folder(self) -> Path:
        """The folder, which exists once the lap is driven."""
        return FOLDER / self.name

    def report(self) -> LapReport:
        """Return the lap report, once the lap is driven."""
        return json.loads((self.folder / "lap.json").read_text(encoding="utf-8"))


DRIVES = [
    Drive("lake-ccw", "The lake, by the network just trained", MODEL, "lake", "ccw", 30),
    Drive("lake-cw", "The lake the other way round", MODEL, "lake", "cw", 30),
    Drive("jungle", "The jungle, by the network that comes with the project", SHIPPED_MODEL, "jungle", "cw", 15),
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
    if not lap.folder.exists():
        unfinished = FOLDER / f"unfinished-{lap.name}"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        outputs = ("json", "--report"), ("png", "--picture"), ("mp4", "--film")
        files = [word for suffix, option in outputs for word in (option, unfinished / f"lap.{suffix}")]
        with ServerProcess(ROOT / "drive.py", lap.model, "--speed", str(lap.speed), "--port", "0") as server:
            road = ("--track", lap.track, "--direction", lap.direction, "--port", server.port)
            done = python("-m", "simulator", "drive", *road, *files, capture_output=True)
        if done.returncode not in (program.DONE, program.INCOMPLETE) or not (unfinished / "lap.json").exists():
            raise SimulatorError(f"{lap.title}: {done.stderr.strip()}; start the demo again to continue")
        unfinished.rename(lap.folder)
    print(f"{lap.title}: {in_words(lap.report())}", flush=True)


def drive_all() -> None:
    """Drive all laps, as many at the same time as there are cores. Raises UserError, OSError."""
    with ThreadPoolExecutor(threads()) as pool:
        list(pool.map(drive, reversed(DRIVES)))  # the jungle takes as long as both laps of the lake


def in_words(report: LapReport) -> str:
    """Return the figures of a lap in one line."""
    times = {0: "never left the road", 1: "left the road once"}
    departures = len(report["departures"])
    return (
        f"{report['distance_m']:.0f} m at {report['mean_speed_mph']:.0f} mph, "
        f"{times.get(departures, f'left the road {departures} times')}; "
        f"{report['offset_mean_m']:.2f} m from the centre line on average, {report['offset_max_m']:.2f} m at most"
    )


def page() -> str:
    """Return the page: one HTML file that needs nothing but the files beside it."""
    figures = [
        f'<figure><video src="{lap.name}/lap.mp4" controls autoplay muted loop playsinline '
        f'aria-label="{html.escape(lap.title)}, from behind the car"></video>'
        f"<figcaption><b>{html.escape(lap.title)}</b> {html.escape(in_words(lap.report()))}.</figcaption></figure>"
        for lap in DRIVES
    ]
    maps = [
        f'<figure><a href="{lap.name}/lap.png"><img src="{lap.name}/lap.png" loading="lazy" '
        f'alt="{html.escape(lap.title)}: the road from above, and the distance from the centre line"></a></figure>'
        for lap in DRIVES
    ]
    steps = [f"<dt><code>{html.escape(command)}</code><dd>{html.escape(text)}" for command, text in NEXT]
    return string.Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        style=STYLE.read_text(encoding="utf-8"),
        films="\n".join(figures),
        maps="\n".join(maps),
        steps="\n".join(steps),
        activate=ACTIVATE,
        images=f"{IMAGES:,}",
    )


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
    )
    for n, (text, step) in enumerate(steps, 1):
        print(f"\n{n} of {len(steps)}: {text}", flush=True)
        begin = time.perf_counter()
        step()
        print(f"{n} of {len(steps)}: done in {time.perf_counter() - begin:.0f} s", flush=True)
    write(FOLDER / "index.html", page().encode())
    width = max(len(command) for command, _ in NEXT)
    print(f"\nLook at it in a browser: {(FOLDER / 'index.html').resolve().as_uri()}")
    print(f"\nThree things to do next, after `{ACTIVATE}` in every new terminal:")
    print("\n".join(f"  {command:{width}}  # {text}" for command, text in NEXT))
    return program.INCOMPLETE if any(lap.report()["departures"] for lap in DRIVES) else program.DONE


if __name__ == "__main__":
    run_tool(main)
