"""Stop a run by a signal: the run can save its state before it ends."""

import signal
from types import FrameType

# Windows cannot send SIGTERM, and other systems may lack it.
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM") if hasattr(signal, name)]


class Interrupted(Exception):
    """The run was asked to stop and has saved its state; args[0] is the number of the signal."""


class StopSignals:
    """A context in which Ctrl-C (SIGINT) and SIGTERM are noted; a second signal raises KeyboardInterrupt.

    received  the number of the signal, 0 without one
    """

    def __init__(self) -> None:
        """Install no handlers yet; entering the context does."""
        self.received = 0

    def __enter__(self) -> "StopSignals":
        self._handlers = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        if self.received:
            raise KeyboardInterrupt
        self.received = number
