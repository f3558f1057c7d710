"""How far a long job is: a bar on a terminal, and elsewhere, as in a log file, a line now and then."""

import sys
import threading
import time
from typing import Any

from tqdm import tqdm

LINE_SECONDS = 30.0  # between two lines
LINE = "{desc}{percentage:3.0f} %, {n_fmt}/{total_fmt} {unit}, {elapsed} since the start, {remaining} left{postfix}"


class Bar(tqdm):
    """A progress bar whose times do not change with the system's clock."""

    monitor_interval = 0  # tqdm's thread would compare them with the clock
    # tqdm's own is for processes, too, and where they are not forked (macOS, Python 3.14) Python tells of a leak at the
    # end of a process that ends at once.
    _lock = threading.RLock()
    _time = property(lambda _: time.monotonic, lambda _, clock: None)  # tqdm sets it to time.time

    def update(self, n: float | None = 1) -> bool | None:
        """Count n more; what goes beyond the total raises it, as tqdm would then show neither it nor the share."""
        self.total = max(self.total or 0, self.n + (n or 0))
        return super().update(n)


class Lines(Bar):
    """A progress bar that is printed as a line every LINE_SECONDS."""

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Print the line, or `msg` if it is not empty; pos: unused."""
        if msg != "":  # that clears a bar
            print((msg or str(self)).strip(), file=sys.stderr, flush=True)


def progress_bar(total: int, unit: str, hidden: bool = False, **options: Any) -> tqdm:
    """Return a progress bar of tqdm on stderr; unit: one of what is counted; options: more of tqdm's."""
    options["miniters"] = 1  # each update looks at the time
    if sys.stderr.isatty() or hidden:
        return Bar(total=total, unit=unit, disable=hidden, **options)
    every: dict[str, Any] = {"delay": LINE_SECONDS, "mininterval": LINE_SECONDS, "maxinterval": LINE_SECONDS}
    several = unit if unit == "m" else f"{unit}s"
    return Lines(total=total, unit=several, bar_format=LINE, **{**options, **every, "leave": False})
