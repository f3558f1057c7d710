"""The driver of the recordings: follows the lane as a practised person does, with a lane position that
wanders a little."""

import math

import numpy as np

from cloning.road.motion import FULL_LOCK, WHEELBASE
from cloning.road.track import Track
from simulator.car import CHARACTERISTIC_SPEED, TOP_SPEED
from simulator.run import Run

SIDEWAYS, BRAKING = 5.0, 4.0  # m/s²: what it takes in a bend and when slowing for one
LOOKAHEAD, LOOKAHEAD_TIME = 3.0, 0.45  # m and s ahead of the car that it steers for
# m (standard deviation) off the centre line, at most about so many, over about so many: people are 1 m off on average.
WANDER, WANDER_MOST, WANDER_LENGTH = 0.9, 1.8, 60.0
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
        self.aim = 0.0  # m to the right of the lane's centre: where recovery drives to
        self.steering = 0.0

    def lane(self, travelled: float) -> float:
        """The metres to the right of the lane's centre that it aims for after so many metres."""
        wandered = -self.wander * float(np.sin(self.waves * travelled + self.phases).sum())
        return self.aim + WANDER_MOST * math.tanh(wandered / WANDER_MOST)

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
        return self.steering, max(-1.0, min(1.0, 0.6 * (limit - speed) + 0.3 * run.track.at(run.s).grade * 9.81 / 4))


class Recovery(Expert):
    """Drives out to the road's sides and back; `recording` tells whether it is on its way back."""

    OUT, BACK = 1.2, 2.2  # m/s sideways
    PAUSE = (1.0, 3.0)  # s on the lane's centre between two returns
    SHARE = (0.55, 0.95)  # of the way from the lane's centre to where a wheel would leave the road
    MARGIN = 1.5  # m from the car's middle to the road's end at which it turns back at the latest

    def __init__(self, track: Track, seed: int = 0, top_speed: float = TOP_SPEED):
        super().__init__(track, seed, top_speed, wander=0.0)
        self.random = np.random.default_rng([seed, 2])
        self.goal, self.until, self.recording = 0.0, self.random.uniform(*self.PAUSE), False

    def drive(self, run: Run) -> tuple[float, float]:
        if self.recording:
            if abs(run.offset) < 0.25 and self.aim == 0:
                self.recording, self.until = False, run.time + self.random.uniform(*self.PAUSE)
        elif self.goal:
            if abs(run.offset - self.goal) < 0.2 or run.time > self.until:
                self.goal, self.recording = 0.0, True
        elif run.time > self.until:
            side = self.random.choice((-1, 1))
            room = self.track.edges[int(run.s / self.track.step) % len(self.track.edges), 0 if side < 0 else 1]
            self.goal = side * self.random.uniform(*self.SHARE) * (room - self.MARGIN)
            self.until = run.time + 6.0
        pace = (self.BACK if self.recording else self.OUT) * 0.02
        self.aim += max(-pace, min(pace, self.goal - self.aim))
        return super().drive(run)
