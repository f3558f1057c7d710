"""Measure how well models drive, on real recordings and in the stand-in simulator, and add them to the scoreboard.

    python -m tools.scoreboard model.pt --name "recipe, lake" --recordings data/lake-ccw data/lake-cw --tracks
    python -m tools.scoreboard model.pt --name shipped --tracks lake --speeds 9 --looks 0 --laps 10
    python -m tools.scoreboard model.pt --name shipped --tracks road-1001 road-1002 --speeds 15 --looks own own+10000

A run measures one model on the courses that its options select. It adds or replaces these results in
tools/scoreboard.json, one by one as they come, and writes the tables to tools/scoreboard.md. Git tracks both files, so
that results can be committed. --table names another table. Recordings are replayed with
`python -m simulator replay --model`, laps are driven with `python -m simulator drive`, as many at a time as the machine
has cores, all at one speed by the same drive.py.

What a model was trained on, and so what is in sample, is told by the names of the recordings in its file: rendered ones
must be named by track, direction and look, such as jungle-cw-look5. --trained-on adds other names.
"""

import argparse
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path, PureWindowsPath
from queue import SimpleQueue

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("scoreboard")  # also while the libraries below are loaded

from cloning.base.arguments import number
from cloning.base.cores import threads
from cloning.base.errors import UserError
from cloning.base.outputs import write_json, write_output
from cloning.network.network import load_checkpoint
from cloning.recordings.log import find_folders
from cloning.replay.score import ORACLE, DrivingMetrics, ReplayReport
from cloning.road.generated import road_number
from cloning.road.track import ROADS, find_road
from cloning.server.server import MAX_CLIENTS
from simulator.report import LapReport
from tools.score_table import Board, Driven, NetworkResults, RealRecording, Replayed, course, driven, table
from tools.server_process import start_server

ROOT = Path(__file__).resolve().parent.parent

DIRECTIONS = ("ccw", "cw")
UNSEEN_LOOKS = (101, 102)  # no model was trained on looks 101 to 1000
ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1"}


def simulate(report: Path, *arguments: str) -> tuple[int, str]:
    """Run a simulator command that writes its report to this file, and return its exit status and stderr."""
    process = subprocess.run(
        [sys.executable, "-m", "simulator", *arguments, "--report", str(report)],
        cwd=ROOT,
        env=ONE_THREAD,
        capture_output=True,
        text=True,
    )
    return process.returncode, process.stderr


def replay(model: Path, folder: Path) -> tuple[RealRecording, dict[str, Replayed]]:
    """Replay a recording, and return what all models have in common and this one's results. Raises UserError."""
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / "report.json"
        _, errors = simulate(file, "replay", str(folder.resolve()), "--model", str(model))
        if not file.exists():
            raise UserError(f"{folder}: {errors}")
        reports: list[ReplayReport] = json.loads(file.read_text(encoding="utf-8"))
    [report] = reports

    def shown(metrics: DrivingMetrics) -> Replayed:
        return {
            "autonomy_percent": metrics["autonomy_percent"],
            "interventions": metrics["interventions"],
            "distance_mean_m": metrics["distance_mean_m"],
        }

    recording: RealRecording = {
        "seconds": report["seconds"],
        "lane_centre_percent": round(100 * report["reference"]["lane centre"] / report["rows_driven"], 1),
        "oracle": {limit: shown(metrics["compared"][ORACLE]) for limit, metrics in report["limits"].items()},
    }
    return recording, {limit: shown(metrics) for limit, metrics in report["limits"].items()}


@contextmanager
def serving(model: Path, mph: int, drives: int) -> Iterator[SimpleQueue[int]]:
    """Serve a model at a set speed to so many drives at a time: a port for each, of no more servers than they need."""
    ports: SimpleQueue[int] = SimpleQueue()
    with ExitStack() as stack:
        for first in range(0, drives, MAX_CLIENTS):
            server, port = start_server((ROOT / "drive.py", model, "--speed", str(mph), "--port", "0"), ONE_THREAD)
            stack.callback(server.wait)
            stack.callback(server.terminate)
            for _ in range(min(MAX_CLIENTS, drives - first)):
                ports.put(port)
        yield ports


def drive_laps(ports: SimpleQueue[int], mph: int, laps: float, place: tuple[str, str, int]) -> Driven:
    """Drive laps in the stand-in simulator; ports: of `serving`; place: track, direction, look. Raises UserError."""
    (track, direction, look), port = place, ports.get()
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "report.json"
            road = ("--track", track, "--direction", direction, "--look", str(look))
            status, errors = simulate(file, "drive", *road, "--laps", str(laps), "--port", str(port))
            report: LapReport | None = json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
    finally:
        ports.put(port)
    # A car that stands still is the model's fault, any other failure is not.
    if report is None or (status == program.FAILED and report.get("ended") != "stood_still"):
        raise UserError(f"{track} {direction}, {mph} mph, look {look}: {errors}")
    return driven(report, mph, look, laps, finished=status != program.FAILED)


