"""Replay metrics, as a report, as text, as a plot and as a film."""

import io
from pathlib import Path
from typing import TypedDict

import cv2
import numpy as np

from cloning.base.film import DriveFilm, frame_rate
from cloning.base.outputs import write_output
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording
from cloning.replay.replay import Drive, Driver, ReferenceLine, ReplayFrame, drive
from cloning.road.camera import FIRST_BONNET_ROW
from cloning.road.overlay import overlay

SMOOTHED_ROWS = 9  # rows (0.6 s) over which steering is averaged before it is correlated
CAPTION_ROWS = 28  # of the film, above each frame
LISTED = 10  # interventions that the text lists for each limit
HUMAN = "the human"  # the report's key of the human driver's own steering
ORACLE = "oracle"  # that of the recovery steering, the label of `model.py --robust`: the best that the measure allows


class DrivingMetrics(TypedDict):
    """The metrics of one drive: autonomy in percent, and absolute offsets from the reference line in metres."""

    autonomy_percent: float
    interventions: int
    distance_mean_m: float
    distance_p95_m: float


class SteeringMetrics(TypedDict):
    """Steering, -1..1, compared with the human driver's.

    error: root mean squared difference; correlation: of both, averaged over nine rows; None if either is constant.
    """

    error: float
    correlation: float | None


class Intervention(TypedDict):
    """An intervention: the centre image's name, seconds driven until then, and metres right of the reference line."""

    image: str
    seconds: float
    metres: float


class LimitReport(DrivingMetrics):
    """The metrics of the drive at one limit; compared: those of the yardsticks, by name."""

    steering: SteeringMetrics
    where: list[Intervention]
    compared: dict[str, DrivingMetrics]


class ReplayReport(TypedDict):
    """The report of one recording.

    reference_asked: "lane" or "human"; reference: number of rows measured from the lane centre, and from the human's
    way (the human driver's path); limits: by the limit in metres; steering_compared: of constant steering.
    """

    recording: str
    rows: int
    rows_driven: int
    stretches: int
    seconds: float
    reference_asked: str
    reference: dict[str, int]
    limits: dict[str, LimitReport]
    steering_compared: dict[str, SteeringMetrics]


def driving_metrics(done: Drive) -> DrivingMetrics:
    """Return the metrics of one drive."""
    distance = np.abs(done.offset)
    return {
        "autonomy_percent": round(100 * done.autonomy(), 4),
        "interventions": len(done.interventions),
        "distance_mean_m": round(float(distance.mean()), 3),
        "distance_p95_m": round(float(np.percentile(distance, 95)), 3),
    }


def steering_metrics(steering: np.ndarray, human: np.ndarray) -> SteeringMetrics:
    """Compare steering with the human driver's: float (n,) each, -1..1."""
    smooth, smooth_human = (
        np.convolve(values, np.ones(SMOOTHED_ROWS) / SMOOTHED_ROWS, "valid") for values in (steering, human)
    )
    varies = np.ptp(smooth) > 0 and np.ptp(smooth_human) > 0
    return {
        "error": round(float(np.sqrt(np.mean((steering - human) ** 2))), 4),
        "correlation": round(float(np.corrcoef(smooth, smooth_human)[0, 1]), 3) if varies else None,
    }


