"""What a user gets: python -m simulator record, drive, window, replay."""

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cloning.errors import RecordingError, SimulatorError
from cloning.road.track import ROADS, Track


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError("must be above 0")
    return value


def mph(text: str) -> float:
    value = float(text)
    if not 1 <= value <= 30:
        raise argparse.ArgumentTypeError("must be 1 to 30 mph, which is as fast as the car goes")
    return value


def natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must be 0 or more")
    return value


def add_record(commands) -> argparse.ArgumentParser:
    parser = commands.add_parser("record", help="an expert drives and is recorded, faster than real time")
    parser.set_defaults(run=record)
    parser.add_argument("folder", help="a new recording: IMG/ and driving_log.csv")
    parser.add_argument("--laps", type=positive, default=1, help="default 1")
    parser.add_argument("--speed", type=mph, default=30.0, help="set speed in mph, 1 to 30 (default)")
    parser.add_argument("--recovery", action="store_true", help="only returns from the road's sides")
    parser.add_argument("--seed", type=natural, default=0, help="of the wandering in the lane (default 0)")
    return parser


def add_drive(commands) -> argparse.ArgumentParser:
    parser = commands.add_parser("drive", help="the client of drive.py; exit status 1 if the car left the road")
    parser.set_defaults(run=drive)
    parser.add_argument("--laps", type=positive, default=1, help="default 1")
    add_server(parser)
    add_wait(parser)
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument(
        "--lockstep",
        action="store_true",
        help="simulated time waits for each answer, so that a run repeats (default)",
    )
    pace.add_argument("--realtime", action="store_true", help="the wall clock's time and the wire's latency")
    parser.add_argument("--report", metavar="FILE", help="write the lap report as JSON")
    parser.add_argument("--picture", metavar="FILE.png", help="draw the track from above with the way driven")
    parser.add_argument("--film", metavar="FILE.mp4", help="film the drive from behind the car")
    return parser


def add_replay(commands) -> None:
    parser = commands.add_parser("replay", help="a model drives real recordings; how far it stays on the road")
    parser.set_defaults(run=replay)
    parser.add_argument("folders", nargs="+", metavar="FOLDER", help="recordings, or folders of recordings")
    parser.add_argument("--model", metavar="model.pt", help="drive by it in this process, not by drive.py's answers")
    parser.add_argument(
        "--limit",
        type=positive,
        nargs="+",
        default=[1.0, 2.5],
        help="m off-centre at which a human would take over (default 1 2.5: NVIDIA's, and where the "
        "car's side touches the edge line)",
    )
    parser.add_argument(
        "--reference",
        choices=("lane", "human"),
        default="lane",
        help="what off-centre is counted from: the lane's centre as read from the frames (default), or "
        "the way that the human drove",
    )
    add_server(parser)
    add_wait(parser)
    parser.add_argument("--report", metavar="FILE", help="write the figures as JSON, a list with one entry a recording")
    parser.add_argument("--picture", metavar="FILE.png", help="draw distance and steering over the recording")
    parser.add_argument("--film", metavar="FILE.mp4", help="film what the model saw, at the last limit")


def add_wait(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--wait", type=positive, default=60.0, help="seconds to wait for a server or an answer (default 60)"
    )


def add_window(commands) -> argparse.ArgumentParser:
    parser = commands.add_parser("window", help="a person drives and records, or watches drive.py drive")
    parser.set_defaults(run=window)
    parser.add_argument("--folder", help="of the recording (default data/window-DATE-TIME)")
    parser.add_argument("--autonomous", action="store_true", help="drive.py drives; W or S takes over")
    add_server(parser)
    return parser


