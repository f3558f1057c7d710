"""Numbers and addresses on a command line, against what argparse and Python read by themselves."""

import argparse

import pytest

from cloning.base.arguments import address, number, ratio
from simulator.__main__ import parse_arguments

IMPOSSIBLE = ["nan", "inf", "-inf", "1e400", "", "x", "1,5", "9" * 5000]


@pytest.mark.parametrize("text", [*IMPOSSIBLE, "-1", "0", "1001", "0.5"])
def test_a_number_out_of_its_range_is_refused(text):
    for form in (int, float, ratio):
        with pytest.raises(argparse.ArgumentTypeError, match="at least 1 and at most 1000"):
            number(form, 1, 1000)(text)


def test_numbers_in_their_range_are_read():
    assert [number(int, 0, 10)(text) for text in ("0", "10")] == [0, 10]
    assert [number(float)(text) for text in ("-1e300", "0.5")] == [-1e300, 0.5]
    assert number(ratio, 1, 60)("30000/1001") == 30000 / 1001
    assert address("::1") == "::1"


@pytest.mark.parametrize(
    "command",
    [
        *("drive --laps=0", "drive --laps=1e18", "drive --port=0", "drive --port=-1", "drive --port=70000"),
        *("drive --host=", "drive --host=\t", "drive --wait=-1"),
        *("record x --laps=0", "record x --speed=40", "record x --seed=-1"),
    ],
)
def test_the_simulator_refuses_it_before_it_begins(command, capsys):
    with pytest.raises(SystemExit) as exited:
        parse_arguments(command.split(" "))
    option = command.split(" ")[-1]
    assert exited.value.code == 2
    assert f"argument {option.partition('=')[0]}: " in capsys.readouterr().err