def replay_report(recording: Recording, lines: list[ReferenceLine], drives: list[Drive], asked: str) -> ReplayReport:
    """Return the report of a recording's drives, one per limit, with those of four yardsticks.

    The yardsticks are steering 0, the recording's mean steering, the human driver's own steering, and the oracle.
    lines: of `reference_lines`; asked: the reference that the user chose, "lane" or "human".
    """
    human = np.array(drives[0].human_steering)
    mean = float(recording.steering.mean())
    yardsticks: dict[str, Driver] = {
        "steering 0": lambda frame: 0.0,
        "mean steering": lambda frame: mean,
        HUMAN: lambda frame: frame.human_steering,
        ORACLE: ReplayFrame.recovery_steering,
    }
    rows = sum(len(line.stretch) for line in lines)
    by_lane = sum(len(line.stretch) for line in lines if line.is_lane_centre)

    def limit_report(done: Drive) -> LimitReport:
        return {
            **driving_metrics(done),
            "steering": steering_metrics(np.array(done.steering), human),
            "where": [
                {
                    "image": recording.name(done.row[at]),
                    "seconds": round(sum(done.seconds[: at + 1]), 2),
                    "metres": round(offset, 2),
                }
                for at, offset in done.interventions.items()
            ],
            "compared": {
                name: driving_metrics(drive(recording, lines, done.limit, driver))
                for name, driver in yardsticks.items()
            },
        }

    return {
        "recording": str(recording.folder),
        "rows": len(recording),
        "rows_driven": rows,
        "stretches": len(lines),
        "seconds": round(sum(drives[0].seconds), 2),
        "reference_asked": asked,
        "reference": {"lane centre": by_lane, "human's way": rows - by_lane},
        "limits": {f"{done.limit:g}": limit_report(done) for done in drives},
        "steering_compared": {
            "steering 0": steering_metrics(np.zeros_like(human), human),
            "mean steering": steering_metrics(np.full_like(human, mean), human),
        },
    }


def report_text(report: ReplayReport) -> str:
    """Return a report as lines for a terminal."""
    by_lane, by_human = report["reference"]["lane centre"], report["reference"]["human's way"]
    references = [f"the lane centre in {by_lane} rows"] if by_lane else []
    references += [f"the human driver's path in {by_human} rows"] if by_human else []
    stretches = "1 stretch" if report["stretches"] == 1 else f"{report['stretches']} stretches"
    lines = [
        f"{report['recording']}: replayed {report['seconds']:.1f} s in {stretches} ({report['rows_driven']} of "
        f"{report['rows']} rows); offsets are measured from {' and '.join(references)}"
    ]
    if report["reference_asked"] == "lane" and by_human:
        lines.append("  the lane centre cannot be estimated reliably where the human driver's path is used instead")
    for limit, metrics in report["limits"].items():
        lines.append(f"limit {limit} m: {_driving(metrics)}")
        lines.append(f"  oracle (the recovery steering itself, driven): {_driving(metrics['compared'][ORACLE])}")
        yardsticks = (
            f"{_plain(name)} {other['autonomy_percent']:.0f} % ({other['interventions']})"
            for name, other in metrics["compared"].items()
            if name != ORACLE
        )
        lines.append("  yardsticks, autonomy (interventions): " + ", ".join(yardsticks))
        lines += [
            f"  intervention at {at['seconds']:.1f} s: {abs(at['metres']):.2f} m to the "
            f"{'right' if at['metres'] > 0 else 'left'}, {at['image']}"
            for at in metrics["where"][:LISTED]
        ]
        if len(metrics["where"]) > LISTED:
            lines.append(f"  … and {len(metrics['where']) - LISTED} more interventions")
    limit, metrics = next(iter(report["limits"].items()))
    steering = metrics["steering"]
    errors = ", ".join(f"{name} {other['error']:.3f}" for name, other in report["steering_compared"].items())
    correlation = "undefined (constant steering)" if steering["correlation"] is None else steering["correlation"]
    lines.append(
        f"steering compared with the human driver's, at limit {limit} m: RMS error {steering['error']:.3f} "
        f"(yardsticks: {errors}); correlation, both smoothed over {SMOOTHED_ROWS} rows: {correlation}"
    )
    return "\n".join(lines)


def _driving(metrics: DrivingMetrics) -> str:
    """Return the metrics of one drive in the text."""
    return (
        f"autonomy {metrics['autonomy_percent']:.1f} %, {metrics['interventions']} interventions; distance from the "
        f"reference: mean {metrics['distance_mean_m']:.2f} m, 95th percentile {metrics['distance_p95_m']:.2f} m"
    )


