"""How a run ends: stopped by a signal, after it has saved its state, or by an error, with what the user can do."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import torch

from cloning.base import program
from cloning.base.errors import UserError, message_of
from cloning.training.distributed import Ranks
from cloning.training.options import Process
from cloning.training.run_files import RunFiles

# Windows cannot send SIGTERM and has no SIGHUP, and other systems may lack them.
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGHUP", "SIGTERM") if hasattr(signal, name)]

# A GPU that is too old, too small or gone since the machine slept, or for which torch lacks an operator.
OF_THE_GPU = torch.AcceleratorError, torch.OutOfMemoryError, NotImplementedError


class Interrupted(Exception):
    """The run was asked to stop and has saved its state; args[0] is the number of the signal."""


class StopSignals:
    """A context in which SIGNALS are noted; after one, Ctrl-C or SIGTERM raises KeyboardInterrupt.

    SIGHUP is that of a closed terminal; what is printed after it is lost. What the process ignores already, as after
    `nohup`, it still does. Only a process's main thread may note signals; in others, as of a sweep, there are none.
    """

    def __init__(self) -> None:
        self.received = 0  # the number of the signal, 0 without one
        self._waiting = False

    def __enter__(self) -> "StopSignals":
        self._terminals = [file for file in (1, 2) if os.isatty(file)]
        here = SIGNALS if threading.current_thread() is threading.main_thread() else []
        noted = [number for number in here if signal.getsignal(number) is not signal.SIG_IGN]
        self._handlers = {number: signal.signal(number, self._note) for number in noted}
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """Raise Interrupted for a signal that came when all was done but what the last epoch saves."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self.received and not error:
            raise Interrupted(self.received)

    def _note(self, number: int, _: FrameType | None) -> None:
        if number == getattr(signal, "SIGHUP", None):  # printing would fail, before the state is saved
            with open(os.devnull, "w") as nowhere:
                for file in self._terminals:
                    os.dup2(nowhere.fileno(), file)
        if self.received and number != getattr(signal, "SIGHUP", None):  # which may come twice
            raise KeyboardInterrupt
        self.received = self.received or number
        if self._waiting:
            self._waiting = False
            raise Interrupted(number)

    @contextmanager
    def at_once(self, save: Callable[[], None], alone: bool) -> Iterator[None]:
        """A context that takes long; a signal saves and raises Interrupted, if no other rank waits for this one."""
        self._waiting = alone
        try:
            if alone and self.received:
                raise Interrupted(self.received)
            yield
        except Interrupted:
            self._waiting = False  # a second SIGHUP does not end `save`
            save()
            raise
        finally:
            self._waiting = False


def status_of(work: Callable[[], None], process: Process, ranks: Ranks) -> int:
    """Do the work of a run, say on stderr what ended it; return 0, 2 after an error, 128 + signal if stopped."""
    files, status, message = RunFiles(process.output), 0, ""
    before = files.state()

    def next_step() -> str:
        # Until the run has saved a state, --resume would continue an earlier run.
        is_its_own = process.resume or files.state() != before
        return "continue with --resume" if is_its_own else "start the run again"

    try:
        process.check()
        with files.claimed(ranks):
            work()
    except UserError as error:
        status, message = 2, str(error)
    except OSError as error:
        remedy = f"all earlier files are intact. Remove the cause and {next_step()}"
        status, message = 2, f"{message_of(error)}; {remedy}"
    except OF_THE_GPU as error:
        told, _, _ = str(error).partition("\n")
        remedy = f"leave the GPU out with --device cpu, and {next_step()}"
        status, message = 2, f"{told}; {remedy}"
    except Interrupted as error:
        status, message = 128 + error.args[0], "stopped and saved; continue with --resume"
    except KeyboardInterrupt:
        status, message = 128 + SIGNALS[0], f"stopped at once; {next_step()}"
    if message and (ranks.first or status == 2):  # the other ranks' errors are their own
        print(program.in_commands(f"{program.name}: {message}"), file=sys.stderr)
    return status
