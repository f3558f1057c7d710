"""The scoreboard's results, what of them is in sample, and the tables that show them."""

import re
from bisect import bisect
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import Any, TypedDict, TypeVar

from cloning.base.outputs import plural
from cloning.recordings.format import PROBLEM_AREAS
from cloning.road.autonomy import LIMITS, autonomy
from cloning.road.generated import road_number
from cloning.road.track import ROADS
from simulator.report import LapReport
from simulator.scenery.looks import SHADOWED
from tools.command import head, row

RENDERED = re.compile(r"(.+?)-(ccw|cw)-look(\d+)\b")  # a rendered recording's name: track, direction, look
SHADOWS, UNKNOWN_ROADS = "shadows", "unknown roads"
SUMMARY_LINES = (*ROADS, SHADOWS, UNKNOWN_ROADS)
ORACLE = "oracle (no network)"  # the title of its column
LIMIT, STAND_IN = "real recordings, limit {:g} m", "stand-in simulator"  # titles in the summary
MARKS = {True: "in sample", False: "held out"}
Cells = dict[str, dict[str, str]]  # by row and column
Result = TypeVar("Result")


class Replayed(TypedDict):
    """A drive of a real recording at one limit; see `cloning.replay.score.DrivingMetrics`."""

    autonomy_percent: float
    interventions: int
    distance_mean_m: float


class RealRecording(TypedDict):
    """What a real recording's replays have in common, whatever the network."""

    seconds: float  # driven
    lane_centre_percent: float  # share of the rows measured from the lane's centre, the others from the driver's path
    oracle: dict[str, Replayed]  # the recovery steering itself, driven, by the limit in metres


class Driven(TypedDict):
    """Laps in the stand-in simulator at one set speed, in one look."""

    track: str
    direction: str
    speed_mph: int
    look: int
    laps: float
    laps_with_departure: int
    departures: int
    distance_km: float
    offset_mean_m: float
    offset_max_m: float
    roughness_per_s: float


class NetworkResults(TypedDict):
    """A network's results."""

    what: str  # how it was trained
    sha256: str  # of its model file
    trained_on: list[str]  # the recordings' names
    replays: dict[str, dict[str, Replayed]]  # by the recording's name and the limit in metres
    drives: list[Driven]


class Board(TypedDict):
    """All results."""

    recordings: dict[str, RealRecording]  # by name
    networks: dict[str, NetworkResults]  # by the titles of their columns


def driven(report: LapReport, speed_mph: int, look: int, laps: float, finished: bool) -> Driven:
    """Return the results of a drive of so many laps; if it was not finished, its last lap counts as left."""
    ends = list(accumulate(report["seconds_a_lap"]))
    left = {bisect(ends, departure["time_s"]) for departure in report["departures"]}
    if not finished:
        laps = report["laps"] + 1
        left.add(report["laps"])
    return {
        "track": report["track"],
        "direction": report["direction"],
        "speed_mph": speed_mph,
        "look": look,
        "laps": laps,
        "laps_with_departure": len(left),
        "departures": len(report["departures"]),
        "distance_km": round(report["distance_m"] / 1000, 2),
        "offset_mean_m": report["offset_mean_m"],
        "offset_max_m": report["offset_max_m"],
        "roughness_per_s": report["steering_roughness_per_s"],
    }


def course(drive: Driven) -> tuple[str, str, int, int]:
    """Return what identifies a drive: track, direction, set speed and look."""
    return drive["track"], drive["direction"], drive["speed_mph"], drive["look"]


# ----------------------------------------------------------------------------------------------------------------------
# In sample or held out


def replay_in_sample(recording: str, trained_on: Sequence[str]) -> bool:
    """Return whether a network was trained on a real recording, or on copies of it.

    Copies have numbers after the name, or an ending by which training repeats them.
    """
    copies = re.compile(rf"{re.escape(recording)}\d*({'|'.join(PROBLEM_AREAS)})?")
    return any(copies.fullmatch(name) for name in trained_on)


def drive_in_sample(track: str, look: int, trained_on: Sequence[str]) -> bool:
    """Return whether a network was trained on a track in a look, in any direction.

    A generated road is in sample in every look if it was trained on in one. Look 0 of the two known tracks resembles
    the real simulator, so it is in sample too if a real recording of the track was trained on, as its name tells.
    """
    for name in trained_on:
        rendered = RENDERED.match(name)
        if rendered and rendered[1] == track and (road_number(track) is not None or int(rendered[3]) == look):
            return True
        if not rendered and look == 0 and re.fullmatch(rf"{track}\d*", name.split("-")[0]):
            return True
    return False


