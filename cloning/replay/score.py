"""Replay metrics, as a report, as text, as a plot and as a film."""

import itertools
from typing import Any

import cv2
import numpy as np

from cloning.base.figure import png
from cloning.base.film import DriveFilm, frame_rate
from cloning.base.outputs import plural
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording
from cloning.replay.replay import Drive, Driver, ReferenceLine, ReplayFrame, drive
from cloning.road.autonomy import autonomy
from cloning.road.camera import FIRST_BONNET_ROW
from cloning.road.motion import stretch_rows
from cloning.road.overlay import overlay

SMOOTHED_ROWS = 9  # rows (0.6 s) over which steering is averaged before it is correlated
CAPTION_ROWS = 28  # of the film, above each frame
LISTED = 10  # interventions that the text lists for each limit
LANE_CENTRE, HUMAN_WAY = "lane_centre", "human_way"  # the report's keys of the reference lines
REFERENCES = {LANE_CENTRE: "from the lane's centre", HUMAN_WAY: "from the recorded driver's path"}
# Why the lane's centre is not the reference.
NOT_DRIVEN = "not driven: standing, or less than two seconds without a break"
NOT_ON_THE_ROAD = "not driven: off the road, or the car did not move as it was steered"
AS_ASKED = "measured from the recorded driver's path, as asked"
NOT_READ = (
    "measured from the recorded driver's path: not placed on a known track, and not read reliably from the frames"
)
ORACLE = "oracle"  # the report's key of the recovery steering as the driver: the best that the measure allows
YARDSTICKS = {"steering_zero": "steering 0", "mean_steering": "mean steering", "human": "recorded driver"}  # key: words


Metrics = dict[str, Any]  # figures by their names in a report, in JSON's types


def driving_metrics(done: Drive, counted: np.ndarray | None = None) -> Metrics:
    """Return the metrics of one drive: autonomy in percent, and absolute offsets from the reference line in metres.

    counted: bool (n,), the entries that count, at least one; None: all.
    """
    counted = np.ones(len(done.row), bool) if counted is None else counted
    distance = np.abs(done.offset)[counted]
    interventions = sum(bool(counted[at]) for at in done.interventions)
    return {
        "autonomy_percent": round(100 * autonomy(interventions, float(np.array(done.seconds)[counted].sum())), 4),
        "interventions": interventions,
        "distance_mean_m": round(float(distance.mean()), 3),
        "distance_p95_m": round(float(np.percentile(distance, 95)), 3),
    }


def drive_metrics(lines: list[ReferenceLine], done: Drive) -> Metrics:
    """Return the metrics of the drive along these lines.

    by_reference: separately for the rows with each kind of reference line, by `LANE_CENTRE` and `HUMAN_WAY`, those that
    there are; steering_roughness_per_s: mean absolute change of the steering, -1..1, per second.
    """
    by_lane = np.repeat([line.is_lane_centre for line in lines], [len(line.stretch) for line in lines])
    seconds, change = np.array(done.seconds), np.abs(np.diff(done.steering, prepend=done.steering[0]))
    inside = seconds > 0  # not the first row of a line
    parts = {LANE_CENTRE: by_lane, HUMAN_WAY: ~by_lane}
    return {
        **driving_metrics(done),
        "by_reference": {name: driving_metrics(done, counted) for name, counted in parts.items() if counted.any()},
        "steering_roughness_per_s": round(float(change[inside].sum() / max(seconds.sum(), 1e-9)), 3),
    }


def reference_metrics(recording: Recording, lines: list[ReferenceLine], asked: str = "lane") -> Metrics:
    """Return what is known of the lane in a recording; lines, asked: as for `replay_report`.

    rows_placed: whose position is that on a known track, or told by the recording itself; None if the lane was not
    asked for; unknown: successive rows where the lane's centre is not the reference: the first and the last centre
    image, their number, and why; mean_speed_mph: of the rows driven.
    """
    by_lane = asked == "lane"
    not_by_lane = NOT_READ if by_lane else AS_ASKED
    why, driven = np.full(len(recording), NOT_DRIVEN, object), np.zeros(len(recording), bool)
    for rows in stretch_rows(recording):
        why[rows] = NOT_ON_THE_ROAD
    for line in lines:
        why[line.rows], driven[line.rows] = "" if line.is_lane_centre else not_by_lane, True
    edges = np.flatnonzero(why[1:] != why[:-1]) + 1
    runs = itertools.pairwise([0, *edges.tolist(), len(why)])
    return {
        "rows_placed": sum(line.placed for line in lines) if by_lane else None,
        "unknown": [
            {"first": recording.name(start), "last": recording.name(end - 1), "rows": end - start, "why": why[start]}
            for start, end in runs
            if why[start]
        ],
        "mean_speed_mph": round(float(recording.speed[driven].mean()), 1),
    }


def steering_metrics(steering: np.ndarray, human: np.ndarray) -> Metrics:
    """Compare steering with the human driver's: float (n,) each, -1..1.

    error: root mean squared difference; correlation: of both, averaged over nine rows; None if either is constant.
    """
    kernel = np.ones(SMOOTHED_ROWS) / SMOOTHED_ROWS
    smooth, smooth_human = (np.convolve(values, kernel, "valid") for values in (steering, human))
    varies = np.ptp(smooth) > 0 and np.ptp(smooth_human) > 0
    return {
        "error": round(float(np.sqrt(np.mean((steering - human) ** 2))), 4),
        "correlation": round(float(np.corrcoef(smooth, smooth_human)[0, 1]), 3) if varies else None,
    }


