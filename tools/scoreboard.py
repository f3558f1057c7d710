"""Measure how well models drive, on real recordings and in the stand-in simulator, and add them to the scoreboard.

    python -m tools.scoreboard model.pt --name "recipe, lake" --recordings data/lake-ccw data/lake-cw
    python -m tools.scoreboard model.pt --name shipped --recordings data --tracks lake --speeds 9 --looks 0 --laps 10

Each row of the table is a course, each column a model. A run measures one model on the courses that its options select.
It adds or replaces these results in tools/scoreboard.json and writes the whole table to tools/scoreboard.md. Git tracks
both files: unlike all other commands, this one changes tracked files on purpose, so that its results can be committed.
--table names another table. Recordings are replayed with `python -m simulator replay --model`, laps are driven with
drive.py and `python -m simulator drive`, as many at a time as the machine has cores.
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

from cloning import program

if __name__ == "__main__":
    program.end_on_interrupt("scoreboard")  # also while the libraries below are loaded

from cloning.arguments import number
from cloning.cores import threads
from cloning.errors import UserError
from cloning.outputs import write_json, write_output
from cloning.recordings.log import find_folders
from cloning.replay.score import ReplayReport
from cloning.road.track import ROADS, find_road
from simulator.report import LapReport
from tools.server_process import start_server

ROOT = Path(__file__).resolve().parent.parent

DIRECTIONS = ("ccw", "cw")
UNSEEN_LOOKS = (101, 102)  # no model was trained on looks from 101 on
ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1"}


class Column(TypedDict):
    """A model's column: how it was trained, the commands that measured it, and course -> results."""

    what: str
    commands: list[str]
    courses: dict[str, str]


def simulate(report: Path, *arguments: str) -> str:
    """Run a simulator command that writes its report to this file, and return its stderr."""
    process = subprocess.run(
        [sys.executable, "-m", "simulator", *arguments, "--report", str(report)],
        cwd=ROOT,
        env=ONE_THREAD,
        capture_output=True,
        text=True,
    )
    return process.stderr


def replay(model: Path, recording: Path) -> dict[str, str]:
    """Replay a recording and return course -> results. Raises UserError."""
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
    """Drive laps in the stand-in simulator and return course -> results. Raises UserError."""
    server, port = start_server((ROOT / "drive.py", model, "--speed", str(mph), "--port", "0"), ONE_THREAD)
    course = f"{track} {direction}, {mph} mph, look {look}"
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "report.json"
            road = ("--track", track, "--direction", direction, "--look", str(look))
            errors = simulate(file, "drive", *road, "--laps", str(laps), "--port", str(port))
            if not file.exists():
                raise UserError(f"{course}: {errors}")
            report: LapReport = json.loads(file.read_text(encoding="utf-8"))
    finally:
        server.terminate()
        server.wait()
    unfinished = "" if report["laps"] >= laps else f", {report['laps']} of {laps:g} laps"
    results = (
        f"{len(report['departures'])} departures in {report['distance_m'] / 1000:.1f} km{unfinished}, "
        f"{report['offset_mean_m']:.2f} m, at most {report['offset_max_m']:.2f}, "
        f"roughness {report['steering_roughness_per_s']:.2f}"
    )
    return {course: results}


HEAD = """# How models drive

Replays of real recordings: NVIDIA's autonomy, the number of interventions in brackets, and the mean distance from the
lane's centre. Laps in the stand-in simulator: departures from the road, mean and greatest distance from the centre
line, and the roughness of the steering, which is its mean absolute change per second. No model was trained on looks
from 101 on.
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
    """Return a sort key that puts real recordings first and sorts numbers by value."""
    return not course.startswith("real"), [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", course)]


def command_line() -> str:
    """Return the command that was typed, without --what, and with only the last part of each path."""
    words = [word for before, word in pairwise(sys.argv) if "--what" not in (before, word)]
    words = [Path(word).name if len(Path(word).parts) > 1 else word for word in words]
    return shlex.join(["python", "-m", "tools.scoreboard", *words])


def measure(args: argparse.Namespace) -> None:
    """Drive the model on the chosen courses, and write the table. Raises UserError."""
    model = args.model.resolve()
    for track in args.tracks:
        find_road(track)
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
            print("\n".join(f"{course}: {results}" for course, results in courses.items()), flush=True)
    file = args.table.with_suffix(".json")
    columns: dict[str, Column] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    column = columns.setdefault(args.name, {"what": "", "commands": [], "courses": {}})
    column["what"] = args.what or column["what"]
    command = command_line()
    column["commands"] = [*(earlier for earlier in column["commands"] if earlier != command), command]
    column["courses"] |= measured
    write_json(file, columns)
    write_output(args.table, table(columns).encode())


def main() -> int:
    """Parse the command line and measure; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="scoreboard", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path, help="a model file of model.py")
    parser.add_argument("--name", required=True, help="name of the model's column")
    parser.add_argument("--what", default="", help="how the model was trained, for the list below the table")
    parser.add_argument(
        "--recordings", nargs="*", default=[], help="recordings to replay, or folders of recordings (default: none)"
    )
    parser.add_argument(
        "--tracks",
        nargs="*",
        default=list(ROADS),
        help=f"tracks to drive, also road-1, road-2 and so on (default: {' '.join(ROADS)})",
    )
    parser.add_argument(
        "--speeds", nargs="*", type=number(int, 1, 30), default=[9, 15, 30], help="set speeds in mph (default 9 15 30)"
    )
    parser.add_argument(
        "--looks",
        nargs="*",
        type=number(int, 0),
        default=[0, *UNSEEN_LOOKS],
        help="looks of the tracks (default 0 101 102)",
    )
    parser.add_argument("--laps", type=number(float, 0.001, 1e5), default=1, help="laps on each course (default 1)")
    parser.add_argument(
        "--table",
        type=Path,
        default=ROOT / "tools" / "scoreboard.md",
        help="Markdown file for the table; the results are kept next to it, in a JSON file of the same name "
        "(default: tools/scoreboard.md, which git tracks)",
    )
    try:
        measure(parser.parse_args())
    except UserError as error:
        return program.failed("scoreboard", error)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