def parse_look(text: str) -> tuple[bool, int]:
    """Parse an item of --looks: return whether the road's number is to be added, and a number."""
    match = re.fullmatch(r"(own)(?:\+(\d+))?|(\d+)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number, own, or own+N such as own+10000")
    own, added, plain = match.groups()
    return bool(own), int(added or plain or 0)


def look_of(track: str, chosen: tuple[bool, int]) -> int:
    """Return the look in which a track is driven; chosen: of `parse_look`. The two known tracks' own look is 0."""
    own, look_number = chosen
    return look_number + ((road_number(track) or 0) if own else 0)


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


def network_of(board: Board, args: argparse.Namespace) -> NetworkResults:
    """Return the entry of the chosen column. Raises UserError if it holds results of another model."""
    model_file = args.model.resolve()
    names, sha256 = trained_on(model_file, args.trained_on), hashlib.sha256(model_file.read_bytes()).hexdigest()
    network = board["networks"].setdefault(
        args.name,
        {"what": "", "commands": [], "sha256": sha256, "trained_on": names, "replays": {}, "drives": []},
    )
    if network["sha256"] != sha256:
        file = args.table.with_suffix(".json")
        raise UserError(
            f"{args.name}: has results of another model file; give another --name, or take it out of {file}"
        )
    network["trained_on"] = sorted({*names, *network["trained_on"]}, key=natural)
    network["what"] = args.what or network["what"]
    command = command_line()
    network["commands"] = [*(earlier for earlier in network["commands"] if earlier != command), command]
    return network


def command_line() -> str:
    """Return the command that was typed, without --what, and with only the last part of each path."""
    words = [word for before, word in pairwise(sys.argv) if "--what" not in (before, word)]
    words = [Path(word).name if len(Path(word).parts) > 1 else word for word in words]
    return "python -m tools.scoreboard " + " ".join(shortened(words))


def shortened(words: Sequence[str]) -> list[str]:
    """Return the words of a command, quoted, with roads that follow one another as the shell's road-{1..9}."""
    runs: list[list[str]] = []
    for word in words:
        before = road_number(runs[-1][-1]) if runs else None
        if before is not None and road_number(word) == before + 1:
            runs[-1].append(word)
        else:
            runs.append([word])
    return [
        f"road-{{{road_number(run[0])}..{road_number(run[-1])}}}" if len(run) > 1 else shlex.quote(run[0])
        for run in runs
    ]


def measure(args: argparse.Namespace) -> None:
    """Drive the model on the chosen courses, and write the tables after each result. Raises UserError."""
    model = args.model.resolve()
    for track in args.tracks:
        find_road(track)
    folders = find_folders(args.recordings) if args.recordings else []
    places = [
        (track, direction, look_of(track, chosen))
        for track in args.tracks
        for direction in DIRECTIONS
        for chosen in args.looks
    ]
    places = list(dict.fromkeys(places))
    file = args.table.with_suffix(".json")
    board = read_board(file)
    network = network_of(board, args)

    def save() -> None:
        network["drives"].sort(key=lambda drive: [natural(str(part)) for part in course(drive)])
        write_json(file, board)
        write_output(args.table, table(board).encode())

    with ThreadPoolExecutor(threads()) as pool:
        replays = pool.map(partial(replay, model), folders)
        for folder, (recording, results) in zip(folders, replays, strict=True):
            board["recordings"][folder.name], network["replays"][folder.name] = recording, results
            print(f"{folder.name}: {results}", flush=True)
            save()
    for mph in args.speeds if places else ():
        drives = min(threads(), len(places))
        with serving(model, mph, drives) as ports, ThreadPoolExecutor(drives) as pool:
            for result in pool.map(partial(drive_laps, ports, mph, args.laps), places):
                others = [drive for drive in network["drives"] if course(drive) != course(result)]
                network["drives"] = [*others, result]
                print(result, flush=True)
                save()


def main() -> int:
    """Parse the command line and measure; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="scoreboard", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path, help="a model file of model.py")
    parser.add_argument("--name", required=True, help="name of the model's column")
    parser.add_argument("--what", default="", help="how the model was trained, for the list below the table")
    parser.add_argument(
        "--trained-on",
        nargs="*",
        default=[],
        metavar="NAME",
        help="recordings that the model was trained on, besides those that its file names (default: none)",
    )
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
        type=parse_look,
        default=[(False, chosen) for chosen in (0, *UNSEEN_LOOKS)],
        help="looks of the tracks: numbers, own for look N of road-N (0 of the lake and the jungle), or own+10000 for "
        "the same with shadows (default 0 101 102)",
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
