"""How far a network's car drifts from the driver's path in two seconds: a quick replay, which needs no lane.

The car begins where the driver's was, and goes where the network steers it by what it then sees. A loss compares
steering on the driver's path only; here errors add up, and steering back counts. writeup_report.md says how well both
foretell the driving.
"""

import math
from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np

from cloning.errors import SimulatorError
from cloning.lane.recovery import LaneAhead
from cloning.pilot.network import Network
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording
from cloning.replay.drivers import ModelDriver
from cloning.replay.replay import ReferenceLine, drive
from cloning.road.motion import Stretch, stretches

SECONDS = 2.0  # as long as the stretches that model.py validates with
ROWS, LEAST_ROWS = round(SECONDS * SAMPLE_RATE), round(0.75 * SECONDS * SAMPLE_RATE)  # of a piece
MOST_PIECES = 32  # a minute of driving

Piece = tuple[Recording, ReferenceLine]


def pieces(recordings: Sequence[Recording], recording: np.ndarray, row: np.ndarray) -> list[Piece]:
    """Return the pieces of SECONDS of the driver's path that some rows cover, at most MOST_PIECES, evenly chosen.

    recording: int (n,), indices into recordings; row: int (n,), the rows, of which some may be missing in between.
    There are none where the rows are too few, or the car stands still.
    """
    found = []
    for number, whole in enumerate(recordings):
        rows = np.unique(row[recording == number])
        drives = stretches(whole)
        for group in np.split(rows, np.flatnonzero(np.abs(np.diff(whole.time[rows])) > SECONDS) + 1):
            for driven in drives if len(group) else ():
                start, end = max(driven.rows.start, int(group[0])), min(driven.rows.stop, int(group[-1]) + 1)
                for at in range(start, end - LEAST_ROWS + 1, ROWS):
                    found.append((whole, _line(whole, slice(at, min(at + ROWS, end)))))
    chosen = np.linspace(0, len(found) - 1, min(len(found), MOST_PIECES)).round().astype(int)
    return [found[number] for number in chosen]


def _line(recording: Recording, rows: slice) -> ReferenceLine:
    """Return the driver's path in these rows."""
    stretch = Stretch.of(recording, rows)
    zeros = np.zeros(len(stretch))
    ahead = LaneAhead.of_stretch(stretch, zeros, zeros.astype(bool)).extended()
    return ReferenceLine(stretch, zeros, zeros, is_lane_centre=False, ahead=ahead)


def drifts(driven: Sequence[Piece], network: Network, pool: Executor) -> np.ndarray:
    """Return how far the network's car and the recorded one are apart at each piece's end: float64 (n,), m.

    nan for a network that computes no finite number. pool: its threads share the work. Raises RecordingError.
    """
    driver = ModelDriver(network)

    def end(piece: Piece) -> float:
        recording, line = piece
        try:
            return abs(drive(recording, [line], math.inf, driver).offset_from_human[-1])
        except SimulatorError:
            return math.nan

    return np.array(list(pool.map(end, driven)), float)


def still_drifts(driven: Sequence[Piece]) -> np.ndarray:
    """Return what `drifts` does for a car whose wheels always point straight ahead."""
    ends = [drive(recording, [line], math.inf, lambda _: 0.0).offset_from_human[-1] for recording, line in driven]
    return np.abs(ends)
