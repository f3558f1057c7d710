"""How far a long job is: one line that renews itself on a terminal, a line every so often in a log."""

import sys
import time


class Progress:
    def __init__(self, total: float, unit: str, every: float = 15.0):
        """total, of which `unit` is the name; every: seconds between two lines of a log."""
        terminal = sys.stderr.isatty()
        self.total, self.unit, self.every = total, unit, 0.2 if terminal else every
        self.end = "\r" if terminal else "\n"
        self.begin = self.shown = time.monotonic()

    def show(self, done: float, simulated: float, note: str = "") -> None:
        """done: of the total; simulated: seconds of simulated time so far."""
        now = time.monotonic()
        if now - self.shown < self.every:
            return
        self.shown = now
        self._line(done, simulated, note, self.end)

    def _line(self, done, simulated, note, end):
        wall = max(time.monotonic() - self.begin, 1e-3)
        left = wall * (self.total - done) / done if done > 0 else float("nan")
        pace = f"{simulated / wall:.1f} times real time, {left:.0f} s left"
        print(f"{done:.1f} of {self.total:g} {self.unit}, {pace}{note}   ", end=end, file=sys.stderr, flush=True)

    def finish(self, done: float, simulated: float) -> float:
        """Returns the wall seconds that it took."""
        self._line(done, simulated, "", "\n")
        return time.monotonic() - self.begin
