"""Make a network for both tracks, in sun and shade, and for unknown roads: render recordings, train, and measure.

    make shipped RECORDINGS="data/lake-ccw data/lake-cw data/jungle data/jungle-shadows"     # or the same without make:
    python -m tools.shipped data/lake-ccw data/lake-cw data/jungle data/jungle-shadows
    python -m tools.shipped data/lake-ccw … --road found/*-*.json --from cloning/network/shipped.pt
    python -m tools.shipped data/lake-ccw … --first 1201 --from cloning/network/shipped.pt

The third one gives a network the roads on which it failed, which tools.search has found, the last one roads and looks
that it has not seen. It is trained on with these and all the others, and its weights become the mean of those before
and after: with the roads of a search, that drove better than either.

Everything is written to the folder shipped/, which git ignores; an interrupted run continues when it is started again.
The rendered recordings show both tracks and generated roads, in many looks and with and without shadows. Roads and
looks 1 to 1000 are left to measure with, and so are these looks' shadowed twins: shipped/report.html tells how the
network drives there, shipped/replays.json how it drives the real recordings.

The network that comes with the project was made so; cloning/network/shipped.md, its model card, has the recordings and
what came out.
"""

import shutil
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from datetime import timedelta
from pathlib import Path
from typing import NamedTuple

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.cores import threads
from cloning.base.errors import RecordingError
from cloning.network import tensors
from cloning.network.network import load_checkpoint, load_model
from cloning.recordings.excluded import EXCLUDED
from cloning.recordings.format import DRIVING_LOG, IMAGE_FOLDER, LANE_FILE, PROBLEM_AREAS
from cloning.recordings.log import find_folders
from cloning.recordings.writer import DEFAULT_START, RecordingWriter, SampleClock
from cloning.road.generated import PointRoad
from cloning.road.points import read_road
from cloning.road.track import ROADS, Track
from simulator.cameras import Cameras
from simulator.expert import LATERAL_ACCELERATION, Expert
from simulator.record import write_row
from simulator.run import Run
from simulator.scenery.looks import SHADOWED
from simulator.workers import started_workers
from simulator.world import Scene
from tools.command import ROOT, python
from tools.lane_frames import FIRST_ROAD, every_second_shadowed

REPEATS = 8  # how often each real recording counts, because the rendered ones are many
EPOCH = 60_000  # images
DISTURBED = 0.4  # share of the images in foul weather, or of a faulty camera
EPOCHS, LEARNING_RATE = 8, 3e-3  # less than --robust's rate: this training is longer
EPOCHS_ON, LEARNING_RATE_ON = 4, 5e-4  # with --from
DIRECTIONS = ("ccw", "cw")
FIRST_LOOK = FIRST_ROAD  # the first look, besides look 0, that is trained on: numbered as the roads
LAPS = 0.5  # of a generated road: of so many images, more roads teach more than whole laps
RATE = 7.5  # rows a second, half of the simulator's: of so many images, more roads teach more than denser ones
FAST = 8.5  # m/s² sideways in the jungle's fast laps; the simulator's drivers reach 8, and frames don't show the speed


class Lap(NamedTuple):
    """A lap that is rendered; track: as `Track` takes it."""

    track: str | PointRoad
    direction: str
    look: int
    laps: float = 1.0
    lateral: float = LATERAL_ACCELERATION  # m/s², see `Expert`

    @property
    def name(self) -> str:
        """The name of its recording."""
        fast = "" if self.lateral == LATERAL_ACCELERATION else "-fast"
        track = self.track if isinstance(self.track, str) else self.track.name
        return f"{track}-{self.direction}-look{self.look}{fast}"


