"""The recordings that the page shows, read again whenever their files change."""

import contextlib
import hashlib
import os
import tempfile
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cloning.base.errors import OutputError, RecordingError, UserError, message_of
from cloning.base.film import FilmWriter, frame_rate
from cloning.base.frame import FRAME
from cloning.base.outputs import short_names
from cloning.browse import computed, replays, summary
from cloning.browse.analyses import LANE, Analyses, Analysis, Result, UnknownError, file_stamp, stamp
from cloning.browse.attention import Attention
from cloning.browse.filter import matching, stretches_of
from cloning.recordings.excluded import EXCLUDED, TAGS, Cut, add_cuts, delete_cuts, one_line, read_cuts
from cloning.recordings.format import CAMERAS, DRIVING_LOG, SAMPLE_RATE
from cloning.recordings.images import jpeg_size, read_frame, read_jpeg
from cloning.recordings.log import Recording, find_folders
from cloning.recordings.part import write_part
from cloning.road.autonomy import LIMITS
from cloning.road.overlay import overlay

COLUMNS = ("steering", "throttle", "brake", "speed", "seconds")  # of the log; the analyses add to them
MAX_FILM = 300 * SAMPLE_RATE  # rows: five minutes, which take half a minute to encode


class Library:
    """The recordings, by an identifier that stays the same when the server is started again."""

    def __init__(self, given: Sequence[str | Path], models: list[Path]):
        """given: recordings, or folders of recordings; models: whose steering is shown. Raises RecordingError."""
        self.recordings: dict[str, Path] = {}
        self.names: dict[str, str] = {}  # of the recordings, by the same identifiers
        self.given, self._adding = given, threading.Lock()
        self.add(*find_folders(given))
        self.models = dict(zip(short_names(models), map(str, models), strict=True))
        self.analyses, self.attention = Analyses(), Attention()

    def look(self) -> None:
        """Add the recordings that are new in the given folders."""
        found: list[Path] = []
        for each in self.given:
            with contextlib.suppress(RecordingError):  # what is gone is told where it is shown
                found += find_folders([each])
        self.add(*found)

    def add(self, *folders: Path) -> list[str]:
        """Add recordings, and return their identifiers."""
        added = {hashlib.blake2b(os.fsencode(each.resolve()), digest_size=6).hexdigest(): each for each in folders}
        with self._adding:  # else of two threads one would lose what the other adds
            recordings = self.recordings | added
            self.names = dict(zip(recordings, short_names(recordings.values()), strict=True))
            self.recordings = recordings
        return list(added)

    def close(self) -> None:
        """End the processes that were started for the page."""
        self.analyses.close()
        self.attention.close()

    def __getitem__(self, identifier: str) -> "ShownRecording":
        """Return a recording. Raises UnknownError."""
        if identifier not in self.recordings:
            raise UnknownError(f"no recording {identifier} here; go back to the list")
        name, folder = self.names[identifier], self.recordings[identifier]
        return ShownRecording(identifier, name, folder, self.models, self.analyses)

    def model(self, index: int) -> str:
        """Return a model's file. Raises UnknownError."""
        if index >= len(self.models):
            raise UnknownError(f"no model {index}")
        return list(self.models.values())[index]


