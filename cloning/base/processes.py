"""Processes that a command starts."""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PYTHON = (sys.executable, "-P")  # loads no module from the current folder, which may be full of someone else's files


def environment() -> dict[str, str]:
    """Return the environment variables with which PYTHON finds this project."""
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


@contextmanager
def starting() -> Iterator[None]:
    """A context in which processes are started; Ctrl-C has its effect at its end, and none in the processes.

    Python would ignore an exception from its own code around a fork. What is garbage by then is never collected in a
    copy of this process: to free a film, open or read, is to wait for its threads. A fork copies none, so the copy
    would wait for ever. Call it in the main thread.
    """
    # The processes inherit this: Ctrl-C reaches them too, but only the one that started them is to act on it.
    if sys.platform != "win32":
        from multiprocessing import resource_tracker  # here, because it takes 40 ms

        resource_tracker.ensure_running()  # multiprocessing starts it with the first process, and then unblocks signals
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    received: list[int] = []  # another thread may still receive it
    handler = signal.getsignal(signal.SIGINT)
    if callable(handler):
        signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        if callable(handler):
            signal.signal(signal.SIGINT, handler)
        if received:
            signal.raise_signal(signal.SIGINT)
