"""The command `python -m simulator benchmark`: all drives of an entry, and what is written about them."""

import argparse
import functools
import hashlib
from pathlib import Path
from typing import Any

from cloning.base.outputs import write_json, write_output
from simulator import driving
from simulator.benchmark import page, replays, scores, tasks
from simulator.benchmark.tasks import Task
from simulator.driving import Drive
from simulator.workers import results


def drive(driver: str, task: Task) -> Drive:
    """Drive a task; in any process, it gives the same."""
    return driving.drive(task.conditions(driver), task.source)


def run(options: argparse.Namespace) -> None:
    """Drive everything, write the page and the JSON, and print the figures. Raises UserError, OSError."""
    entry, folder = options.entry, options.folder
    workers = driving.workers_for(entry, options.processes, options.scheduler)
    recordings = replays.folders(options.recordings) if options.recordings else []
    folder.mkdir(parents=True, exist_ok=True)
    chosen = tasks.quick_tasks() if options.quick else tasks.all_tasks()
    with workers as pool:
        done = results(pool, functools.partial(drive, entry), chosen, "drive")
        drives = [scores.driven(*pair) for pair in zip(chosen, done, strict=True)]
        clips = list(results(pool, functools.partial(page.film, entry), page.failures(chosen, drives), "film"))
        drives += results(pool, functools.partial(replays.replay, entry), recordings, "recording")
    groups = scores.by_group(drives)
    file = Path(entry)
    found: dict[str, Any] = {
        "version": tasks.VERSION,
        "quick": options.quick,
        "entry": file.stem if file.is_file() else entry,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None,
        "score": scores.score(groups),
        "groups": groups,
        "foretelling": scores.foretelling(drives),
        "drives": drives,
    }
    write_json(folder / "benchmark.json", found)
    write_output(folder / "report.html", page.page(found, clips).encode())
    for group, figures in groups.items():
        print(group, *(f"{name} {value}" for name, value in figures.items()), sep=", ")
    if found["foretelling"]:
        print(found["foretelling"])
    if not recordings:
        print("replays: not run; --recordings names the folder of the recordings")
    print(f"{folder / 'report.html'}, benchmark.json; the line for LEADERBOARD.md:")
    print(scores.line(found["entry"], found))
