"""Replay metrics, as a report, as text, as a plot and as a film."""

import io
from pathlib import Path
from typing import TypedDict

import cv2
import numpy as np

from cloning.base.film import DriveFilm, frame_rate
from cloning.base.outputs import plural, write_output
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording
from cloning.replay.replay import Drive, Driver, ReferenceLine, ReplayFrame, drive
from cloning.road.camera import FIRST_BONNET_ROW
from cloning.road.overlay import overlay

SMOOTHED_ROWS = 9  # rows (0.6 s) over which steering is averaged before it is correlated
CAPTION_ROWS = 28  # of the film, above each frame
LISTED = 10  # interventions that the text lists for each limit
ORACLE = "oracle"  # the report's key of the recovery steering as the driver: the best that the measure allows
YARDSTICKS = {"steering_zero": "steering 0", "mean_steering": "mean steering", "human": "human driver"}  # key: words


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

    reference_asked: "lane" or "human"; reference: the rows measured from the lane's centre, `lane_centre`, and from the
    human driver's path, `human_way`; limits: by the limit in metres; steering_compared: of constant steering.
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
    """Return the report of a recording's drives, one per limit, compared with the oracle and the YARDSTICKS.

    lines: of `reference_lines`; asked: the reference that the user chose, "lane" or "human".
    """
    human = np.array(drives[0].human_steering)
    mean = float(recording.steering.mean())
    others: dict[str, Driver] = {
        "steering_zero": lambda _: 0.0,
        "mean_steering": lambda _: mean,
        "human": lambda frame: frame.human_steering,
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
                name: driving_metrics(drive(recording, lines, done.limit, driver)) for name, driver in others.items()
            },
        }

    return {
        "recording": str(recording.folder),
        "rows": len(recording),
        "rows_driven": rows,
        "stretches": len(lines),
        "seconds": round(sum(drives[0].seconds), 2),
        "reference_asked": asked,
        "reference": {"lane_centre": by_lane, "human_way": rows - by_lane},
        "limits": {f"{done.limit:g}": limit_report(done) for done in drives},
        "steering_compared": {
            "steering_zero": steering_metrics(np.zeros_like(human), human),
            "mean_steering": steering_metrics(np.full_like(human, mean), human),
        },
    }


def report_text(report: ReplayReport) -> str:
    """Return a report as lines for a terminal."""
    by_lane, by_human = report["reference"]["lane_centre"], report["reference"]["human_way"]
    references = [f"the lane centre in {by_lane} rows"] if by_lane else []
    references += [f"the human driver's path in {by_human} rows"] if by_human else []
    stretches = plural(report["stretches"], "stretch", "stretches")
    lines = [
        f"{report['recording']}: replayed {report['seconds']:.1f} s in {stretches} ({report['rows_driven']} of "
        f"{report['rows']} rows); offsets are measured from {' and '.join(references)}"
    ]
    if report["reference_asked"] == "lane" and by_human:
        lines.append("  the lane centre cannot be estimated reliably where the human driver's path is used instead")
    for limit, metrics in report["limits"].items():
        others = {words: metrics["compared"][name] for name, words in YARDSTICKS.items()}
        lines.append(f"limit {limit} m: {_driving(metrics)}")
        lines.append(f"  oracle (the recovery steering itself, driven): {_driving(metrics['compared'][ORACLE])}")
        yardsticks = (f"{words} {o['autonomy_percent']:.0f} % ({o['interventions']})" for words, o in others.items())
        lines.append("  yardsticks, autonomy (interventions): " + ", ".join(yardsticks))
        for at in metrics["where"][:LISTED]:
            side = "right" if at["metres"] > 0 else "left"
            lines.append(
                f"  intervention at {at['seconds']:.1f} s: {abs(at['metres']):.2f} m to the {side}, {at['image']}"
            )
        if (more := len(metrics["where"]) - LISTED) > 0:
            lines.append(f"  … and {plural(more, 'more intervention')}")
    limit, metrics = next(iter(report["limits"].items()))
    steering = metrics["steering"]
    errors = (f"{YARDSTICKS[name]} {other['error']:.3f}" for name, other in report["steering_compared"].items())
    correlation = "undefined (constant steering)" if steering["correlation"] is None else steering["correlation"]
    lines.append(
        f"steering compared with the human driver's, at limit {limit} m: RMS error {steering['error']:.3f} "
        f"(yardsticks: {', '.join(errors)}); correlation, both smoothed over {SMOOTHED_ROWS} rows: {correlation}"
    )
    return "\n".join(lines)


def _driving(metrics: DrivingMetrics) -> str:
    """Return the metrics of one drive in the text."""
    return (
        f"autonomy {metrics['autonomy_percent']:.1f} %, {plural(metrics['interventions'], 'intervention')}; "
        f"distance from the reference: mean {metrics['distance_mean_m']:.2f} m, "
        f"95th percentile {metrics['distance_p95_m']:.2f} m"
    )


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
        count = plural(len(done.interventions), "intervention")
        title = f"limit {done.limit:g} m: autonomy {100 * done.autonomy():.1f} %, {count}"
        ax.set(ylabel="m right of the reference", title=title)
    seconds = np.cumsum(drives[-1].seconds)
    axes[-1].plot(seconds, drives[-1].steering, linewidth=0.8, label="model")
    axes[-1].plot(seconds, drives[-1].human_steering, linewidth=0.6, color="0.5", label="human driver")
    axes[-1].set(xlabel="s", ylabel="steering")
    for ax in axes:
        ax.legend(loc="upper right", fontsize=8)
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
            caption += f"   {plural(len(done.interventions), 'intervention')}"
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
