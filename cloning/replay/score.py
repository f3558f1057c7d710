"""What replays of recordings came to: as figures, as text, as a picture and as a film."""

import io
from pathlib import Path

import cv2
import numpy as np

from cloning.errors import SimulatorError
from cloning.film import FilmWriter
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording
from cloning.replay.replay import Drive, Moment, Reference, drive
from simulator.report import put

SMOOTHED = 9  # rows over which steering is averaged before it is compared


def percentages(done: Drive) -> dict:
    """Of one drive: autonomy in percent, interventions, metres from the reference."""
    away = np.abs(done.distance)
    return {
        "autonomy_percent": round(100 * done.autonomy(), 2),
        "interventions": len(done.interventions),
        "distance_mean_m": round(float(away.mean()), 3),
        "distance_p95_m": round(float(np.percentile(away, 95)), 3),
    }


def figures(recording: Recording, references: list[Reference], drives: list[Drive], asked: str) -> dict:
    """The replay report of a recording: seconds, metres to the right, steering -1..1.

    asked: the reference that was asked for, "lane" or "human".
    """
    human = np.array(drives[0].human)
    mean = float(recording.steering.mean())
    blind = {
        "steering 0": lambda moment: 0.0,
        "mean steering": lambda moment: mean,
        "the human": lambda moment: moment.human,
    }
    rows = sum(len(reference.stretch) for reference in references)
    by_lane = sum(len(reference.stretch) for reference in references if reference.lane)
    return {
        "recording": str(recording.folder),
        "rows": len(recording),
        "rows_driven": rows,
        "stretches": len(references),
        "seconds": round(sum(drives[0].time), 2),
        "reference_asked": asked,
        "reference": {"lane centre": by_lane, "human's way": rows - by_lane},
        "limits": {
            f"{done.limit:g}": percentages(done)
            | {
                "steering": against(np.array(done.steering), human),
                "where": [
                    {
                        "image": recording.name(done.row[at]),
                        "seconds": round(sum(done.time[: at + 1]), 2),
                        "metres": round(off, 2),
                    }
                    for at, off in done.interventions.items()
                ],
                "compared": {
                    who: percentages(drive(recording, references, done.limit, steer)) for who, steer in blind.items()
                },
            }
            for done in drives
        },
        "steering_compared": {
            "steering 0": against(np.zeros_like(human), human),
            "mean steering": against(np.full_like(human, mean), human),
        },
    }


def against(steering: np.ndarray, human: np.ndarray) -> dict:
    """The root of the mean squared difference from the human's steering, and, of both averaged over nine rows, the
    correlation (None where one is constant)."""
    smooth = [np.convolve(values, np.ones(SMOOTHED) / SMOOTHED, "valid") for values in (steering, human)]
    varies = all(np.ptp(values) > 0 for values in smooth)
    return {
        "error": round(float(np.sqrt(np.mean((steering - human) ** 2))), 4),
        "correlation": round(float(np.corrcoef(*smooth)[0, 1]), 3) if varies else None,
    }


def text(report: dict) -> str:
    reference = " and ".join(f"the {what} in {rows} rows" for what, rows in report["reference"].items() if rows)
    lines = [
        f"{report['recording']}: {report['seconds']:.1f} s driven in {report['stretches']} stretches "
        f"({report['rows_driven']} of {report['rows']} rows); off-centre is counted from {reference}"
    ]
    if report["reference_asked"] == "lane" and report["reference"]["human's way"]:
        lines.append("the lane's centre is not trusted where the human's way stands for it: an unknown road?")
    for limit, one in report["limits"].items():
        lines.append(
            f"at {limit} m: autonomy {one['autonomy_percent']:.1f} %, {one['interventions']} interventions; "
            f"off-centre {one['distance_mean_m']:.2f} m on average, 95 %: {one['distance_p95_m']:.2f} m"
        )
        others = (
            f"{who} {other['autonomy_percent']:.0f} % ({other['interventions']})"
            for who, other in one["compared"].items()
        )
        lines.append("  for comparison: " + ", ".join(others))
        lines += [f"  {at['seconds']:.1f} s: {at['metres']:+.2f} m, {at['image']}" for at in one["where"][:10]]
        if len(one["where"]) > 10:
            lines.append(f"  … and {len(one['where']) - 10} more")
    first, others = next(iter(report["limits"].values()))["steering"], report["steering_compared"]
    errors = ", ".join(f"{who}: {other['error']:.3f}" for who, other in others.items())
    lines.append(
        f"steering: error {first['error']:.3f} ({errors}), correlation with the human's, both averaged over "
        f"{SMOOTHED} rows: {first['correlation']}"
    )
    return "\n".join(lines)


