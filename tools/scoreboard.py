"""Measure how well models drive, on real recordings and in the stand-in simulator, and add them to the scoreboard.

    python -m tools.scoreboard model.pt --name "recipe, lake" --recordings data/lake-ccw data/lake-cw --tracks
    python -m tools.scoreboard model.pt --name shipped --tracks lake --speeds 9 --looks 0 --laps 10
    python -m tools.scoreboard model.pt --name shipped --tracks road-1001 road-1002 --speeds 15 --looks own own+10000

A run measures one model on the courses that its options select. It adds or replaces these results in
tools/scoreboard.json, one by one as they come, and writes the tables to tools/scoreboard.md. Git tracks both files, so
that results can be committed. --table names another table. Recordings are replayed with
`python -m simulator replay --model`, laps are driven as by `python -m simulator drive` and drive.py, until the time of
so many interventions as there are departures is that of the whole drive.

What a model was trained on, and so what is in sample, follows from the names of the recordings in its file: rendered
ones must be named by track, direction and look, such as jungle-cw-look5. --trained-on adds other names.
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("scoreboard")  # also while the libraries below are loaded

import argparse
import hashlib
import json
import os
import re
import tempfile
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from itertools import product
from pathlib import Path, PureWindowsPath

from cloning.base.arguments import number
from cloning.base.cores import threads
from cloning.base.errors import UserError
from cloning.base.outputs import write_json, write_output
from cloning.network.network import load_checkpoint
from cloning.recordings.log import find_folders
from cloning.replay.score import ORACLE, DrivingMetrics, ReplayReport
from cloning.road.generated import road_number
from cloning.road.track import ROADS, Track, find_points
from simulator.driving import Conditions, drive
from simulator.report import lap_report
from simulator.run import Run
from simulator.workers import add_workers, started_workers
from tools.command import ROOT, command_line, python, run_tool
from tools.score_table import Board, Driven, NetworkResults, RealRecording, Replayed, course, driven, replay_text, table

DIRECTIONS = ("ccw", "cw")
UNSEEN_LOOKS = (101, 102)  # no model was trained on looks 101 to 1000
ONE_THREAD = {"OMP_NUM_THREADS": "1"}  # a process computes with one, because as many run as there are cores


def replay(model: Path, folder: Path) -> tuple[RealRecording, dict[str, Replayed]]:
    """Replay a recording, and return what all models have in common and this one's results. Raises UserError."""
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary, "report.json")
        words = ("-m", "simulator", "replay", folder.resolve(), "--model", model, "--report", file)
        done = python(*words, cwd=ROOT, env=os.environ | ONE_THREAD, capture_output=True)
        if not file.exists():
            raise UserError(f"{folder}: {done.stderr}")
        report: ReplayReport = json.loads(file.read_text(encoding="utf-8"))[0]

    def shown(metrics: DrivingMetrics) -> Replayed:
        percent, metres = metrics["autonomy_percent"], metrics["distance_mean_m"]
        return {"autonomy_percent": percent, "interventions": metrics["interventions"], "distance_mean_m": metres}

    recording: RealRecording = {
        "seconds": report["seconds"],
        "lane_centre_percent": round(100 * report["reference"]["lane_centre"] / report["rows_driven"], 1),
        "oracle": {limit: shown(metrics["compared"][ORACLE]) for limit, metrics in report["limits"].items()},
    }
    return recording, {limit: shown(metrics) for limit, metrics in report["limits"].items()}


def drive_laps(model: str, mph: int, laps: float, on: tuple[str, str, int]) -> Driven:
    """Drive laps in the stand-in simulator, in any process; on: track, direction, look. Raises UserError."""
    (track, direction, look), runs = on, deque[Run](maxlen=1)
    metres = laps * Track(track, direction).length
    conditions = Conditions(model, mph, look, direction, metres, set_back=True)
    done = drive(conditions, track, lambda run, _: runs.append(run))
    return driven(lap_report(runs[0]), mph, look, laps, finished=not done.failed)


def lap_in_words(drive: Driven) -> str:
    """Return the result of a drive in the stand-in simulator, for people."""
    road = f"{drive['track']} {drive['direction']}, look {drive['look']}, {drive['speed_mph']} mph"
    return f"{road}: {drive['distance_km']:.2f} km, departures: {drive['departures']}"


def parse_look(text: str) -> tuple[bool, int]:
    """Parse an item of --looks: return whether the road's number is to be added, and a look."""
    match = re.fullmatch(r"(own)(?:\+(\d+))?|(\d+)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number, own, or own+N such as own+10000")
    own, added, plain = match.groups()
    return bool(own), int(added or plain or 0)


def look_of(track: str, chosen: tuple[bool, int]) -> int:
    """Return the look in which a track is driven; chosen: of `parse_look`. The two known tracks' own look is 0."""
    own, look = chosen
    return look + (road_number(track) or 0) * own


