"""Share the server's one thread: one piece of work at a time, and whoever has worked least goes first.

eventlet goes round all connections that have something to do: beside a hundred busy ones, a car would wait for each of
them, several times for each telemetry.
"""

import time
from typing import Any

from cloning.server.libraries import eventlet


class Account:
    """The work of one connection, or of several that share one account."""

    used = 0.0  # s; only differences between accounts count


class Turns:
    """Gives turns: the right to work until the next wait for the network, and no longer than a few milliseconds.

    This is start-time fair queueing: a client that sends a telemetry now and then goes before others that always have
    work, however many they are; and nobody saves up time by being idle.
    """

    def __init__(self) -> None:
        self.clock = 0.0  # what the account at work had used when its turn began
        self.waiting: list[tuple[Account, Any]] = []  # in the order of arrival, each with the event that ends its wait
        self.working: Account | None = None
        self.passing_on = False  # whether the hub is to call `_pass_on`
        self.began, self.price = 0.0, 1.0  # time.thread_time(); see `take`

    def take(self, account: Account, price: float = 1.0) -> None:
        """Wait for a turn; it ends by itself when this green thread waits or ends.

        price: by which the account is charged for a second of work.
        """
        account.used = max(account.used, self.clock)
        waiter = (account, eventlet.Event())
        self.waiting.append(waiter)
        if not self.passing_on:
            self._schedule()
        try:
            waiter[1].wait()
        except BaseException:  # a timeout, or the end of this thread
            if waiter in self.waiting:
                self.waiting.remove(waiter)
            raise
        self.began, self.price = time.thread_time(), price

    def _pass_on(self) -> None:
        """End a turn and begin the next.

        The hub does this when the one at work has given it the thread back. It asks for new input before it wakes the
        next one.
        """
        self.passing_on = False
        if self.working:
            self.working.used += self.price * (time.thread_time() - self.began)
            self.working = None
        if self.waiting:
            next_one = min(self.waiting, key=lambda waiter: waiter[0].used)
            self.waiting.remove(next_one)
            self.working, self.clock, self.began = next_one[0], next_one[0].used, time.thread_time()
            next_one[1].send()
            self._schedule()

    def _schedule(self) -> None:
        """Let the hub call `_pass_on`, after all that it has to call already."""
        self.passing_on = True
        eventlet.hubs.get_hub().schedule_call_global(0, self._pass_on)


TURNS = Turns()  # of the one thread
STRANGERS = Account()  # of all that is no open session: accepting connections, HTTP requests, the page


def pause(seconds: float) -> None:
    """Let others work for so long, and then wait for a turn among the strangers."""
    eventlet.sleep(seconds)
    TURNS.take(STRANGERS)
