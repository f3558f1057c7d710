"""The throttle that holds a speed, or stops the car."""

import math

STILL, ALMOST_STILL = 0.5, 2.0  # mph: the stand-in simulator tells 0.44 of a car at rest
LEVEL = 0.1  # throttle that keeps a car at 9 to 15 mph where the road is level
# A stopped car's throttle is changed every CHANGE_FRAMES as long as the car does not become slower. The first change is
# what the car needed above LEVEL, within FIRST_CHANGE. A change was wrong if the car then gains speed faster than
# before, or if MOST_CHANGES of them were in vain: the next one is GROWTH times as large, the other way.
CHANGE_FRAMES, FIRST_CHANGE, MOST_CHANGES, GROWTH = 4, (0.1, 0.5), 2, 1.5
LEAST_CHANGE = 0.03  # once it has come to rest the next change is half as large and the other way, but so much at least
ROLLING, SLOWER, FASTER = 0.8, 0.02, 0.05  # mph; by the last two, a speed surely changes in CHANGE_FRAMES


class SpeedController:
    """The PI controller of Udacity's drive.py: throttle = 0.1 e + 0.002 Σe, where e = set speed - speed in mph.

    The sum is not changed while the throttle is at its limit, so that it does not wind up on a hill. A set speed of 0
    brakes until the car is at rest, or almost and no longer becomes slower. On a slope no brake holds it there, and
    what the simulator tells has no sign: so a throttle that holds it is sought, to one side until the car has come to
    rest, then to the other in steps half as large.
    """

    PROPORTIONAL, INTEGRAL = 0.1, 0.002

    def __init__(self, set_speed: float):
        """set_speed: mph."""
        self.set_speed, self.error_sum = set_speed, 0.0
        self._begin(LEVEL)

    def _begin(self, throttle: float) -> None:
        """Forget what `_stop` did; throttle: of a car that is driven."""
        least, most = FIRST_CHANGE
        self.change = math.copysign(min(max(abs(throttle - LEVEL), least), most), throttle - LEVEL)
        self.stands, self.hold, self.rests = False, 0.0, True
        self.speed = self.gain = math.inf  # mph, when a change was last due, and how much faster it had become by then
        self.frames, self.in_vain = 0, 0  # since then; changes

    def throttle(self, speed: float) -> float:
        """Return the throttle, -1..1, at this speed in mph; call it once per frame."""
        if self.set_speed == 0:
            return self._stop(speed)
        error = self.set_speed - speed
        throttle = self.PROPORTIONAL * error + self.INTEGRAL * (self.error_sum + error)
        if abs(throttle) <= 1:
            self.error_sum += error
        self._begin(throttle)
        return min(1.0, max(-1.0, throttle))

    def _stop(self, speed: float) -> float:
        if not self.stands:
            before, self.speed = self.speed, speed
            self.stands = speed < STILL or before < speed < ALMOST_STILL
            return self.hold if self.stands else -1.0
        if speed < STILL and not self.rests:
            self.change = math.copysign(max(abs(self.change) / 2, LEAST_CHANGE), -self.change)
            self.in_vain = 0
        self.rests = speed < STILL or (self.rests and speed < ROLLING)
        self.frames += 1
        if self.frames == CHANGE_FRAMES:
            if speed > STILL and speed > self.speed + (FASTER if speed <= ROLLING else -SLOWER):
                self.in_vain += 1
                if self.in_vain > MOST_CHANGES or speed - self.speed > self.gain + FASTER:
                    self.change, self.in_vain = -GROWTH * self.change, 0
                self.hold = min(1.0, max(-1.0, self.hold + self.change))
            else:
                self.in_vain = 0
            self.gain = speed - self.speed if self.in_vain else math.inf
            self.speed, self.frames = speed, 0
        return self.hold