def _plain(name: str) -> str:
    """Return a yardstick's name in the text: the report's keys remain those of earlier versions."""
    return "human driver" if name == HUMAN else name


def write_plot(path: str | Path, recording: Recording, drives: list[Drive]) -> None:
    """Plot offsets and steering over time, with the interventions, into a PNG file. Raises OutputError."""
    from matplotlib.figure import Figure  # slow to import, and not needed without a plot

    figure = Figure(figsize=(12, 2.6 * (len(drives) + 1)), layout="constrained")
    axes = figure.subplots(len(drives) + 1, 1, sharex=True)
    for ax, done in zip(axes, drives, strict=False):
        seconds, offset = np.cumsum(done.seconds), np.array(done.offset)
        human_offset = offset - done.offset_from_human
        offset[np.flatnonzero(np.diff(done.row) > 1) + 1] = np.nan  # no line is plotted across a break
        ax.axhspan(-done.limit, done.limit, color="0.93")
        ax.plot(seconds, offset, linewidth=0.9, label="model")
        ax.plot(seconds, human_offset, linewidth=0.7, color="0.5", label="human driver")
        for at in done.interventions:
            ax.axvline(seconds[at], color="tab:red", linewidth=0.8)
        ax.set(
            ylabel="m right of the reference",
            title=f"limit {done.limit:g} m: autonomy {100 * done.autonomy():.1f} %, "
            f"{len(done.interventions)} interventions",
        )
        ax.legend(loc="upper right", fontsize=8)
    seconds = np.cumsum(drives[-1].seconds)
    axes[-1].plot(seconds, drives[-1].steering, linewidth=0.8, label="model")
    axes[-1].plot(seconds, drives[-1].human_steering, linewidth=0.6, color="0.5", label="human driver")
    axes[-1].set(xlabel="s", ylabel="steering")
    axes[-1].legend(loc="upper right", fontsize=8)
    file = io.BytesIO()
    figure.suptitle(recording.folder.name)
    figure.savefig(file, format="png", dpi=90)
    write_output(path, file.getvalue())


class ReplayFilm(DriveFilm):
    """A film of a replay: the model's view and steering on the left, the human driver's on the right.

    It shows what is above the bonnet: a view from another pose ends there, and the network sees no more either.
    """

    def __init__(self, path: str):
        """Open the film. Raises OutputError."""
        super().__init__(path, SAMPLE_RATE, quality=24)

    def begin(self, recording: Recording) -> None:
        """Give the film the recording's own rate, unless it has begun with another recording."""
        if self.writer.stream is None:
            self.writer.rate = frame_rate(recording.time.tolist(), SAMPLE_RATE)

    def watch(self, frame: ReplayFrame, done: Drive) -> None:
        """Append the row that was just driven."""
        if self.error:
            return
        caption = f"model   steering {done.steering[-1]:+.3f}   {done.offset[-1]:+.2f} m   limit {done.limit:g} m"
        if done.interventions:
            caption += f"   interventions {len(done.interventions)}"
        views = [
            captioned(frame.view, done.steering[-1], caption),
            captioned(frame.recorded, frame.human_steering, f"human driver   steering {frame.human_steering:+.3f}"),
        ]
        self.add(np.hstack(views))


def captioned(frame: np.ndarray, steering: float, caption: str) -> np.ndarray:
    """Return a frame above the bonnet, at twice its size, with a caption on black and the path at this steering.

    frame: uint8 (160, 320, 3), RGB; returns uint8 (298, 640, 3), RGB.
    """
    shown = overlay(frame, steering)[: 2 * FIRST_BONNET_ROW]
    shown = cv2.copyMakeBorder(shown, CAPTION_ROWS, 0, 0, 0, cv2.BORDER_CONSTANT)
    cv2.putText(shown, caption, (10, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return shown
