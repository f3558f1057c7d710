"""Trainings that other programs call: their settings change no weights, and are as they were afterwards."""

from dataclasses import replace
from typing import Any

import pytest

from model import REPORT


@pytest.mark.parametrize("figure", [{"dropout": 0.2}, {"batch_size": 8.0}, {"learning_rate": "1e-3"}])
def test_figures_of_another_type_are_refused(figure: dict[str, Any]):
    with pytest.raises(ValueError, match=f"{next(iter(figure))} is .*, not of type"):
        replace(REPORT, **figure)


def test_lists_as_of_a_file_are_ranges():
    ranges: dict[str, Any] = {"brightness": [0.4, 1.2]}
    assert replace(REPORT, **ranges) == REPORT
