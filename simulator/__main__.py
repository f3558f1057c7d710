"""What a user gets: python -m simulator record, drive."""

import argparse
import sys

from . import SimulatorError
from .track import ROADS, Track


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


def arguments(argv=None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m simulator", description="A stand-in for Udacity's driving simulator."
    )
    commands = parser.add_subparsers(dest="command", required=True)

    record = commands.add_parser("record", help="an expert drives and is recorded, faster than real time")
    record.add_argument("folder", help="a new recording: IMG/ and driving_log.csv")
    record.add_argument("--laps", type=positive, default=1, help="default 1")
    record.add_argument("--speed", type=mph, default=30.0, help="set speed in mph, 1 to 30 (default)")

    drive = commands.add_parser(
        "drive", help="the client of drive.py; exit status 1 if the car left the road"
    )
    drive.add_argument("--laps", type=positive, default=1, help="default 1")
    drive.add_argument("--host", default="127.0.0.1", help="where drive.py runs (default 127.0.0.1)")
    drive.add_argument("--port", type=int, default=4567, help="default 4567")
    drive.add_argument(
        "--wait", type=positive, default=60.0, help="seconds to wait for a server or an answer (default 60)"
    )
    pace = drive.add_mutually_exclusive_group()
    pace.add_argument(
        "--lockstep",
        action="store_true",
        help="simulated time waits for each answer, so that a run can be repeated (default)",
    )
    pace.add_argument("--realtime", action="store_true", help="the wall clock's time, and the wire's latency")
    drive.add_argument("--report", metavar="FILE", help="write the lap report as JSON")
    drive.add_argument(
        "--picture", metavar="FILE.png", help="write a picture of the track from above with the way driven"
    )

    for command in (record, drive):
        command.add_argument("--track", choices=sorted(ROADS), default="lake", help="default lake")
        command.add_argument(
            "--direction",
            choices=("ccw", "cw"),
            help="default the one that the simulator starts in: ccw on the lake, cw in the jungle",
        )
        command.add_argument(
            "--look",
            type=natural,
            default=0,
            help="0 (default) the real simulator's; any other number another light, other textures and trees",
        )
        command.add_argument(
            "--seed", type=natural, default=0, help="same seed and arguments, same run (default 0)"
        )
    return parser.parse_args(argv)


def record(args, track: Track) -> int:
    from .record import record  # panda3d loads only when it is needed, and says why if it cannot

    run = record(args.folder, track, args.laps, args.speed, args.seed, args.look)
    for departure in run.departures:
        print(f"left the road at {departure.s:.0f} m after {departure.time:.1f} s")
    return 0


def drive(args, track: Track) -> int:
    from . import report, scenery
    from .cameras import Cameras
    from .client import Client
    from .progress import Progress
    from .run import Run
    from .world import Scene

    run = Run(track, "autonomous")
    cameras = Cameras(Scene(scenery.build(track.name, args.look)), ("center",))
    client = Client(run, cameras, args.host, args.port, args.wait, args.realtime)
    progress = Progress(args.laps, "laps")
    try:
        client.drive(args.laps, progress)
    finally:
        summary = report.figures(run, client)
        if run.time:
            print(report.text(summary))
        if args.report:
            report.write_json(args.report, summary)
        if args.picture:
            report.write_picture(args.picture, run)
    return 1 if run.departures else 0


def main(argv=None) -> int:
    args = arguments(argv)
    try:
        return {"record": record, "drive": drive}[args.command](args, Track(args.track, args.direction))
    except SimulatorError as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nstopped; what was written is whole", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
