"""The line in drive.py's terminal that says how a car drives."""

import itertools
import statistics
import time

from cloning.server.page import Server, Session
from cloning.server.terminal import Unblocked


class StatusLine:
    """Prints a line about the watched session: every half second on a terminal, every minute to a file."""

    def __init__(self, server: Server, stderr: Unblocked):
        """stderr: where each line replaces the last one if it is a terminal."""
        self.server, self.stderr = server, stderr
        self.period = 0.5 if stderr.is_terminal else 60.0  # s
        self.session: Session | None = None
        self.frames, self.time = 0, time.perf_counter()  # at the last line

    def update(self) -> None:
        """Print the line if it is due."""
        now = time.perf_counter()
        if now < self.time + self.period:
            return
        session = self.server.watched_session()
        if session and session.driven and not session.ended:
            line = self.text(session, now)
            self.stderr.write(f"\r{line}\033[K" if self.stderr.is_terminal else f"{line}\n")
        self.session, self.time, self.frames = session, now, session.driven if session else 0

    def text(self, session: Session, now: float) -> str:
        """Return the line: means since the last line or the session's start, and the last frame's figures.

        now: time.perf_counter().
        """
        frames, since = (self.frames, self.time) if session is self.session else (0, session.started)
        rate = (session.driven - frames) / max(now - since, 1e-3)
        recent = list(itertools.islice(reversed(session.history), max(session.driven - frames, 1)))
        latency, last = statistics.fmean(frame.latency for frame in recent), recent[0]
        line = (
            f"{rate:5.1f} frames/s, {latency:5.1f} ms in drive.py, steering {last.steering:+.2f}, "
            f"{last.speed:4.1f} mph, {session.driven} frames"
        )
        return f"{line}, {session.unusable} unusable" if session.unusable else line
