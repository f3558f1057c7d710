"""The recordings that the page shows, read again whenever their files change."""

import functools
import hashlib
import os
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
OFFSET, MODEL = "offset", "model-"  # the analyses' columns: m, right positive; model-0 and so on: steering, -1..1
REPLAY = "replay-"  # replay-0-2.5 and so on: the lateral offset with model 0 as the driver, at a limit of 2.5 m


class UnknownError(UserError):
    """A recording, row or column that the page asks for and that does not exist."""


class Library:
    """The recordings, by an identifier that stays the same when the server is started again."""

    def __init__(self, folders: list[Path], models: list[Path]):
        """folders: recordings; models: whose steering is shown."""
        self.folders = {
            hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=6).hexdigest(): folder for folder in folders
        }
        self.models = [str(model) for model in models]
        self.analyses, self.attention = Analyses(), Attention()
        self.analysed = {OFFSET: (LANE, "offset")}  # column -> the analysis that has it, and its name there
        for number, model in enumerate(self.models):
            self.analysed[f"{MODEL}{number}"] = Analysis("steering", model), "steering"
            for limit in LIMITS:
                self.analysed[f"{REPLAY}{number}-{limit:g}"] = Analysis("replay", model, limit), "offset"

    def close(self) -> None:
        """End the processes that were started for the page."""
        self.analyses.close()
        self.attention.close()

    def folder(self, identifier: str) -> Path:
        """Return a recording's folder. Raises UnknownError."""
        if identifier not in self.folders:
            raise UnknownError(f"no recording {identifier} here; go back to the list")
        return self.folders[identifier]

    def version(self, identifier: str) -> str:
        """Return what changes when the log does. Raises UnknownError, and RecordingError if it is gone."""
        size, changed = file_stamp(self.folder(identifier) / DRIVING_LOG)
        return f"{size:x}-{changed:x}"

    def recording(self, identifier: str, version: str | None = None) -> Recording:
        """Return a recording with all its rows. Raises RecordingError, also if it is not of this version any more."""
        now = self.version(identifier)
        if version not in (None, now):
            raise RecordingError(
                f"{self.folder(identifier) / DRIVING_LOG}: has changed since this page read it; load the page again. "
                "Your cuts are in the recording's folder"
            )
        return _read(self.folder(identifier), now)

    def overview(self, identifier: str) -> dict[str, Any]:
        """Return what the list shows of a recording; {"message"} instead of figures if it can't be read."""
        folder = self.folder(identifier)
        shown: dict[str, Any] = {"id": identifier, "name": folder.resolve().name, "folder": str(folder)}
        try:
            cuts = tuple(read_cuts(folder))
            shown |= _figures(folder, self.version(identifier), cuts)
            shown["lane"] = self.analyses.state(folder, LANE)
            if shown["lane"]["state"] == "ready":
                shown |= _road(folder, self.version(identifier), stamp(folder, LANE))
        except (UserError, OSError) as error:
            shown["message"] = message_of(error)
        return shown

    def details(self, identifier: str, limit: str | None = None) -> dict[str, Any]:
        """Return what the page shows of one recording besides its columns; limit: of the replays to tell of, or None.

        Raises RecordingError, UnknownError.
        """
        folder, recording = self.folder(identifier), self.recording(identifier)
        cuts = read_cuts(folder)
        self.analyses.hurry(folder)
        steering = [self.analysed[f"{MODEL}{number}"][0] for number in range(len(self.models))]
        models = [{"name": Path(each.model).name, **self.analyses.state(folder, each)} for each in steering]
        lane = {"lane": self.analyses.state(folder, LANE)}
        shown = self.overview(identifier) | lane | {"version": self.version(identifier), "models": models, "cuts": []}
        is_cut = np.zeros(len(recording), bool)
        for cut, rows in zip(cuts, cut_rows(folder, cuts, recording.names, recording.images[:, 0]), strict=True):
            edges = np.flatnonzero(np.diff(rows, prepend=False, append=False)).reshape(-1, 2)
            shown["cuts"].append({**cut.__dict__, "frames": int(rows.sum()), "stretches": edges.tolist()})
            is_cut |= rows
        ready = [OFFSET] if shown["lane"]["state"] == "ready" else []
        ready += [f"{MODEL}{number}" for number, model in enumerate(models) if model["state"] == "ready"]
        columns = {name: self.column(identifier, name) for name in ready}
        return shown | {
            "places": summary.places(recording.steering, columns.pop(OFFSET, None), [*columns.values()], is_cut),
            "limit": limit,
            "replays": [self._replay(folder, recording, each) for each in self._replays(limit)] if limit else [],
        }

    def _replays(self, limit: str) -> list[Analysis]:
        """Return the replays at a limit, one a model. Raises UnknownError."""
        if limit not in (f"{each:g}" for each in LIMITS):
            raise UnknownError(f"no limit {limit[:40]}; there are {' and '.join(f'{each:g}' for each in LIMITS)} m")
        return [self.analysed[f"{REPLAY}{number}-{limit}"][0] for number in range(len(self.models))]

    def _replay(self, folder: Path, recording: Recording, replay: Analysis) -> dict[str, Any]:
        shown = self.analyses.state(folder, replay, begin=False)
        if shown["state"] == "ready":
            of = stamp(folder, replay)
            shown |= {**replays.figures(_result(folder, replay, of), recording.images[:, 0]), "stamp": of}
        return shown

    def replay(self, identifier: str, limit: str, begin: bool) -> None:
        """Begin the replays of a recording at a limit, or end those that are not done. Raises UnknownError."""
        folder = self.folder(identifier)
        for replay in self._replays(limit):
            if begin:
                self.analyses.state(folder, replay)
            else:
                self.analyses.stop(folder, replay)

    def retry(self, identifier: str, name: str) -> None:
        """Begin the analysis that has a column again, after it failed. Raises UnknownError, RecordingError."""
        if name not in self.analysed:
            raise UnknownError(f"no analysis of {name[:40]}")
        self.analyses.retry(self.folder(identifier), self.analysed[name][0])

    def column(self, identifier: str, name: str, version: str | None = None) -> np.ndarray:
        """Return a column of a recording: float32 (n,), nan where nothing is known.

        Raises UnknownError, RecordingError.
        """
        recording = self.recording(identifier, version)
        if name == "seconds":
            return summary.driven_seconds(recording.time).astype(np.float32)
        if name in COLUMNS:
            return getattr(recording, name)
        if name not in self.analysed:
            raise UnknownError(f"no column {name[:40]}")
        analysis, part = self.analysed[name]
        folder = self.folder(identifier)
        return _result(folder, analysis, stamp(folder, analysis)).column(part, recording.images[:, 0])

    def row(self, identifier: str, row: int, version: str | None = None) -> dict[str, Any]:
        """Return a row's line in the log and the names of its images. Raises UnknownError, RecordingError."""
        recording = self._with_row(identifier, row, version)
        names = [recording.name(row, camera) for camera in range(len(CAMERAS))]
        return {"line": int(recording.lines[row]), "images": names}

    def jpeg(
        self, identifier: str, row: int, picture: str, version: str | None = None, with_path: bool = False
    ) -> bytes:
        """Return the JPEG of a frame; picture: one of CAMERAS, or a replay's column: what its car sees there.

        with_path: draw the path ahead at the model's steering on what a replayed car sees. Raises UnknownError,
        NotReplayedError, and RecordingError if a frame is unusable.
        """
        recording = self._with_row(identifier, row, version)
        if picture.startswith(REPLAY) and picture in self.analysed:
            folder, replay = self.folder(identifier), self.analysed[picture][0]
            of = stamp(folder, replay)
            result = _result(folder, replay, of)
            place = replays.place_of(result, int(recording.images[row, 0]))
            line = int(result.columns["line"][place])
            return _line_views(folder, self.version(identifier), replay, of, line).jpeg(place, with_path)
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

    def model(self, number: int) -> str:
        """Return a model's file. Raises UnknownError."""
        if number >= len(self.models):
            raise UnknownError(f"no model {number}")
        return self.models[number]

    def _with_row(self, identifier: str, row: int, version: str | None) -> Recording:
        recording = self.recording(identifier, version)
        if row >= len(recording):
            raise UnknownError(f"no row {row}: the recording has {len(recording)}")
        return recording

    def cut(self, identifier: str, first: str, last: str, reason: str) -> Cut:
        """Cut a stretch, and return the cut as it is written; first, last: file names of centre images.

        Raises RecordingError, OSError.
        """
        folder, recording = self.folder(identifier), self.recording(identifier)
        cut = Cut(first, last, one_line(reason))
        next(cut_rows(folder, [cut], recording.names, recording.images[:, 0]))  # refuses what is no stretch
        add_cut(folder, cut)
        return cut

    def restore(self, identifier: str, first: str, last: str, reason: str) -> Cut:
        """Undo a cut, and return it. Raises RecordingError, OSError."""
        cut = Cut(first, last, reason)
        delete_cut(self.folder(identifier), cut)
        return cut


