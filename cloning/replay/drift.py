"""How far a network's car is from where it should be after two seconds: a quick replay, for each epoch of a training.

The car begins where the driver's was, and goes where the network steers it by what it then sees. A loss compares
steering on the driver's path only; here errors add up, and steering back counts: see writeup_report.md.
"""

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from cloning.base.errors import SimulatorError
from cloning.network.network import Network
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import Driver, ReferenceLine, drive
from cloning.road.motion import Stretch, stretch_rows

SECONDS = 2.0  # as long as the stretches that model.py validates with
ROWS, LEAST_ROWS = round(SECONDS * SAMPLE_RATE), round(0.75 * SECONDS * SAMPLE_RATE)  # of a piece
MOST_PIECES = 32  # a minute of driving


class Piece(NamedTuple):
    """A piece of a recording."""

    recording: Recording
    line: ReferenceLine  # the driver's path
    aim: float  # m from the driver's car at the piece's end to where the network's should be, right positive

    def drift(self, driver: Driver) -> float:
        """Return how far from where it should be a driver's car is at the end, m. Raises what the driver raises."""
        return abs(drive(self.recording, [self.line], math.inf, driver).offset_from_human[-1] - self.aim)


def held_out(recordings: Sequence[Recording], recording: np.ndarray, row: np.ndarray, aim: np.ndarray) -> list[Piece]:
    """Return the pieces of SECONDS of the driver's path that some rows cover, at most MOST_PIECES, evenly chosen.

    recording: int (n,), indices into recordings; row: int (n,), the rows, of which some may be missing in between; aim:
    float (n,), m from the driver's car to where the network's should be, right positive. There are no pieces where the
    rows are too few, or the car stands still.
    """
    found = []
    for index, each in enumerate(recordings):
        originals = each.originals()
        whole, numbers = each.take(originals), np.searchsorted(originals, row[recording == index], "right") - 1
        rows, first = np.unique(numbers, return_index=True)
        aims = aim[recording == index][first]
        drives = stretch_rows(whole)
        for group in np.split(rows, np.flatnonzero(np.abs(np.diff(whole.time[rows])) > SECONDS) + 1):
            for driven in drives if len(group) else ():
                start, end = max(driven.start, int(group[0])), min(driven.stop, int(group[-1]) + 1)
                for at in range(start, end - LEAST_ROWS + 1, ROWS):
                    stop = min(at + ROWS, end)
                    last = np.searchsorted(rows, stop - 1, "right") - 1  # or the row before, if that one is missing
                    found.append((whole, slice(at, stop), float(aims[last])))
    chosen = np.linspace(0, len(found) - 1, min(len(found), MOST_PIECES)).round().astype(int)
    return [
        Piece(whole, ReferenceLine.human_path(Stretch.of(whole, rows)), aim_there)
        for whole, rows, aim_there in (found[index] for index in chosen)
    ]


def drifts(driven: Sequence[Piece], network: Network, pool: Executor) -> np.ndarray:
    """Return how far from where it should be the network's car is at each piece's end: float64 (n,), m.

    nan for a network that computes no finite number. pool: its threads share the work. Raises RecordingError.
    """
    driver = ModelDriver(network)

    def drift(piece: Piece) -> float:
        try:
            return piece.drift(driver)
        except SimulatorError:
            return math.nan

    return np.array(list(pool.map(drift, driven)), float)


def still_drifts(driven: Sequence[Piece]) -> np.ndarray:
    """Return what `drifts` does for a car whose wheels always point straight ahead."""
    return np.array([piece.drift(lambda _: 0.0) for piece in driven])
