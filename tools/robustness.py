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
import hashlib
import io
import itertools
import json
import statistics
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, TypedDict

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("robustness")  # also while the libraries below are loaded

import cv2
import numpy as np

from cloning.base.arguments import number
from cloning.base.cores import threads
from cloning.base.errors import SimulatorError, UserError
from cloning.base.outputs import write_json, write_output
from cloning.base.progress import progress_bar
from cloning.network.network import SHIPPED_MODEL
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import decode, encode
from cloning.recordings.log import Recording, find_folders
from cloning.replay import replay
from cloning.replay.score import driving_metrics
from cloning.road.autonomy import LIMITS, autonomy
from cloning.road.disturbances import HELD_OUT, KINDS, STRENGTHS, Disturbance, Disturber
from cloning.road.motion import MPH, TOP_SPEED_MPH
from cloning.road.track import Track
from simulator.record import renderers_context, start_renderer
from simulator.run import Run
from tools.command import command_line, head, row, run_tool
from tools.driving import Conditions, cameras_at, drive, load_driver
from tools.search import end

TRACKS, SPEEDS, DIRECTIONS = ("lake", "jungle"), (30.0, 15.0), ("ccw", "cw")  # mph on each
NONE = "none"  # what results without a disturbance are called
STAND_IN, REPLAYS = "Stand-in simulator", f"Real recordings, replayed, limit {LIMITS[-1]:g} m"
GALLERY_PLACE, GALLERY_FRAMES = 200.0, 12  # m along the jungle; frames, some of which come late or not at all
TILE, GALLERY_SEED, GALLERY_QUALITY = (160, 80), 3, 60  # columns and rows


class Model(NamedTuple):
    """A model file, its name in tables, and its contents' SHA-256."""

    file: str
    name: str
    sha256: str


class Course(NamedTuple):
    """A drive in the stand-in, or the replay of a recording, whose speed is 0.

    on    track, or folder of the recording
    seed  of the disturbance, so that not every drive has its drops in the same place
    """

    on: str
    seed: int = 0
    speed: float = 0.0
    direction: str = ""
    laps: float = 0.0
    look: int = 0

    def __str__(self) -> str:
        laps = f" {self.direction}, {self.speed:g} mph, look {self.look}, {self.laps:g} laps"
        return self.on + laps * bool(self.speed)


class Result(TypedDict):
    """A drive; sha256: of the model; disturbance: such as `fog:3`, or NONE; departures: interventions in a replay."""

    model: str
    sha256: str
    where: str
    course: str
    disturbance: str
    autonomy_percent: float
    departures: int
    distance_mean_m: float


Job = tuple[Model, Course, Disturbance | None]


def key(result: Result) -> tuple[str, ...]:
    """Return what tells a result from all others."""
    return result["sha256"], result["model"], result["course"], result["disturbance"]


def key_of(job: Job) -> tuple[str, ...]:
    """Return the key of a job's result."""
    model, course, disturbance = job
    return model.sha256, model.name, str(course), str(disturbance or NONE)


@functools.lru_cache(maxsize=1)
def _recording(folder: str) -> tuple[Recording, list[replay.ReferenceLine]]:
    recording = replay.load_recording(folder)
    return recording, replay.reference_lines(recording)


def measure(job: Job) -> Result:
    """Drive, in any process. Raises UserError."""
    model, course, disturbance = job
    if course.speed:
        metres = course.laps * Track(course.on).length
        way = (course.speed, course.look, course.direction, metres, True, disturbance, course.seed)
        driven = drive(Conditions(model.file, *way), course.on)
        departures, mean = len(driven.departures), driven.mean
        percent = 0.0 if driven.failed else 100 * max(0.0, autonomy(departures, driven.planned))
    else:
        steering, (recording, lines) = load_driver(model.file), _recording(course.on)

        def driver(frame: replay.ReplayFrame) -> float:
            return steering(decode(frame.jpeg()))

        metrics = driving_metrics(replay.drive(recording, lines, LIMITS[-1], driver, disturbance=disturbance))
        departures, mean = metrics["interventions"], metrics["distance_mean_m"]
        percent = metrics["autonomy_percent"]
    return {
        "model": model.name,
        "sha256": model.sha256,
        "where": STAND_IN if course.speed else REPLAYS,
        "course": str(course),
        "disturbance": str(disturbance or NONE),
        "autonomy_percent": round(percent, 2),
        "departures": departures,
        "distance_mean_m": round(mean, 3),
    }


def measure_all(jobs: Sequence[Job], file: Path, processes: int) -> list[Result]:
    """Return the results of all jobs, of which those in the file are not driven again; it gets each as it comes.

    Raises UserError.
    """
    results = {key(each): each for each in json.loads(file.read_text(encoding="utf-8"))} if file.exists() else {}
    left = [job for job in jobs if key_of(job) not in results]
    with ExitStack() as stack:
        with program.interrupt_deferred():
            pool = ProcessPoolExecutor(processes, renderers_context(), start_renderer)
            stack.callback(end, pool)
            coming = [pool.submit(measure, job) for job in left]
        bar = stack.enter_context(progress_bar(len(left), "drive"))
        try:
            for done in as_completed(coming):
                result = done.result()
                results[key(result)] = result
                write_json(file, [results[each] for each in sorted(results)])
                bar.update()
        except BrokenExecutor as error:
            raise SimulatorError("a driving process was killed, perhaps for lack of memory; run it again") from error
    return [results[key_of(job)] for job in jobs]


# ----------------------------------------------------------------------------------------------------------------------
# Table and picture


class Figures(NamedTuple):
    """The results of a model with a disturbance on all courses; autonomy: percent, the mean of the drives'."""

    autonomy: float
    departures: int
    distance: float


