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
    "option", ["--laps=0", "--laps=1e18", "--port=0", "--port=-1", "--port=70000", "--host=", "--host= ", "--wait=-1"]
)
def test_the_simulator_refuses_it_before_it_connects(option, capsys):
    with pytest.raises(SystemExit) as exited:
        parse_arguments(["drive", option])
    assert exited.value.code == 2
    assert f"argument {option.partition('=')[0]}: " in capsys.readouterr().err