def trained_on(model: Path, more: Sequence[str]) -> list[str]:
    """Return the names of the recordings that a model was trained on; more: besides those that its file names.

    Raises ModelError, and UserError if nothing is named.
    """
    arguments = load_checkpoint(model).get("arguments")
    folders = arguments.get("recordings") if isinstance(arguments, dict) else None
    names = {PureWindowsPath(str(folder)).name for folder in folders or ()} | set(more)  # of paths of any system
    if not names:
        raise UserError(f"{model}: does not say what it was trained on; name the recordings with --trained-on")
    return sorted(names, key=natural)


def natural(text: str) -> list[int | str]:
    """Return a sort key by which numbers in texts are sorted by value."""
    return [int(part) if at % 2 else part for at, part in enumerate(re.split(r"(\d+)", text))]


def read_board(file: Path) -> Board:
    """Return the results in a file, none if there is no such file. Raises UserError."""
    if not file.exists():
        return {"recordings": {}, "networks": {}}
    board = json.loads(file.read_text(encoding="utf-8"))
    if set(board) != set(Board.__annotations__):
        raise UserError(f"{file}: holds results in another form, of an earlier version; give another --table")
    return board


def network_of(board: Board, options: argparse.Namespace) -> NetworkResults:
    """Return the entry of the chosen column. Raises UserError if it holds results of another model."""
    names = trained_on(options.model, options.trained_on)
    sha256 = hashlib.sha256(options.model.read_bytes()).hexdigest()
    new: NetworkResults = {"what": "", "sha256": sha256, "trained_on": [], "replays": {}, "drives": []}
    network = board["networks"].setdefault(options.name, new)
    if network["sha256"] != sha256:
        file = options.table.with_suffix(".json")
        raise UserError(
            f"{options.name}: has results of another model file; give another --name, or take it out of {file}"
        )
    network["trained_on"] = sorted({*names, *network["trained_on"]}, key=natural)
    network["what"] = options.what or network["what"]
    return network


def measure(options: argparse.Namespace) -> None:
    """Drive the model on the chosen courses, and write the tables after each result. Raises UserError."""
    for track in options.tracks:
        find_points(track)
    folders = find_folders(options.recordings) if options.recordings else []
    chosen = product(options.tracks, DIRECTIONS, options.looks)
    courses = list(dict.fromkeys((track, direction, look_of(track, look)) for track, direction, look in chosen))
    file = options.table.with_suffix(".json")
    board = read_board(file)
    network = network_of(board, options)

    def save(line: str) -> None:
        print(line, flush=True)
        network["drives"].sort(key=lambda drive: [natural(str(part)) for part in course(drive)])
        write_json(file, board)
        write_output(options.table, table(board).encode())

    with ThreadPoolExecutor(threads()) as pool:
        replays = pool.map(partial(replay, options.model), folders)
        for folder, (recording, results) in zip(folders, replays, strict=True):
            board["recordings"][folder.name], network["replays"][folder.name] = recording, results
            save("; ".join(f"{folder.name}, limit {limit} m: {replay_text(each)}" for limit, each in results.items()))
    if not courses:
        return
    with started_workers(options.processes, options.scheduler) as workers:
        coming = [
            workers.submit(drive_laps, str(options.model), mph, options.laps, on)
            for mph in options.speeds
            for on in courses
        ]
        for result in (each.result() for each in as_completed(coming)):
            others = [drive for drive in network["drives"] if course(drive) != course(result)]
            network["drives"] = [*others, result]
            save(lap_in_words(result))


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and measure; return the exit status. Raises UserError."""
    parser = command_line("scoreboard", __doc__)
    add = parser.add_argument
    add("model", type=lambda text: Path(text).resolve(), help="a model file of model.py")
    add("--name", required=True, help="name of the model's column")
    add("--what", default="", help="how the model was trained, for the list below the tables")
    names = "recordings that the model was trained on, besides those that its file names (default: none)"
    add("--trained-on", nargs="*", default=[], metavar="NAME", help=names)
    add("--recordings", nargs="*", default=[], help="to replay, or folders of recordings (default: none)")
    tracks = f"tracks to drive, also road-1, mountain-1 and so on (default: {' '.join(ROADS)})"
    add("--tracks", nargs="*", default=list(ROADS), help=tracks)
    speeds = "set speeds in mph (default 9 15 30)"
    add("--speeds", nargs="*", type=number(int, 1, 30), default=[9, 15, 30], help=speeds)
    looks = (
        "looks of the tracks: numbers, own for look N of road-N (0 of the lake and the jungle), or own+10000 for the "
        "same with shadows (default 0 101 102)"
    )
    default_looks = [(False, look) for look in (0, *UNSEEN_LOOKS)]
    add("--looks", nargs="*", type=parse_look, default=default_looks, help=looks)
    add("--laps", type=number(float, 0.001, 1e5), default=1, help="laps on each course (default %(default)s)")
    file = (
        "Markdown file for the tables; the results are kept next to it, in a JSON file of the same name "
        "(default: tools/scoreboard.md, which git tracks)"
    )
    add("--table", type=Path, default=ROOT / "tools" / "scoreboard.md", help=file)
    add_workers(parser)
    measure(parser.parse_args(argv))
    return program.DONE


if __name__ == "__main__":
    run_tool(main)