def add_server(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--host", default="127.0.0.1", help="where drive.py runs (default 127.0.0.1)")
    parser.add_argument("--port", type=int, default=4567, help="default 4567")


def arguments(argv=None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m simulator", description="A stand-in for Udacity's driving simulator."
    )
    commands = parser.add_subparsers(required=True)
    add_replay(commands)
    for command in (add_record(commands), add_drive(commands), add_window(commands)):
        command.add_argument("--track", choices=sorted(ROADS), default="lake", help="default lake")
        command.add_argument(
            "--direction",
            choices=("ccw", "cw"),
            help="default the simulator's own: ccw on the lake, cw in the jungle",
        )
        command.add_argument(
            "--look",
            type=natural,
            default=0,
            help="0 (default): as the real one; others: other light, soils, trees, shadows",
        )
    return parser.parse_args(argv)


# What loads panda3d is imported where it is used: `--help` and bad arguments need none of it.


def record(args) -> int:
    from simulator.record import record

    track = Track(args.track, args.direction)
    run = record(args.folder, track, args.laps, args.speed, args.seed, args.look, args.recovery)
    for departure in run.departures:
        print(f"left the road at {departure.s:.0f} m after {departure.time:.1f} s")
    return 0


def drive(args) -> int:
    from simulator import report, scenery
    from simulator.cameras import Cameras
    from simulator.client import Client
    from simulator.film import ChaseFilm
    from simulator.progress import Progress
    from simulator.run import Run
    from simulator.world import Scene

    outputs(args.report, args.picture, args.film)
    run = Run(Track(args.track, args.direction), "autonomous")
    scene = Scene(scenery.build(args.track, args.look))
    film = ChaseFilm(args.film, scene) if args.film else None
    client = Client(run, Cameras(scene, ("center",)), args.host, args.port, args.wait, args.realtime)
    if film:
        client.watch = lambda: film.watch(run)
    try:
        client.drive(args.laps, Progress(args.laps, "laps"))
    finally:
        summary = report.figures(run, client)
        if run.time:
            print(report.text(summary))
        if film:
            film.close()
        if args.report:
            report.write_json(args.report, summary)
        if args.picture:
            report.write_picture(args.picture, run)
    return 1 if run.departures else 0


def replay(args) -> int:
    from cloning.recordings.log import find_folders
    from cloning.replay import replay as replaying
    from cloning.replay import score
    from cloning.replay.drivers import InProcess, Served
    from simulator import report
    from simulator.progress import Progress

    outputs(args.report, args.picture, args.film)
    folders = find_folders(args.folders)
    steer = InProcess(args.model) if args.model else Served(args.host, args.port, args.wait)
    film = score.SideBySide(args.film) if args.film else None
    reports = []
    try:
        for folder in folders:
            recording = replaying.load(folder)
            references = replaying.references(recording, args.reference == "lane")
            if not references:
                raise SimulatorError(f"{folder}: no two seconds of driving without a break to replay")
            rows = sum(len(reference.stretch) for reference in references)

            def drive(limit, folder=folder, recording=recording, references=references, rows=rows):
                progress = Progress(rows, f"rows of {folder.name} at {limit:g} m")

                def watch(moment, done):
                    progress.show(len(done.row), sum(done.time))
                    if film and limit == args.limit[-1]:
                        film.watch(moment, done)

                return replaying.drive(recording, references, limit, steer, watch)

            with ThreadPoolExecutor(len(args.limit) if args.model else 1) as pool:
                drives = list(pool.map(drive, args.limit))
            reports.append(score.figures(recording, references, drives, args.reference))
            print(score.text(reports[-1]), flush=True)
            if args.picture:
                path = Path(args.picture)
                path = path if len(folders) == 1 else path.with_stem(f"{path.stem}-{folder.name}")
                score.picture(path, recording, drives)
    finally:
        steer.close()
        if film:
            film.close()
        if args.report and reports:
            report.write_json(args.report, reports)
    return 0


def outputs(*paths: str | None) -> None:
    """Raises SimulatorError before the work, not after it, if a file's folder is missing."""
    for path in filter(None, paths):
        if not Path(path).absolute().parent.is_dir():
            raise SimulatorError(f"{path}: there is no such folder; make it first")


def window(args) -> int:
    from datetime import datetime

    from simulator.window import Window

    folder = args.folder or f"data/window-{datetime.now():%Y%m%d-%H%M%S}"
    server = (args.host, args.port) if args.autonomous else None
    shown = Window(Track(args.track, args.direction), folder, args.look, server)
    try:
        shown.run()
    finally:
        shown.finish()
    return 0


def main(argv=None) -> int:
    args = arguments(argv)
    try:
        return args.run(args)
    except (SimulatorError, RecordingError) as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nstopped; what was written is whole", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