class ShownRecording:
    """What the page shows of a recording, and changes in it.

    Besides COLUMNS it has the columns of analyses: offset, m, right positive; label, the steering that `model.py
    --robust` learns there; model-0 and so on, the models' steering, -1..1; replay-0-2.5 and so on, the lateral offset
    with model 0 as the driver, at a limit of 2.5 m; driver-0-2.5 and so on, its steering then.
    """

    def __init__(self, identifier: str, name: str, folder: Path, models: dict[str, str], analyses: Analyses):
        """models: name -> file, in the order of the page."""
        self.identifier, self.name, self.folder = identifier, name, folder
        self.models, self.analyses = models, analyses
        self.analysed = {"offset": (LANE, "offset"), "label": (LANE, "label")}  # column -> analysis, its name there
        for index, model in enumerate(models.values()):
            self.analysed[f"model-{index}"] = Analysis("steering", model), "steering"
            for limit in LIMITS:
                replay = Analysis("replay", model, limit)
                self.analysed[f"replay-{index}-{limit:g}"] = replay, "offset"
                self.analysed[f"driver-{index}-{limit:g}"] = replay, "steering"

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
        return computed.read(self.folder, now)

    def overview(self) -> dict[str, Any]:
        """Return what the list shows of a recording; {"message"} instead of figures if it can't be read."""
        shown: dict[str, Any] = {"id": self.identifier, "name": self.name, "folder": str(self.folder)}
        try:
            cuts, version = tuple(read_cuts(self.folder)), self.version()
            shown |= {"version": version, **computed.figures(self.folder, version, cuts)}
            shown["tags"] = sorted({tag.reason for tag in read_cuts(self.folder, TAGS)})
            shown["lane"] = self._state("offset")
            if shown["lane"]["state"] == "ready":
                shown |= computed.road(self.folder, version, cuts, shown["lane"]["stamp"])
        except (UserError, OSError) as error:
            shown["message"] = message_of(error)
        return shown

    def _without_map(self) -> dict[str, Any]:
        """Return the overview without what draws its map: what is asked for every few seconds need not send that."""
        return {name: value for name, value in self.overview().items() if name not in summary.MAP}

    def details(self, limit: str | None = None) -> dict[str, Any]:
        """Return what the page shows of one recording besides its columns; limit: of the replays to tell of, or None.

        Raises RecordingError, UnknownError.
        """
        version = self.version()
        recording, kept = self._with_kept(version)
        self.analyses.urgent = self.folder
        models = [{"name": name, **self._state(f"model-{at}")} for at, name in enumerate(self.models)]
        shown = self._without_map()
        if "message" in shown:  # a file has changed since
            raise RecordingError(shown["message"])
        for kind, file in (("cuts", EXCLUDED), ("tags", TAGS)):
            shown[kind] = computed.covered(self.folder, version, tuple(read_cuts(self.folder, file)), file)[2]
        offset = self._found("offset", recording) if shown["lane"]["state"] == "ready" else None
        ready = [f"model-{at}" for at, model in enumerate(models) if model["state"] == "ready"]
        steering = [self._found(column, recording) for column in ready]
        return shown | {
            "models": models,
            "jumps": summary.jumps(recording.steering, offset, steering, ~kept),
            "limit": limit,
            "replays": [self._replay(version, column) for column in self._replays(limit)] if limit else [],
        }

    def _replays(self, limit: str) -> list[str]:
        return [f"replay-{index}-{limit}" for index in range(len(self.models))]

    def _replay(self, version: str, column: str, begin: bool = False) -> dict[str, Any]:
        shown = self._state(column, begin, again=begin)
        if shown["state"] == "ready":
            shown |= computed.driven(self.folder, version, self._analysis(column), shown["stamp"])
        return shown

    def replay(self, limit: str, begin: bool) -> None:
        """Begin the replays at a limit, or end those that are not done. Raises UnknownError."""
        if begin:
            self.analyses.resume()  # whoever asks for one wants it
        for column in self._replays(limit):
            (self.analyses.state if begin else self.analyses.stop)(self.folder, self._analysis(column))

    def retry(self, column: str) -> None:
        """Begin the analysis that has a column again, after it failed. Raises UnknownError, RecordingError."""
        self.analyses.state(self.folder, self._analysis(column), again=True)

    def _analysis(self, column: str) -> Analysis:
        if column not in self.analysed:
            raise UnknownError(f"no column {column[:40]}")
        return self.analysed[column][0]

    def _state(self, column: str, begin: bool = True, again: bool = False) -> dict[str, Any]:
        analysis = self._analysis(column)
        try:
            return self.analyses.state(self.folder, analysis, begin, again)
        except RecordingError as error:  # the images or the model are gone; all else can be shown
            return {"state": "failed", "message": str(error)}

    def _result(self, column: str) -> tuple[Result, str]:
        """Return the result of the analysis that has a column, and its stamp."""
        now = stamp(self.folder, self._analysis(column))
        return computed.result(self.folder, self._analysis(column), now), now

    def column(self, name: str, version: str | None = None) -> np.ndarray:
        """Return a column: float32 (n,), nan where nothing is known. Raises UnknownError, RecordingError."""
        recording = self.read(version)
        if name == "seconds":
            return summary.driven_seconds(recording.time).astype(np.float32)
        if name in COLUMNS:
            return getattr(recording, name)
        return self._found(name, recording)

    def _found(self, column: str, recording: Recording) -> np.ndarray:
        """Return a column of an analysis, as `column`."""
        return self._result(column)[0].column(self.analysed[column][1], recording.images[:, 0])

    def matches(self, condition: str, limit: str | None, version: str | None = None) -> dict[str, Any]:
        """Return the rows that meet a condition: their number, and the stretches of them that are not cut.

        A stretch is [first row, row after the last, the names of the first's and the last's centre image]. Columns are
        called as on the page: model1, driver1, replay1: the first model's, the last two at a limit. Raises UserError.
        """
        version = self.version() if version is None else version
        recording, kept = self._with_kept(version)
        names = {"offset": "offset", "label": "label"} | {name: name for name in COLUMNS}
        for index in range(len(self.models)):
            names[f"model{index + 1}"] = f"model-{index}"
            if limit:
                names |= {f"{kind}{index + 1}": f"{kind}-{index}-{limit}" for kind in ("replay", "driver")}
        rows = matching(condition, lambda name: self.column(names[name], version), list(names))
        rows &= kept
        found = stretches_of(rows)
        ends = [[first, end, recording.name(first), recording.name(end - 1)] for first, end in found]
        return {"rows": int(rows.sum()), "stretches": ends}

    def compared(self, limit: str, begin: bool) -> dict[str, Any]:
        """Return the overview with each model's figures: how it steers, and how it drives at a limit.

        begin: begin the analyses that are missing or have failed. Raises UnknownError, RecordingError.
        """
        shown, models = self._without_map(), list[dict[str, Any]]()
        if "message" in shown:
            return shown
        version, cuts = shown["version"], tuple(read_cuts(self.folder))
        if begin:
            self.analyses.resume()
        for at, (name, column) in enumerate(zip(self.models, self._replays(limit), strict=True)):
            steering = self._state(f"model-{at}", begin, again=begin)
            error = None
            if steering["state"] == "ready":
                error = computed.error(self.folder, version, cuts, self._analysis(f"model-{at}"), steering["stamp"])
            replay = self._replay(version, column, begin)
            models.append({"name": name, "steering": steering, "error": error, "replay": replay})
        return shown | {"models": models}

    def row(self, row: int, version: str | None = None) -> dict[str, Any]:
        """Return a row's line in the log and the names of its images. Raises UnknownError, RecordingError."""
        recording = self._with_row(row, version)
        names = [recording.name(row, camera) for camera in range(len(CAMERAS))]
        return {"line": int(recording.lines[row]), "images": names}

    def jpeg(self, row: int, picture: str, version: str | None = None) -> bytes:
        """Return the JPEG of a frame; picture: one of CAMERAS, or a replay's column: what its car sees there.

        Raises UnknownError, and RecordingError if a frame is unusable.
        """
        recording = self._with_row(row, version)
        replay, name = self.analysed.get(picture, (LANE, ""))
        if replay.kind == "replay" and name == "offset":
            result, now = self._result(picture)
            index = replays.index_of(result, int(recording.images[row, 0]))
            line = int(result.columns["line"][index])
            return computed.line_views(self.folder, self.version(), replay, now, line).jpeg(index)
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

    def _with_kept(self, version: str | None) -> tuple[Recording, np.ndarray]:
        """Return all rows, and which are not cut: bool (n,). Raises RecordingError as `read`."""
        version = self.version() if version is None else version
        self.read(version)
        recording, is_cut, _ = computed.covered(self.folder, version, tuple(read_cuts(self.folder)))
        return recording, ~is_cut

    def _with_row(self, row: int, version: str | None) -> Recording:
        recording = self.read(version)
        if row >= len(recording):
            raise UnknownError(f"no row {row}: the recording has {len(recording)}")
        return recording

    def cut(self, cuts: Iterable[Cut], file: str = EXCLUDED) -> list[Cut]:
        """Cut or tag stretches, and return the cuts that were not there. Raises RecordingError, OSError."""
        cuts = [Cut(cut.first, cut.last, one_line(cut.reason)) for cut in cuts]
        computed.covered(self.folder, self.version(), tuple(cuts), file)  # refuses what is no stretch
        return add_cuts(self.folder, *cuts, file=file)

    def restore(self, cuts: Iterable[Cut], file: str = EXCLUDED) -> list[Cut]:
        """Undo cuts or tags, and return those that were there. Raises GoneError, RecordingError, OSError."""
        return delete_cuts(self.folder, *cuts, file=file)

    def _selected(self, stretches: list[list[int]] | None = None, version: str | None = None) -> Recording:
        """Return the rows of stretches, [first, row after the last], without those that are cut. Raises UserError.

        stretches: None for all rows.
        """
        recording, kept = self._with_kept(version)
        stretches = [[0, len(recording)]] if stretches is None else stretches
        chosen = np.zeros(len(recording), bool)
        for first, end in stretches:
            chosen[first:end] = True
        chosen &= kept
        if not chosen.any():
            raise RecordingError(f"{self.folder}: all of the selection is cut; select other frames")
        return recording.take(chosen)

    def export(
        self, stretches: list[list[int]], version: str, name: str, others: list["ShownRecording"]
    ) -> tuple[Path, list[str]]:
        """Write stretches, and all of the other recordings, as one recording beside this one.

        Return its folder, and what did not fit, in words. Raises UserError.
        """
        if not name.strip(". ") or any(c in r'/\:*?"<>|' or not c.isprintable() for c in name) or len(name) > 100:
            raise OutputError(f"{name[:60]!r}: not the name of a folder; use letters and digits, for example bends")
        selected = [self._selected(stretches, version), *(other._selected() for other in others)]
        folder = self.folder.resolve().with_name(name)
        return folder, write_part(selected, folder)

    def film(self, stretches: list[list[int]], version: str) -> bytes:
        """Return an mp4 film of stretches, with the path ahead at the human driver's steering. Raises UserError."""
        selected = self._selected(stretches, version)
        if len(selected) > MAX_FILM:
            raise OutputError(f"film: {len(selected)} frames; mark a stretch of at most {MAX_FILM}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            with FilmWriter(path, frame_rate(selected.time.tolist(), SAMPLE_RATE), quality=24) as writer:
                for row in range(len(selected)):
                    writer.add(overlay(read_frame(selected.path(row)), float(selected.steering[row])))
            return path.read_bytes()
