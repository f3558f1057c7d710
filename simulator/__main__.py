"""Commands: `python -m simulator record`, `drive`, `correct`, `replay`, `window`, `join`, `benchmark`."""

from cloning.base import program

if __name__ == "__main__":
    # Also while the libraries below are loaded.
    program.end_on_interrupt("simulator", "stopped; the files that it has written are complete")

import argparse
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cloning.base.arguments import MAX_PORT, address, number
from cloning.base.errors import UserError
from cloning.base.outputs import check_folders, write_json
from cloning.recordings.format import PROBLEM_AREAS, SAMPLE_RATE
from cloning.recordings.writer import RecordingWriter, check_name_of_corrections, start_of
from cloning.road.autonomy import LIMITS
from cloning.road.disturbances import KINDS, STRENGTHS, Disturbance
from cloning.road.generated import LANDS, MARKINGS
from cloning.road.motion import SET_SPEED_MPH, TOP_SPEED_MPH
from cloning.road.points import LAND, MARKING, MAX_WIDTH, MIN_WIDTH, WIDTH, read_road
from cloning.road.track import ROADS, Track
from cloning.wire.protocol import PORT
from simulator.workers import add_workers


def disturbance(text: str) -> Disturbance:
    """Return the disturbance of a text such as `fog:3`, as a type for argparse."""
    try:
        return Disturbance.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _shared_options() -> list[argparse.ArgumentParser]:
    """Return the options that several commands have: of laps, the server, the wait, the road, and disturbances."""
    parsers = laps, server, wait, road, disturb = [argparse.ArgumentParser(add_help=False) for _ in range(5)]
    laps.add_argument("--laps", type=number(float, 1e-6, 1e5), default=1, help="laps, such as 0.5 (default 1)")
    add = server.add_argument
    add("--host", type=address, default="127.0.0.1", help="address of the server (default %(default)s)")
    add("--port", type=number(int, 1, MAX_PORT), default=PORT, help="port of the server (default %(default)s)")
    text = "seconds to wait for the server, or for an answer that the car can use (default 60)"
    wait.add_argument("--wait", type=number(float, 0.01, 1e6), default=60.0, help=text)
    add = road.add_argument
    text = f"{', '.join(ROADS)}, or a road generated from its number: road-1, mountain-1 and so on (default lake)"
    add("--track", help=text)
    text = (
        "drive a road of your own: its centre line's points in m, as CSV (x,y or x,y,z, z up; or columns so named), "
        "JSON (road_points) or x,y,z@x,y,z (y up, as in Unity); if its last point is not its first, a lap ends there"
    )
    add("--road", metavar="FILE", help=text)
    text = f"width of the --road in m (default: the file's, or {WIDTH:g})"
    add("--width", type=number(float, MIN_WIDTH, MAX_WIDTH), help=text)
    add("--marking", choices=MARKINGS, help=f"marking of the --road (default: the file's, or {MARKING})")
    add("--land", choices=LANDS, help=f"land around the --road (default: the file's, or {LAND})")
    text = (
        "default: as in the real simulator, ccw on the lake and cw in the jungle; ccw on generated roads; "
        "as its points are listed on a --road, where for an open one this is called ccw"
    )
    add("--direction", choices=("ccw", "cw"), help=text)
    text = (
        "look of the road; 0 (default): like the real simulator; any other number: different light, colours, "
        "textures and plants; 10000 more: the same with shadows, as at the real simulator's higher graphics quality"
    )
    add("--look", type=number(int, 0), default=0, help=text)
    text = (
        f"foul weather, dirt or a fault of the cameras, such as fog:3; kinds: {', '.join(KINDS)}; strengths: "
        f"{STRENGTHS[0]} to {STRENGTHS[-1]}; the same in each drive (default: none)"
    )
    disturb.add_argument("--disturb", type=disturbance, metavar="KIND:STRENGTH", help=text)
    return parsers


