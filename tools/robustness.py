"""Measure how well models drive in foul weather and with faulty cameras, by kind and strength of the disturbance.

    python -m tools.robustness                                            # the network that comes with the project
    python -m tools.robustness model.pt old.pt --strengths 3 4 5          # several models
    python -m tools.robustness model.pt --kinds fog snow --laps 0.25      # in a few minutes
    python -m tools.robustness model.pt --recordings data/lake-ccw        # also replays of real recordings
    python -m tools.robustness --gallery tools/disturbances.jpg           # only a picture of all disturbances

A model drives the lake and the jungle in both directions with each disturbance, and without one. A departure counts as
an intervention: autonomy is 1 - departures x 6 s / the time at the set speed, and 0 for a car that does not arrive. The
same options give the same results, on any number of processes. The folder gets a table (robustness.md), a picture
(robustness.png), and the result of each drive (robustness.json) as it comes: a run that was interrupted goes on there.
"""

import functools
import itertools
import statistics
from collections.abc import Sequence
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import UserError
from cloning.base.figure import png
from cloning.base.outputs import claimed, read_json, write_json, write_output
from cloning.base.progress import progress_bar
from cloning.network.network import SHIPPED_MODEL
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import encode
from cloning.recordings.log import Recording, find_folders
from cloning.replay import replay
from cloning.replay.score import driving_metrics
from cloning.road.autonomy import LIMITS
from cloning.road.disturbances import HELD_OUT, KINDS, STRENGTHS, Disturbance, Disturber
from cloning.road.motion import MPH, TOP_SPEED_MPH
from cloning.road.track import Track
from simulator import driving
from simulator.benchmark.replays import driver_of
from simulator.benchmark.tasks import VERSION
from simulator.driving import Conditions
from simulator.run import Run
from simulator.workers import add_workers, started_workers
from tools.command import head, row

TRACKS, SPEEDS, DIRECTIONS = ("lake", "jungle"), (30.0, 15.0), ("ccw", "cw")  # mph on each
STAND_IN, REPLAYS = "stand-in simulator", f"replays at {LIMITS[-1]:g} m"
GALLERY_PLACE, GALLERY_FRAMES = 200.0, 12  # m along the jungle; frames, some of which come late or not at all
TILE, GALLERY_SEED, GALLERY_QUALITY = (160, 80), 3, 60  # columns and rows


class Drive(NamedTuple):
    """A drive of a model in the stand-in, or a replay, which has no laps."""

    name: str  # of the model in tables
    sha256: str  # of its file
    on: str  # track, or folder of a recording
    laps: float
    conditions: Conditions  # of which a replay has the driver and the disturbance only

    @property
    def where(self) -> str:
        """The title under which its figures stand."""
        return f"{self.name}, {STAND_IN if self.laps else REPLAYS}"

    def __str__(self) -> str:
        how = self.conditions
        course = f" {how.direction}, {how.speed:g} mph, look {how.look}, {self.laps:g} laps" * bool(self.laps)
        return f"{self.name} {self.sha256[:16]}, rules {VERSION}, {self.on}{course}, {how.disturbance or 'clear'}"


class Figures(NamedTuple):
    """How a model drove; autonomy: percent; departures: interventions in a replay; distance: m from the centre."""

    autonomy: float
    departures: int
    distance: float

    def __str__(self) -> str:
        return f"{self.autonomy:.1f} %, {self.departures}, {self.distance:.2f} m"


@functools.lru_cache(maxsize=1)
def _recording(folder: str) -> tuple[Recording, list[replay.ReferenceLine]]:
    recording = replay.load_recording(folder)
    return recording, replay.reference_lines(recording)


def measure(drive: Drive) -> Figures:
    """Drive, in any process. Raises UserError."""
    how = drive.conditions
    if drive.laps:
        driven = driving.drive(how, drive.on)
        return Figures(round(100 * driven.autonomy, 2), len(driven.departures), round(driven.mean, 3))
    recording, lines = _recording(drive.on)
    done = replay.drive(recording, lines, LIMITS[-1], driver_of(how.driver), disturbance=how.disturbance)
    metrics = driving_metrics(done)
    return Figures(metrics["autonomy_percent"], metrics["interventions"], metrics["distance_mean_m"])


