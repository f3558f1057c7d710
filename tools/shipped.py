"""Make a network for both tracks, in sun and shade, and for unknown roads: render recordings, train, and measure.

    make shipped RECORDINGS="data/lake-ccw data/lake-cw data/jungle data/jungle-shadows"     # or the same without make:
    python -m tools.shipped data/lake-ccw data/lake-cw data/jungle data/jungle-shadows

Everything is written to the folder shipped/, which git ignores; an interrupted run continues when it is started again.
The rendered recordings show both tracks and generated roads, in many looks and with and without shadows. Roads and
looks 1 to 1000 are left to measure with, and so are these looks' shadowed twins: shipped/scoreboard.md has the results.

The network that comes with the project was made so; cloning/network/shipped.md, its model card, has the recordings and
what came out.
"""

import shutil
import time
from pathlib import Path
from typing import NamedTuple

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("shipped")  # also while the libraries below are loaded

from cloning.base.arguments import number
from cloning.base.errors import RecordingError
from cloning.recordings.excluded import EXCLUDED
from cloning.recordings.format import DRIVING_LOG, IMAGE_FOLDER, LANE_FILE, PROBLEM_AREAS
from cloning.recordings.log import find_folders
from cloning.road.track import ROADS, Track
from simulator.record import record
from simulator.scenery.looks import SHADOWED
from tools.command import ROOT, command_line, python, run_tool
from tools.lane_frames import FIRST_ROAD, every_second_shadowed

REPEATS = 20  # how often each real recording counts, because the rendered ones are many
LEARNING_RATE = 2e-3  # half of --robust's: this training is longer
DIRECTIONS = ("ccw", "cw")
FIRST_LOOK = 1001  # the first look, besides look 0, that is trained on
LAPS = 0.5  # of a generated road: of so many images, more roads teach more than whole laps
# What is driven in the end: both tracks and ten generated roads that were not trained on, in looks with shadows that
# were not either.
MEASURED = ("--tracks", *ROADS, *(f"road-{k}" for k in range(1, 11)), "--looks", "own+10100")


class Lap(NamedTuple):
    """A lap that is rendered."""

    track: str
    direction: str
    look: int


def laps(looks: int, roads: int) -> list[Lap]:
    """Return the laps to render: of both tracks in so many looks, and of so many generated roads, each in its own.

    Look 0, which resembles the real simulator, is driven in both directions, without and with both kinds of shadows,
    any other look in one direction; every second one has shadows.
    """
    twins = (0, SHADOWED, 2 * SHADOWED)
    chosen = [Lap(track, direction, look) for track in ROADS for direction in DIRECTIONS for look in twins]
    for look in range(FIRST_LOOK, FIRST_LOOK + looks - 1):
        chosen += [Lap(track, DIRECTIONS[look % 2], every_second_shadowed(look)) for track in ROADS]
    for road in range(FIRST_ROAD, FIRST_ROAD + roads):
        chosen.append(Lap(f"road-{road}", DIRECTIONS[road % 2], every_second_shadowed(road)))
    return chosen


def render(folder: Path, chosen: list[Lap]) -> list[Path]:
    """Record the laps that are not there yet, and return all recordings.

    Raises RecordingError if the expert leaves the road, SimulatorError, OSError.
    """
    recordings = [folder / f"{lap.track}-{lap.direction}-look{lap.look}" for lap in chosen]
    for i, (lap, recording) in enumerate(zip(chosen, recordings, strict=True)):
        if recording.exists():
            continue
        unfinished = folder / "unfinished"
        shutil.rmtree(unfinished, ignore_errors=True)
        begin = time.perf_counter()
        length = 1 if lap.track in ROADS else LAPS
        run, rows = record(unfinished, Track(lap.track, lap.direction), laps=length, seed=i, look=lap.look)
        if run.departures:
            raise RecordingError(f"{recording}: the expert left the road")
        unfinished.rename(recording)
        print(f"{i + 1}/{len(chosen)} {recording.name}: {rows} rows in {time.perf_counter() - begin:.0f} s", flush=True)
    return recordings


def repeat(folder: Path, recordings: list[Path]) -> list[Path]:
    """Make a folder of each real recording, with a name for which training repeats it, and return these folders.

    Raises RecordingError for two recordings of one name, OSError.
    """
    twins: dict[Path, Path] = {}
    for recording in recordings:
        twin = folder / f"{recording.resolve().name}{PROBLEM_AREAS[0]}"
        if twin in twins:
            raise RecordingError(f"{recording} and {twins[twin]} have the same name: rename one of them")
        twins[twin] = recording
        twin.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(recording / DRIVING_LOG, twin / DRIVING_LOG)
        for name in (EXCLUDED, LANE_FILE):
            (twin / name).unlink(missing_ok=True)
            if (recording / name).exists():
                shutil.copyfile(recording / name, twin / name)
        (twin / IMAGE_FOLDER).unlink(missing_ok=True)
        (twin / IMAGE_FOLDER).symlink_to((recording / IMAGE_FOLDER).resolve())
    return list(twins)


def main(argv: list[str] | None = None) -> int:
    """Render, train and measure; return the exit status. Raises UserError, OSError."""
    parser = command_line("shipped", __doc__)
    add = parser.add_argument
    add("recordings", nargs="+", help="real recordings, or folders of recordings")
    add("--looks", type=number(int, 1, 101), default=15, help="looks of each track (default %(default)s)")
    add("--roads", type=number(int, 0, 1000), default=200, help="generated roads (default %(default)s)")
    add("--epochs", type=number(int, 1), default=17, help="of 60,000 images (default %(default)s)")
    add("--seed", type=number(int, 0), default=0, help="of the training (default %(default)s)")
    add("--folder", type=Path, default=Path("shipped"), help="where to write (default %(default)s)")
    options = parser.parse_args(argv)
    model = options.folder / "model.pt"
    real = repeat(options.folder / "real", find_folders(options.recordings))  # first, since rendering takes long
    rendered = render(options.folder / "rendered", laps(options.looks, options.roads))
    length = ("--epochs", options.epochs, "--learning-rate", LEARNING_RATE)
    training = ("--robust", *length, "--repeats", REPEATS, "--seed", options.seed, "--resume")
    # By name, since the folders may also hold what an earlier run with other options left there.
    status = python(ROOT / "model.py", *real, *rendered, "--output", model, *training).returncode
    if status != program.DONE:
        return status
    board = ("--name", "shipped", "--speeds", 15, *MEASURED, "--table", options.folder / "scoreboard.md")
    return python("-m", "tools.scoreboard", model, "--recordings", *options.recordings, *board).returncode


if __name__ == "__main__":
    run_tool(main)
