"""How drives become a score: one formula, of which LEADERBOARD.md tells what it means."""

from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean
from typing import Any, TypedDict

from cloning.base.outputs import plural
from cloning.lane.foretell import EARLIEST, LATEST, WINDOW
from simulator.benchmark.tasks import GROUPS, Task
from simulator.driving import Drive

DIGITS = 2  # of a score, in percent


class Driven(TypedDict):
    """What is told of a drive; score: 0..100."""

    group: str
    name: str
    score: float
    departures: list[float]  # s after the start
    ended: str
    mean_m: float
    farthest_m: float
    alarms: tuple[int, int] | None  # in so many of so many windows, see `alarmed`; None: the entry foretells nothing


def percent(autonomy: float) -> float:
    """Return the score of a drive, 0..100."""
    return round(100 * max(0.0, autonomy), DIGITS)


def windows(departures: Sequence[float], seconds: float) -> list[tuple[float, float]]:
    """Return where the windows of a drive begin and end in which alarms are counted, as SelfOracle counts them.

    In a drive with departures these are the seconds in which an alarm foretells one, otherwise the whole drive is cut
    into windows. All are s after the start.
    """
    before = ((max(last, each - EARLIEST), each - LATEST) for last, each in pairwise([0.0, *departures]))
    whole = ((k * WINDOW, (k + 1) * WINDOW) for k in range(int(seconds // WINDOW)))
    return [(begin, end) for begin, end in (before if departures else whole) if begin < end]


def alarmed(departures: Sequence[float], alarms: Sequence[float], seconds: float) -> tuple[int, int]:
    """Return in how many of a drive's windows there was an alarm, and how many there are."""
    found = windows(departures, seconds)
    return sum(any(begin <= alarm < end for alarm in alarms) for begin, end in found), len(found)


def foretelling(drives: Sequence[Driven]) -> str | None:
    """Return how well departures were foretold, in words; None if they were not."""
    sums = [[0, 0], [0, 0]]
    for drive in drives:
        for i, count in enumerate(drive["alarms"] or ()):
            sums[bool(drive["departures"])][i] += count
    (false, ordinary), (foretold, departures) = sums
    if not ordinary + departures:
        return None
    return (
        f"of {plural(departures, 'departure')} more than {LATEST:g} s after the start or the one before, {foretold} "
        f"foretold {LATEST:g} to {EARLIEST:g} s ahead; false alarms in {false} of {ordinary} times {WINDOW:g} s of "
        "drives without a departure"
    )


def driven(task: Task, drive: Drive) -> Driven:
    """Return what is told of a drive."""
    departures = [round(departure.time, 2) for departure in drive.departures]
    return {
        "group": task.group,
        "name": task.name,
        "score": percent(drive.autonomy),
        "departures": departures,
        "ended": drive.ended,
        "mean_m": round(drive.mean, 3),
        "farthest_m": round(drive.farthest, 3),
        "alarms": None if drive.alarms is None else alarmed(departures, drive.alarms, drive.seconds),
    }


def by_group(drives: Sequence[Driven]) -> dict[str, dict[str, Any]]:
    """Return the figures of each group that was driven; score: 0..100, mean_m: from the lane's centre."""
    found = {}
    for group in dict.fromkeys(each["group"] for each in drives):
        chosen = [each for each in drives if each["group"] == group]
        found[group] = {
            "drives": len(chosen),
            "score": round(fmean(each["score"] for each in chosen), DIGITS),
            "departures": sum(len(each["departures"]) for each in chosen),
            "mean_m": round(fmean(each["mean_m"] for each in chosen), 3),
        }
    return found


def score(groups: dict[str, dict[str, Any]]) -> float:
    """Return the score, 0..100: the mean of the groups' scores, without the replays, which not everybody can drive."""
    return round(fmean(groups[name]["score"] for name in GROUPS), DIGITS)


def away(found: dict[str, Any]) -> float:
    """Return the mean distance from the lane's centre, m, of all groups alike; found: what the JSON has."""
    return fmean(found["groups"][group]["mean_m"] for group in GROUPS)


def line(name: str, found: dict[str, Any]) -> str:
    """Return the row of LEADERBOARD.md; found: what the JSON has."""
    groups = found["groups"]
    cells = [f"{groups[group]['score']:.2f}" if group in groups else "-" for group in (*GROUPS, "replays")]
    return "| " + " | ".join([name, f"**{found['score']:.2f}**", *cells, f"{away(found):.2f}"]) + " |"