def measure_all(drives: Sequence[Drive], file: Path, workers: Executor) -> dict[Drive, Figures]:
    """Return the figures of all drives; the file gets each as it comes, and may have some. Raises UserError."""
    kept = read_json(file) if file.exists() else {}
    coming = {workers.submit(measure, drive): drive for drive in drives if str(drive) not in kept}
    with progress_bar(len(coming), "drive") as bar:
        for done in as_completed(coming):
            drive, figures = coming[done], done.result()
            driving.refuse_replaced(drive.conditions.driver, drive.sha256)
            kept[str(drive)] = figures._asdict()
            write_json(file, dict(sorted(kept.items())))
            bar.update()
    return {drive: Figures(**kept[str(drive)]) for drive in drives}


# ----------------------------------------------------------------------------------------------------------------------
# Table and picture

Curves = dict[str, dict[Disturbance | None, Figures]]  # by where, and by disturbance


def curves_of(found: dict[Drive, Figures]) -> Curves:
    """Return the means of autonomy and distance, and the departures, of all courses together."""
    groups: dict[str, dict[Disturbance | None, list[Figures]]] = {}
    for drive, figures in found.items():
        groups.setdefault(drive.where, {}).setdefault(drive.conditions.disturbance, []).append(figures)
    return {
        where: {
            disturbance: Figures(statistics.fmean(percents), sum(departures), statistics.fmean(metres))
            for disturbance, group in each.items()
            for percents, departures, metres in [zip(*group, strict=True)]
        }
        for where, each in groups.items()
    }


def table(curves: Curves, kinds: Sequence[str], strengths: Sequence[int]) -> str:
    """Return the tables in Markdown."""
    lines = ["# Robustness", "", "Autonomy, departures (interventions in a replay), and m from the lane's centre."]
    for where, figures in curves.items():
        lines += ["", f"## {where}", "", f"Without a disturbance: {figures[None]}.", ""]
        lines.append(head("kind", *(f"strength {strength}" for strength in strengths)))
        for kind in kinds:
            cells = (figures[Disturbance(kind, strength)] for strength in strengths)
            lines.append(row(kind + " (held out)" * (kind in HELD_OUT), *cells))
        for held_out in (False, True):
            chosen = [kind for kind in kinds if (kind in HELD_OUT) == held_out]
            stayed = (sum(not figures[Disturbance(kind, each)].departures for kind in chosen) for each in strengths)
            title = f"**{'held out' if held_out else 'others'}: kinds without a departure**"
            lines.append(row(title, *(f"{count} of {len(chosen)}" for count in stayed)))
    return "\n".join(lines) + "\n"


