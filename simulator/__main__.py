"""python -m simulator: record."""

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

    for command in (record,):
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


def main(argv=None) -> int:
    args = arguments(argv)
    track = Track(args.track, args.direction)
    try:
        from .record import record  # panda3d loads only when it is needed, and says why if it cannot

        run = record(args.folder, track, args.laps, args.speed, args.seed, args.look)
        for departure in run.departures:
            print(f"left the road at {departure.s:.0f} m after {departure.time:.1f} s")
        return 0
    except SimulatorError as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nstopped; what was recorded is whole", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
