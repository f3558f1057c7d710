"""Steers one drive by a network, though its camera is turned or shifted, and its frames are noisy, late or lost."""

from collections.abc import Callable

import numpy as np

from cloning.lane.average import Average
from cloning.lane.foretell import Foreteller
from cloning.lane.mount import Mount
from cloning.lane.predict import Predictor


class Pilot:
    """Lets the network steer by frames as the simulator's camera sees them, and corrects the steering for late ones."""

    def __init__(
        self,
        steer: Callable[[np.ndarray], float | np.floating],
        foretell: Foreteller | None = None,
        as_mounted: bool = False,
    ):
        """steer: returns the network's steering, -1..1, for a frame; foretell: steers instead, and tells the risk.

        as_mounted: frames are taken as they are, however the camera seems to be mounted. Raises ModelError.
        """
        self.steer, self.foretell = steer, foretell
        self.mount, self.average, self.predictor = None if as_mounted else Mount(), Average(), Predictor()
        self.seen = np.empty(0, np.uint8)  # the last frame as the network saw it

    def __call__(self, frame: np.ndarray, time: float, speed: float) -> tuple[np.float32, float | None]:
        """Return the steering, -1..1, and the risk, 0..1, that the car leaves the road, None if that is not known.

        frame: the drive's next one, uint8 (160, 320, 3) RGB; time: s; speed: m/s. Raises ArithmeticError as `steer`.
        """
        step = self.predictor.move(time, speed)
        self.seen = self.average(self.mount(frame) if self.mount else frame, step)
        found, risk = self.foretell(self.seen, time, speed) if self.foretell else (self.steer(self.seen), None)
        # By the frame as it came: that the camera's mounting is found out must not look like a movement.
        return self.predictor.correct(found, frame), risk
