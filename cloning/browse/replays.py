"""Replays for the page: their figures, and what the replayed car sees in each row."""

from typing import Any

import numpy as np

from cloning.browse.analyses import Result, UnknownError
from cloning.recordings.images import encode
from cloning.recordings.log import Recording
from cloning.replay.views import StretchViews
from cloning.road.camera import VIEW_JPEG_QUALITY
from cloning.road.motion import Stretch


def rows_with(images: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the recording's row of each centre image: int64 (k,); images: int (k,).

    centres: int32 (n,), the rows' centre images. Of rows with the same one, which are copies, it is the first.
    """
    first = np.full(max(centres.max(initial=0), images.max(initial=0)) + 1, -1)
    first[centres[::-1]] = np.arange(len(centres))[::-1]
    return first[images]


def figures(result: Result, centres: np.ndarray) -> dict[str, Any]:
    """Return a replay's metrics, its interventions as [row, offset in m], and where the lane is not known.

    The row is the last one before the car is set back, which shows where it went; the first of a line has none. Where
    the lane is not known: [the first row, rows, why]. centres: as in `rows_with`.
    """
    rows = rows_with(result.images, centres)
    where = [[int(rows[index - 1]), metres] for index, metres in result.about["where"]]
    unknown = result.about["unknown"]
    firsts = rows_with(np.array([image for image, *_ in unknown], int), centres).tolist()
    parts = [[row, *more] for row, (_, *more) in zip(firsts, unknown, strict=True)]
    return {**result.about, "where": where, "unknown": parts, "driven": len(rows)}


def index_of(result: Result, image: int) -> int:
    """Return the index of a centre image in the result's columns. Raises UnknownError for a row left out."""
    indices = np.flatnonzero(result.images == image)
    if not len(indices):
        raise UnknownError("not replayed here: cut, an unusable image, off the road, or standing")
    return int(indices[-1])


class LineViews:
    """The views from the replayed car along one reference line, as the model saw them."""

    def __init__(self, recording: Recording, result: Result, line: int):
        """line: its index among the reference lines."""
        indices = np.flatnonzero(result.columns["line"] == line)
        part = recording.take(rows_with(result.images, recording.images[:, 0])[indices])
        self.views = StretchViews(part, Stretch.of(part, slice(0, len(part))))
        self.right, self.yaw = (result.columns[name][indices] for name in ("right", "yaw"))
        self.first = int(indices[0])

    def jpeg(self, index: int) -> bytes:
        """Return the view at an index of the result's columns; at the human driver's pose, the recorded file itself.

        Raises RecordingError if an image became unusable.
        """
        at = index - self.first
        pose = float(self.right[at]), float(self.yaw[at])
        return encode(self.views.view_from(at, *pose), VIEW_JPEG_QUALITY) if any(pose) else self.views.jpeg(at)
