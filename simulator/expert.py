"""The driver of the recordings: follows the lane as a practised person does, with a lane position that
wanders a little."""

import math

import numpy as np

from .car import CHARACTERISTIC_SPEED, FULL_LOCK, TOP_SPEED, WHEELBASE
from .run import Run
from .track import Track

SIDEWAYS, BRAKING = 5.0, 4.0  # m/s²: what it takes in a bend and when slowing for one
LOOKAHEAD, LOOKAHEAD_TIME = 3.0, 0.45  # m and s ahead of the car that it steers for
WANDER, WANDER_LENGTH = 0.45, 60.0  # m (standard deviation) off the centre line, over about so many metres
SMOOTHING = 0.12  # s: hands follow the eyes


def speeds(track: Track, top: float) -> np.ndarray:
    """The speed in m/s at each of the track's points: slow enough for the bend, and to brake for the bends to
    come."""
    limit = np.minimum(top, np.sqrt(SIDEWAYS / np.maximum(np.abs(track.curvature), 1e-6)))
    for _ in range(2):  # the second time round carries the braking over the first point
        for i in range(len(limit) - 1, -1, -1):
            after = limit[(i + 1) % len(limit)]
            limit[i] = min(limit[i], math.sqrt(after * after + 2 * BRAKING * track.step))
    return limit


class Expert:
    """Steers by pure pursuit; `wander` metres of seeded wandering about the lane's centre."""

    def __init__(self, track: Track, seed: int = 0, top_speed: float = TOP_SPEED, wander: float = WANDER):
        """top_speed: m/s."""
        self.track, self.top = track, min(top_speed, TOP_SPEED)
        self.limits = speeds(track, self.top)
        random = np.random.default_rng([seed, 1])
        waves = np.arange(1, max(2, int(track.length / WANDER_LENGTH)) + 1)
        # not commensurate with the lap, so that no two laps are alike
        self.waves = 2 * np.pi * (waves * random.uniform(0.9, 1.1, len(waves))) / track.length
        self.phases = random.uniform(0, 2 * np.pi, len(waves))
        self.wander = wander * math.sqrt(2 / len(waves))
        self.aim = 0.0  # m to the left of the lane's centre: where recovery drives to
        self.steering = 0.0

    def lane(self, travelled: float) -> float:
        """The offset in metres, positive left, that it aims for after so many metres."""
        return self.aim + self.wander * float(np.sin(self.waves * travelled + self.phases).sum())

    def drive(self, run: Run) -> tuple[float, float]:
        """Steering and throttle, both -1..1, for the run's next step."""
        car = run.car
        speed = car.speed
        ahead = LOOKAHEAD + LOOKAHEAD_TIME * speed
        goal = self.track.at(run.s + ahead, self.lane(run.travelled + ahead))
        at = car.node.get_pos()
        dx, dy = goal.x - at.x, goal.y - at.y
        bearing = (math.atan2(dy, dx) - car.heading + math.pi) % (2 * math.pi) - math.pi
        bend = 2 * math.sin(bearing) / math.hypot(dx, dy)
        angle = math.atan(WHEELBASE * bend * (1 + (speed / CHARACTERISTIC_SPEED) ** 2))
        wanted = max(-1.0, min(1.0, -math.degrees(angle) / FULL_LOCK))
        self.steering += (wanted - self.steering) * 0.02 / SMOOTHING
        limit = self.limits[int((run.s + 0.1 * speed) / self.track.step) % len(self.limits)]
        if limit >= self.top:
            return self.steering, 1.0  # the car's own limiter holds the set speed
        return self.steering, max(
            -1.0, min(1.0, 0.6 * (limit - speed) + 0.3 * run.track.at(run.s).grade * 9.81 / 4)
        )
