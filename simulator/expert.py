"""The drivers of rendered recordings: an expert that keeps its lane like a practised human, and a recovery driver."""

import math

import numpy as np

from cloning.road.motion import FULL_LOCK, WHEELBASE, wrap_angle
from cloning.road.track import LEFT, RIGHT, Track
from simulator.car import CHARACTERISTIC_SPEED, STEP, TOP_SPEED
from simulator.run import Run
from simulator.world import GRAVITY

LATERAL_ACCELERATION, MAX_DECELERATION = 5.0, 4.0  # m/s² at most, in bends and before them
LOOKAHEAD, LOOKAHEAD_TIME = 3.0, 0.45  # m plus s of driving: distance to the point that the expert steers for
# The expert's lateral offset varies with this standard deviation, limit and shortest wavelength, all in m. The human
# drivers of the real recordings are 0.6 m (lake) to 1.6 m (jungle) off the centre on average.
WANDER, MAX_WANDER, MIN_WAVELENGTH = 0.9, 1.8, 60.0
WANDER_MARGIN = 2.0  # m that an offset of the expert's choice stays from the edge of a narrow road
STEERING_TIME = 0.12  # s: time constant of the steering
PREVIEW_TIME = 0.1  # s: the speed limit is that of the point so far ahead


def speed_limits(track: Track, top_speed: float, lateral: float) -> np.ndarray:
    """Return the speed limits at the track's points for their bends and those ahead: (n,), m/s; lateral: m/s²."""
    limit = np.minimum(top_speed, np.sqrt(lateral / np.maximum(np.abs(track.curvature), 1e-6)))
    for _ in range(2):  # the second pass continues the braking across the first point
        for i in range(len(limit) - 1, -1, -1):
            after = limit[(i + 1) % len(limit)]
            limit[i] = min(limit[i], math.sqrt(after * after + 2 * MAX_DECELERATION * track.step))
    return limit


class Expert:
    """Steers by pure pursuit along the lane's centre, with a lateral offset that varies slowly.

    recordable  whether the present step belongs in a recording
    target      mean lateral offset in m, right positive
    """

    def __init__(
        self,
        track: Track,
        seed: int = 0,
        top_speed: float = TOP_SPEED,
        wander: float = WANDER,
        lateral: float = LATERAL_ACCELERATION,
    ):
        """seed: of the lateral offsets; wander: their standard deviation in m; top_speed: m/s; lateral: m/s²."""
        self.track, self.top_speed = track, min(top_speed, TOP_SPEED)
        self.limits = speed_limits(track, self.top_speed, lateral)
        rng = np.random.default_rng([seed, 1])
        waves = np.arange(1, max(2, int(track.length / MIN_WAVELENGTH)) + 1)
        # Wavelengths that do not divide the track's length, so that laps differ; in radians per m.
        self.waves = 2 * np.pi * (waves * rng.uniform(0.9, 1.1, len(waves))) / track.length
        self.phases = rng.uniform(0, 2 * np.pi, len(waves))
        self.amplitude = wander * math.sqrt(2 / len(waves))
        self.max_wander = min(MAX_WANDER, float(track.edges.min()) - WANDER_MARGIN)
        self.recordable = True
        self.target = 0.0
        self.steering = 0.0

    def drive(self, run: Run) -> tuple[float, float]:
        """Return steering and throttle, both -1..1, for the next step of the run."""
        car = run.car
        speed = car.speed
        ahead = LOOKAHEAD + LOOKAHEAD_TIME * speed
        wander = -self.amplitude * float(np.sin(self.waves * (run.travelled + ahead) + self.phases).sum())
        goal = self.track.at(run.s + ahead, self.target + self.max_wander * math.tanh(wander / self.max_wander))
        position = car.node.get_pos()
        dx, dy = goal.x - position.x, goal.y - position.y
        bearing = wrap_angle(math.atan2(dy, dx) - car.heading)
        curvature = 2 * math.sin(bearing) / math.hypot(dx, dy)  # left positive, as headings are
        angle = math.atan(WHEELBASE * curvature * (1 + (speed / CHARACTERISTIC_SPEED) ** 2))
        wanted = max(-1.0, min(1.0, -math.degrees(angle) / FULL_LOCK))
        self.steering += (wanted - self.steering) * STEP / STEERING_TIME
        limit = self.limits[self.track.index(run.s + PREVIEW_TIME * speed)]
        if limit >= self.top_speed:
            return self.steering, 1.0  # the car's own limiter holds the set speed
        climb = 0.3 * run.track.at(run.s).grade * GRAVITY / 4
        return self.steering, max(-1.0, min(1.0, 0.6 * (limit - speed) + climb))


class Recovery(Expert):
    """Drives towards the edges of the road and back to the lane's centre; only the returns are recorded."""

    OUTWARD_SPEED, RETURN_SPEED = 1.2, 2.2  # m/s sideways
    CENTRED_TIME = (1.0, 3.0)  # s on the lane's centre after a return: shortest and longest
    TURNING_POINT = (0.55, 0.95)  # least and greatest share of the distance from the lane's centre to the margin
    MARGIN = 1.5  # m that the car's middle keeps from the edge of the road
    MAX_OUTWARD_TIME = 6.0  # s

    def __init__(self, track: Track, seed: int = 0, top_speed: float = TOP_SPEED):
        """top_speed: m/s."""
        super().__init__(track, seed, top_speed, wander=0.0)
        self.rng = np.random.default_rng([seed, 2])
        self.goal, self.until, self.recordable = 0.0, self.rng.uniform(*self.CENTRED_TIME), False

    def drive(self, run: Run) -> tuple[float, float]:
        """Return steering and throttle for the next step of the run, and set `recordable` during a return."""
        if self.recordable:
            if abs(run.offset) < 0.25 and self.target == 0:
                self.recordable, self.until = False, run.time + self.rng.uniform(*self.CENTRED_TIME)
        elif self.goal:
            if abs(run.offset - self.goal) < 0.2 or run.time > self.until:
                self.goal, self.recordable = 0.0, True
        elif run.time > self.until:
            side = self.rng.choice((LEFT, RIGHT))
            edge = self.track.edges[self.track.index(run.s), 0 if side == LEFT else 1]
            self.goal = side * self.rng.uniform(*self.TURNING_POINT) * (edge - self.MARGIN)
            self.until = run.time + self.MAX_OUTWARD_TIME
        change = (self.RETURN_SPEED if self.recordable else self.OUTWARD_SPEED) * STEP
        self.target += max(-change, min(change, self.goal - self.target))
        return super().drive(run)