def replay_report(
    recording: Recording, lines: list[ReferenceLine], drives: list[Drive], asked: str, disturbance: str | None = None
) -> Metrics:
    """Return the report of a recording's drives, one per limit, compared with the oracle and the YARDSTICKS.

    lines: of `reference_lines`; asked: the reference that the user chose, "lane" or "human"; disturbance: of what the
    driver saw, such as "fog:3".
    """
    human = np.array(drives[0].human_steering)
    mean = float(recording.steering.mean())
    others: dict[str, Driver] = {
        "steering_zero": lambda _: 0.0,
        "mean_steering": lambda _: mean,
        "human": lambda frame: frame.human_steering,
        ORACLE: ReplayFrame.recovery_steering,
    }
    by_lane = sum(len(line.stretch) for line in lines if line.is_lane_centre)

    def limit_report(done: Drive) -> Metrics:
        return {
            **drive_metrics(lines, done),
            "steering": steering_metrics(np.array(done.steering), human),
            "where": [  # s driven until then, and m right of the reference line
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
        "rows_driven": len(human),
        "stretches": len(lines),
        "seconds": round(sum(drives[0].seconds), 2),
        **reference_metrics(recording, lines, asked),
        "disturbance": disturbance,
        "reference_asked": asked,
        "reference": {LANE_CENTRE: by_lane, HUMAN_WAY: len(human) - by_lane},  # rows measured from each
        "limits": {f"{done.limit:g}": limit_report(done) for done in drives},  # by the limit in m
        "steering_compared": {
            "steering_zero": steering_metrics(np.zeros_like(human), human),
            "mean_steering": steering_metrics(np.full_like(human, mean), human),
        },
    }


def report_text(report: Metrics) -> str:
    """Return a report as lines for a terminal."""
    stretches, rows = plural(report["stretches"], "stretch", "stretches"), report["rows"]
    lines = [
        f"{report['recording']}: replayed {report['seconds']:.1f} s in {stretches} ({report['rows_driven']} of {rows} "
        f"rows) at {report['mean_speed_mph']:.1f} mph on average"
    ]
    if report["rows_placed"] is not None:
        placed = report["rows_placed"] / rows
        lines[0] += f"; {100 * placed:.1f} % of the rows are placed, on a known track or by the recording itself"
    if report["disturbance"]:
        lines.append(f"  disturbance: {report['disturbance']}")
    if report["reference_asked"] == "lane":
        unknown = [
            f"{plural(u['rows'], 'row')} from {u['first']} to {u['last']}: {u['why']}" for u in report["unknown"]
        ]
        lines += [f"  lane's centre unknown in {words}" for words in unknown[:LISTED]]
        if (more := len(unknown) - LISTED) > 0:
            lines.append(f"  … and in {plural(more, 'more place')}")
    for limit, metrics in report["limits"].items():
        others = {words: metrics["compared"][name] for name, words in YARDSTICKS.items()}
        kinds = [(REFERENCES[name], part) for name, part in metrics["by_reference"].items()]
        if len(kinds) > 1:
            kinds.append(("from both", metrics))
        lines += [f"limit {limit} m, {words}: {_driving(part)}" for words, part in kinds]
        lines.append(f"  mean absolute change of the steering: {metrics['steering_roughness_per_s']:.2f} per second")
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
        f"steering compared with the recorded driver's, at limit {limit} m: RMS error {steering['error']:.3f} "
        f"(yardsticks: {', '.join(errors)}); correlation, both smoothed over {SMOOTHED_ROWS} rows: {correlation}"
    )
    return "\n".join(lines)


def _driving(metrics: Metrics) -> str:
    return (
        f"autonomy {metrics['autonomy_percent']:.1f} %, {plural(metrics['interventions'], 'intervention')}; "
        f"distance: mean {metrics['distance_mean_m']:.2f} m, "
        f"95th percentile {metrics['distance_p95_m']:.2f} m"
    )


def plot(recording: Recording, drives: list[Drive]) -> bytes:
    """Return a PNG of offsets and steering over time, with the interventions."""
    from matplotlib.figure import Figure  # slow to import, and not needed without a plot

    figure = Figure(figsize=(12, 2.6 * (len(drives) + 1)), layout="constrained")
    axes = figure.subplots(len(drives) + 1, 1, sharex=True)
    for ax, done in zip(axes, drives, strict=False):
        seconds, begins = np.cumsum(done.seconds), np.equal(done.seconds, 0)
        offset = np.where(begins, np.nan, done.offset)  # no line is plotted across a break
        ax.axhspan(-done.limit, done.limit, color="0.93")
        ax.plot(seconds, offset, linewidth=0.9, label="model")
        ax.plot(seconds, offset - done.offset_from_human, linewidth=0.7, color="0.5", label="recorded driver")
        for at in done.interventions:
            ax.axvline(seconds[at], color="tab:red", linewidth=0.8)
        count = plural(len(done.interventions), "intervention")
        title = f"limit {done.limit:g} m: autonomy {100 * done.autonomy():.1f} %, {count}"
        ax.set(ylabel="m right of the reference", title=title)
    seconds = np.cumsum(drives[-1].seconds)
    axes[-1].plot(seconds, drives[-1].steering, linewidth=0.8, label="model")
    axes[-1].plot(seconds, drives[-1].human_steering, linewidth=0.6, color="0.5", label="recorded driver")
    axes[-1].set(xlabel="s", ylabel="steering")
    for ax in axes:
        ax.legend(loc="upper right", fontsize=8)
    return png(figure, 90, recording.folder.name)


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
            captioned(frame.recorded, frame.human_steering, f"recorded driver   steering {frame.human_steering:+.3f}"),
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
