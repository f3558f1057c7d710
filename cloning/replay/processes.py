"""Drives of a recording in processes of their own: in threads, they would wait for one another's Python code."""

import multiprocessing
import signal
import sys
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Self

from cloning.base.errors import SimulatorError, UserError
from cloning.base.processes import interrupt_deferred
from cloning.replay.replay import Drive

CAN_FORK = sys.platform == "linux"  # elsewhere there is no fork, or libraries do not survive it


class ForkedDrives:
    """Drives that run in forked processes, one each; a context, at whose end none of them runs any more."""

    def __init__(self, drives: Sequence[Callable[[], Drive]]):
        """Start them; what they change in memory is lost, but for the Drive that each returns."""
        context = multiprocessing.get_context("fork")
        self.processes: list[BaseProcess] = []
        self.pending: dict[Connection, int] = {}  # where a drive's result will come from -> its index
        self.results: dict[int, Drive] = {}
        try:
            with interrupt_deferred():
                for index, drive in enumerate(drives):
                    receiver, sender = context.Pipe(duplex=False)
                    process = context.Process(target=_send_result, args=(drive, sender), daemon=True)
                    process.start()
                    sender.close()
                    self.processes.append(process)
                    self.pending[receiver] = index
        except KeyboardInterrupt:
            self.__exit__()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes:
            process.terminate()
        for process in self.processes:
            process.join()

    def collect(self, timeout: float | None) -> None:
        """Take the results that have come, and wait for the others: for the next one so many seconds, None: for all.

        Raises the UserError of a drive that failed, and SimulatorError if its process ended without a result.
        """
        while self.pending and (ready := wait(self.pending, timeout)):
            for receiver in ready:
                assert isinstance(receiver, Connection)
                try:
                    result = receiver.recv()
                except EOFError:
                    raise SimulatorError("the process of a drive was killed, or failed with the error above") from None
                if isinstance(result, UserError):
                    raise result
                self.results[self.pending.pop(receiver)] = result


def _send_result(drive: Callable[[], Drive], sender: Connection) -> None:
    """Send what a drive returns, or the UserError that it raises."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        sender.send(drive())
    except UserError as error:
        sender.send(error)
