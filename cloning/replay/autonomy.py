"""Autonomy, NVIDIA's measure of driving (arXiv 1604.07316, section 6): the one definition, for replays and laps."""

PENALTY = 6.0  # s that NVIDIA counts for a human taking over


def autonomy(interventions: int, seconds: float) -> float:
    """1 - interventions x 6 s / seconds driven, at most 1.

    Negative if a human would have had to drive for longer than the drive took; 1 for a drive of no length.
    """
    return 1 - interventions * PENALTY / seconds if seconds else 1.0
