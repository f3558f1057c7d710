"""The scoreboard: how well models drive, on real recordings and in the stand-in simulator.

    python -m tools.scoreboard model.pt --name "recipe, lake" --recordings data/lake-ccw data/lake-cw
    python -m tools.scoreboard model.pt --name shipped --recordings data --tracks lake --speeds 9 --looks 0 --laps 10

Each row of the table is a course, each column a model. A run adds or replaces its model's figures on the courses that
it was asked for, in tools/scoreboard.json, and writes the whole table, tools/scoreboard.md. Recordings are replayed in
process, laps are driven by drive.py and `python -m simulator drive` over the wire, as many at a time as the machine has
cores.
"""

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TypedDict

from cloning.cores import threads
from cloning.errors import UserError
from cloning.outputs import write_json, write_output
from cloning.recordings.log import find_folders
from cloning.replay.score import ReplayReport
from simulator.report import LapReport

ROOT = Path(__file__).resolve().parent.parent

DIRECTIONS = ("ccw", "cw")
UNSEEN_LOOKS = (101, 102, 103, 104, 105)  # no model was trained on them
ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1"}


class Column(TypedDict):
    """A model's column: how it was trained, the commands that measured it, and course -> figures."""

    what: str
    commands: list[str]
    courses: dict[str, str]


def simulate(report: Path, *arguments: str) -> str:
    """Run a simulator command that writes its report to this file, and return what it printed to stderr."""
    done = subprocess.run(
        [sys.executable, "-m", "simulator", *arguments, "--report", str(report)],
        cwd=ROOT,
        env=ONE_THREAD,
        capture_output=True,
        text=True,
    )
    return done.stderr


def replay(model: Path, recording: Path) -> dict[str, str]:
    """Replay a recording and return course -> figures. Raises UserError."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "report.json"
        errors = simulate(file, "replay", str(recording.resolve()), "--model", str(model))
        if not file.exists():
            raise UserError(f"{recording}: {errors}")
        reports: list[ReplayReport] = json.loads(file.read_text(encoding="utf-8"))
    [report] = reports
    reference = "the lane's centre" if report["reference"]["lane centre"] else "the human driver's path"
    return {
        f"real {recording.name}, {limit} m from {reference}": f"{metrics['autonomy_percent']:.1f} % "
        f"({metrics['interventions']}), {metrics['distance_mean_m']:.2f} m"
        for limit, metrics in report["limits"].items()
    }


def drive_laps(model: Path, track: str, direction: str, mph: int, look: int, laps: float) -> dict[str, str]:
    """Drive laps in the stand-in simulator and return course -> figures. Raises UserError."""
    server = subprocess.Popen(
        [sys.executable, "drive.py", str(model), "--speed", str(mph), "--port", "0"],
        cwd=ROOT,
        env=ONE_THREAD,
        stderr=subprocess.PIPE,
        text=True,
    )
    course = f"{track} {direction}, {mph} mph, look {look}"
    try:
        port = listening_port(server)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "report.json"
            road = ("--track", track, "--direction", direction, "--look", str(look))
            errors = simulate(file, "drive", *road, "--laps", str(laps), "--port", port)
            if not file.exists():
                raise UserError(f"{course}: {errors}")
            report: LapReport = json.loads(file.read_text(encoding="utf-8"))
    finally:
        server.terminate()
        server.communicate()
    unfinished = "" if report["laps"] >= laps else f", {report['laps']} of {laps:g} laps"
    figures = (
        f"{len(report['departures'])} departures in {report['distance_m'] / 1000:.1f} km{unfinished}, "
        f"{report['offset_mean_m']:.2f} m, at most {report['offset_max_m']:.2f}, "
        f"roughness {report['steering_roughness_per_s']:.2f}"
    )
    return {course: figures}


def listening_port(server: subprocess.Popen[str]) -> str:
    """Return the port that drive.py prints once it listens. Raises UserError if it ends before."""
    printed = []
    for line in server.stderr or ():
        if port := re.search(r"Listening on .*:(\d+)\.", line):
            return port[1]
        printed.append(line)
    raise UserError("".join(printed).strip())


HEAD = """# How models drive

Replays of real recordings: NVIDIA's autonomy, with the number of interventions, and the mean distance from the lane's
centre. Laps in the stand-in simulator: departures from the road, mean and largest distance from the centre line, the
steering's mean absolute change a second. Looks from 101 on were never trained on.
"""


def table(columns: dict[str, Column]) -> str:
    """Return the table as Markdown."""
    courses = sorted({course for column in columns.values() for course in column["courses"]}, key=order)
    lines = [HEAD, "| course | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    lines += [
        f"| {course} | " + " | ".join(column["courses"].get(course, "-") for column in columns.values()) + " |"
        for course in courses
    ]
    lines += ["", "Measured with:"]
    for name, column in columns.items():
        lines += ["", f"* {name}: {column['what']}", *(f"  * `{command}`" for command in column["commands"])]
    return "\n".join(lines) + "\n"


def order(course: str) -> tuple[bool, list[int | str]]:
    """Sort real recordings first, and numbers by their value."""
    return not course.startswith("real"), [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", course)]


def command_line() -> str:
    """Return the command that was typed, without --what, and paths by their last name alone."""
    words = [word for before, word in pairwise(sys.argv) if "--what" not in (before, word)]
    words = [Path(word).name if len(Path(word).parts) > 1 else word for word in words]
    return shlex.join(["python", "-m", "tools.scoreboard", *words])


def measure(args: argparse.Namespace) -> None:
    """Drive the model on the courses that were asked for, and write the table. Raises UserError."""
    model = args.model.resolve()
    folders = find_folders(args.recordings) if args.recordings else []
    jobs: list[Callable[[], dict[str, str]]] = [partial(replay, model, folder) for folder in folders]
    jobs += [
        partial(drive_laps, model, track, direction, mph, look, args.laps)
        for track in args.tracks
        for direction in DIRECTIONS
        for mph in args.speeds
        for look in args.looks
    ]
    measured: dict[str, str] = {}
    with ThreadPoolExecutor(threads()) as pool:
        for courses in pool.map(lambda job: job(), jobs):
            measured |= courses
            print("\n".join(f"{course}: {figures}" for course, figures in courses.items()), flush=True)
    file = args.table.with_suffix(".json")
    columns: dict[str, Column] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    column = columns.setdefault(args.name, {"what": "", "commands": [], "courses": {}})
    column["what"] = args.what or column["what"]
    command = command_line()
    column["commands"] = [*(earlier for earlier in column["commands"] if earlier != command), command]
    column["courses"] |= measured
    write_json(file, columns)
    write_output(args.table, table(columns).encode())


def main() -> None:
    """Parse the command line and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--name", required=True, help="of the model's column")
    parser.add_argument("--what", default="", help="how the model was trained, for the list below the table")
    parser.add_argument("--recordings", nargs="*", default=[], help="real recordings to replay")
    parser.add_argument("--tracks", nargs="*", default=["lake", "jungle"], choices=["lake", "jungle"])
    parser.add_argument("--speeds", nargs="*", type=int, default=[9, 15, 30], help="mph (default 9 15 30)")
    parser.add_argument("--looks", nargs="*", type=int, default=[0, *UNSEEN_LOOKS[:2]], help="default 0 101 102")
    parser.add_argument("--laps", type=float, default=1, help="default 1")
    parser.add_argument("--table", type=Path, default=ROOT / "tools" / "scoreboard.md", help="default %(default)s")
    try:
        measure(parser.parse_args())
    except UserError as error:
        sys.exit(f"tools.scoreboard: {error}")


if __name__ == "__main__":
    main()