def replays(board: Board) -> Iterator[tuple[str, str, float, Replayed, bool]]:
    """Yield each replay: its network's title, recording and limit in metres, the result, whether it is in sample."""
    for title, network in board["networks"].items():
        for name, limits in network["replays"].items():
            for limit, result in limits.items():
                yield title, name, float(limit), result, replay_in_sample(name, network["trained_on"])


def drives(board: Board) -> Iterator[tuple[str, Driven, bool]]:
    """Yield each drive: its network's title, the result, whether it is in sample."""
    for title, network in board["networks"].items():
        for drive in network["drives"]:
            yield title, drive, drive_in_sample(drive["track"], drive["look"], network["trained_on"])


# ----------------------------------------------------------------------------------------------------------------------
# The summary: four lines for each network


def summary(board: Board) -> Cells:
    """Return the summary's cells: of each network's results on a line those held out, or all if there are none."""
    pools: dict[str, dict[str, list[tuple[Any, bool]]]] = defaultdict(lambda: defaultdict(list))
    for title, name, limit, result, in_sample in replays(board):
        line = SHADOWS if "shadow" in name else next(filter(name.startswith, ROADS), None)
        counted = board["recordings"][name]["seconds"], result["interventions"]
        pools[f"{title}: {line}"][LIMIT.format(limit)].append((counted, in_sample))
    for title, drive, in_sample in drives(board):
        line = SHADOWS if drive["look"] >= SHADOWED else drive["track"]
        line = line if road_number(drive["track"]) is None else UNKNOWN_ROADS
        pools[f"{title}: {line}"][STAND_IN].append((drive, in_sample))

    def pooled(column: str, results: list[tuple[Any, bool]]) -> str:
        held_out = [result for result, in_sample in results if not in_sample]
        chosen = held_out or [result for result, _ in results]
        return f"{laps_text(chosen) if column == STAND_IN else autonomy_text(chosen)}, {MARKS[not held_out]}"

    rows = [f"{title}: {line}" for title in board["networks"] for line in SUMMARY_LINES]
    return {row: {column: pooled(column, results) for column, results in pools[row].items()} for row in rows}


def autonomy_text(counted: Sequence[tuple[float, int]]) -> str:
    """Return the autonomy over the seconds and interventions of replays, together."""
    seconds, interventions = (sum(column) for column in zip(*counted, strict=True))
    percent = 100 * autonomy(int(interventions), seconds)
    return f"{percent:.1f} %, {plural(int(interventions), 'intervention')} in {seconds:.0f} s"


def laps_text(drives: Sequence[Driven]) -> str:
    """Return how often the car left the road in drives, together."""
    km, departures, laps, left = (
        sum(drive[key] for drive in drives) for key in ("distance_km", "departures", "laps", "laps_with_departure")
    )
    kept = max(0.0, laps - left)
    return f"{kept:g} of {laps:g} laps without a departure, {departures / km if km else 0:.2f} departures per km"


# ----------------------------------------------------------------------------------------------------------------------
# The tables of all results


def replay_rows(board: Board) -> Cells:
    """Return the cells of real recordings."""
    rows: dict[tuple[str, float], dict[str, str]] = defaultdict(dict)
    for name, recording in board["recordings"].items():
        for limit, result in recording["oracle"].items():
            rows[name, float(limit)][ORACLE] = replay_text(result)
    for title, name, metres, result, in_sample in replays(board):
        rows[name, metres][title] = f"{replay_text(result)}, {MARKS[in_sample]}"

    shares = {name: recording["lane_centre_percent"] for name, recording in board["recordings"].items()}
    references = {
        name: "" if share == 100 else f", {share:.0f} % of it from the lane's centre" for name, share in shares.items()
    }
    return {f"{name}, limit {limit:g} m{references[name]}": rows[name, limit] for name, limit in sorted(rows)}


def replay_text(result: Replayed) -> str:
    """Return the cell of a replay."""
    interventions = plural(result["interventions"], "intervention")
    return f"{result['autonomy_percent']:.1f} %, {interventions}, {result['distance_mean_m']:.2f} m"


