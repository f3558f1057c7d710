"""Steers one drive: a network does, but for a camera that is mounted askew, and frames that come late or are lost."""

from collections.abc import Callable

import numpy as np

from cloning.lane.foretell import Foreteller
from cloning.lane.mount import Mount
from cloning.lane.predict import Predictor


class Pilot:
    """Lets the network steer by frames as the simulator's camera sees them, and corrects it for late and lost ones."""

    def __init__(
        self,
        steer: Callable[[np.ndarray], float | np.floating],
        foretell: Foreteller | None = None,
        as_mounted: bool = False,
    ):
        """steer: returns the network's steering, -1..1, for a frame; foretell: steers instead, and tells the risk.

        as_mounted: frames are taken as they are, however the camera seems to be mounted.
        """
        self.steer, self.foretell = steer, foretell
        self.mount, self.predictor = None if as_mounted else Mount(), Predictor()

    def __call__(self, frame: np.ndarray, time: float, speed: float) -> tuple[np.float32, float | None]:
        """Return the steering, -1..1, and the risk, 0..1, that the car leaves the road, None if that is not known.

        frame: the drive's next one, uint8 (160, 320, 3) RGB; time: s; speed: m/s. Raises ArithmeticError as `steer`.
        """
        frame = self.mount(frame) if self.mount else frame
        found, risk = self.foretell(frame, time, speed) if self.foretell else (self.steer(frame), None)
        return self.predictor(found, frame, time, speed), risk
