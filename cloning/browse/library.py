"""The recordings that the page shows, read again whenever their files change."""

import functools
import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from cloning.browse import summary
from cloning.browse.analyses import LANE, Analyses, Result, file_stamp, read_result, stamp
from cloning.errors import RecordingError, UserError, message_of
from cloning.recordings.excluded import Cut, add_cut, cut_rows, delete_cut, one_line, read_cuts
from cloning.recordings.format import CAMERAS, DRIVING_LOG, FRAME
from cloning.recordings.images import jpeg_size, read_jpeg
from cloning.recordings.log import Recording, read_uncut

OPEN = 2  # recordings that are kept in memory: 100,000 rows take 20 MB
COLUMNS = ("steering", "throttle", "speed", "seconds")  # of the log; the analyses add to them
OFFSET, MODEL = "offset", "model-"  # the analyses' columns: m, right positive; model-0 and so on: steering, -1..1


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
        self.analyses = Analyses()

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

    def details(self, identifier: str) -> dict[str, Any]:
        """Return what the page shows of one recording besides its columns. Raises RecordingError."""
        folder, recording = self.folder(identifier), self.recording(identifier)
        cuts = read_cuts(folder)
        self.analyses.hurry(folder)
        models = [{"name": Path(model).name, **self.analyses.state(folder, model)} for model in self.models]
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
            "places": summary.places(recording.steering, columns.pop(OFFSET, None), [*columns.values()], is_cut)
        }

    def column(self, identifier: str, name: str, version: str | None = None) -> np.ndarray:
        """Return a column of a recording: float32 (n,), nan where nothing is known.

        Raises UnknownError, RecordingError.
        """
        recording = self.recording(identifier, version)
        if name == "seconds":
            return summary.driven_seconds(recording.time).astype(np.float32)
        if name in COLUMNS:
            return getattr(recording, name)
        number = name.removeprefix(MODEL)
        if name == OFFSET:
            analysis, part = LANE, OFFSET
        elif name.startswith(MODEL) and number.isascii() and number.isdigit() and int(number) < len(self.models):
            analysis, part = self.models[int(number)], "steering"
        else:
            raise UnknownError(f"no column {name[:40]}")
        folder = self.folder(identifier)
        return _result(folder, analysis, stamp(folder, analysis)).column(part, recording.images[:, 0])

    def row(self, identifier: str, row: int, version: str | None = None) -> dict[str, Any]:
        """Return a row's line in the log and the names of its images. Raises UnknownError, RecordingError."""
        recording = self._with_row(identifier, row, version)
        names = [recording.name(row, camera) for camera in range(len(CAMERAS))]
        return {"line": int(recording.lines[row]), "images": names}

    def jpeg(self, identifier: str, row: int, camera: str, version: str | None = None) -> bytes:
        """Return the JPEG of a frame; camera: one of CAMERAS. Raises UnknownError, and RecordingError if unusable."""
        recording = self._with_row(identifier, row, version)
        if camera not in CAMERAS:
            raise UnknownError(f"no camera {camera[:40]}")
        path = recording.path(row, CAMERAS.index(camera))
        try:
            jpeg = read_jpeg(path)
            if jpeg_size(jpeg) != FRAME[:2]:
                raise ValueError("not of a frame's size")
        except ValueError as error:
            raise RecordingError(f"{path}: {error}") from None
        return jpeg

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


@functools.lru_cache(maxsize=2 * OPEN)
def _result(folder: Path, analysis: str, of: str) -> Result:
    result = read_result(folder, analysis)
    if result is None:
        raise UnknownError(f"{folder}: this column is still being analysed")
    return result


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
