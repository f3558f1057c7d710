"""The scoreboard's results, what of them is in sample, and the tables that show them."""

import re
from bisect import bisect
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import TypedDict, TypeVar

from cloning.base.outputs import plural
from cloning.recordings.format import PROBLEM_AREAS
from cloning.road.autonomy import LIMITS, autonomy
from cloning.road.generated import road_number
from cloning.road.track import ROADS
from simulator.report import LapReport
from simulator.scenery.looks import SHADOWED

RENDERED = re.compile(r"(.+?)-(ccw|cw)-look(\d+)\b")  # a rendered recording's name: track, direction, look
SHADOWS, UNKNOWN_ROADS = "shadows", "unknown roads"
SUMMARY_LINES = (*ROADS, SHADOWS, UNKNOWN_ROADS)
ORACLE = "oracle (no network)"  # the title of its column
Result = TypeVar("Result")


class Replayed(TypedDict):
    """A drive of a real recording at one limit; see `cloning.replay.score.DrivingMetrics`."""

    autonomy_percent: float
    interventions: int
    distance_mean_m: float


class RealRecording(TypedDict):
    """What a real recording's replays have in common, whatever the network.

    seconds: driven; lane_centre_percent: share of the rows measured from the lane's centre, the others from the human
    driver's path; oracle: the recovery steering itself, driven, by the limit in metres.
    """

    seconds: float
    lane_centre_percent: float
    oracle: dict[str, Replayed]


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
    """A network's results.

    what: how it was trained; commands: that measured it; sha256: of its model file; trained_on: the recordings' names;
    replays: by the recording's name and the limit in metres.
    """

    what: str
    commands: list[str]
    sha256: str
    trained_on: list[str]
    replays: dict[str, dict[str, Replayed]]
    drives: list[Driven]


class Board(TypedDict):
    """All results: the real recordings by name, and the networks by the titles of their columns."""

    recordings: dict[str, RealRecording]
    networks: dict[str, NetworkResults]


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


def held_out_else_all(results: Sequence[Result], in_sample: Callable[[Result], bool]) -> tuple[list[Result], str]:
    """Return the held-out results, or all of them if none is, and the words for that."""
    held_out = [result for result in results if not in_sample(result)]
    return (held_out, mark(False)) if held_out else (list(results), mark(True))


def mark(in_sample: bool) -> str:
    """Return the words that mark a result."""
    return "in sample" if in_sample else "held out"


# ----------------------------------------------------------------------------------------------------------------------
# The summary: four lines for each network


def replay_line(recording: str) -> str | None:
    """Return the line of the summary to which a real recording belongs by its name, or None."""
    return SHADOWS if "shadow" in recording else next((track for track in ROADS if recording.startswith(track)), None)


def drive_line(track: str, look: int) -> str:
    """Return the line of the summary to which a drive belongs."""
    if road_number(track) is not None:
        return UNKNOWN_ROADS
    return SHADOWS if look >= SHADOWED else track


def summary(board: Board) -> list[str]:
    """Return the summary as Markdown."""
    columns = [*(f"real recordings, limit {limit:g} m" for limit in LIMITS), "stand-in simulator"]
    rows: dict[str, dict[str, str]] = {}
    for name, network in board["networks"].items():
        for line in SUMMARY_LINES:
            cells = {columns[i]: pooled_replays(board, network, line, f"{limit:g}") for i, limit in enumerate(LIMITS)}
            cells["stand-in simulator"] = pooled_drives(network, line)
            rows[f"{name}: {line}"] = {column: cell for column, cell in cells.items() if cell}
    return grid("network: where", columns, rows)


def pooled_replays(board: Board, network: NetworkResults, line: str, limit: str) -> str:
    """Return the autonomy over a line's real recordings together, by their seconds and interventions; "" for none."""
    names = [name for name, limits in network["replays"].items() if replay_line(name) == line and limit in limits]
    names, words = held_out_else_all(names, lambda name: replay_in_sample(name, network["trained_on"]))
    if not names:
        return ""
    seconds = sum(board["recordings"][name]["seconds"] for name in names)
    interventions = sum(network["replays"][name][limit]["interventions"] for name in names)
    percent = 100 * autonomy(interventions, seconds)
    return f"{percent:.1f} %, {plural(interventions, 'intervention')} in {seconds:.0f} s, {words}"


def pooled_drives(network: NetworkResults, line: str) -> str:
    """Return the departures in all drives of a line together; "" for none."""
    drives = [drive for drive in network["drives"] if drive_line(drive["track"], drive["look"]) == line]
    drives, words = held_out_else_all(
        drives, lambda drive: drive_in_sample(drive["track"], drive["look"], network["trained_on"])
    )
    return f"{laps_text(drives)}, {words}" if drives else ""


def laps_text(drives: Sequence[Driven]) -> str:
    """Return how often the car left the road in drives, together."""
    km, departures = sum(drive["distance_km"] for drive in drives), sum(drive["departures"] for drive in drives)
    laps = sum(drive["laps"] for drive in drives)
    kept = max(0.0, laps - sum(drive["laps_with_departure"] for drive in drives))
    return f"{kept:g} of {laps:g} laps without a departure, {departures / km if km else 0:.2f} departures per km"


# ----------------------------------------------------------------------------------------------------------------------
# The tables of all results


