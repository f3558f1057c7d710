"""What a server prints: little, whatever its clients send, and without waiting for a terminal that nobody reads."""

import logging
import queue
import re
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from typing import TextIO

from cloning.base.errors import printable

MAX_WAITING = 100  # texts that wait to be printed; more are dropped
MAX_KINDS = 50  # of warnings
MAX_PER_MINUTE = 200  # lines
MAX_LINE = 1000  # characters, but for its end
LAST_SECONDS = 1.0  # in which what waits at the end is printed


class Unblocked:
    """A text stream that is written to by a thread: where nobody reads, what is printed is lost, and nothing waits."""

    def __init__(self, stream: TextIO):
        self.stream, self.is_terminal = stream, stream.isatty()
        self.texts: queue.Queue[str] = queue.Queue(MAX_WAITING)
        threading.Thread(target=self._print, daemon=True).start()

    def _print(self) -> None:
        while True:
            text = self.texts.get()
            try:
                self.stream.write(text)
                self.stream.flush()
            except OSError:
                return  # the terminal is gone, and what comes next is dropped
            self.texts.task_done()

    def write(self, text: str) -> None:
        """Print a text, unless too many wait already."""
        with suppress(queue.Full):
            self.texts.put_nowait(text)

    def flush(self) -> None:
        """Do nothing: the thread does."""

    def finish(self) -> None:
        """Wait until all is printed, but not for long."""
        until = time.monotonic() + LAST_SECONDS
        while self.texts.unfinished_tasks and time.monotonic() < until:
            time.sleep(0.001)


class Few(logging.Filter):
    """Passes warnings that differ only in numbers once, then the tenth, the hundredth and so on, with their number.

    Each becomes a line of MAX_LINE characters at most: libraries warn in a client's words. Of all lines it passes
    MAX_PER_MINUTE. A record may have an attribute `warned`, a Counter of kinds: a session's records have its own, so
    that each session logs each kind.
    """

    def __init__(self) -> None:
        super().__init__()
        self.warned: Counter[str] = Counter()
        self.minute, self.passed = 0, 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to log a record."""
        if record.levelno >= logging.WARNING and not self._is_news(record):
            return False
        if self.minute != (minute := int(time.monotonic() / 60)):
            self.minute, self.passed = minute, 0
        self.passed += 1
        record.msg, record.args = printable(record.getMessage()).replace("\n", " ")[:MAX_LINE], None
        if self.passed == MAX_PER_MINUTE:
            record.msg = f"{record.msg} (this is the last line of this minute)"
        return self.passed <= MAX_PER_MINUTE

    def _is_news(self, record: logging.LogRecord) -> bool:
        if record.exc_info and record.exc_info[0]:  # a library would print where it met what a client sent
            record.msg = f"{record.msg} ({record.exc_info[0].__name__}: {record.exc_info[1]})"
            record.exc_info = None
        warned: Counter[str] = vars(record).get("warned", self.warned)
        kind = re.sub(r"\b[0-9A-F]{2}\b|[0-9]+", "", str(record.msg))
        if kind not in warned and len(warned) >= MAX_KINDS:
            return False
        warned[kind] += 1
        if warned[kind] > 1:
            record.msg = f"{record.msg} ({warned[kind]} times so far)"
        return bool(re.fullmatch("10*", str(warned[kind])))


def log_to_stderr(program: str) -> Unblocked:
    """Print the log to stderr, each line with the program's name; return the stream, for other lines of a server."""
    stream = Unblocked(sys.stderr)
    handler = logging.StreamHandler(stream)
    handler.addFilter(Few())
    status_line_end = "\r\033[K" if stream.is_terminal else ""
    logging.basicConfig(format=f"{status_line_end}{program}: %(message)s", handlers=[handler])
    return stream
