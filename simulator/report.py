"""What a drive was like: as text, as JSON, and as a picture of the track from above."""

import io
import json
import math

import numpy as np

from cloning.errors import SimulatorError
from cloning.files import write
from cloning.road.motion import MPH
from simulator.car import STEP
from simulator.run import Run


def figures(run: Run, client=None) -> dict:
    """The lap report; seconds, metres, mph, steering as -1..1. client: whose frames and round trips belong
    to it."""
    offset = np.abs(run.trajectory.offset) if run.trajectory.offset else np.zeros(1)
    lap_times = np.diff([0.0, *run.lap_times])
    report = {
        "track": run.track.name,
        "direction": run.track.direction,
        "laps": run.laps,
        "seconds_a_lap": [round(float(seconds), 2) for seconds in lap_times],
        "simulated_seconds": round(run.time, 2),
        "distance_m": round(run.distance, 1),
        "mean_speed_mph": round(run.distance / run.time / MPH, 2) if run.time else 0.0,
        "departures": [
            {
                "time_s": round(d.time, 2),
                "along_m": round(float(d.s), 1),
                "side": d.side,
                "speed_mph": round(d.speed / MPH, 1),
                "x_m": round(d.x, 1),
                "y_m": round(d.y, 1),
            }
            for d in run.departures
        ],
        "autonomy": round(run.autonomy(), 4),
        "offset_mean_m": round(float(offset.mean()), 3),
        "offset_max_m": round(float(offset.max()), 3),
        "steering_roughness_per_s": round(run.roughness(), 3),
    }
    if client is not None and client.round_trips:
        trips = np.array(client.round_trips) * 1000
        report |= {
            "frames": client.frames,
            "frames_per_simulated_second": round(client.frames / run.time, 1) if run.time else 0.0,
            "round_trip_ms": {
                "median": round(float(np.median(trips)), 1),
                "p95": round(float(np.percentile(trips, 95)), 1),
                "max": round(float(trips.max()), 1),
            },
            "own_ms_a_frame": round(client.own_time / client.frames * 1000, 2) if client.own_time else None,
            "unusable_answers": client.dropped,
            "reconnections": client.reconnections,
        }
    return report


def text(report: dict) -> str:
    lines = [
        f"{report['track']} {report['direction']}: {report['laps']} laps, {report['distance_m']:.0f} m in "
        f"{report['simulated_seconds']:.1f} s, {report['mean_speed_mph']:.1f} mph on average"
    ]
    if report["seconds_a_lap"]:
        lines.append("seconds a lap: " + ", ".join(f"{seconds:.1f}" for seconds in report["seconds_a_lap"]))
    lines.append(f"departures: {len(report['departures'])}, autonomy {100 * report['autonomy']:.1f} %")
    lines += [
        f"  {d['time_s']:.1f} s, {d['along_m']:.0f} m along, to the {d['side']}, at {d['speed_mph']:.1f} mph"
        for d in report["departures"]
    ]
    lines.append(
        f"distance from the centre line: mean {report['offset_mean_m']:.2f} m, largest {report['offset_max_m']:.2f} m"
    )
    lines.append(f"steering: mean absolute change {report['steering_roughness_per_s']:.2f} per second")
    if "frames" in report:
        trip = report["round_trip_ms"]
        lines.append(
            f"frames: {report['frames']}, {report['frames_per_simulated_second']:.1f} per simulated second; "
            f"round trip {trip['median']:.1f} ms (95 %: {trip['p95']:.1f}, largest {trip['max']:.1f})"
        )
        if report["unusable_answers"] or report["reconnections"]:
            lines.append(f"unusable answers: {report['unusable_answers']}, reconnections: {report['reconnections']}")
    return "\n".join(lines)


def write_json(path: str, report: dict) -> None:
    """Raises SimulatorError."""
    put(path, json.dumps(report, indent=1).encode() + b"\n")


def put(path, data: bytes) -> None:
    """Write a file that the user named. Raises SimulatorError."""
    try:
        write(path, data)
    except OSError as error:
        raise SimulatorError(f"{path}: {error.strerror}; give a place that can be written") from error


def write_picture(path: str, run: Run) -> None:
    """The track from above, the way driven coloured by its distance from the centre line, departures marked.

    Raises SimulatorError.
    """
    from matplotlib import colors  # large, and needed only here
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    track = run.track
    figure = Figure(figsize=(9, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(aspect="equal")
    ring = np.r_[np.arange(len(track.points)), 0]
    for side, column in ((-1, 0), (1, 1)):
        edge = track.points[ring, :2] + side * track.rightward[ring] * track.edges[ring, column, None]
        axes.plot(*edge.T, color="0.6", linewidth=0.7)
    every = max(1, round(0.1 / STEP))
    way = np.column_stack([run.trajectory.x, run.trajectory.y])[::every]
    if len(way) > 1:
        pieces = np.stack([way[:-1], way[1:]], axis=1)
        pieces = pieces[np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1) < 3]
        lines = LineCollection(pieces, cmap="viridis", norm=colors.Normalize(0, 4), linewidth=1.8)
        jump = np.linalg.norm(np.diff(way, axis=0), axis=1) < 3
        lines.set_array(np.abs(run.trajectory.offset)[::every][:-1][jump])
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
    axes.set(xlabel="east, m", ylabel="north, m", title=text(figures(run)).splitlines()[0])
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    put(path, picture.getvalue())
