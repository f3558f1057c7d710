"""The score board: how models drive, on real recordings and in the stand-in simulator.

    python -m tools.scoreboard model.pt --name "recipe, lake" --recordings data/lake-ccw data/lake-cw
    python -m tools.scoreboard model.pt --name shipped --recordings data --tracks lake --speeds 9 --looks 0 --laps 10

Each row of the table is a course, each column a model. A run adds or replaces its model's figures on the courses that
it was asked for, in tools/scoreboard.json, and writes the table anew from all of them, tools/scoreboard.md. Replays
are driven in process, laps by drive.py and `python -m simulator drive` over the wire, as many at a time as there are
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
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

from cloning.compute import threads
from cloning.files import write
from cloning.recordings.log import find_folders

ROOT = Path(__file__).resolve().parent.parent

DIRECTIONS = ("ccw", "cw")
UNSEEN = (101, 102, 103, 104, 105)  # looks that nothing was trained on
ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1"}


def report(folder: str, *command: str) -> tuple[object | None, str]:
    """The JSON that a simulator command reports, or None, and what it said on stderr."""
    file = Path(folder) / "report.json"
    done = subprocess.run(
        [sys.executable, "-m", "simulator", *command, "--report", str(file)],
        cwd=ROOT,
        env=ONE_THREAD,
        capture_output=True,
        text=True,
    )
    return (json.loads(file.read_text()) if file.exists() else None), done.stderr


def replay(model: Path, recording: Path) -> dict[str, str]:
    """Course -> what a replay of the recording came to."""
    with tempfile.TemporaryDirectory() as folder:
        found, said = report(folder, "replay", str(recording.resolve()), "--model", str(model))
    if found is None:
        raise SystemExit(f"{recording}: {said}")
    limits, reference = found[0]["limits"], found[0]["reference"]
    centre = "the lane's centre" if reference["lane centre"] else "the human's way"
    figures = {}
    for limit, one in limits.items():
        driven = f"{one['autonomy_percent']:.1f} % ({one['interventions']}), {one['distance_mean_m']:.2f} m"
        figures[f"real {recording.name}, {limit} m from {centre}"] = driven
    return figures


def lap(model: Path, track: str, direction: str, mph: int, look: int, laps: float) -> dict[str, str]:
    """Course -> what laps of the stand-in came to."""
    server = subprocess.Popen(
        [sys.executable, "drive.py", str(model), "--speed", str(mph), "--port", "0"],
        cwd=ROOT,
        env=ONE_THREAD,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        port = re.search(r":(\d+)\.", server.stderr.readline())[1]
        with tempfile.TemporaryDirectory() as folder:
            found, said = report(
                folder,
                "drive",
                "--track",
                track,
                "--direction",
                direction,
                "--look",
                str(look),
                "--laps",
                str(laps),
                "--port",
                port,
            )
    finally:
        server.terminate()
        server.communicate()
    if found is None:
        raise SystemExit(f"{track} {direction}: {said}")
    unfinished = "" if found["laps"] >= laps else f", {found['laps']} of {laps:g} laps"
    driven = (
        f"{len(found['departures'])} departures in {found['distance_m'] / 1000:.1f} km{unfinished}, "
        f"{found['offset_mean_m']:.2f} m, at most {found['offset_max_m']:.2f}, "
        f"roughness {found['steering_roughness_per_s']:.2f}"
    )
    return {f"{track} {direction}, {mph} mph, look {look}": driven}


HEAD = """# How models drive

Replays of real recordings: NVIDIA's autonomy, with the number of interventions, and the mean distance from the lane's
centre. Laps in the stand-in simulator: departures from the road, mean and largest distance from the centre line, the
steering's mean absolute change a second. Looks from 101 on were never trained on.
"""


def table(results: dict) -> str:
    """The table as Markdown."""
    courses = sorted({course for one in results.values() for course in one["courses"]}, key=order)
    lines = [HEAD, "| course | " + " | ".join(results) + " |", "|---" * (len(results) + 1) + "|"]
    lines += [
        f"| {course} | " + " | ".join(one["courses"].get(course, "-") for one in results.values()) + " |"
        for course in courses
    ]
    lines += ["", "Made by:"]
    for name, one in results.items():
        lines += ["", f"* {name}: {one['what']}", *(f"  * `{command}`" for command in one["commands"])]
    return "\n".join(lines) + "\n"


def order(course: str) -> tuple:
    """Real ones first; numbers as numbers."""
    return not course.startswith("real"), [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", course)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--name", required=True, help="of the model's column")
    parser.add_argument("--what", default="", help="how the model was trained, for the list below the table")
    parser.add_argument("--recordings", nargs="*", default=[], help="real recordings to replay")
    parser.add_argument("--tracks", nargs="*", default=["lake", "jungle"], choices=["lake", "jungle"])
    parser.add_argument("--speeds", nargs="*", type=int, default=[9, 15, 30], help="mph (default 9 15 30)")
    parser.add_argument("--looks", nargs="*", type=int, default=[0, *UNSEEN[:2]], help="default 0 101 102")
    parser.add_argument("--laps", type=float, default=1)
    parser.add_argument("--table", type=Path, default=ROOT / "benchmarks" / "driving.md")
    args = parser.parse_args()
    model = args.model.resolve()
    jobs = [(replay, model, folder) for folder in (find_folders(args.recordings) if args.recordings else [])]
    jobs += [
        (lap, model, track, direction, mph, look, args.laps)
        for track in args.tracks
        for direction in DIRECTIONS
        for mph in args.speeds
        for look in args.looks
    ]
    with ThreadPoolExecutor(threads()) as pool:
        found: dict[str, str] = {}
        for one in pool.map(lambda job: job[0](*job[1:]), jobs):
            found |= one
            print("\n".join(f"{course}: {came}" for course, came in one.items()), flush=True)
    file = args.table.with_suffix(".json")
    results = json.loads(file.read_text()) if file.exists() else {}
    mine = results.setdefault(args.name, {"what": "", "commands": [], "courses": {}})
    mine["what"] = args.what or mine["what"]
    words = [word for before, word in pairwise(sys.argv) if "--what" not in (before, word)]
    words = [Path(word).name if "/" in word else word for word in words]
    command = shlex.join(["python", "-m", "tools.scoreboard", *words])
    mine["commands"] = [*(one for one in mine["commands"] if one != command), command]
    mine["courses"] |= found
    write(file, json.dumps(results, indent=1).encode() + b"\n")
    write(args.table, table(results).encode())


if __name__ == "__main__":
    main()
