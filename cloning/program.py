"""How a command prints and ends: after Ctrl-C with a message and without a traceback, at any moment.

A command calls `end_on_interrupt` before it imports large libraries, and `run` at the end of its file.
"""

import io
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import NoReturn


def end_on_interrupt(program: str, message: str = "stopped") -> None:
    """Make Ctrl-C print this message and end the process at once, with status 130.

    An exception would not do: libraries that are interrupted while they load turn it into errors of their own.
    """

    def stop(number: int, _: FrameType | None) -> None:
        print(f"{program}: {message}", file=sys.stderr, flush=True)
        os._exit(128 + number)

    # A shell has its background processes ignore Ctrl-C; leave it so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, stop)


def run(main: Callable[[], int | None]) -> NoReturn:
    """Run a command's main function and end with its exit status; Ctrl-C raises KeyboardInterrupt only in `main`.

    Characters that stdout cannot show, such as undecodable bytes of a file's name, are printed as escapes there.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    stop = signal.getsignal(signal.SIGINT)
    if callable(stop):
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        status = main()
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, stop)
        sys.stdout.flush()
        status = 128 + signal.SIGINT
        if callable(stop):
            stop(signal.SIGINT, None)
    finally:
        signal.signal(signal.SIGINT, stop)
    sys.exit(status)