def replay_rows(board: Board) -> dict[str, dict[str, str]]:
    """Return the cells of real recordings, by row and column."""
    rows: dict[str, dict[str, str]] = {}
    for name, recording in sorted(board["recordings"].items()):
        share = recording["lane_centre_percent"]
        reference = "" if share == 100 else f", {share:.0f} % of it from the lane's centre"
        replays = {
            title: network["replays"][name]
            for title, network in board["networks"].items()
            if name in network["replays"]
        }
        limits = {limit for results in (recording["oracle"], *replays.values()) for limit in results}
        for limit in sorted(limits, key=float):
            row = rows[f"{name}, limit {limit} m{reference}"] = {}
            if limit in recording["oracle"]:
                row[ORACLE] = replay_text(recording["oracle"][limit])
            for title, results in replays.items():
                if limit in results:
                    in_sample = replay_in_sample(name, board["networks"][title]["trained_on"])
                    row[title] = f"{replay_text(results[limit])}, {mark(in_sample)}"
    return rows


def replay_text(result: Replayed) -> str:
    """Return the cell of a replay."""
    interventions = plural(result["interventions"], "intervention")
    return f"{result['autonomy_percent']:.1f} %, {interventions}, {result['distance_mean_m']:.2f} m"


def known_track_rows(board: Board) -> dict[str, dict[str, str]]:
    """Return the cells of drives on the two known tracks, by row and column."""
    rows: dict[tuple[str, str, int, int], dict[str, str]] = {}
    for title, network in board["networks"].items():
        for drive in network["drives"]:
            if road_number(drive["track"]) is None:
                in_sample = drive_in_sample(drive["track"], drive["look"], network["trained_on"])
                rows.setdefault(course(drive), {})[title] = (
                    f"{plural(drive['departures'], 'departure')} in {drive['distance_km']:.1f} km, "
                    f"{drive['offset_mean_m']:.2f} m, at most {drive['offset_max_m']:.2f} m, "
                    f"roughness {drive['roughness_per_s']:.2f}/s, {mark(in_sample)}"
                )
    return {
        f"{track} {direction}, {mph} mph, look {look}": rows[track, direction, mph, look]
        for track, direction, mph, look in sorted(rows)
    }


def generated_road_rows(board: Board) -> dict[str, dict[str, str]]:
    """Return the cells of drives on generated roads, by row and column: all roads of one kind in one cell."""
    kinds: dict[tuple[int, bool, bool], dict[str, list[Driven]]] = {}
    for title, network in board["networks"].items():
        for drive in network["drives"]:
            if road_number(drive["track"]) is not None:
                in_sample = drive_in_sample(drive["track"], drive["look"], network["trained_on"])
                kind = drive["speed_mph"], drive["look"] >= SHADOWED, in_sample
                kinds.setdefault(kind, {}).setdefault(title, []).append(drive)
    return {
        f"{mph} mph, looks {'with' if shadowed else 'without'} shadows, {mark(in_sample)}": {
            title: roads_text(drives) for title, drives in kinds[mph, shadowed, in_sample].items()
        }
        for mph, shadowed, in_sample in sorted(kinds)
    }


def roads_text(drives: Sequence[Driven]) -> str:
    """Return the cell of drives on several roads; means are by distance."""
    km = sum(drive["distance_km"] for drive in drives)
    offset = sum(drive["offset_mean_m"] * drive["distance_km"] for drive in drives) / km if km else 0.0
    roughness = sum(drive["roughness_per_s"] * drive["distance_km"] for drive in drives) / km if km else 0.0
    roads = plural(len({drive["track"] for drive in drives}), "road")
    return f"{roads}: {laps_text(drives)}, {offset:.2f} m, roughness {roughness:.2f}/s"


def grid(corner: str, columns: Sequence[str], rows: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return a Markdown table without the columns and rows that have no cell."""
    used = [column for column in columns if any(column in cells for cells in rows.values())]
    lines = [f"| {corner} | " + " | ".join(used) + " |", "|---" * (len(used) + 1) + "|"]
    for row, cells in rows.items():
        if cells:
            lines.append(f"| {row} | " + " | ".join(cells.get(column, "-") for column in used) + " |")
    return lines


HEAD = """# How models drive

**In sample**: the network was trained on this real recording, or on this track in this look (on a generated road in any
look; look 0 resembles the real simulator, so that it counts as trained on with any real recording of the track). All
else is **held out**. A line of the summary pools the held-out results, or those in sample if there are no others: the
real recordings by their seconds and interventions, the laps in the stand-in simulator at all speeds. Shadows are the
real recordings with shadows in their names, and the lake and the jungle in looks from 10000 on; unknown roads are
generated ones in any look.
"""
REAL = """
## Real recordings

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
    lines = [HEAD, *summary(board)]
    if rows := replay_rows(board):
        lines += [REAL, *grid("recording", [ORACLE, *titles], rows)]
    if rows := known_track_rows(board):
        lines += ["\n## Laps in the stand-in simulator", DRIVES, *grid("course", titles, rows)]
    if rows := generated_road_rows(board):
        lines += ["\n## Laps on generated roads", DRIVES, *grid("courses", titles, rows)]
    lines += ["\n## Measured with"]
    for title, network in board["networks"].items():
        lines += ["", f"* {title}: {network['what']}", *(f"  * `{command}`" for command in network["commands"])]
    return "\n".join(lines) + "\n"