def known_track_rows(board: Board) -> Cells:
    """Return the cells of drives on the two known tracks."""
    rows: dict[tuple[str, str, int, int], dict[str, str]] = defaultdict(dict)
    for title, drive, in_sample in drives(board):
        if road_number(drive["track"]) is None:
            rows[course(drive)][title] = (
                f"{plural(drive['departures'], 'departure')} in {drive['distance_km']:.1f} km, "
                f"{drive['offset_mean_m']:.2f} m, at most {drive['offset_max_m']:.2f} m, "
                f"roughness {drive['roughness_per_s']:.2f}/s, {MARKS[in_sample]}"
            )
    return {
        f"{track} {direction}, {mph} mph, look {look}": rows[track, direction, mph, look]
        for track, direction, mph, look in sorted(rows)
    }


def generated_road_rows(board: Board) -> Cells:
    """Return the cells of drives on generated roads: all roads at one speed in one light in one cell."""
    pools: dict[tuple[int, bool, bool], dict[str, list[Driven]]] = defaultdict(lambda: defaultdict(list))
    for title, drive, in_sample in drives(board):
        if road_number(drive["track"]) is not None:
            pools[drive["speed_mph"], drive["look"] >= SHADOWED, in_sample][title].append(drive)
    return {
        f"{mph} mph, looks {'with' if shadowed else 'without'} shadows, {MARKS[in_sample]}": {
            title: roads_text(pool) for title, pool in pools[mph, shadowed, in_sample].items()
        }
        for mph, shadowed, in_sample in sorted(pools)
    }


def roads_text(drives: Sequence[Driven]) -> str:
    """Return the cell of drives on several roads; means are by distance."""
    km = sum(drive["distance_km"] for drive in drives) or 1
    offset = sum(drive["offset_mean_m"] * drive["distance_km"] for drive in drives) / km
    roughness = sum(drive["roughness_per_s"] * drive["distance_km"] for drive in drives) / km
    roads = plural(len({drive["track"] for drive in drives}), "road")
    return f"{roads}: {laps_text(drives)}, {offset:.2f} m, roughness {roughness:.2f}/s"


def grid(corner: str, columns: Sequence[str], rows: Cells) -> str:
    """Return a Markdown table without the columns and rows that have no cell, or "" if none is left."""
    used = [column for column in columns if any(column in cells for cells in rows.values())]
    lines = [row(name, *(cells.get(column, "-") for column in used)) for name, cells in rows.items() if cells]
    return "\n".join([head(corner, *used), *lines]) if lines else ""


HEAD = """# How models drive

**In sample**: the network was trained on this real recording, or on this track in this look (on a generated road in any
look; look 0 resembles the real simulator, so that it counts as trained on with any real recording of the track). All
else is **held out**. A line of the summary pools the held-out results, or those in sample if there are no others: the
real recordings by their seconds and interventions, the laps in the stand-in simulator at all speeds. Shadows are the
real recordings with shadows in their names, and the lake and the jungle in looks from 10000 on; unknown roads are
generated ones in any look.
"""
REAL = """
NVIDIA's autonomy, the number of interventions, and the mean distance from the lane's centre. The oracle is the recovery
steering itself, driven instead of a network: the best that the measure allows.
"""
DRIVES = """
Departures from the road, mean and greatest distance from the centre line, and the roughness of the steering: its mean
absolute change per second, where 1 is full lock.
"""


def table(board: Board) -> str:
    """Return all tables as Markdown."""
    titles = list(board["networks"])
    networks = [f"* {title}: {network['what']}" for title, network in board["networks"].items()]
    sections = (
        ("", HEAD, grid("network: where", [*map(LIMIT.format, LIMITS), STAND_IN], summary(board))),
        ("## Real recordings\n", REAL, grid("recording", [ORACLE, *titles], replay_rows(board))),
        ("## Laps in the stand-in simulator\n", DRIVES, grid("course", titles, known_track_rows(board))),
        ("## Laps on generated roads\n", DRIVES, grid("courses", titles, generated_road_rows(board))),
        ("## The networks\n", "", "\n".join(networks)),
    )
    return "\n".join(f"{title}{text}\n{cells}\n" for title, text, cells in sections if cells)
