"""Autonomy, NVIDIA's measure of driving (arXiv 1604.07316, section 6), for replays and laps."""

LIMITS = (1.0, 2.5)  # m from the lane centre: NVIDIA's; at the second one, the car's side is on the edge line
INTERVENTION_TIME = 6.0  # s that NVIDIA counts for an intervention: a human takes over and brings the car back


def autonomy(interventions: int, seconds: float) -> float:
    """Return 1 - interventions x 6 s / seconds driven: at most 1, and 1 for a drive of no length.

    It is negative if the interventions would have taken longer than the drive.
    """
    return 1 - interventions * INTERVENTION_TIME / seconds if seconds else 1.0
