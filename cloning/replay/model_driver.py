"""The driver of a replay that is a model in this process."""

import copy

from cloning.base.errors import SimulatorError
from cloning.base.frame import FRAME
from cloning.network.network import Network, load_model, steer
from cloning.replay.replay import ReplayFrame


class ModelDriver:
    """Steers by a model in this process, with drive.py's arithmetic, but without its correction for late frames."""

    def __init__(self, model: str | Network):
        """Load the model; model: its file, or the network itself. Raises ModelError."""
        self.network = load_model(model) if isinstance(model, str) else model
        if next(self.network.parameters()).device.type == "mps":  # which threads can't share: torch ends the process
            self.network = copy.deepcopy(self.network).cpu()
        top, bottom = self.network.crop
        self.rows = slice(top, FRAME[0] - bottom)  # of a frame, which the network sees

    def __call__(self, frame: ReplayFrame) -> float:
        """Return the steering, -1..1. Raises SimulatorError if the network computes no finite number."""
        try:
            return float(steer(self.network, frame.received(self.rows)))
        except ArithmeticError as error:
            raise SimulatorError(f"{error}: train the model again") from None