def laps(
    looks: int, fast: int, number_of: dict[str, int], roads: Sequence[PointRoad] = (), first: int = FIRST_LOOK
) -> list[Lap]:
    """Return the laps to render: of both tracks in so many looks, fast ones of the jungle, and of generated roads.

    number_of: generated roads of each kind; each has a look of its own. roads: others, driven in both directions.
    first: number of the first generated road of each kind, and of the first look besides look 0. Look 0, which
    resembles the real simulator, is driven in both directions, without and with both kinds of shadows, any other look
    in one direction; every second one has shadows.
    """
    twins = (0, SHADOWED, 2 * SHADOWED)
    chosen = [Lap(track, direction, look) for track in ROADS for direction in DIRECTIONS for look in twins]
    for look in range(first, first + looks - 1):
        chosen += [Lap(track, DIRECTIONS[look % 2], every_second_shadowed(look)) for track in ROADS]
    for look in range(first, first + fast):  # not the direction in which the same look is driven slowly
        chosen.append(Lap("jungle", DIRECTIONS[1 - look % 2], every_second_shadowed(look), lateral=FAST))
    for kind, count in number_of.items():
        for road in range(first, first + count):
            chosen.append(Lap(f"{kind}-{road}", DIRECTIONS[road % 2], every_second_shadowed(road), LAPS))
    for look, points in enumerate(roads, first):
        chosen += [Lap(points, direction, every_second_shadowed(look)) for direction in DIRECTIONS]
    return chosen


def drive_lap(folder: Path, lap: Lap, seed: int) -> int:
    """Record the expert's lap in this process; return its rows. Raises RecordingError, also if it leaves the road."""
    track = Track(lap.track, lap.direction)
    run, expert, clock = Run(track), Expert(track, seed, lateral=lap.lateral), SampleClock(rate=RATE)
    cameras = Cameras(Scene.of(track.source, lap.look))
    with RecordingWriter(folder, DEFAULT_START + timedelta(days=seed)) as recording:
        while run.travelled < lap.laps * track.length:
            run.step(*expert.drive(run))
            if run.departures:
                raise RecordingError(f"{folder}: the expert left the road")
            if clock.due(run.time):
                write_row(recording, cameras, run)
    return recording.rows


def render(folder: Path, chosen: list[Lap]) -> list[Path]:
    """Record the laps that are not there yet, each in a process of its own, and return all recordings.

    Raises RecordingError for two of one name, SimulatorError if a process is killed, and the errors of `drive_lap`.
    """
    wanted = [folder / lap.name for lap in chosen]
    if twice := {path.name for path in wanted if wanted.count(path) > 1}:
        raise RecordingError(f"{', '.join(sorted(twice))}: two roads have the same name; rename one of their files")
    shutil.rmtree(unfinished := folder / "unfinished", ignore_errors=True)
    begin = time.perf_counter()
    with started_workers(threads()) as pool:
        driven = {
            pool.submit(drive_lap, unfinished / recording.name, lap, seed): recording
            for seed, (recording, lap) in enumerate(zip(wanted, chosen, strict=True))
            if not recording.exists()
        }
        for i, lap in enumerate(as_completed(driven), 1):
            rows, recording = lap.result(), driven[lap]
            (unfinished / recording.name).rename(recording)
            state = f"{rows} rows, {time.perf_counter() - begin:.0f} s since the start"
            print(f"{i}/{len(driven)} {recording.name}: {state}", flush=True)
    shutil.rmtree(unfinished, ignore_errors=True)
    return wanted


def repeat(folder: Path, recordings: list[Path]) -> list[Path]:
    """Return a folder for each real recording, named so that training repeats it. Raises RecordingError, OSError."""
    twins: dict[Path, Path] = {}
    for recording in recordings:
        twin = folder / f"{recording.resolve().name}{PROBLEM_AREAS[0]}"
        if twin in twins:
            raise RecordingError(f"{recording} and {twins[twin]} have the same name: rename one of them")
        twins[twin] = recording
        shutil.rmtree(twin, ignore_errors=True)
        twin.mkdir(parents=True)
        for name in (DRIVING_LOG, EXCLUDED, LANE_FILE):
            if (recording / name).exists():
                shutil.copyfile(recording / name, twin / name)
        images = (recording / IMAGE_FOLDER).resolve()
        try:
            (twin / IMAGE_FOLDER).symlink_to(images)
        except OSError:  # which on Windows only an administrator may make
            shutil.copytree(images, twin / IMAGE_FOLDER)
    return list(twins)