def picture(curves: Curves, kinds: Sequence[str], strengths: Sequence[int]) -> bytes:
    """Return a PNG with autonomy by strength, 0 for none, a panel for each kind."""
    from matplotlib.figure import Figure

    columns = min(6, len(kinds))
    rows = -(-len(kinds) // columns)
    figure = Figure(figsize=(max(6, 2.3 * columns), 1.9 * rows + 0.8), layout="constrained")
    grid = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    for axes in grid[len(kinds) :]:
        axes.axis("off")
    for axes, kind in zip(grid, kinds, strict=False):
        shown = [None, *(Disturbance(kind, strength) for strength in strengths)]
        for where, figures in curves.items():
            style = "--" if where.endswith(REPLAYS) else "-"
            axes.plot([0, *strengths], [figures[each].autonomy for each in shown], style, marker=".", label=where)
        held_out = kind in HELD_OUT
        axes.set_title(kind + ", held out" * held_out, fontsize=9, color="tab:red" if held_out else "black")
        axes.set(ylim=(-4, 104), xticks=[0, *strengths])
        axes.grid(alpha=0.3)
    figure.supxlabel("strength, 0 without a disturbance")
    figure.supylabel("autonomy, %")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper center", fontsize=8)
    return png(figure, 100)


def gallery() -> bytes:
    """Return a JPEG with a rendered frame under each disturbance, at each strength."""
    run, cameras, frames = Run(Track("jungle")), driving.cameras_at("jungle", 0), []
    for i in range(GALLERY_FRAMES):
        run.s = GALLERY_PLACE + i * SPEEDS[0] * MPH / SAMPLE_RATE
        run.set_back()
        frames.append(cameras.frames(run.car.node.get_transform())[0])
    rows = []
    for kind in KINDS:
        tiles = []
        for strength in STRENGTHS:
            seen = list(map(Disturber(Disturbance(kind, strength), GALLERY_SEED), frames))[-1]
            tile = cv2.resize(seen, TILE, interpolation=cv2.INTER_AREA)
            cv2.rectangle(tile, (0, 0), (TILE[0], 13), (0, 0, 0), -1)
            text = f"{kind}:{strength}" + " held out" * (kind in HELD_OUT)
            cv2.putText(tile, text, (3, 10), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1, cv2.LINE_AA)
            tiles.append(cv2.copyMakeBorder(tile, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(255, 255, 255)))
        rows.append(np.hstack(tiles))
    half = -(-len(rows) // 2)
    return encode(np.hstack([np.vstack(rows[:half]), np.vstack(rows[half:])]), GALLERY_QUALITY)


def main(argv: list[str] | None = None) -> int:
    """Measure, and write table and picture. Raises UserError, OSError."""
    parser = command_line("python -m tools.robustness", __doc__)
    add = parser.add_argument
    add("models", nargs="*", default=[str(SHIPPED_MODEL)], help="model or .onnx files (default: the project's own)")
    add("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND", help="default: all")
    add("--strengths", nargs="+", type=int, choices=STRENGTHS, default=list(STRENGTHS), help="default: all")
    add("--tracks", nargs="*", choices=TRACKS, default=TRACKS, help="default: both")
    mph = number(float, 1, TOP_SPEED_MPH)
    add("--speeds", nargs=2, type=mph, default=SPEEDS, help="mph on the lake and in the jungle (default: 30 15)")
    add("--laps", type=number(float, 0.001, 100), default=1.0, help="of each drive, such as 0.5 (default 1)")
    add("--look", type=number(int, 0), default=0, help="light and colours, see README.md (default 0)")
    add("--recordings", nargs="*", default=[], help="to replay, or folders of recordings (default: none)")
    add("--output", type=Path, default=Path("robustness"), help="folder (default: %(default)s)")
    add_workers(parser)
    add("--gallery", metavar="FILE.jpg", help="only write a picture of a frame under all disturbances")
    options = parser.parse_args(argv)
    if options.gallery:
        write_output(options.gallery, gallery())
        return program.DONE
    models = []
    for file in dict.fromkeys(options.models):
        driving.load_driver(file)  # before processes start
        stem = Path(file).stem
        unique = [Path(other).stem for other in options.models].count(stem) == 1
        models.append((file, stem if unique else file, driving.digest_of(Path(file))))
    courses: list[tuple[str, float, Conditions]] = []
    for track in options.tracks:
        at, metres = TRACKS.index(track), options.laps * Track(track).length
        for seed, way in enumerate(DIRECTIONS, 2 * at):  # so not every drive has its drops in the same place
            how = Conditions("", options.speeds[at], options.look, way, metres, set_back=True, seed=seed)
            courses.append((track, options.laps, how))
    courses += [(str(folder), 0, Conditions("", 0, 0)) for folder in find_folders(options.recordings)]
    if not courses:
        raise UserError("nothing to drive: name --tracks or --recordings")
    kinds, strengths = list(dict.fromkeys(options.kinds)), sorted(set(options.strengths))
    disturbances = [None, *(Disturbance(*each) for each in itertools.product(kinds, strengths))]
    drives = [
        Drive(name, sha256, on, laps, how._replace(driver=file, disturbance=each))
        for on, laps, how in courses
        for each in disturbances
        for file, name, sha256 in models
    ]
    with claimed(options.output):
        with started_workers(options.processes, options.scheduler) as workers:
            curves = curves_of(measure_all(drives, options.output / "robustness.json", workers))
        tables = table(curves, kinds, strengths)
        print(tables, end="")
        write_output(options.output / "robustness.md", tables.encode())
        write_output(options.output / "robustness.png", picture(curves, kinds, strengths))
    return program.DONE


if __name__ == "__main__":
    program.run(main)
