"""Search for roads on which a driver fails, at random and by evolution, as programs that test driving networks do.

    python -m tools.search found                                  # the network that comes with the project
    python -m tools.search found --max-angle 60 --hills 0.2       # on roads that are harder than those of other teams
    python -m tools.search found --driver 127.0.0.1:4567          # a server, which drives one car at a time
    python -m simulator drive --road found/evolution-1-17.json    # drives a failure again, with drive.py --speed 20

A road has 7 or 8 nodes, 10 to 25 m apart, with a turn at each, through which a Catmull-Rom spline goes. A driver
fails if a wheel leaves the road, or the car does not arrive at its end in time. Evolution keeps the roads on which the
car came farthest from the lane's centre, and changes the turns and distances of some of their nodes. The same options
find the same roads, on any number of processes; another kind of processor rounds otherwise. Each failure is driven
again, and must be the same to the last digit.

The folder gets a file for each failure, which `--road` of `python -m simulator` takes; search.json, with what was
printed; and failures.png: the roads from above, and where the car left them.
"""

import functools
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import TrackError, UserError
from cloning.base.figure import png
from cloning.base.outputs import claimed, plural, write_json, write_output
from cloning.base.progress import progress_bar
from cloning.network.network import SHIPPED_MODEL
from cloning.road.generated import LANDS, MARKINGS, PointRoad
from cloning.road.motion import TOP_SPEED_MPH
from cloning.road.points import LAND, MARKING, MAX_GRADE, spline_road
from cloning.road.track import LEFT, RIGHT, Track
from simulator.driving import Conditions, Drive, drive, workers_for
from simulator.workers import add_workers, results
from tools.command import head, row

SEARCHES = ("random", "evolution")
NODES = (7, 8)  # of a road, with these lengths in m between them, as in maxitwo's and MultiSim's generators
LENGTHS = (10.0, 25.0)
POPULATION = 10  # roads that evolution keeps; each has one child in a generation
MUTATED, MUTATION = 0.3, 1 / 6  # share of a child's nodes that change; standard deviation, as a share of the range
PLACES = 50  # along a road, at which directions are compared
SHOWN = 24  # failures in the picture


class Kind(NamedTuple):
    """What all roads of a search have in common; sharpest: turn at a node, degrees; steepest: dz/ds between nodes."""

    sharpest: float
    steepest: float
    marking: str
    land: str


class Candidate(NamedTuple):
    """A road of a search; genes: float64 (nodes - 1, 3), the turn, length and grade to each node from that before."""

    genes: np.ndarray
    road: PointRoad


def make_candidate(rng: np.random.Generator, kind: Kind, name: str, parent: Candidate | None = None) -> Candidate:
    """Return a random road, or a changed parent."""
    turn, grade = kind.sharpest, kind.steepest
    least, most = np.array([(-turn, LENGTHS[0], -grade), (turn, LENGTHS[1], grade)])
    while True:
        if parent is None:
            genes = rng.uniform(least, most, (rng.integers(NODES[0], NODES[1], endpoint=True) - 1, 3))
        else:
            chosen = rng.random(len(parent.genes)) < MUTATED
            chosen[rng.integers(len(chosen))] = True
            changed = parent.genes + chosen[:, None] * rng.normal(0, 1, parent.genes.shape) * MUTATION * (most - least)
            genes = changed.clip(least, most)
        try:
            return Candidate(genes, spline_road(genes, marking=kind.marking, land=kind.land, name=name))
        except TrackError:
            continue


def diversity(roads: Sequence[PointRoad]) -> float | None:
    """Return how much the roads' courses differ, degrees: the mean over all pairs of the RMS difference in direction.

    Directions are relative to the start, at PLACES along each road. None for fewer than two roads.
    """
    directions = []
    for track in map(Track, roads):
        heading = track.heading[track.first + np.linspace(0, track.length / track.step, PLACES).astype(int)]
        directions.append(np.degrees(heading - heading[0]))
    # One road with all after it at once: 10,000 roads have 50 million pairs.
    rows = np.array(directions)
    sums = [np.sqrt(np.square(rows[at + 1 :] - rows[at]).mean(1)).sum() for at in range(len(rows) - 1)]
    return round(float(sum(sums)) / math.comb(len(rows), 2), 1) if sums else None


Driven = tuple[PointRoad, Drive]
DriveAll = Callable[[Sequence[PointRoad]], list[Drive]]


def explore(search: str, seed: int, roads: int, kind: Kind, drive_all: DriveAll) -> Iterator[Driven]:
    """Yield each road of a search with its drive; the same arguments give the same roads."""
    rng = np.random.default_rng((SEARCHES.index(search), seed))
    kept: list[tuple[Candidate, Drive]] = []
    for first in range(0, roads, POPULATION):
        names = [f"{search}-{seed}-{i + 1}" for i in range(first, min(first + POPULATION, roads))]
        parents = [candidate for candidate, _ in kept] if search == "evolution" else []
        new = [make_candidate(rng, kind, name, parents[i] if parents else None) for i, name in enumerate(names)]
        drives = drive_all([candidate.road for candidate in new])
        driven = list(zip(new, drives, strict=True))
        kept = sorted(kept + driven, key=lambda pair: -pair[1].farthest)[:POPULATION]
        yield from ((candidate.road, drive) for candidate, drive in driven)


