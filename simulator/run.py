"""One simulated drive: the car on its track, what it did, and where it left the road."""

from dataclasses import dataclass, field

import numpy as np

from cloning.replay.autonomy import autonomy
from cloning.road.motion import MPH
from cloning.road.track import Track
from simulator.car import STEP, WHEELS, Car
from simulator.world import ground

REACH = 1.95  # m from the car's middle to a wheel, at most


@dataclass(frozen=True)
class Departure:
    """Where and when a wheel left the road's surface: seconds, metres along the track, m/s, metres (x east, y
    north)."""

    time: float
    s: float
    speed: float
    x: float
    y: float
    side: str


@dataclass
class Path:
    """What the car did, an entry a physics step of 0.02 s: metres, m/s, steering -1..1."""

    x: list = field(default_factory=list)
    y: list = field(default_factory=list)
    offset: list = field(default_factory=list)  # to the right of the centre line
    speed: list = field(default_factory=list)
    steering: list = field(default_factory=list)


class Run:
    """The car on its track. Time is simulated: it passes only in `step`."""

    def __init__(self, track: Track, start: str = "training"):
        """start: where it begins, as one of the simulator's modes does: "training" or "autonomous"."""
        self.track = track
        self.car = Car(ground(track))
        self.s, self.offset = track.starts[start], 0.0
        self.time, self.travelled, self.distance = 0.0, 0.0, 0.0
        self.departures: list[Departure] = []
        self.lap_times: list[float] = []
        self.path = Path()
        self.steering = self.throttle = 0.0
        self.set_back()

    def set_back(self, offset: float = 0.0, speed: float = 0.0) -> None:
        """Put the car on the road where it is along it, settled on its springs, rolling at `speed` m/s."""
        self.car.place(self.track.at(self.s, offset))
        self.car.settle()
        self.car.body.set_linear_velocity(self.car.node.get_quat().get_forward() * speed)
        self.offset = offset

    @property
    def speed_mph(self) -> float:
        return self.car.speed / MPH

    @property
    def laps(self) -> int:
        return len(self.lap_times)

    def step(self, steering: float, throttle: float) -> bool:
        """Drive for 0.02 s. Returns False, with the car set back on the centre line, if it left the road."""
        self.steering, self.throttle = steering, throttle
        self.car.step(steering, throttle)
        self.time += STEP
        at = self.car.node.get_pos()
        before = self.s
        self.s, self.offset = self.track.locate(at.x, at.y, before)
        length = self.track.length
        self.travelled += (self.s - before + length / 2) % length - length / 2
        self.distance += self.car.speed * STEP
        if self.travelled >= (self.laps + 1) * length:
            self.lap_times.append(self.time)
        path = self.path
        path.x.append(at.x)
        path.y.append(at.y)
        path.offset.append(self.offset)
        path.speed.append(self.car.speed)
        path.steering.append(steering)
        side = self.off_road()
        if side:
            self.departures.append(Departure(self.time, self.s, self.car.speed, at.x, at.y, side))
            self.set_back()
        return not side

    def off_road(self) -> str:
        """The side on which a wheel stands beyond the road's surface; empty while none does."""
        at = int(self.s / self.track.step)
        if abs(self.offset) + REACH < self.track.edges[at - 3 : at + 3].min(initial=REACH if at < 3 else np.inf):
            return ""  # no wheel can reach so far: most of the time
        matrix = self.car.node.get_mat()
        for aside, forward, _, _ in WHEELS:
            wheel = matrix.xform_point((aside, forward, 0))
            s, offset = self.track.locate(wheel.x, wheel.y, self.s)
            left, right = self.track.edges[int(s / self.track.step) % len(self.track.edges)]
            if offset < -left:
                return "left"
            if offset > right:
                return "right"
        return ""

    def autonomy(self) -> float:
        """NVIDIA's measure, 0..1: the share of the time in which no human would have had to take over."""
        return autonomy(len(self.departures), self.time)

    def roughness(self) -> float:
        """Mean absolute change of the steering per second."""
        return float(np.abs(np.diff(self.path.steering)).mean() / STEP) if len(self.path.steering) > 1 else 0.0
