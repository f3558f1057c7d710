"""Autonomy, NVIDIA's measure of driving (arXiv 1604.07316, section 6), for replays and laps; laps in words."""

from collections.abc import Mapping
from typing import Any

LIMITS = (1.0, 2.5)  # m from the lane centre: NVIDIA's; at the second one, the car's side is on the lake's edge line
INTERVENTION_TIME = 6.0  # s that NVIDIA counts for an intervention: a human takes over and brings the car back


def autonomy(interventions: int, seconds: float) -> float:
    """Return 1 - interventions x 6 s / seconds driven: at most 1, and 1 for a drive of no length.

    It is negative if the interventions would have taken longer than the drive.
    """
    return 1 - interventions * INTERVENTION_TIME / seconds if seconds else 1.0


def lap_in_words(report: Mapping[str, Any]) -> str:
    """Return the figures of a lap in one line; report: of `python -m simulator drive --report`."""
    times = {0: "never left the road", 1: "left the road once"}
    departures = len(report["departures"])
    return (
        f"{report['distance_m']:.0f} m at {report['mean_speed_mph']:.0f} mph, "
        f"{times.get(departures, f'left the road {departures} times')}; "
        f"{report['offset_mean_m']:.2f} m from the centre line on average, {report['offset_max_m']:.2f} m at most"
    )