@functools.lru_cache(maxsize=OPEN)
def _read(folder: Path, version: str) -> Recording:
    return read_uncut(folder)


@functools.lru_cache(maxsize=6 * OPEN)  # 100,000 rows take 3 MB
def _result(folder: Path, analysis: Analysis, of: str) -> Result:
    result = read_result(folder, analysis)
    if result is None:
        raise UnknownError(f"{folder}: this column is still being analysed")
    return result


@functools.lru_cache(maxsize=2 * OPEN)
def _line_views(folder: Path, version: str, replay: Analysis, of: str, line: int) -> replays.LineViews:
    return replays.LineViews(_read(folder, version), _result(folder, replay, of), line)


@functools.lru_cache(maxsize=1000)
def _figures(folder: Path, version: str, cuts: tuple[Cut, ...]) -> dict[str, Any]:
    """Return a recording's figures: a few kB, so that a list of recordings need not be read again."""
    recording = _read(folder, version)
    is_cut = np.zeros(len(recording), bool)
    for rows in cut_rows(folder, cuts, recording.names, recording.images[:, 0]):
        is_cut |= rows
    return summary.figures(recording, is_cut)


@functools.lru_cache(maxsize=1000)
def _road(folder: Path, version: str, of: str) -> dict[str, Any]:
    return summary.road_of(_result(folder, LANE, of), _read(folder, version).images[:, 0])
