"""What a report contains: figures, tables and pictures of a run, and the page made of them."""

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from cloning.base import program
from cloning.base.errors import ModelError, RecordingError, UserError, message_of
from cloning.base.outputs import as_typed, short_names
from cloning.browse import summary
from cloning.browse.runs import overview
from cloning.network.attention import visual_backprop
from cloning.network.compute import one_thread
from cloning.network.layer_table import layer_table
from cloning.network.network import load_model
from cloning.recordings.check import check_images
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording, find_folders, read_recording
from cloning.replay.command import drive_at_limits
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import Drive, NothingToReplay, ReplayFrame, load_recording, reference_lines
from cloning.replay.score import ORACLE, YARDSTICKS, captioned, plot, replay_report
from cloning.report.pictures import epochs_chart, film_uri, frame_uri, picture_uri, steering_chart, uri
from cloning.road.autonomy import LIMITS, lap_in_words
from cloning.road.overlay import overlay
from cloning.server.template import whole_page
from cloning.training.pictures import panel
from cloning.training.run_files import RunFiles
from cloning.training.summary import VERDICTS, duration

EXAMPLES = (0.05, 0.5, 0.95)  # quantiles of the steering: most often to the left, none, and to the right
HARDLY = 0.05  # steering
FILMS = 9_000_000  # bytes of all films in the page, which should have less than 15 MB
SHOWN = 6  # interventions of each replay that are shown
DRIVERS = {"network": "the network", **YARDSTICKS, ORACLE: "recovery steering"}  # rows of the table of replays
PICTURES = ("LRC_", "augmented-")  # of the training: the three cameras' images, and those made from them


def in_words(steering: float) -> str:
    """Return in words how a driver steers, -1..1: to the left may well be in a bend to the right, to correct."""
    if abs(steering) < HARDLY:
        return "the driver hardly steers"
    return f"the driver steers to the {'left' if steering < 0 else 'right'}"


class Shots:
    """Keeps the rows before the first interventions, which show where the car went."""

    def __init__(self) -> None:
        self.before: ReplayFrame | None = None
        self.taken: list[tuple[ReplayFrame, float]] = []  # with the network's steering, -1..1

    def watch(self, frame: ReplayFrame, done: Drive) -> None:
        """Look at a row that was just driven."""
        if self.before and len(self.taken) < min(len(done.interventions), SHOWN):
            self.taken.append((self.before, done.steering[-2]))
        self.before = frame


class Lap(NamedTuple):
    """A lap in the stand-in simulator."""

    title: str  # the name of its picture
    figures: str  # in words; "" if its report is not beside the picture
    picture: str  # data URI, as the next
    film: str  # "" if there is none

    @classmethod
    def of(cls, picture: Path, most: int) -> "Lap":
        """Read a lap's picture, and report and film beside it; most: bytes of the film. Raises UserError, OSError."""
        report, film = picture.with_suffix(".json"), picture.with_suffix(".mp4")
        try:
            figures = lap_in_words(json.loads(report.read_bytes())) if report.exists() else ""
        except (ValueError, LookupError, TypeError) as error:
            raise UserError(f"{report}: not a report of `simulator drive` ({error!r}); make it again") from None
        return cls(picture.stem, figures, picture_uri(picture), film_uri(film, most) if film.exists() else "")


