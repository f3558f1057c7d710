"""What the pages ask for every few seconds, kept for each state of a recording's files.

version: of the log, as `ShownRecording.version` tells it; now: the stamp of the analysis, see `analyses.stamp`; cuts:
those that are in the recording's folder.
"""

import functools
import threading
from pathlib import Path
from typing import Any

import numpy as np

from cloning.browse import replays, summary
from cloning.browse.analyses import LANE, Analysis, Result, UnknownError, read_result
from cloning.browse.filter import stretches_of
from cloning.recordings.excluded import EXCLUDED, Cut, cut_rows
from cloning.recordings.log import Recording, read_uncut

OPEN = 2  # recordings that are kept in memory: 100,000 rows take 20 MB

_wanted: dict[Path, threading.Lock] = {}
_reading = threading.Lock()


def read(folder: Path, version: str) -> Recording:
    """Return all rows. Raises RecordingError."""
    with _wanted.setdefault(folder, threading.Lock()):  # threads that want the same recording read it once
        return _read_once(folder, version)


@functools.lru_cache(maxsize=OPEN)
def _read_once(folder: Path, version: str) -> Recording:
    with _reading:  # one at a time, since each takes memory
        return read_uncut(folder)


@functools.lru_cache(maxsize=2 * OPEN)  # cuts and tags: thousands take a second, and a page asks every few
def covered(
    folder: Path, version: str, cuts: tuple[Cut, ...], file: str = EXCLUDED
) -> tuple[Recording, np.ndarray, list[dict[str, Any]]]:
    """Return all rows, which of them are in a cut, or with TAGS in a tag, bool (n,), and each cut with its rows.

    A log may grow while it is read: `read` may then give other rows. Raises RecordingError.
    """
    recording, shown = read(folder, version), []
    is_cut = np.zeros(len(recording), bool)
    for cut, rows in zip(cuts, cut_rows(folder, cuts, recording.names, recording.images[:, 0], file), strict=True):
        is_cut |= rows
        shown.append({**cut.__dict__, "frames": int(rows.sum()), "stretches": stretches_of(rows)})
    return recording, is_cut, shown


@functools.lru_cache(maxsize=6 * OPEN)  # 100,000 rows take 3 MB
def result(folder: Path, analysis: Analysis, now: str) -> Result:
    """Return what an analysis has found. Raises UnknownError if it is not done."""
    found = read_result(folder, analysis)
    if found is None:
        raise UnknownError(f"{folder}: the analysis that tells this column is not done")
    return found


@functools.lru_cache(maxsize=2 * OPEN)
def line_views(folder: Path, version: str, replay: Analysis, now: str, line: int) -> replays.LineViews:
    """Return what a replay's car sees along one of its lines."""
    return replays.LineViews(read(folder, version), result(folder, replay, now), line)


@functools.lru_cache(maxsize=1000)  # a few kB each, so that a list of recordings need not be read again
def figures(folder: Path, version: str, cuts: tuple[Cut, ...]) -> dict[str, Any]:
    """Return a recording's figures; see `summary.figures`."""
    return summary.figures(*covered(folder, version, cuts)[:2])


@functools.lru_cache(maxsize=1000)
def road(folder: Path, version: str, cuts: tuple[Cut, ...], now: str) -> dict[str, Any]:
    """Return where a recording was driven; see `summary.road_of`."""
    recording, is_cut, _ = covered(folder, version, cuts)
    return summary.road_of(result(folder, LANE, now), recording.images[:, 0], is_cut)


@functools.lru_cache(maxsize=1000)
def error(folder: Path, version: str, cuts: tuple[Cut, ...], analysis: Analysis, now: str) -> float | None:
    """Return the root mean square of the difference of a model's steering from the driver's; None if it is unknown."""
    recording, is_cut, _ = covered(folder, version, cuts)
    difference = result(folder, analysis, now).column("steering", recording.images[:, 0]) - recording.steering
    known = difference[~np.isnan(difference) & ~is_cut]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


@functools.lru_cache(maxsize=1000)
def driven(folder: Path, version: str, analysis: Analysis, now: str) -> dict[str, Any]:
    """Return how a model drives in a replay; see `replays.figures`."""
    return replays.figures(result(folder, analysis, now), read(folder, version).images[:, 0])
