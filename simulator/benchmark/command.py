"""The command `python -m simulator benchmark`: all drives of an entry, and what is written about them."""

import argparse
import functools
import json
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from cloning.base.errors import SimulatorError, UserError
from cloning.base.outputs import claimed, write_json, write_output
from simulator import driving
from simulator.benchmark import page, replays, scores, tasks
from simulator.benchmark.tasks import Task
from simulator.driving import Drive
from simulator.workers import results


def drive(driver: str, task: Task) -> Drive:
    """Drive a task; in any process, it gives the same."""
    return driving.drive(task.conditions(driver), task.source)


def drive_all(
    pool: Executor, driver: str, chosen: Sequence[Task], file: Path, about: dict[str, Any], resume: bool
) -> list[scores.Driven]:
    """Return what is told of the drives; the file gets each as it comes, and to resume, those in it are not repeated.

    about: what the entry is, as in the file. Raises UserError, OSError.
    """
    kept: dict[str, scores.Driven] = {}
    if resume and file.exists():
        try:
            found = json.loads(file.read_text(encoding="utf-8"))
            before, kept = found["about"], found["drives"]
            others = [f"{key} {before[key]}, not {own}" for key, own in about.items() if before[key] != own]
        except (ValueError, LookupError, TypeError) as error:
            raise UserError(f"{file}: damaged ({error!r}); leave out --resume") from None
        if others:
            raise UserError(f"{file}: has drives of {'; '.join(others)}; leave out --resume")
    missing = [task for task in chosen if task.name not in kept]
    for task, done in zip(missing, results(pool, functools.partial(drive, driver), missing, "drive"), strict=True):
        driving.refuse_replaced(driver, about["sha256"])
        kept[task.name] = scores.driven(task, done)
        write_json(file, {"about": about, "drives": kept})
    return [kept[task.name] for task in chosen]


def run(options: argparse.Namespace) -> None:
    """Drive everything, write the page and the JSON, and print the figures. Raises UserError, OSError."""
    entry, folder = options.entry, options.folder
    file, unfinished = Path(entry), folder / "unfinished.json"
    about = {
        "version": tasks.VERSION,
        "entry": file.stem if file.is_file() else entry,
        "sha256": driving.digest_of(file) if file.is_file() else None,
    }
    workers = driving.workers_for(entry, options.processes, options.scheduler)
    recordings = replays.folders(options.recordings) if options.recordings else []
    chosen = tasks.quick_tasks() if options.quick else tasks.all_tasks()
    with claimed(folder):
        try:
            with workers as pool:
                drives = drive_all(pool, entry, chosen, unfinished, about, options.resume)
                clips = list(results(pool, functools.partial(page.film, entry), page.failures(chosen, drives), "film"))
                drives += results(pool, functools.partial(replays.replay, entry), recordings, "recording")
            driving.refuse_replaced(entry, about["sha256"])
        except SimulatorError as error:
            on = "with --resume, the benchmark goes on after the drives that are done"
            raise SimulatorError(f"{error}; {on}") from None
        groups = scores.by_group(drives)
        found: dict[str, Any] = about | {
            "quick": options.quick,
            "score": scores.score(groups),
            "groups": groups,
            "foretelling": scores.foretelling(drives),
            "drives": drives,
        }
        write_json(folder / "benchmark.json", found)
        write_output(folder / "report.html", page.page(found, clips).encode())
        unfinished.unlink()
    for group, figures in groups.items():
        print(group, *(f"{name} {value}" for name, value in figures.items()), sep=", ")
    if found["foretelling"]:
        print(found["foretelling"])
    if not recordings:
        print("replays: not run; --recordings names the folder of the recordings")
    print(f"{folder / 'report.html'}, benchmark.json; the line for LEADERBOARD.md:")
    print(scores.line(found["entry"], found))
