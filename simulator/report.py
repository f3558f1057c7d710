"""The lap report: the metrics of a drive as JSON and as text, and a picture of the track from above."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cloning.base import program
from cloning.base.figure import png
from cloning.base.film import DriveFilm
from cloning.base.outputs import plural, run_all, write_output
from cloning.road.autonomy import LIMITS, autonomy, lap_in_words
from cloning.road.motion import MPH
from cloning.road.track import LEFT, RIGHT, Track
from simulator.car import STEP
from simulator.client import Client
from simulator.run import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes

JUMP = 3.0  # m: between plotted points further apart the car was set back, so no line joins them
MAP_INCHES, MARGIN = 6.0, 15.0  # the longer side of the map, and m that it shows around the centre line
ARROW_OFFSET, ARROW_LENGTH = 11.0, 35.0  # m from the centre line to the right, and m


def drive_and_report(client: Client, laps: float, *outputs: Callable[[], object], film: DriveFilm | None = None) -> int:
    """Let a server drive, print the lap report, make the film and the other outputs, and return the exit status.

    All this also of a drive that is not finished; of one that never began there is nothing to show.
    """

    def report() -> None:
        if client.run.time:
            run_all(lambda: print(report_text(lap_report(client.run, client))), *outputs)

    run_all(lambda: client.drive(laps), film.close if film else lambda: None, report)
    return program.INCOMPLETE if client.run.departures else program.DONE


def lap_report(run: Run, client: Client | None = None) -> dict[str, Any]:
    """Return the report of a run, for JSON, with the metrics of the client that drove it, if there is one.

    Offsets are absolute distances from the centre line, steering is -1..1, x is east and y north. A server's drive has
    its end (see `DriveEnd`), and once it has answered, times from a telemetry to its answer, and the time that the
    simulator itself used, which is measured in lock-step only.
    """
    offset = np.abs(run.trajectory.offset) if run.trajectory.offset else np.zeros(1)
    changes, lap_times = np.abs(np.diff(run.trajectory.steering)), np.diff([0.0, *run.lap_times])
    report: dict[str, Any] = {
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
        "autonomy": round(autonomy(len(run.departures), run.time), 4),
        "offset_mean_m": round(float(offset.mean()), 3),
        "offset_max_m": round(float(offset.max()), 3),
        "steering_roughness_per_s": round(float(changes.mean() / STEP), 3) if len(changes) else 0.0,
    }
    if client is None:
        return report
    if client.cameras.disturbance:
        report["disturbance"] = str(client.cameras.disturbance)
    report["ended"] = client.ended
    if client.round_trips:
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


def report_text(report: dict[str, Any]) -> str:
    """Return a report as lines for a terminal."""
    lines = [
        f"{report['track']} {report['direction']}: {plural(report['laps'], 'lap')}, {report['distance_m']:.0f} m in "
        f"{report['simulated_seconds']:.1f} s, {report['mean_speed_mph']:.1f} mph on average"
    ]
    if "disturbance" in report:
        lines.append(f"disturbance: {report['disturbance']}")
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
    """Plot a drive as PNG: the track from above with the car's path, and the lateral offset along the way.

    Its colours reach to 1 m, where a human would take over, as in the pictures of all drives. Raises OutputError.
    """
    from matplotlib import colors  # here, because loading matplotlib takes long and only this function needs it
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    track = run.track
    wide, high = np.ptp(track.points[:, :2], axis=0) + 2 * MARGIN
    map_inches = min(MAP_INCHES / wide, MAP_INCHES / high) * np.array([wide, high])
    figure = Figure(figsize=(map_inches[0] + 1.6, map_inches[1] + 2.8), layout="constrained")
    above, along = figure.subplots(2, 1, height_ratios=[map_inches[1], 1.7])
    above.set_aspect("equal")
    ring = track.wrap(np.arange(round(track.length / track.step) + 1))
    for column, side in enumerate((LEFT, RIGHT)):
        edge = track.points[ring, :2] + side * track.rightward[ring] * track.edges[ring, column, None]
        above.plot(*edge.T, color="0.6", linewidth=0.7)
    every = max(1, round(0.1 / STEP))
    trajectory = run.trajectory
    path_driven = np.column_stack([trajectory.x, trajectory.y])[::every]
    offset = np.array(trajectory.offset)[::every]
    metres = np.cumsum(trajectory.speed)[::every] * STEP
    joined = np.linalg.norm(np.diff(path_driven, axis=0), axis=1) < JUMP
    scale = max(LIMITS[0], math.ceil(10 * np.abs(offset).max(initial=0)) / 10)
    segments = np.stack([path_driven[:-1], path_driven[1:]], axis=1)
    lines = LineCollection(list(segments[joined]), cmap="viridis", norm=colors.Normalize(0, LIMITS[0]), linewidth=2.5)
    lines.set_array(np.abs(offset)[:-1][joined])
    above.add_collection(lines)
    extend = "max" if scale > LIMITS[0] else "neither"
    figure.colorbar(lines, ax=above, label="m from the centre line", shrink=0.8, extend=extend)
    mark_start(above, track)
    whole = metres.copy()
    whole[np.flatnonzero(~joined) + 1] = np.nan  # no line is plotted across a jump
    along.plot(whole, offset, linewidth=1)
    along.axhline(0, color="0.6", linewidth=0.7)
    for departure in run.departures:
        above.plot(departure.x, departure.y, "x", color="tab:red", markersize=9, markeredgewidth=2)
        name = {"color": "tab:red", "textcoords": "offset points"}
        above.annotate(f"{departure.time:.0f} s", (departure.x, departure.y), (4, 4), **name)
        driven = float(np.sum(trajectory.speed[: round(departure.time / STEP)]) * STEP)
        along.axvline(driven, color="tab:red", linewidth=1)
        along.annotate(f"{departure.time:.0f} s", (driven, -scale), (3, 3), **name)
    words = lap_in_words(lap_report(run)).replace("; ", "\n")
    above.set(xlabel="east, m", ylabel="north, m")
    along.set(xlabel="distance driven, m", ylabel="m right of the\ncentre line", ylim=(-1.05 * scale, 1.05 * scale))
    along.set_xlim(0, max(1.0, run.distance))
    along.grid(alpha=0.3)
    write_output(path, png(figure, 130, f"{track.name} {track.direction}: {words}"))


def mark_start(axes: "Axes", track: Track) -> None:
    """Plot where the autonomous mode starts, and an arrow beside the road in the direction of driving."""
    start = track.at(track.starts["autonomous"])
    beside = track.at(track.starts["autonomous"], ARROW_OFFSET)
    east, north = ARROW_LENGTH * math.cos(start.heading), ARROW_LENGTH * math.sin(start.heading)
    axes.plot(start.x, start.y, "o", color="black", markersize=6)
    arrow = {"arrowstyle": "-|>", "linewidth": 1.5, "color": "black"}
    axes.annotate("", (beside.x + east, beside.y + north), (beside.x, beside.y), arrowprops=arrow)
    behind = -0.35 * east, -0.35 * north  # points
    axes.annotate("start", (beside.x, beside.y), behind, ha="center", va="center", textcoords="offset points")
