"""The page about a benchmark, one file with everything in it."""

import base64
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cloning.recordings.writer import SampleClock
from cloning.server.template import whole_page
from simulator import driving
from simulator.benchmark import scores
from simulator.benchmark.scores import Driven
from simulator.benchmark.tasks import GROUPS, Task
from simulator.cameras import Cameras
from simulator.film import ChaseFilm
from simulator.run import Run

SHOWN = 4.0  # s before the car leaves the road, in a film


class Clip(NamedTuple):
    """The film of a failure; again: whether the car left the road at the same moment when it was filmed."""

    name: str
    film: str  # data URI
    again: bool


def failures(tasks: Sequence[Task], drives: Sequence[Driven]) -> list[tuple[Task, float]]:
    """Return the worst drive of each group in which the car left the road, and after how many s it first did."""
    worst: dict[str, tuple[Task, Driven]] = {}
    for task, drive in zip(tasks, drives, strict=True):
        if drive["departures"] and (task.group not in worst or drive["score"] < worst[task.group][1]["score"]):
            worst[task.group] = task, drive
    return [(task, drive["departures"][0]) for task, drive in worst.values()]


def film(driver: str, failure: tuple[Task, float]) -> Clip:
    """Drive a task again until the car leaves the road, and film the last seconds. Raises UserError."""
    task, until = failure
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        shown = ChaseFilm(str(path), driving.scene_of(task.source, task.look), start=max(0.0, until - SHOWN))

        def watch(run: Run, cameras: Cameras | None) -> None:
            shown.cameras = cameras
            if run.departures and not shown.writer.frames:  # earlier than before: its last moment alone
                shown.clock = SampleClock()
            shown.watch(run)

        drive = driving.drive(task.conditions(driver)._replace(set_back=False), task.source, watch)
        shown.close()
        data = base64.b64encode(path.read_bytes()).decode()
    again = [round(departure.time, 2) for departure in drive.departures] == [until]
    return Clip(task.name, f"data:video/mp4;base64,{data}", again)


def page(found: dict[str, Any], clips: Sequence[Clip]) -> str:
    """Return the page; found: what the JSON has."""
    about = {**GROUPS, "replays": "real recordings, replayed; not part of the score"}
    templates, away = Path(__file__).with_name("templates"), scores.away(found)
    return whole_page(templates, found=found, clips=clips, about=about, seconds=SHOWN, away=away)