def write_mean(before: Path, after: Path, path: Path) -> None:
    """Write a model file with the mean of two networks' weights; all else is as the second one's file tells.

    A network that was trained on, and that from which it began: Wortsman et al., "Robust fine-tuning of zero-shot
    models", CVPR 2022. Raises ModelError, OSError.
    """
    saved, weights = load_checkpoint(after), load_model(before).state_dict()
    mean = {name: (weights[name] + tensor) / 2 for name, tensor in saved["network"].items()}
    tensors.save(path, saved | {"network": mean})


def main(argv: list[str] | None = None) -> int:
    """Render, train and measure; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.shipped", __doc__)
    add = parser.add_argument
    add("recordings", nargs="+", help="real recordings, or folders of recordings")
    add("--looks", type=number(int, 1, 101), default=8, help="looks of each track (default %(default)s)")
    add("--fast", type=number(int, 0, 100), default=4, help="fast laps of the jungle (default %(default)s)")
    add("--roads", type=number(int, 0, 1000), default=100, help="generated roads (default %(default)s)")
    add("--mountains", type=number(int, 0, 1000), default=50, help="generated mountain roads (default %(default)s)")
    text = "number of the first generated road of each kind, and of the first look (default %(default)s)"
    add("--first", type=number(int, FIRST_LOOK, 9000), default=FIRST_LOOK, help=text)
    add("--road", nargs="+", default=[], metavar="FILE", help="roads by points, such as those that tools.search found")
    text = "train on from this model file, and take the mean of its weights and the new ones"
    add("--from", dest="start", type=Path, metavar="MODEL", help=text)
    text = f"of {EPOCH:,} images (default {EPOCHS}; with --from {EPOCHS_ON})"
    add("--epochs", type=number(int, 1), help=text)
    add("--seed", type=number(int, 0), default=0, help="of the training (default %(default)s)")
    add("--folder", type=Path, default=Path("shipped"), help="where to write (default %(default)s)")
    options = parser.parse_args(argv)
    model, points = options.folder / "model.pt", [read_road(file) for file in options.road]
    trained, epochs, rate, begin = model, EPOCHS, LEARNING_RATE, tuple[str | Path, ...]()
    if start := options.start:
        if start.resolve() == model.resolve():
            parser.error(f"--from {start}: the mean is written there; copy the file first, or name another --folder")
        load_model(start)  # before all is rendered
        trained, epochs, rate = options.folder / "trained-on" / "model.pt", EPOCHS_ON, LEARNING_RATE_ON
        begin = ("--from", start)
    real = repeat(options.folder / "real", find_folders(options.recordings))  # first, since rendering takes long
    number_of = {"road": options.roads, "mountain": options.mountains}
    rendered = render(options.folder / "rendered", laps(options.looks, options.fast, number_of, points, options.first))
    length = ("--epochs", options.epochs or epochs, "--samples-per-epoch", EPOCH, "--learning-rate", rate)
    training = ("--robust", *length, "--repeats", REPEATS, "--disturbed", DISTURBED, "--seed", options.seed, "--resume")
    # By name, since the folders may also hold what an earlier run with other options left there.
    status = python(ROOT / "model.py", *real, *rendered, *begin, "--output", trained, *training).returncode
    if status != program.DONE:
        return status
    if start:
        write_mean(start, trained, model)
    replays = (*options.recordings, "--model", model, "--report", options.folder / "replays.json")
    status = python("-m", "simulator", "replay", *replays).returncode
    if status != program.DONE:
        return status
    return python("-m", "simulator", "benchmark", model, "--quick", "--folder", options.folder).returncode


if __name__ == "__main__":
    program.run(main)
