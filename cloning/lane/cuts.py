"""Finds where a recording's frames are cut: from one row to the next, the cameras see something else.

Then the car was put somewhere else, or the rows after it are another road's, whatever the time stamps say. What is seen
by a car that moves changes gradually; in shade, or at a bridge, in some parts of the frames or in successive rows.
"""

import itertools
from collections.abc import Callable

import cv2
import numpy as np

from cloning.lane.reader import STRIP_SHAPE
from cloning.recordings.log import Recording
from cloning.road.motion import MIN_STRETCH_ROWS, Stretch

BLOCKS = (4, 8)  # rows and columns of equal parts of a strip, whose mean colours are compared
SHARE = 0.3  # of the blocks of all cameras: from one row to the next, so many change by no more than the row's change
NEAR = 5  # rows before and after, with whose changes one is compared
# A row's change relative to the greatest near it. In 10,000 rows of four real and two rendered recordings it is at most
# 1.48; where rows of two of them meet, it is below 1.7 once in 200 times.
CUT = 1.7
STILL = 1.0  # grey levels, added to the greatest change near a row: where the car hardly moves, noise is no cut
ROWS_AT_ONCE = 256


def block_colours(strips: np.ndarray) -> np.ndarray:
    """Return the mean colours of parts of strips, uint8 (n, 3, 32, 160, 3): float32 (n, 96, 3)."""
    n, cameras = strips.shape[:2]
    rows, columns = BLOCKS
    # All strips as one image, one below the other, so that OpenCV is called once for all.
    tall = strips.reshape(-1, *STRIP_SHAPE[1:])
    means = cv2.resize(tall, (columns, n * cameras * rows), interpolation=cv2.INTER_AREA)
    return means.reshape(n, -1, 3).astype(np.float32)


def find_cuts(colours: np.ndarray) -> np.ndarray:
    """Return whether the frames are cut before each row but the first: bool (n - 1,); colours: of `block_colours`."""
    change = np.quantile(np.abs(np.diff(colours, axis=0)).mean(2), SHARE, axis=1)
    padded = np.pad(change, NEAR)
    near = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR + 1).copy()
    near[:, NEAR] = 0
    return change > CUT * (near.max(1) + STILL)


def split_at_cuts(
    recording: Recording, stretches: list[Stretch], strips: Callable[[slice], np.ndarray]
) -> list[Stretch]:
    """Return the stretches of a recording, split where its frames are cut; each is at least 2 s long.

    strips: returns those of the three cameras in rows of the recording. Raises RecordingError for unreadable images.
    """
    whole = []
    for stretch in stretches:
        first, end = stretch.rows.start, stretch.rows.stop
        starts = range(first, end, ROWS_AT_ONCE)
        pieces = [block_colours(strips(slice(start, min(start + ROWS_AT_ONCE, end)))) for start in starts]
        cuts = first + 1 + np.flatnonzero(find_cuts(np.concatenate(pieces)))
        edges = [first, *cuts.tolist(), end]
        rows = [slice(*each) for each in itertools.pairwise(edges) if each[1] - each[0] >= MIN_STRETCH_ROWS]
        whole += [Stretch.of(recording, each) for each in rows]
    return whole
