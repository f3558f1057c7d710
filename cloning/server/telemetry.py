"""Read the simulator's telemetry, with numbers in the format of any .NET culture, and write numbers that it reads."""

import base64
import math
import re
import unicodedata
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from cloning.recordings.images import decode
from cloning.wire.protocol import MAX_NAME, STAND_IN, Place

MAX_MESSAGE = 1 << 17  # bytes; a telemetry message has about 16,000
MISSING = "is missing, which the simulator of term 1 sends"
UNREADABLE = object()  # what the server gives for a telemetry that is too long, not JSON or in several parts
NUMERIC_FIELDS = ("steering_angle", "throttle", "speed")  # degrees, -1..1, mph; the first two as applied at the moment

# The simulator formats with "N4" of the machine's culture. Mono 6.8 writes -12.3456 as `12.3456-` in 16 Arabic cultures
# (ar-SA), `- 12.3456` in km-KH and pa-Arab-PK, `- 12,3456` in hr-HR, and 30.5 as `30/5000` in fa-IR. Newer runtimes
# also use U+2212 as minus sign and U+066B as decimal separator. "N4" always writes decimals: the last separator is the
# decimal one, and a separator before it groups digits.
NUMBER = re.compile(
    r"(?P<before>[-+(\u2212]?) ?"
    r"(?P<whole>\d+(?:[.,'\s\u2019\u066c]\d{2,3})*?)"
    r"(?:(?P<separator>[.,/\u066b])(?P<decimals>\d+))?(?P<exponent>[eE][-+]?\d+)?"
    r" ?(?P<after>[-)\u2212]?)"
)
SIGNS = {"": 1, "+": 1, "-": -1, "()": -1}  # by the characters before and after a number
MAX_LENGTH = 40  # characters of a number
LARGEST = 1e6  # m or s in a place: no road and no drive is longer


class UnusableTelemetry(ValueError):
    """Telemetry that lacks what driving needs; the message is the reason."""


@dataclass(frozen=True)
class Telemetry:
    """The part of a telemetry message that driving and its page need."""

    jpeg: bytes  # the image as received
    image: np.ndarray  # decoded: uint8 (160, 320, 3), RGB
    speed: float  # mph
    cte: float | None  # m from the lane's centre, which some simulators tell, in their own sign; None if it is unusable
    place: Place | None  # which only the stand-in simulator tells
    time: float | None  # s by the simulator's own clock, likewise, also without a place


def parse_telemetry(message: object) -> Telemetry:
    """Read the image, the speed and the distance from the centre out of a telemetry message.

    message: the decoded JSON, or UNREADABLE. Other fields are ignored. Raises UnusableTelemetry.
    """
    speed = parse_speed(message)
    assert isinstance(message, dict), "a message with a speed is one"
    if "image" not in message:
        raise UnusableTelemetry(f"image {MISSING}")
    try:
        cte, _ = parse_number(message.get("cte"))
    except ValueError:
        cte = None
    try:
        jpeg = base64.b64decode(message["image"], validate=True)
    except (TypeError, ValueError) as error:
        raise UnusableTelemetry("the image is not base64") from error
    try:
        told = message.get(STAND_IN)
        return Telemetry(jpeg, decode(jpeg), speed, cte, parse_place(told), parse_time(told))
    except ValueError as error:
        raise UnusableTelemetry(f"the image is unusable: {error}") from error


def parse_speed(message: object) -> float:
    """Return the speed in a telemetry message, mph, whatever its image is. Raises UnusableTelemetry."""
    if message is UNREADABLE:
        raise UnusableTelemetry(
            f"its JSON is incomplete, it is longer than {MAX_MESSAGE} bytes, or its image is sent as bytes, "
            "not as base64 text"
        )
    if not isinstance(message, dict):
        raise UnusableTelemetry("it is not a JSON object")
    if "speed" not in message:
        raise UnusableTelemetry(f"speed {MISSING}")
    try:
        return parse_number(message["speed"])[0]
    except ValueError as error:
        raise UnusableTelemetry("speed is not a number") from error


def parse_place(told: object) -> Place | None:
    """Return what the stand-in simulator tells of its car's place; None if it is not exactly that."""
    if not isinstance(told, dict) or set(told) != {each.name for each in fields(Place)}:
        return None
    place = Place(**told)
    usable = all(map(_usable, (place.x, place.y, place.offset, place.departures, place.time)))
    return place if usable and type(place.track) is str and len(place.track) <= MAX_NAME else None


def parse_time(told: object) -> float | None:
    """Return the time that the stand-in simulator tells, s; None if it tells none."""
    time = told.get("time") if isinstance(told, dict) else None
    return time if _usable(time) else None


def _usable(number: Any) -> bool:
    return type(number) in (int, float) and abs(number) <= LARGEST  # False for nan


def parse_number(written: object) -> tuple[float, str]:
    """Return a finite number and its decimal separator ("" if it has no decimals).

    Raises ValueError for anything that no .NET culture writes for a finite number.
    """
    text = str(written)
    if len(text) > MAX_LENGTH:
        raise ValueError("too long for a number")
    # Arabic, Hebrew and Persian cultures write invisible direction marks next to the minus sign.
    match = NUMBER.fullmatch("".join(character for character in text if unicodedata.category(character) != "Cf"))
    if not match:
        raise ValueError("not a number")
    sign = SIGNS.get((match["before"] + match["after"]).replace("\u2212", "-"))
    separator = match["separator"] or ""
    if sign is None or (separator and separator in match["whole"]):  # -1-, 1,000,000
        raise ValueError("not a number")
    whole = re.sub(r"\D", "", match["whole"])
    value = sign * float(f"{whole}.{match['decimals'] or 0}{match['exponent'] or ''}")
    if not math.isfinite(value):
        raise ValueError("not finite")
    return value, separator


def decimal_separator(message: object, previous: str) -> str:
    """Return the decimal separator of a telemetry message, the only one that its simulator understands.

    previous: returned for a message whose numbers cannot be read or have no decimals.
    """
    if not isinstance(message, dict):
        return previous
    for key in NUMERIC_FIELDS:
        try:
            _, separator = parse_number(message.get(key))
        except ValueError:
            continue
        if separator:
            return separator
    return previous


def format_number(value: float | np.floating, separator: str = ".") -> str:
    """Return a number as the simulator reads it: without exponent, and exact for a float32."""
    return np.format_float_positional(np.float32(value), trim="-").replace(".", separator)
