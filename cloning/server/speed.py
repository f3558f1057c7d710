"""The throttle that holds a speed, or stops the car."""

import math

STILL, ALMOST_STILL = 0.5, 2.0  # mph: the stand-in simulator tells 0.44 of a car at rest
BRAKING = 5.0  # mph: below it the simulator's brake is its weak reverse gear
UPHILL, STEADY = 0.4, 0.1  # throttle, mph a frame: a car that needs more, and gains no more speed, would roll backwards
PUSH = 0.7  # throttle that stops it on the steepest grade, and does not throw it forwards
# Throttle with which a pushed car is held then: so much more each time, up to this share of what held its speed before.
HOLD_STEP, HOLDING = 0.1, 0.8
# Frames in which a car becomes faster at a throttle until the other one is tried; a push takes longer to tell.
LOST_FRAMES = {-1.0: 4, PUSH: 12}


class SpeedController:
    """The PI controller of Udacity's drive.py: throttle = 0.1 e + 0.002 Σe, where e = set speed - speed in mph.

    The sum is not changed while the throttle is at its limit, so that it does not wind up on a hill. A set speed of 0
    brakes until the car is at rest, or almost and no longer becomes slower. On a slope no brake holds it there, and
    what the simulator tells has no sign: a car that rolls downhill is braked again, one that rolls backwards is pushed,
    and then held by more throttle: rolling to and fro, it would leave the road within a minute.
    """

    PROPORTIONAL, INTEGRAL = 0.1, 0.002

    def __init__(self, set_speed: float):
        """set_speed: mph."""
        self.set_speed, self.error_sum, self.driven = set_speed, 0.0, math.inf
        self._begin(0.0, math.inf)

    def _begin(self, throttle: float, speed: float) -> None:
        """Forget what `_stop` did; throttle, speed: of a car that is driven."""
        self.is_uphill, self.driven = throttle > UPHILL and speed < self.driven + STEADY, speed
        self.stands, self.stop_throttle, self.hold = False, -1.0, 0.0
        self.speed, self.faster = math.inf, 0  # in the last frame, mph; frames in which it rose

    def throttle(self, speed: float) -> float:
        """Return the throttle, -1..1, at this speed in mph; call it once per frame."""
        if self.set_speed == 0:
            return self._stop(speed)
        error = self.set_speed - speed
        throttle = self.PROPORTIONAL * error + self.INTEGRAL * (self.error_sum + error)
        if abs(throttle) <= 1:
            self.error_sum += error
        self._begin(throttle, speed)
        return min(1.0, max(-1.0, throttle))

    def _stop(self, speed: float) -> float:
        before, self.speed = self.speed, speed
        if self.stands:
            self.stands, self.faster = speed < (ALMOST_STILL if self.is_uphill else BRAKING), 0
            self.stop_throttle = PUSH if self.is_uphill else -1.0
            if self.is_uphill and not self.stands:
                self.hold = max(0.0, min(self.hold + HOLD_STEP, HOLDING * self.INTEGRAL * self.error_sum))
        elif speed < STILL or before < speed < ALMOST_STILL:
            self.stands = True
        else:
            self.faster = self.faster + 1 if speed > max(before, BRAKING) else 0
            if self.faster == LOST_FRAMES[self.stop_throttle]:
                self.is_uphill, self.stands, self.hold = not self.is_uphill, True, 0.0
        return self.hold if self.stands else self.stop_throttle