def figures_of(results: Sequence[Result], where: str, model: str) -> dict[str, Figures]:
    """Return the figures of a model by disturbance."""
    found: dict[str, list[Result]] = {}
    for each in results:
        if (each["where"], each["model"]) == (where, model):
            found.setdefault(each["disturbance"], []).append(each)
    return {
        disturbance: Figures(
            statistics.fmean(each["autonomy_percent"] for each in group),
            sum(each["departures"] for each in group),
            statistics.fmean(each["distance_mean_m"] for each in group),
        )
        for disturbance, group in found.items()
    }


def places(results: Sequence[Result]) -> list[tuple[str, str]]:
    """Return where each model drove, and the model."""
    return list(dict.fromkeys((each["where"], each["model"]) for each in results))


def table(results: Sequence[Result], kinds: Sequence[str], strengths: Sequence[int]) -> str:
    """Return the tables of all models in Markdown."""
    lines = ["# Robustness", "", "Autonomy, departures (interventions in a replay), and m from the lane's centre."]
    for where, model in places(results):
        figures = figures_of(results, where, model)

        def cell(disturbance: str, figures: dict[str, Figures] = figures) -> str:
            found = figures[disturbance]
            return f"{found.autonomy:.1f} %, {found.departures}, {found.distance:.2f} m"

        lines += ["", f"## {where}: {model}", "", f"Without a disturbance: {cell(NONE)}.", ""]
        lines.append(head("kind", *(f"strength {strength}" for strength in strengths)))
        for kind in kinds:
            held_out = " (held out)" * (kind in HELD_OUT)
            lines.append(row(kind + held_out, *(cell(f"{kind}:{strength}") for strength in strengths)))
        for name, chosen in (
            ("kinds without a departure", [kind for kind in kinds if kind not in HELD_OUT]),
            ("held out, likewise", [kind for kind in kinds if kind in HELD_OUT]),
        ):
            counts = [sum(not figures[f"{kind}:{strength}"].departures for kind in chosen) for strength in strengths]
            lines.append(row(f"**{name}**", *(f"{count} of {len(chosen)}" for count in counts)))
    return "\n".join(lines) + "\n"


def picture(results: Sequence[Result], kinds: Sequence[str], strengths: Sequence[int]) -> bytes:
    """Return a PNG with the models' autonomy by strength, 0 for none, a panel for each kind."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(6, len(kinds))
    rows = -(-len(kinds) // columns)
    figure = Figure(figsize=(max(6, 2.3 * columns), 1.9 * rows + 0.8), layout="constrained")
    FigureCanvasAgg(figure)
    grid = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    models = list(dict.fromkeys(each["model"] for each in results))
    for axes, kind in itertools.zip_longest(grid, kinds):
        if kind is None:
            axes.axis("off")
            continue
        for where, model in places(results):
            figures = figures_of(results, where, model)
            autonomies = [figures[name].autonomy for name in (NONE, *(f"{kind}:{strength}" for strength in strengths))]
            style = {"color": f"C{models.index(model)}", "linestyle": "-" if where == STAND_IN else "--"}
            axes.plot([0, *strengths], autonomies, marker=".", label=f"{model}, {where.lower()}", **style)
        held_out = kind in HELD_OUT
        axes.set_title(kind + ", held out" * held_out, fontsize=9, color="tab:red" if held_out else "black")
        axes.set(ylim=(-4, 104), xticks=[0, *strengths])
        axes.grid(alpha=0.3)
    figure.supxlabel("strength, 0 without a disturbance")
    figure.supylabel("autonomy, %")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper center", fontsize=8)
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=100)
    return image.getvalue()


def gallery() -> bytes:
    """Return a JPEG with a rendered frame under each disturbance, at each strength."""
    run, cameras, frames = Run(Track("jungle")), cameras_at("jungle", 0), []
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
    parser = command_line("robustness", __doc__)
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
    add("--processes", type=number(int, 1), default=threads(), help="drives at a time (default: cores)")
    add("--gallery", metavar="FILE.jpg", help="only write a picture of a frame under all disturbances")
    options = parser.parse_args(argv)
    if options.gallery:
        write_output(options.gallery, gallery())
        return program.DONE
    models = []
    for file in dict.fromkeys(options.models):
        load_driver(file)  # before processes start
        stem = Path(file).stem
        unique = [Path(other).stem for other in options.models].count(stem) == 1
        models.append(Model(file, stem if unique else file, hashlib.sha256(Path(file).read_bytes()).hexdigest()))
    speeds = dict(zip(TRACKS, options.speeds, strict=True))
    courses = [
        Course(track, 2 * TRACKS.index(track) + i, speeds[track], direction, options.laps, options.look)
        for track in options.tracks
        for i, direction in enumerate(DIRECTIONS)
    ]
    courses += [Course(str(folder)) for folder in (find_folders(options.recordings) if options.recordings else ())]
    if not courses:
        raise UserError("nothing to drive: name --tracks or --recordings")
    kinds, strengths = (list(dict.fromkeys(given)) for given in (options.kinds, sorted(options.strengths)))
    disturbances = [None, *(Disturbance(*each) for each in itertools.product(kinds, strengths))]
    jobs = [(model, *each) for each in itertools.product(courses, disturbances) for model in models]
    options.output.mkdir(parents=True, exist_ok=True)
    results = measure_all(jobs, options.output / "robustness.json", options.processes)
    tables = table(results, kinds, strengths)
    print(tables, end="")
    write_output(options.output / "robustness.md", tables.encode())
    write_output(options.output / "robustness.png", picture(results, kinds, strengths))
    return program.DONE


if __name__ == "__main__":
    run_tool(main)
