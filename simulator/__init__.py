"""A stand-in for Udacity's driving simulator: the same roads, car, cameras, recordings and wire, without a
screen.

The modules in the order in which a frame goes through them: track, scenery (with lake, jungle, shapes and
textures), world,
car, cameras, then recording or wire, then report. `python -m simulator --help` tells what it does.
"""

PENALTY = 6.0  # s that NVIDIA counts for a human taking over (arXiv 1604.07316, section 6)


class SimulatorError(Exception):
    """Something the user can mend; the message says what and how."""
