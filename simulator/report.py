"""The lap report: the metrics of a drive as JSON and as text, and a picture of the track from above."""

import io
import math
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np

from cloning.outputs import write_output
from cloning.road.motion import MPH
from cloning.road.track import LEFT, RIGHT
from simulator.car import STEP
from simulator.client import Client
from simulator.run import Run

JUMP = 3.0  # m: between plotted points further apart the car was set back, so no line joins them


class DepartureReport(TypedDict):
    """Where the car left the road; x is east, y is north."""

    time_s: float
    along_m: float
    side: str
    speed_mph: float
    x_m: float
    y_m: float


class RoundTrips(TypedDict):
    """Milliseconds from a telemetry to its answer."""

    median: float
    p95: float
    max: float


class LapReport(TypedDict):
    """The metrics of a drive; offsets are absolute distances from the centre line, steering is -1..1.

    The keys from `frames` on exist if a server drove. own_ms_a_frame is the time that the simulator itself used, which
    is measured in lock-step only.
    """

    track: str
    direction: str
    laps: int
    seconds_a_lap: list[float]
    simulated_seconds: float
    distance_m: float
    mean_speed_mph: float
    departures: list[DepartureReport]
    autonomy: float
    offset_mean_m: float
    offset_max_m: float
    steering_roughness_per_s: float
    frames: NotRequired[int]
    frames_per_simulated_second: NotRequired[float]
    round_trip_ms: NotRequired[RoundTrips]
    own_ms_a_frame: NotRequired[float | None]
    unusable_answers: NotRequired[int]
    reconnections: NotRequired[int]


def lap_report(run: Run, client: Client | None = None) -> LapReport:
    """Return the report of a run, with the metrics of the client that drove it, if there is one."""
    offset = np.abs(run.trajectory.offset) if run.trajectory.offset else np.zeros(1)
    lap_times = np.diff([0.0, *run.lap_times])
    report: LapReport = {
        "track": run.track.name,
        "direction": run.track.direction,
        "laps": run.laps,
        "seconds_a_lap": [round(float(seconds), 2) for seconds in lap_times],
        "simulated_seconds": round(run.time, 2),
        "distance_m": round(run.distance, 1),
        "mean_speed_mph": round(run.distance / run.time / MPH, 2) if run.time else 0.0,
        "departures": [
            {
                "time_s": round(departure.time, 2),
                "along_m": round(float(departure.s), 1),
                "side": departure.side,
                "speed_mph": round(departure.speed / MPH, 1),
                "x_m": round(departure.x, 1),
                "y_m": round(departure.y, 1),
            }
            for departure in run.departures
        ],
        "autonomy": round(run.autonomy(), 4),
        "offset_mean_m": round(float(offset.mean()), 3),
        "offset_max_m": round(float(offset.max()), 3),
        "steering_roughness_per_s": round(run.roughness(), 3),
    }
    if client is not None and client.round_trips:
        milliseconds = np.array(client.round_trips) * 1000
        report |= {
            "frames": client.frames,
            "frames_per_simulated_second": round(client.frames / run.time, 1) if run.time else 0.0,
            "round_trip_ms": {
                "median": round(float(np.median(milliseconds)), 1),
                "p95": round(float(np.percentile(milliseconds, 95)), 1),
                "max": round(float(milliseconds.max()), 1),
            },
            "own_ms_a_frame": round(client.own_time / client.frames * 1000, 2) if client.own_time else None,
            "unusable_answers": client.unusable,
            "reconnections": client.reconnections,
        }
    return report


def report_text(report: LapReport) -> str:
    """Return a report as lines for a terminal."""
    lines = [
        f"{report['track']} {report['direction']}: {report['laps']} laps, {report['distance_m']:.0f} m in "
        f"{report['simulated_seconds']:.1f} s, {report['mean_speed_mph']:.1f} mph on average"
    ]
    if report["seconds_a_lap"]:
        lines.append("seconds per lap: " + ", ".join(f"{seconds:.1f}" for seconds in report["seconds_a_lap"]))
    lines.append(f"departures: {len(report['departures'])}, autonomy {100 * report['autonomy']:.1f} %")
    lines += [
        f"  after {departure['time_s']:.1f} s, {departure['along_m']:.0f} m along the track, to the "
        f"{departure['side']}, at {departure['speed_mph']:.1f} mph"
        for departure in report["departures"]
    ]
    lines.append(
        f"distance from the centre line: mean {report['offset_mean_m']:.2f} m, maximum {report['offset_max_m']:.2f} m"
    )
    lines.append(f"steering: mean absolute change {report['steering_roughness_per_s']:.2f} per second")
    if "frames" in report:
        trip = report["round_trip_ms"]
        lines.append(
            f"frames: {report['frames']}, {report['frames_per_simulated_second']:.1f} per simulated second; "
            f"round trip: median {trip['median']:.1f} ms, 95th percentile {trip['p95']:.1f}, maximum {trip['max']:.1f}"
        )
        if report["unusable_answers"] or report["reconnections"]:
            lines.append(f"unusable answers: {report['unusable_answers']}, reconnections: {report['reconnections']}")
    return "\n".join(lines)


def write_picture(path: str | Path, run: Run) -> None:
    """Plot the track from above as PNG: the car's path, coloured by its distance from the centre line, and departures.

    Raises OutputError.
    """
    from matplotlib import colors  # here, because loading matplotlib takes long and only this function needs it
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    track = run.track
    figure = Figure(figsize=(9, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(aspect="equal")
    ring = np.r_[np.arange(len(track.points)), 0]
    for column, side in enumerate((LEFT, RIGHT)):
        edge = track.points[ring, :2] + side * track.rightward[ring] * track.edges[ring, column, None]
        axes.plot(*edge.T, color="0.6", linewidth=0.7)
    every = max(1, round(0.1 / STEP))
    path_driven = np.column_stack([run.trajectory.x, run.trajectory.y])[::every]
    if len(path_driven) > 1:
        segments = np.stack([path_driven[:-1], path_driven[1:]], axis=1)
        joined = np.linalg.norm(np.diff(path_driven, axis=0), axis=1) < JUMP
        lines = LineCollection(list(segments[joined]), cmap="viridis", norm=colors.Normalize(0, 4), linewidth=1.8)
        lines.set_array(np.abs(run.trajectory.offset)[::every][:-1][joined])
        axes.add_collection(lines)
        figure.colorbar(lines, ax=axes, label="distance from the centre line, m", shrink=0.7)
    start = track.at(track.starts["autonomous"])
    axes.annotate(
        "",
        (start.x + 12 * math.cos(start.heading), start.y + 12 * math.sin(start.heading)),
        (start.x, start.y),
        arrowprops={"arrowstyle": "->", "linewidth": 1.5},
    )
    for departure in run.departures:
        axes.plot(departure.x, departure.y, "x", color="tab:red", markersize=9, markeredgewidth=2)
        axes.annotate(
            f"{departure.time:.0f} s",
            (departure.x, departure.y),
            (4, 4),
            textcoords="offset points",
            color="tab:red",
        )
    axes.set(xlabel="east, m", ylabel="north, m", title=report_text(lap_report(run)).splitlines()[0])
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_output(path, picture.getvalue())
