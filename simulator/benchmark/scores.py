"""How drives become a score: one formula, of which LEADERBOARD.md tells what it means."""

from collections.abc import Sequence
from statistics import fmean
from typing import Any, TypedDict

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


class Figures(TypedDict):
    """What is told of a group of drives; score: 0..100."""

    drives: int
    score: float
    departures: int
    mean_m: float


def percent(autonomy: float) -> float:
    """Return the score of a drive, 0..100."""
    return round(100 * max(0.0, autonomy), DIGITS)


def driven(task: Task, drive: Drive) -> Driven:
    """Return what is told of a drive."""
    return {
        "group": task.group,
        "name": task.name,
        "score": percent(drive.autonomy),
        "departures": [round(departure.time, 2) for departure in drive.departures],
        "ended": drive.ended,
        "mean_m": round(drive.mean, 3),
        "farthest_m": round(drive.farthest, 3),
    }


def by_group(drives: Sequence[Driven]) -> dict[str, Figures]:
    """Return the figures of each group that was driven."""
    found: dict[str, Figures] = {}
    for group in dict.fromkeys(each["group"] for each in drives):
        chosen = [each for each in drives if each["group"] == group]
        found[group] = {
            "drives": len(chosen),
            "score": round(fmean(each["score"] for each in chosen), DIGITS),
            "departures": sum(len(each["departures"]) for each in chosen),
            "mean_m": round(fmean(each["mean_m"] for each in chosen), 3),
        }
    return found


def score(groups: dict[str, Figures]) -> float:
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
