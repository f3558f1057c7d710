"""The throttle that holds a speed, or stops the car."""

import math

STILL, ALMOST_STILL = 0.5, 2.0  # mph: the stand-in simulator tells 0.44 of a car at rest


class SpeedController:
    """The PI controller of Udacity's drive.py: throttle = 0.1 e + 0.002 Σe, where e = set speed - speed in mph.

    The sum is not changed while the throttle is at its limit, so that it does not wind up on a hill. A set speed of 0
    brakes until the car is at rest, or almost and no longer becomes slower: below 5 mph the simulator's brake is its
    reverse gear, which first slows the car down. Then there is none that could hold it on a slope.
    """

    PROPORTIONAL, INTEGRAL = 0.1, 0.002

    def __init__(self, set_speed: float):
        """set_speed: mph."""
        self.set_speed, self.error_sum = set_speed, 0.0
        self.speed, self.stands = math.inf, False  # mph in the last frame while it stops; whether it has

    def throttle(self, speed: float) -> float:
        """Return the throttle, -1..1, at this speed in mph; call it once per frame."""
        if self.set_speed == 0:
            self.stands = self.stands or speed < STILL or self.speed < speed < ALMOST_STILL
            self.speed = speed
            return 0.0 if self.stands else -1.0
        self.speed, self.stands = math.inf, False
        error = self.set_speed - speed
        throttle = self.PROPORTIONAL * error + self.INTEGRAL * (self.error_sum + error)
        if abs(throttle) <= 1:
            self.error_sum += error
        return min(1.0, max(-1.0, throttle))
