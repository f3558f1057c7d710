"""Telemetry as the simulator writes it in other cultures, against what Mono and .NET write there."""

import numpy as np
import pytest

from cloning.server.telemetry import decimal_separator, format_number, parse_number

# -12.3456 with the format "N4", as Mono 6.8 writes it (ar-SA … sv-SE) or a newer runtime does.
WRITTEN = {
    "en-US": ("-12.3456", "."),
    "de-DE": ("-12,3456", ","),
    "ar-SA": ("12.3456-", "."),
    "km-KH": ("- 12.3456", "."),
    "hr-HR": ("- 12,3456", ","),
    "fa-IR": ("-12/3456", "/"),
    "fa-IR, minus behind": ("12/3456-", "/"),
    "sv-SE": ("\u221212,3456", ","),
    "fa-IR, newer": ("\u200e\u221212\u066b3456", "\u066b"),
    "ar-SA, newer": ("\u061c-12.3456", "."),
    "digits of its own": ("-\u06f1\u06f2\u066b\u06f3\u06f4\u06f5\u06f6", "\u066b"),
    "minus behind, apart": ("12,3456 -", ","),
    "in parentheses": ("(12.3456)", "."),
}
OTHERS = [
    *(("30/5000", 30.5, "/"), ("0.0000", 0.0, "."), ("0,2000", 0.2, ","), ("7", 7.0, ""), ("6,500", 6.5, ",")),
    *((6.5, 6.5, "."), (-7, -7.0, ""), ("1e-05", 1e-5, "")),  # JSON numbers, of clients other than the simulator
    *(("1,234.5678", 1234.5678, "."), ("1.234,5678", 1234.5678, ","), ("1 234,5678", 1234.5678, ",")),
    *(("1\u00a0234,5678", 1234.5678, ","), ("1\u202f234,5678", 1234.5678, ","), ("1\u2019234.5678", 1234.5678, ".")),
    *(("12,34,567.8000", 1234567.8, "."), ("1\u066c234\u066b5678", 1234.5678, "\u066b")),
]


@pytest.mark.parametrize(
    "written, value, separator", [*((written, -12.3456, separator) for written, separator in WRITTEN.values()), *OTHERS]
)
def test_numbers_of_every_culture(written, value, separator):
    assert parse_number(written) == (value, separator)


@pytest.mark.parametrize(
    "written",
    [
        *("", "-", ".", "fast", "NaN", "Infinity", "-\u221e", "1e999", "1.2.3", "1,000,000", "1 2", "1" * 1000),
        *("--1", "-1-", "(1", "1)", "1e", "0x1F", None, True, [0], {}),
    ],
)
def test_anything_else_is_not_a_number(written):
    with pytest.raises(ValueError):
        parse_number(written)


@pytest.mark.parametrize("value", [1e-7, -3e-5, 0.1, -1.0, 123456.0, 0.0])
@pytest.mark.parametrize("separator", [".", ",", "/", "\u066b"])
def test_numbers_are_written_without_exponent_and_exactly(value, separator):
    written = format_number(np.float32(value), separator)
    assert "e" not in written
    assert np.float32(written.replace(separator, ".")) == np.float32(value)


def test_the_separator_is_that_of_the_first_number_with_decimals():
    assert decimal_separator({"steering_angle": "12/3456-", "throttle": "0/2000"}, ".") == "/"
    assert decimal_separator({"steering_angle": "left", "throttle": "1", "speed": "6,5000"}, ".") == ","
    for message in ({}, [1.5], None, {"speed": "fast"}, {"speed": "7"}):
        assert decimal_separator(message, ",") == ","
