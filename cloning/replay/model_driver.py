"""The driver of a replay that is a model in this process."""

import copy

from cloning.base.errors import SimulatorError
from cloning.base.frame import FRAME
from cloning.lane.pilot import Pilot
from cloning.network.network import Network, load_model, steer
from cloning.replay.replay import ReplayFrame
from cloning.road.motion import MPH


class ModelDriver:
    """Steers by a model in this process, with drive.py's arithmetic.

    A recording's own frames are taken as they are. Disturbed ones, which may be moved, noisy, late or lost, are given
    to a `Pilot`, as in drive.py, which needs all their rows.
    """

    def __init__(self, model: str | Network):
        """Load the model; model: its file, or the network itself. Raises ModelError."""
        self.network = load_model(model) if isinstance(model, str) else model
        if next(self.network.parameters()).device.type == "mps":  # which threads can't share: torch ends the process
            self.network = copy.deepcopy(self.network).cpu()
        top, bottom = self.network.crop
        self.rows = slice(top, FRAME[0] - bottom)  # of a frame, which the network sees
        self.pilot: Pilot | None = None  # of the stretch that is driven

    def __call__(self, frame: ReplayFrame) -> float:
        """Return the steering, -1..1. Raises SimulatorError if the network computes no finite number."""
        try:
            if not frame.disturber:
                return float(steer(self.network, frame.received(self.rows)))
            if not self.pilot or frame.at == 0:
                self.pilot = Pilot(lambda seen: steer(self.network, seen))
            return float(self.pilot(frame.received(slice(0, FRAME[0])), frame.time, frame.speed * MPH)[0])
        except ArithmeticError as error:
            raise SimulatorError(f"{error}: train the model again") from None
