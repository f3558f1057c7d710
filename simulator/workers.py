"""Where independent drives run: in processes of this machine, or on many machines as Dask's workers.

Each is a `concurrent.futures` executor. What it runs must give the same result wherever and however often it is run:
Dask runs again what a worker did not finish that was killed.
"""

import argparse
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from multiprocessing.context import BaseContext
from typing import TypeVar

from cloning.base.arguments import number
from cloning.base.cores import threads
from cloning.base.errors import SimulatorError, UserError
from cloning.base.processes import starting
from cloning.base.progress import progress_bar

MOST_ON_WINDOWS = 61  # processes, whose ends it can wait for at the same time
WAIT = 30.0  # s for a worker of Dask's to come; its scheduler is waited for as long
Item = TypeVar("Item")
Result = TypeVar("Result")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the options `processes` and `scheduler`, which `started_workers` takes."""
    parser.add_argument("--processes", type=number(int, 1), default=threads(), help="drives at a time (default: cores)")
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="drive on the workers of Dask's scheduler there, such as 192.168.0.7:8786, instead of in --processes; the "
        "project is installed, and the driver's file is in the same place, on each",
    )


@contextmanager
def started_workers(processes: int, scheduler: str | None = None) -> Iterator[Executor]:
    """A context with an executor; call it in the main thread. At its end, nothing runs there any more.

    Raises SimulatorError if a process was killed, UserError if there is no such scheduler, or it has no worker.
    """
    with ExitStack() as stack:
        if scheduler:
            yield _dask(scheduler, stack)
            return
        if sys.platform == "win32":
            processes = min(processes, MOST_ON_WINDOWS)
        others = multiprocessing.active_children()
        with starting():
            pool = stack.enter_context(ProcessPoolExecutor(processes, _context(), begin, (signal.SIG_IGN,)))
        try:
            with starting():
                for _ in range(processes):  # each starts a process
                    pool.submit(int)
            yield pool
        except BrokenExecutor as error:
            raise SimulatorError("a driving process was killed, perhaps for lack of memory; start again") from error
        except BaseException:
            for process in multiprocessing.active_children():  # after Ctrl-C they would drive on to their roads' ends
                if process not in others:
                    process.terminate()
            # One that ends while it sends leaves half a result, and the pool would wait for ever for the other half.
            pool._result_queue._writer.close()  # type: ignore[attr-defined]
            raise


def results(pool: Executor, work: Callable[[Item], Result], items: Iterable[Item], unit: str = "") -> Iterable[Result]:
    """Return the results of all items in their order; unit: what a bar that shows how far they are calls them.

    As `pool.map`, but for Ctrl-C: that would cancel what runs, and Python 3.11 fails on it when its processes end.
    """
    coming = [pool.submit(work, item) for item in items]
    done = map(_result, coming)
    return progress_bar(len(coming), unit, iterable=done) if unit else done


def _result(future: Future[Result]) -> Result:
    """Return a result once it is there; on Windows, Ctrl-C has its effect only between two short waits."""
    while not wait([future], 0.2).done:
        pass
    return future.result()


def _context() -> BaseContext:
    """Return how the processes are started: on Linux as copies of one that has only imported what renders.

    A copy of this process could wait for ever for a lock that one of its threads held, as torch's and OpenCV's do.
    """
    context = multiprocessing.get_context("forkserver" if sys.platform == "linux" else None)
    context.set_forkserver_preload(["simulator.record"])
    return context


def begin(on_interrupt: signal.Handlers) -> None:
    """Let a process handle Ctrl-C so, and end together with the one that started it, even if that is killed."""
    signal.signal(signal.SIGINT, on_interrupt)
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _dask(address: str, stack: ExitStack) -> Executor:
    try:
        from distributed import Client  # an optional library
    except ImportError as error:
        raise UserError(f"{error}; pip install distributed") from None
    try:
        client = stack.enter_context(Client(address))
        client.wait_for_workers(1, timeout=WAIT)  # without: a scheduler alone is waited for for ever
    except (OSError, ValueError) as error:
        remedy = "start `dask scheduler`, and on each machine `dask worker` with its address"
        raise UserError(f"{address}: {error}; {remedy}") from None
    executor = client.get_executor(pure=False)
    stack.callback(executor.shutdown, wait=False)
    return executor
