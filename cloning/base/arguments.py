"""Types for argparse, so that every command refuses an impossible number or address in the same words."""

import argparse
import math
from collections.abc import Callable
from typing import TypeVar

from cloning.base.program import in_commands

Number = TypeVar("Number", int, float)
MAX_PORT = 65535


def command_line(name: str | None, documentation: str | None, epilog: str | None = None) -> argparse.ArgumentParser:
    """Return a command's parser, whose help begins with the command's docstring and ends with the epilog.

    name: as a clone's user starts it, such as `python -m cloning.browse`; None: the name of the file.
    """
    name, words = name and in_commands(name), in_commands(documentation or "")
    raw = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(name, description=words, epilog=epilog, formatter_class=raw)


def number(read: Callable[[str], Number], least: float = -math.inf, most: float = math.inf) -> Callable[[str], Number]:
    """Return a type for argparse: a finite number from `least` to `most`.

    read: returns the number in the text, such as `int`, and raises ValueError or ArithmeticError if it is none.
    """
    limits = f" of at least {least:g}" if least > -math.inf else ""
    limits += f" and at most {most:g}" if most < math.inf else ""
    wanted = ("a whole number" if read is int else "a finite number") + limits

    def parse(text: str) -> Number:
        try:
            value = read(text)
        except (ValueError, ArithmeticError):
            value = None
        if value is None or not least <= value <= most or value in (-math.inf, math.inf):
            raise argparse.ArgumentTypeError(f"{text[:40]} is not {wanted}")
        return value

    return parse


def ratio(text: str) -> float:
    """Return the value of a number or a fraction such as 30000/1001. Raises ValueError, ZeroDivisionError."""
    numerator, slash, denominator = text.partition("/")
    return float(numerator) / (float(denominator) if slash else 1)


def address(text: str) -> str:
    """Return a host name or address; an empty one would stand for every network that this machine is in."""
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty; name an address, such as 127.0.0.1")
    return text
