"""The recordings that the page shows, read again whenever their files change."""

import functools
import hashlib
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np

from cloning.base.errors import RecordingError, UserError, message_of
from cloning.base.frame import FRAME
from cloning.browse import replays, summary
from cloning.browse.analyses import LANE, Analyses, Analysis, Result, file_stamp, read_result, stamp
from cloning.browse.attention import Attention
from cloning.recordings.excluded import Cut, add_cut, cut_rows, delete_cut, one_line, read_cuts
from cloning.recordings.format import CAMERAS, DRIVING_LOG
from cloning.recordings.images import jpeg_size, read_jpeg
from cloning.recordings.log import Recording, read_uncut
from cloning.road.autonomy import LIMITS

OPEN = 2  # recordings that are kept in memory: 100,000 rows take 20 MB
COLUMNS = ("steering", "throttle", "speed", "seconds")  # of the log; the analyses add to them

_wanted: dict[Path, threading.Lock] = {}
_reading = threading.Lock()


class UnknownError(UserError):
    """A recording, row or column that the page asks for and that does not exist."""


class Library:
    """The recordings, by an identifier that stays the same when the server is started again."""

    def __init__(self, folders: list[Path], models: list[Path]):
        """folders: recordings; models: whose steering is shown."""
        self.models = [str(model) for model in models]
        self.analyses, self.attention = Analyses(), Attention()
        self.recordings = {
            hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=6).hexdigest(): folder for folder in folders
        }

    def close(self) -> None:
        """End the processes that were started for the page."""
        self.analyses.close()
        self.attention.close()

    def __getitem__(self, identifier: str) -> "ShownRecording":
        """Return a recording. Raises UnknownError."""
        if identifier not in self.recordings:
            raise UnknownError(f"no recording {identifier} here; go back to the list")
        return ShownRecording(identifier, self.recordings[identifier], self.models, self.analyses)

    def model(self, index: int) -> str:
        """Return a model's file. Raises UnknownError."""
        if index >= len(self.models):
            raise UnknownError(f"no model {index}")
        return self.models[index]


