"""The command `python -m simulator benchmark`: all drives of an entry, and what is written about them."""

import argparse
import functools
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, TypeVar

from cloning.base.outputs import write_json
from cloning.base.progress import progress_bar
from simulator import driving
from simulator.benchmark import scores, tasks
from simulator.benchmark.tasks import Task
from simulator.driving import Drive
from simulator.workers import started_workers

Item = TypeVar("Item")
Result = TypeVar("Result")


def drive(driver: str, task: Task) -> Drive:
    """Drive a task; in any process, it gives the same."""
    return driving.drive(task.conditions(driver), task.source)


def each(pool: Executor, work: Callable[[Item], Result], items: Iterable[Item], unit: str) -> list[Result]:
    """Return the results of all items, and show how far they are."""
    items = list(items)
    with progress_bar(len(items), unit) as bar:
        results = []
        for result in pool.map(work, items):
            results.append(result)
            bar.update()
    return results


def run(options: argparse.Namespace) -> None:
    """Drive everything, write the page and the JSON, and print the figures. Raises UserError, OSError."""
    begin = time.perf_counter()
    driving.check_driver(options.entry)  # before processes start
    folder: Path = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    chosen = tasks.quick_tasks() if options.quick else tasks.all_tasks()
    processes = 1 if driving.server_address(options.entry) else options.processes
    with started_workers(processes, options.scheduler) as pool:
        done = each(pool, functools.partial(drive, options.entry), chosen, "drive")
    drives = [scores.driven(task, each) for task, each in zip(chosen, done, strict=True)]
    groups = scores.by_group(drives)
    found: dict[str, Any] = {
        "version": tasks.VERSION,
        "quick": options.quick,
        "entry": options.entry,
        "score": scores.score(groups),
        "groups": groups,
        "drives": drives,
    }
    write_json(folder / "benchmark.json", found)
    for group, figures in groups.items():
        print(group, *(f"{name} {value}" for name, value in figures.items()), sep=", ")
    print(scores.line(Path(options.entry).stem, found))
    print(f"{time.perf_counter() - begin:.0f} s")
