"""Errors that the user can correct.

The message names the file, the line and the remedy. A command prints it to stderr and ends.
"""

import errno
import re

CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # characters, but for the ends of lines and tabs


class UserError(Exception):
    """An error that the user can correct; the message says what is wrong and what to do."""


class RecordingError(UserError):
    """A recording that cannot be read or written; the message names the file and, where there is one, the line."""


class ModelError(UserError):
    """A model file that cannot be used or resumed."""


class SimulatorError(UserError):
    """The stand-in simulator, its window or its connection cannot continue."""


class TrackError(UserError):
    """A track that does not exist."""


class OutputError(UserError):
    """A file that the user asked for cannot be written."""


def printable(text: str) -> str:
    """Return a text with its control characters as escapes: in someone else's files they may change the terminal."""
    return CONTROL.sub(lambda character: ascii(character[0])[1:-1], text)


def message_of(error: UserError | OSError | MemoryError) -> str:
    """The `printable` message for the user; that of an OSError begins with the file's name, as those of a UserError do.

    When no file can be opened any more, the name is that of any file, and tells nothing.
    """
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        return f"{error.strerror}; end other programs, or raise the limit with `ulimit -n`"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return printable(f"{error.filename}: {error.strerror}")
    return printable(str(error))