def picture(path: str, recording: Recording, drives: list[Drive]) -> None:
    """Distance from the reference and steering over the recording, interventions marked. Raises SimulatorError."""
    from matplotlib.figure import Figure  # large, and needed only here

    figure = Figure(figsize=(12, 2.6 * (len(drives) + 1)), layout="constrained")
    axes = figure.subplots(len(drives) + 1, 1, sharex=True)
    for ax, done in zip(axes, drives, strict=False):
        seconds, distance = np.cumsum(done.time), np.array(done.distance)
        distance[np.flatnonzero(np.diff(done.row) > 1) + 1] = np.nan  # breaks are not joined
        ax.axhspan(-done.limit, done.limit, color="0.93")
        ax.plot(seconds, distance, linewidth=0.9, label="the model")
        ax.plot(seconds, np.array(done.distance) - done.beside, linewidth=0.7, color="0.5", label="the human")
        for at in done.interventions:
            ax.axvline(seconds[at], color="tab:red", linewidth=0.8)
        ax.set(
            ylabel="m right of the centre",
            title=f"{len(done.interventions)} interventions at {done.limit:g} m: "
            f"autonomy {100 * done.autonomy():.1f} %",
        )
        ax.legend(loc="upper right", fontsize=8)
    seconds = np.cumsum(drives[-1].time)
    axes[-1].plot(seconds, drives[-1].steering, linewidth=0.8, label="the model")
    axes[-1].plot(seconds, drives[-1].human, linewidth=0.6, color="0.5", label="the human")
    axes[-1].set(xlabel="s", ylabel="steering")
    axes[-1].legend(loc="upper right", fontsize=8)
    file = io.BytesIO()
    figure.suptitle(recording.folder.name)
    figure.savefig(file, format="png", dpi=90)
    put(path, file.getvalue())


class SideBySide:
    """A film of a replay: what the model saw with its steering to the left, the human's frame to the right."""

    def __init__(self, path: str):
        """Raises SimulatorError."""
        try:
            self.film = FilmWriter(Path(path), SAMPLE_RATE, quality=24, preset="veryfast")
        except OSError as error:
            raise SimulatorError(f"{path}: no film can be written there ({error.strerror})") from error

    def watch(self, moment: Moment, done: Drive) -> None:
        said = f"{done.distance[-1]:+.2f} m   steering {done.steering[-1]:+.3f}   limit {done.limit:g} m"
        if done.interventions:
            said += f"   interventions {len(done.interventions)}"
        pictures = [
            captioned(moment.seen, done.steering[-1], said),
            captioned(moment.recorded, moment.human, f"the human   steering {moment.human:+.3f}"),
        ]
        self.film.add(np.hstack(pictures))

    def close(self) -> None:
        self.film.close()


def captioned(frame: np.ndarray, steering: float, said: str) -> np.ndarray:
    """A frame at twice its size, uint8 (320, 640, 3), RGB, with the way that the steering takes and a line of text."""
    from cloning.pilot.attention import overlay  # which loads torch, and only films need it

    shown = overlay(frame, steering)
    cv2.putText(shown, said, (10, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    return shown