def run_search(
    folder: Path, search: str, seed: int, roads: int, kind: Kind, drive_all: DriveAll
) -> tuple[dict[str, Any], list[Driven]]:
    """Search, print each failure and write its file, then drive it again; return figures, and the failures.

    degrees_between_failures, degrees_between_roads: their `diversity`.
    """
    begin, first_failure = time.perf_counter(), ""
    driven: list[Driven] = []
    failures: list[Driven] = []
    with progress_bar(roads, "road") as bar:
        for road, driven_so in explore(search, seed, roads, kind, drive_all):
            driven.append((road, driven_so))
            bar.update()
            if driven_so.failed:
                first_failure = first_failure or f"{time.perf_counter() - begin:.0f} s, {len(driven)} roads"
                failures.append((road, driven_so))
                figures = driven_so.figures()
                print(road.name, *(f"{name} {value}" for name, value in figures.items()), sep=", ", flush=True)
                look = {"width": road.width, "marking": road.marking, "land": road.land}
                write_json(folder / f"{road.name}.json", figures | look | {"road_points": road.points.tolist()})
    seconds = time.perf_counter() - begin
    again = drive_all([road for road, _ in failures])
    same = sum(first == second for (_, first), second in zip(failures, again, strict=True))
    return {
        "search": search,
        "seed": seed,
        "roads": roads,
        "failures": len(failures),
        "first_failure": first_failure,
        "same_again": same,
        "degrees_between_failures": diversity([road for road, _ in failures]),
        "degrees_between_roads": diversity([road for road, _ in driven]),
        "farthest_m": round(max(drive.farthest for _, drive in driven), 2),
        "seconds": round(seconds),
    }, failures


def picture(failures: Sequence[Driven], title: str) -> bytes:
    """Return a PNG of roads on which the driver failed, from above, with the car's path and where it ended."""
    from matplotlib.figure import Figure

    columns = min(6, len(failures))
    rows = -(-len(failures) // columns)
    figure = Figure(figsize=(max(6, 2.6 * columns), 2.6 * rows + 0.5), layout="constrained")
    figure.suptitle(title)
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in grid[len(failures) :]:
        axes.axis("off")
    for axes, (road, driven) in zip(grid, failures, strict=False):
        track, path = Track(road), np.array(driven.path)
        middle = slice(track.first, len(track.points) - track.first)
        for side in (LEFT, RIGHT):
            edge = track.points[middle, :2] + side * track.rightward[middle] * road.width / 2
            axes.plot(*edge.T, color="0.6", linewidth=0.7)
        axes.plot(*path.T, color="tab:blue", linewidth=1.2)
        axes.plot(*path[0], "o", color="black", markersize=3)
        axes.plot(*path[-1], "x", color="tab:red", markersize=7, markeredgewidth=2)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(f"{road.name}\n{driven.ended}, {driven.along:.0f} m along", fontsize=8)
        axes.tick_params(labelsize=6)
    return png(figure, 110)


def main(argv: list[str] | None = None) -> int:
    """Search, print a table; return 1 if a failure was not the same when driven again. Raises UserError, OSError."""
    parser = command_line("python -m tools.search", __doc__)
    add = parser.add_argument
    add("folder", type=Path, help="new folder for the failures")
    add("--driver", default=str(SHIPPED_MODEL), help="model file, .onnx file, or HOST:PORT of a server; default: ours")
    add("--searches", nargs="+", choices=SEARCHES, default=SEARCHES, help="default: both")
    add("--seeds", nargs="+", type=number(int, 0), default=[1], help="of each search (default 1)")
    add("--roads", type=number(int, 1), default=50, help="that each search drives for a seed (default %(default)s)")
    speed = number(float, 1, TOP_SPEED_MPH)
    add("--speed", type=speed, default=20.0, help="mph (default %(default)s); a server sets its own: tell it here")
    add("--max-angle", type=number(float, 1, 90), default=35.0, help="at a node, degrees (default %(default)s)")
    add("--hills", type=number(float, 0, MAX_GRADE), default=0.0, help="steepest dz/ds between nodes (default: flat)")
    add("--look", type=number(int, 0), default=0, help="light and colours, see README.md (default %(default)s)")
    add("--marking", choices=MARKINGS, default=MARKING, help="default: %(default)s")
    add("--land", choices=LANDS, default=LAND, help="default: %(default)s")
    add_workers(parser)
    options = parser.parse_args(argv)
    workers = workers_for(options.driver, options.processes, options.scheduler)
    folder: Path = options.folder
    kind = Kind(options.max_angle, options.hills, options.marking, options.land)
    work = functools.partial(drive, Conditions(options.driver, options.speed, options.look))
    searches, failures = [], []
    with claimed(folder):
        if any(folder.iterdir()):
            raise UserError(f"{folder}: is not empty; name a new folder")
        with workers as pool:
            for seed, search in itertools.product(options.seeds, options.searches):
                figures, failed = run_search(
                    folder, search, seed, options.roads, kind, lambda roads: list(results(pool, work, roads))
                )
                searches.append(figures)
                failures += failed
        print(head(*(name.replace("_", " ") for name in searches[0])))
        for figures in searches:
            print(row(*("" if value is None else value for value in figures.values())))
        write_json(folder / "search.json", {"options": vars(options) | {"folder": str(folder)}, "searches": searches})
        if failures:
            title = plural(len(failures), "failure") + f", the first {SHOWN}" * (len(failures) > SHOWN)
            write_output(folder / "failures.png", picture(failures[:SHOWN], title))
    same = sum(figures["same_again"] for figures in searches)
    print(f"{same} of {len(failures)} failures were the same, to the last digit, when they were driven again")
    return program.DONE if same == len(failures) else program.INCOMPLETE


if __name__ == "__main__":
    program.run(main)