class ShownRecording:
    """What the page shows of a recording, and changes in it.

    Besides COLUMNS it has the columns of analyses: offset, m, right positive; model-0 and so on, the models' steering,
    -1..1; replay-0-2.5 and so on, the lateral offset with model 0 as the driver, at a limit of 2.5 m.
    """

    def __init__(self, identifier: str, folder: Path, models: list[str], analyses: Analyses):
        """models: their files, in the order of the page."""
        self.identifier, self.folder, self.models, self.analyses = identifier, folder, models, analyses
        self.analysed = {"offset": LANE}
        for index, model in enumerate(models):
            self.analysed[f"model-{index}"] = Analysis("steering", model)
            self.analysed |= {f"replay-{index}-{limit:g}": Analysis("replay", model, limit) for limit in LIMITS}

    def version(self) -> str:
        """Return what changes when the log does. Raises RecordingError if it is gone."""
        size, changed = file_stamp(self.folder / DRIVING_LOG)
        return f"{size:x}-{changed:x}"

    def read(self, version: str | None = None) -> Recording:
        """Return all rows. Raises RecordingError, also if the log is not of this version any more."""
        now = self.version()
        if version not in (None, now):
            raise RecordingError(
                f"{self.folder / DRIVING_LOG}: has changed since this page read it; load the page again. "
                "Your cuts are in the recording's folder"
            )
        return _read(self.folder, now)

    def overview(self) -> dict[str, Any]:
        """Return what the list shows of a recording; {"message"} instead of figures if it can't be read."""
        shown: dict[str, Any] = {"id": self.identifier, "name": self.folder.resolve().name, "folder": str(self.folder)}
        try:
            shown |= _figures(self.folder, self.version(), tuple(read_cuts(self.folder)))
            shown["lane"] = self._state("offset")
            if shown["lane"]["state"] == "ready":
                shown |= _road(self.folder, self.version(), stamp(self.folder, LANE))
        except (UserError, OSError) as error:
            shown["message"] = message_of(error)
        return shown

    def details(self, limit: str | None = None) -> dict[str, Any]:
        """Return what the page shows of one recording besides its columns; limit: of the replays to tell of, or None.

        Raises RecordingError, UnknownError.
        """
        recording, cuts = self.read(), read_cuts(self.folder)
        self.analyses.urgent = self.folder
        models = [{"name": Path(model).name, **self._state(f"model-{at}")} for at, model in enumerate(self.models)]
        shown = self.overview() | {"lane": self._state("offset"), "version": self.version()}
        rows_cut = _rows_cut(self.folder, tuple(cuts), recording)
        shown["cuts"] = [
            {
                **cut.__dict__,
                "frames": int(rows.sum()),
                "stretches": np.flatnonzero(np.diff(rows, prepend=False, append=False)).reshape(-1, 2).tolist(),
            }
            for cut, rows in zip(cuts, rows_cut, strict=True)
        ]
        offset = self.column("offset") if shown["lane"]["state"] == "ready" else None
        steering = [self.column(f"model-{at}") for at, model in enumerate(models) if model["state"] == "ready"]
        return shown | {
            "models": models,
            "jumps": summary.jumps(recording.steering, offset, steering, np.logical_or.reduce(rows_cut)),
            "limit": limit,
            "replays": [self._replay(recording, column) for column in self._replays(limit)] if limit else [],
        }

    def _replays(self, limit: str) -> list[str]:
        """Return the columns of the replays at a limit, one a model."""
        return [f"replay-{index}-{limit}" for index in range(len(self.models))]

    def _replay(self, recording: Recording, column: str) -> dict[str, Any]:
        shown = self._state(column, begin=False)
        if shown["state"] == "ready":
            result, now = self._result(column)
            shown |= {**replays.figures(result, recording.images[:, 0]), "stamp": now}
        return shown

    def replay(self, limit: str, begin: bool) -> None:
        """Begin the replays at a limit, or end those that are not done. Raises UnknownError."""
        for column in self._replays(limit):
            (self.analyses.state if begin else self.analyses.stop)(self.folder, self._analysis(column))

    def retry(self, column: str) -> None:
        """Begin the analysis that has a column again, after it failed. Raises UnknownError, RecordingError."""
        self.analyses.retry(self.folder, self._analysis(column))

    def _analysis(self, column: str) -> Analysis:
        if column not in self.analysed:
            raise UnknownError(f"no column {column[:40]}")
        return self.analysed[column]

    def _state(self, column: str, begin: bool = True) -> dict[str, Any]:
        return self.analyses.state(self.folder, self._analysis(column), begin)

    def _result(self, column: str) -> tuple[Result, str]:
        """Return the result of the analysis that has a column, and its stamp."""
        now = stamp(self.folder, self._analysis(column))
        return _result(self.folder, self._analysis(column), now), now

    def column(self, name: str, version: str | None = None) -> np.ndarray:
        """Return a column: float32 (n,), nan where nothing is known. Raises UnknownError, RecordingError."""
        recording = self.read(version)
        if name == "seconds":
            return summary.driven_seconds(recording.time).astype(np.float32)
        if name in COLUMNS:
            return getattr(recording, name)
        part = "steering" if self._analysis(name).kind == "steering" else "offset"
        return self._result(name)[0].column(part, recording.images[:, 0])

    def row(self, row: int, version: str | None = None) -> dict[str, Any]:
        """Return a row's line in the log and the names of its images. Raises UnknownError, RecordingError."""
        recording = self._with_row(row, version)
        names = [recording.name(row, camera) for camera in range(len(CAMERAS))]
        return {"line": int(recording.lines[row]), "images": names}

    def jpeg(self, row: int, picture: str, version: str | None = None, with_path: bool = False) -> bytes:
        """Return the JPEG of a frame; picture: one of CAMERAS, or a replay's column: what its car sees there.

        with_path: draw the path ahead at the model's steering on what a replayed car sees. Raises UnknownError,
        NotReplayedError, and RecordingError if a frame is unusable.
        """
        recording = self._with_row(row, version)
        replay = self.analysed.get(picture)
        if replay and replay.kind == "replay":
            result, now = self._result(picture)
            index = replays.index_of(result, int(recording.images[row, 0]))
            line = int(result.columns["line"][index])
            return _line_views(self.folder, self.version(), replay, now, line).jpeg(index, with_path)
        if picture not in CAMERAS:
            raise UnknownError(f"no picture {picture[:40]}")
        path = recording.path(row, CAMERAS.index(picture))
        try:
            jpeg = read_jpeg(path)
            if jpeg_size(jpeg) != FRAME[:2]:
                raise ValueError("not of a frame's size")
        except ValueError as error:
            raise RecordingError(f"{path}: {error}") from None
        return jpeg

    def _with_row(self, row: int, version: str | None) -> Recording:
        recording = self.read(version)
        if row >= len(recording):
            raise UnknownError(f"no row {row}: the recording has {len(recording)}")
        return recording

    def cut(self, first: str, last: str, reason: str) -> Cut:
        """Cut a stretch, and return the cut as it is written; first, last: file names of centre images.

        Raises RecordingError, OSError.
        """
        cut = Cut(first, last, one_line(reason))
        _rows_cut(self.folder, (cut,), self.read())  # refuses what is no stretch
        add_cut(self.folder, cut)
        return cut

    def restore(self, first: str, last: str, reason: str) -> Cut:
        """Undo a cut, and return it. Raises RecordingError, OSError."""
        cut = Cut(first, last, reason)
        delete_cut(self.folder, cut)
        return cut


def _rows_cut(folder: Path, cuts: tuple[Cut, ...], recording: Recording) -> np.ndarray:
    """Return the rows of each cut: bool (cuts, n). Raises RecordingError."""
    rows = list(cut_rows(folder, cuts, recording.names, recording.images[:, 0]))
    return np.array(rows, bool).reshape(len(cuts), len(recording))


def _read(folder: Path, version: str) -> Recording:
    with _wanted.setdefault(folder, threading.Lock()):  # threads that want the same recording read it once
        return _read_once(folder, version)


@functools.lru_cache(maxsize=OPEN)
def _read_once(folder: Path, version: str) -> Recording:
    with _reading:  # one at a time, since each takes memory
        return read_uncut(folder)


@functools.lru_cache(maxsize=6 * OPEN)  # 100,000 rows take 3 MB
def _result(folder: Path, analysis: Analysis, now: str) -> Result:
    result = read_result(folder, analysis)
    if result is None:
        raise UnknownError(f"{folder}: this column is still being analysed")
    return result


@functools.lru_cache(maxsize=2 * OPEN)
def _line_views(folder: Path, version: str, replay: Analysis, now: str, line: int) -> replays.LineViews:
    return replays.LineViews(_read(folder, version), _result(folder, replay, now), line)


@functools.lru_cache(maxsize=1000)  # a few kB each, so that a list of recordings need not be read again
def _figures(folder: Path, version: str, cuts: tuple[Cut, ...]) -> dict[str, Any]:
    recording = _read(folder, version)
    return summary.figures(recording, np.logical_or.reduce(_rows_cut(folder, cuts, recording)))


@functools.lru_cache(maxsize=1000)
def _road(folder: Path, version: str, now: str) -> dict[str, Any]:
    return summary.road_of(_result(folder, LANE, now), _read(folder, version).images[:, 0])