class Report:
    """The report of one run."""

    def __init__(self, folder: Path, laps: Sequence[Path] = ()):
        """Read a run; laps: pictures to show. Raises UserError, OSError."""
        files = RunFiles(str(folder / "model.pt"))
        self.run, self.name = overview(files), folder.resolve().name
        arguments = json.loads(files.arguments.read_bytes())
        self.output, best = (folder / name for name in self.run["models"])
        self.model = best if best.exists() else self.output
        if not self.run["best"]:
            why = "no epoch is finished with a loss that is a number"
            raise UserError(f"{folder}: {why}, so there is nothing to report; let model.py go on, or train again")
        one_thread()  # as drive.py does; replays run at the same time
        self.network = load_model(self.model)
        self.arguments = files.arguments
        self.recipe, self.labels = arguments.get("recipe"), arguments.get("training", {}).get("labels")
        self.laps = [Lap.of(picture, FILMS // len(laps)) for picture in laps]
        self.recordings: list[dict[str, Any]] = []
        self.missing: list[str] = []  # why recordings and pictures are not shown
        self.trained_on = set[int]()  # digests of the centre images that the network was given
        self.looked_at: Recording | None = None  # the recording whose frames are shown
        for name in self.run["recordings"]:
            with self._noting_what_is_missing():
                for found in find_folders([name], exact=True):
                    with self._noting_what_is_missing():
                        self._read(found)
        for each, short in zip(self.recordings, short_names(each["folder"] for each in self.recordings), strict=True):
            each["name"] = short
        self.knows_all = not (self.missing or arguments.get("from_model"))  # that the network was trained on
        numbers, self.augmentations = self.run["pictures"], list[tuple[int, *tuple[str, ...]]]()
        for number in sorted({*numbers[:1], *numbers[-1:]}):
            with self._noting_what_is_missing():
                pictures = [files.pictures / f"training_generator_{kind}{number}.png" for kind in PICTURES]
                self.augmentations.append((number, *map(picture_uri, pictures)))
        self.replays: list[dict[str, Any]] = []

    @contextlib.contextmanager
    def _noting_what_is_missing(self) -> Iterator[None]:
        try:
            yield
        except (UserError, OSError) as error:
            self.missing.append(message_of(error))

    def _read(self, folder: Path) -> None:
        """Read a recording that the run was given. Raises RecordingError, OSError."""
        recording = check_images(read_recording(folder), show_progress=False)
        if not len(recording):
            raise RecordingError(f"{folder}: no usable row is left")
        figures = summary.figures(recording, np.zeros(len(recording), bool))
        cut = sum(rows for _, rows in recording.cuts)
        self.trained_on.update(recording.digests[recording.images[:, 0]].tolist())
        self.recordings.append({**figures, "folder": folder, "cut_frames": cut})
        self.looked_at = self.looked_at or recording

    def replay(self, folders: list[Path]) -> None:
        """Let the network drive recordings, at both limits, but those too short for it. Raises UserError."""
        for folder in folders:
            try:
                recording, shots = load_recording(folder), Shots()
                lines, limits = reference_lines(recording), sorted(LIMITS, reverse=True)
            except NothingToReplay as error:
                self.missing.append(message_of(error))
                continue
            drives = drive_at_limits(recording, lines, ModelDriver(self.network), limits, shots.watch, parallel=True)
            drives.reverse()  # the one at the lower limit was driven last, because that is watched
            report = replay_report(recording, lines, drives, "lane")
            rows = [
                (limit, name, found["compared"].get(key, found))
                for limit, found in report["limits"].items()
                for key, name in DRIVERS.items()
            ]
            where = report["limits"][f"{limits[-1]:g}"]["where"]
            captions = [
                f"{at['seconds']:.1f} s   {abs(at['metres']):.2f} m to the {'right' if at['metres'] > 0 else 'left'}"
                for at in where
            ]
            pictures = [
                (caption, frame_uri(captioned(frame.view, steering, caption)))
                for caption, (frame, steering) in zip(captions, shots.taken, strict=False)
            ]
            is_given = not self.trained_on.isdisjoint(recording.digests[recording.images[:, 0]].tolist())
            other = "was held out" if self.knows_all else "it may have been trained on"
            which, curves = "it was trained on" if is_given else other, uri(plot(recording, drives), "image/png")
            shown = {"which": which, "table": rows, "plot": curves, "interventions": len(where), "pictures": pictures}
            self.replays.append(report | shown)
            self.looked_at = recording  # the network has not seen it, which tells more

    def examples(self) -> list[dict[str, str]]:
        """Return frames steered differently, and with what the network looks at. Raises ModelError, RecordingError."""
        if self.looked_at is None:
            return []
        recording, shown = self.looked_at, []
        order = np.argsort(recording.steering, kind="stable")
        for quantile in EXAMPLES:
            row = int(order[round(quantile * (len(order) - 1))])
            frame, human = read_frame(recording.path(row)), float(recording.steering[row])
            try:
                steering, mask = visual_backprop(self.network, frame)
            except ArithmeticError as error:
                raise ModelError(f"{self.model}: {error}; train the model again") from None
            recorded = picture_uri(panel(frame, recording.name(row), human))
            attention = frame_uri(overlay(frame, steering, mask))
            words = {"name": in_words(human), "steering": f"{steering:+.2f}, the driver {human:+.2f}"}
            shown.append({**words, "recorded": recorded, "attention": attention})
        return shown

    def next_steps(self) -> list[tuple[str, str]]:
        """Return what to do next: why, and a command."""
        folder, steps = self.model.parent, list[tuple[str, tuple[object, ...]]]()
        train = "python", "model.py"
        if not self.run["robust"]:
            why = "Train with recovery steering from other positions, which drives best"
            robust = ("--robust", "--output", folder / "robust" / "model.pt")
            steps.append((why, (*train, *self.run["recordings"], *robust)))
        epochs, go_on = self.run["epochs"], (*train, "--resume", "--output", self.output)
        if self.run["state"] == "stopped":
            steps.append((f"It stopped before the end of its {epochs} epochs: let it go on", go_on))
        if self.run["best"]["epoch"] == epochs:
            why = "The last epoch is the best one: train longer"
            steps.append((why, (*go_on, "--epochs", 2 * epochs)))
        if not self.replays:
            why = "Let it drive recordings that it was not trained on, and write this report again"
            steps.append((why, ("python", "-m", "cloning.report", folder, "--held-out", "FOLDER")))
        for each in self.replays:
            if each["interventions"]:
                why = f"Watch the interventions on {Path(each['recording']).name}, and record more of such places"
                steps.append((why, ("python", "-m", "cloning.browse", each["recording"], "--model", self.model)))
        steps.append(("Let it drive the simulator, or the stand-in for it", ("python", "drive.py", self.model)))
        return [(why, program.in_commands(as_typed(*command))) for why, command in steps]

    def page(self) -> str:
        """Return the page, which needs no other file. Raises UserError."""
        run, folder = self.run, Path(__file__).with_name("templates")
        best = next((row["val_drift"] for row in run["history"] if row["epoch"] == run["best"]["epoch"]), None)
        verdict = next((words for limit, words in VERDICTS if best is not None and best <= limit), "")
        driven = np.sum([each["histogram"] for each in self.recordings], axis=0, dtype=int)
        counts = {"of {:,} rows, as driven": driven} if self.recordings else {}
        if self.labels and not run["robust"]:  # whose labels depend on the position from which a row is seen
            counts["of {:,} for training, resampled"] = self.labels
        losses = {"loss": "training, augmented", "val_loss": "validation"}
        try:
            return whole_page(
                folder,
                report=self,
                run=run,
                recipe=self.recipe,
                examples=self.examples(),
                duration=duration(sum(row["seconds"] for row in run["history"])),
                layers=layer_table(self.network),
                steering=steering_chart(counts) if counts else None,
                drift=epochs_chart(run, {"val_drift": "drift"}, "m") if best is not None else None,
                losses=epochs_chart(run, losses, "mean squared error"),
                verdict=verdict.format(remedy="see what to do next, at the end"),
            )
        except jinja2.UndefinedError as error:
            raise UserError(f"{self.arguments}: of another version ({error}); train again with this one") from None