def parse_arguments(argv: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line; its `run` is the command's function."""
    parser = argparse.ArgumentParser(
        prog=program.in_commands("python -m simulator"), description="A stand-in for Udacity's driving simulator."
    )
    commands, mph = parser.add_subparsers(required=True), number(float, 1, TOP_SPEED_MPH)
    laps, server, wait, road, disturb = _shared_options()

    def command(
        run: Callable, help: str, *shared: argparse.ArgumentParser, epilog: str | None = None
    ) -> argparse.ArgumentParser:
        """Add the command that the function run_NAME runs, and return its parser."""
        name, sentence = run.__name__.removeprefix("run_"), f"{help[0].upper()}{help[1:]}."
        added = commands.add_parser(name, help=help, description=sentence, parents=shared, epilog=epilog)
        added.set_defaults(run=run)
        return added

    text = "let a model drive real recordings, and print its autonomy and distance from the lane centre"
    add = command(run_replay, text, server, wait, disturb).add_argument
    add("folders", nargs="+", metavar="FOLDER", help="recordings, or folders of recordings")
    text = "drive with this model, or .onnx file, in this process; without it, the server at --host and --port drives"
    add("--model", metavar="model.pt", help=text)
    text = (
        "distance in m from the lane centre at which a human would take over; each limit is a drive of its own "
        "(default 1, as in NVIDIA's evaluation, and 2.5, where on the lake the side of the car is on the edge line)"
    )
    metres = number(float, 0.01, 1000)
    add("--limit", type=metres, nargs="+", default=LIMITS, dest="limits", metavar="LIMIT", help=text)
    text = "measure offsets from the lane centre (default), which lane.csv or the frames tell, or from the human's path"
    add("--reference", choices=("lane", "human"), default="lane", help=text)
    add("--report", metavar="FILE", help="write the metrics as JSON: a list, one entry per recording")
    text = "plot lateral offset and steering over time; of several recordings, FILE-RECORDING.png each"
    add("--picture", metavar="FILE.png", help=text)
    add("--film", metavar="FILE.mp4", help="film what the model sees in the drives at the last limit")

    add = command(run_record, "record an expert driver, faster than real time", laps, road, disturb).add_argument
    add("folder", help="folder for the new recording: IMG/ and driving_log.csv")
    text = "set speed in mph, 1 to %(default)s (default %(default)s)"
    add("--speed", type=mph, default=TOP_SPEED_MPH, help=text)
    add("--recovery", action="store_true", help="record only returns from the sides of the road to the lane centre")
    text = "seed of the expert's random lateral offsets, the dates in the image names, and --disturb (default 0)"
    add("--seed", type=number(int, 0), default=0, help=text)

    status = (
        "Exit status: 0 if the car stayed on the road, 1 if it left the road, 2 if an error ended the drive "
        "or a file could not be written."
    )
    driving = laps, server, wait, road, disturb
    add = command(run_drive, "let drive.py drive, and print a lap report", *driving, epilog=status).add_argument
    text = "simulated time follows the wall clock; by default it waits for each answer, and a drive is repeatable"
    add("--realtime", action="store_true", help=text)
    add("--report", metavar="FILE", help="write the lap report as JSON")
    add("--picture", metavar="FILE.png", help="plot the track from above with the path driven")
    add("--film", metavar="FILE.mp4", help="film the drive from behind the car, with what its camera sees")

    text = "let drive.py drive, and record the expert, who takes over where the car is off the lane's centre"
    add = command(run_correct, text, *driving, epilog="Exit status: as that of drive.").add_argument
    add("folder", help=f"folder for the new recording; its name must end in {' or '.join(PROBLEM_AREAS)}")
    text = "the expert's set speed in mph, never exceeded: give drive.py the same (default %(default)g, as drive.py's)"
    add("--speed", type=mph, default=SET_SPEED_MPH, help=text)

    add = command(run_window, "drive and record by hand, or watch drive.py drive", server, road, disturb).add_argument
    text = "folder for the recording (default data/window-DATE-TIME, with --autonomous window-DATE-TIME-corrections)"
    add("--folder", help=text)
    text = "let drive.py drive; W or S takes over, and only then is anything recorded"
    add("--autonomous", action="store_true", help=text)

    ends = (
        "It ends when the program's server has gone for --wait seconds, and in the dialect measures also after "
        "the laps that the program asks for. Unity's own options, with which such programs start their simulator, are "
        "accepted: -logFile FILE takes the messages, and -batchmode and -nographics are always so."
    )
    text = "let another team's test program drive, in place of the modified simulator that it expects"
    add = command(run_join, text, server, wait, road, disturb, epilog=ends).add_argument
    text = (
        "measures: telemetry with cte, laps and so on (SelfOracle, ThirdEye); roads: the program sends roads "
        "(maxitwo, perturbation-drive, MultiSim); episodes: on named tracks, in weathers (udacity-gym)"
    )
    add("--dialect", choices=("measures", "roads", "episodes"), required=True, help=text)
    text = (
        "let simulated time follow the wall clock: 1 in real time, 0.5 half as fast; by default it waits for the "
        "answer to each telemetry, and in the dialects roads and episodes for the program's driver"
    )
    add("--pace", type=number(float, 0, 100), default=0.0, metavar="FACTOR", help=text)
    text = "telemetries a simulated second, of which there are at most 50 (default %(default)s)"
    add("--fps", type=number(float, 1, 1000), default=SAMPLE_RATE, help=text)
    text = (
        "only write a program that runs this command with these options and its own; programs that start the "
        "simulator themselves take it for the simulator (a shell script: not for Windows)"
    )
    add("--launcher", metavar="NAME.x86_64", help=text)
    add("-logFile", dest="log", metavar="FILE", help=argparse.SUPPRESS)
    add("-batchmode", "-nographics", action="store_true", help=argparse.SUPPRESS)

    benchmark = command(run_benchmark, "score a driver on fixed tasks: see LEADERBOARD.md")
    add = benchmark.add_argument
    add("entry", help="model file, .onnx file, HOST:PORT of a server, straight (steering 0) or expert")
    add("--quick", action="store_true", help="fewer and shorter drives: two minutes on 2 cores, else up to two hours")
    text = "for report.html and benchmark.json, whose earlier ones are replaced (default: %(default)s)"
    add("--folder", type=Path, default=Path("benchmark"), help=text)
    add("--resume", action="store_true", help="go on there after the drives of a benchmark that was interrupted")
    add("--recordings", type=Path, metavar="FOLDER", help="also replay the real recordings of data/README.md in it")
    add_workers(benchmark)
    return parser.parse_args(argv)


def given_for_road(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the given options about a road of one's own, as `make_road` takes them."""
    own = {name: getattr(arguments, name) for name in ("width", "marking", "land")}
    return {name: value for name, value in own.items() if value is not None}


def chosen_track(arguments: argparse.Namespace, needs_file: bool = True) -> Track:
    """Return the track of the road options; needs_file: for options of a road of one's own. Raises UserError."""
    given = given_for_road(arguments)
    if arguments.road is None:
        if given and needs_file:
            raise UserError(f"--{next(iter(given))} is of a road of your own: name its file with --road")
        return Track("lake" if arguments.track is None else arguments.track, arguments.direction)
    if arguments.track is not None:
        raise UserError("--track and --road name two roads; leave one of them out")
    return Track(read_road(arguments.road, **given), arguments.direction)


# Each function imports what its command needs, because `--help` and wrong arguments need neither panda3d nor torch.


def run_record(arguments: argparse.Namespace) -> int:
    """Record the expert; print its departures and how fast it was recorded."""
    from simulator.record import record

    track = chosen_track(arguments)
    begin = time.perf_counter()
    how = (arguments.laps, arguments.speed, arguments.seed, arguments.look, arguments.recovery, arguments.disturb)
    run, rows = record(arguments.folder, track, *how)
    pace = run.time / (time.perf_counter() - begin)
    for departure in run.departures:
        print(f"left the road at {departure.s:.0f} m after {departure.time:.1f} s")
    recorded = f"{arguments.folder}: {rows} rows" if rows else "nothing was recorded"
    print(f"{recorded} from {run.time:.0f} simulated seconds, at {pace:.1f} times real time")
    return program.INCOMPLETE if run.departures else program.DONE


def run_drive(arguments: argparse.Namespace) -> int:
    """Let drive.py drive, and write the requested files even if the drive ends early, unless it never began."""
    from simulator import report
    from simulator.cameras import Cameras
    from simulator.client import Client
    from simulator.film import ChaseFilm
    from simulator.run import Run
    from simulator.world import Scene

    check_folders(arguments.report, arguments.picture, arguments.film, read=[arguments.road])
    run = Run(chosen_track(arguments), "autonomous")
    scene = Scene.of(run.track.source, arguments.look)
    cameras = Cameras(scene, ("center",), arguments.disturb)
    client = Client(run, cameras, arguments.host, arguments.port, arguments.wait, arguments.realtime)
    film, outputs = None, list[Callable[[], object]]()
    if arguments.film:
        film = ChaseFilm(arguments.film, scene, cameras)
        client.watch = functools.partial(film.watch, run)
    if arguments.report:
        outputs.append(lambda: write_json(arguments.report, report.lap_report(run, client)))
    if arguments.picture:
        outputs.append(lambda: report.write_picture(arguments.picture, run))
    return report.drive_and_report(client, arguments.laps, *outputs, film=film)


def run_correct(arguments: argparse.Namespace) -> int:
    """Let drive.py drive with corrections by the expert; print a lap report and what was recorded."""
    from simulator.correct import CorrectedClient
    from simulator.report import drive_and_report
    from simulator.run import Run
    from simulator.world import Scene

    check_name_of_corrections(arguments.folder)
    run = Run(chosen_track(arguments), "autonomous")
    round_of = Path(arguments.folder).absolute().name  # the next one, perhaps with the same options, has another name
    with RecordingWriter(arguments.folder, start_of(arguments.look, run.track.name, round_of)) as recording:
        scene = Scene.of(run.track.source, arguments.look)
        server = (arguments.host, arguments.port, arguments.wait)
        client = CorrectedClient(run, scene, arguments.speed, recording, *server, arguments.disturb)
        return drive_and_report(client, arguments.laps, lambda: print(client.summary()))


def run_replay(arguments: argparse.Namespace) -> int:
    """Let a model drive real recordings."""
    from cloning.replay import command

    driver = None
    if arguments.model and arguments.model.endswith(".onnx"):
        from simulator.benchmark.replays import driver_of

        driver = driver_of(arguments.model)
    command.run(arguments, driver)
    return program.DONE


def run_window(arguments: argparse.Namespace) -> int:
    """Open the window in which a person drives or watches."""
    from datetime import datetime

    from simulator.controls import HELP
    from simulator.window import Window

    ending = PROBLEM_AREAS[-1] if arguments.autonomous else ""
    folder = arguments.folder or f"data/window-{datetime.now():%Y%m%d-%H%M%S}{ending}"
    server = (arguments.host, arguments.port) if arguments.autonomous else None
    opened = Window(chosen_track(arguments), folder, arguments.look, server, arguments.disturb)
    print(HELP, flush=True)
    try:
        opened.run()
    finally:
        opened.finish()
    if opened.failed:
        raise opened.failed
    raise KeyboardInterrupt  # panda3d has caught it: every other end is a SystemExit


def run_join(arguments: argparse.Namespace) -> int:
    """Let another program's server drive, or write the program that does this."""
    from simulator.join import join, write_launcher

    track = chosen_track(arguments, needs_file=arguments.dialect != "roads")
    if arguments.dialect == "episodes" and (arguments.track or arguments.road):
        raise UserError("in the dialect episodes the program names the tracks; leave out --track and --road")
    if not arguments.launcher:
        return join(arguments, track, given_for_road(arguments))
    write_launcher(arguments)
    return program.DONE


def run_benchmark(arguments: argparse.Namespace) -> int:
    """Let an entry drive the benchmark's tasks."""
    from simulator.benchmark import command

    command.run(arguments)
    return program.DONE


def main(argv: list[str] | None = None) -> int:
    """Run a command and return its exit status."""
    arguments = parse_arguments(argv)
    try:
        return arguments.run(arguments)
    except UserError as error:
        return program.failed(error)


if __name__ == "__main__":
    program.run(main)
