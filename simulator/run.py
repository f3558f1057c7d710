"""A simulated run: the car on its track, its trajectory, and its departures from the road."""

from dataclasses import dataclass, field

import numpy as np

from cloning.road.motion import MPH, wrap_angle
from cloning.road.track import Track
from cloning.wire.protocol import MAX_NAME, Place
from simulator.car import STEP, WHEELS, Car
from simulator.world import build_physics

WHEEL_REACH = 1.95  # m: every wheel's hub is closer to the car's middle


@dataclass(frozen=True)
class Departure:
    """Where and how fast the car left the road with a wheel."""

    time: float  # simulated seconds since the start
    s: float  # metres along the track
    speed: float  # m/s
    x: float  # the car's position in metres, to the east
    y: float  # and to the north
    side: str  # of the road that it left on, "left" or "right"


@dataclass
class Trajectory:
    """The car's motion, with one entry for each physics step."""

    x: list[float] = field(default_factory=list)  # position in metres, to the east
    y: list[float] = field(default_factory=list)  # and to the north
    offset: list[float] = field(default_factory=list)  # lateral offset in metres, right positive
    speed: list[float] = field(default_factory=list)  # m/s
    steering: list[float] = field(default_factory=list)  # -1..1, right positive


class Run:
    """The car on its track, in simulated time, which only `step` and `advance` advance.

    s, offset   the car's position: metres along the track and to the right of its centre line
    time        simulated seconds
    travelled   metres along the track since the start, negative if the car went backwards
    distance    metres that the car has driven
    steering    of the last step, -1..1, right positive
    throttle    of the last step, -1..1, negative brakes
    lap_times   simulated seconds since the start at which each lap ended
    at_end      whether the car has come to the end of an open road; the next step then begins at its start again
    """

    def __init__(self, track: Track, start: str = "training"):
        """start: the mode of the real simulator whose starting position is used, "training" or "autonomous"."""
        self.track = track
        self.car = Car(build_physics(track))
        self.start, self.at_end = track.starts[start], False
        self.s, self.offset = self.start, 0.0
        self.time, self.travelled, self.distance = 0.0, 0.0, 0.0
        self.departures: list[Departure] = []
        self.lap_times: list[float] = []
        self.trajectory = Trajectory()
        self.steering = self.throttle = 0.0
        self.set_back()

    def set_back(self, offset: float = 0.0, speed: float = 0.0, turn: float = 0.0) -> None:
        """Place the car on the road at `s`, settled on its springs.

        offset: lateral, m, right positive; speed: m/s, along its heading; turn: radians from the road to the right.
        """
        pose = self.track.at(self.s, offset)
        self.car.place(pose._replace(heading=pose.heading - turn))  # headings grow to the left
        self.car.settle()
        self.car.body.set_linear_velocity(self.car.node.get_quat().get_forward() * speed)
        self.offset = offset

    @property
    def speed_mph(self) -> float:
        """Speed in mph."""
        return self.car.speed / MPH

    @property
    def lane(self) -> tuple[float, float]:
        """Lateral offset, m, and heading error, radians, both positive to the right, as recordings have them."""
        return self.offset, wrap_angle(self.track.at(self.s).heading - self.car.heading)  # headings grow to the left

    @property
    def place(self) -> Place:
        """Where the car is, for the page of drive.py."""
        position, source = self.car.node.get_pos(), self.track.source
        name = source if isinstance(source, str) else f"--road {self.track.name}"[:MAX_NAME]
        return Place(name, position.x, position.y, self.offset, len(self.departures), self.time)

    @property
    def laps(self) -> int:
        """Number of finished laps."""
        return len(self.lap_times)

    def step(self, steering: float, throttle: float) -> bool:
        """Drive a physics step, see `Car.step`; return False if the car left the road and was set back."""
        stayed = self.advance(steering, throttle)
        if not stayed:
            self.set_back()
        return stayed

    def advance(self, steering: float, throttle: float) -> bool:
        """Drive a physics step, see `Car.step`; return False if the car left the road, and leave it where it is."""
        if self.at_end:
            self.s, self.travelled, self.at_end = self.start, self.laps * self.track.length, False
            self.set_back()
        self.steering, self.throttle = steering, throttle
        self.car.step(steering, throttle)
        self.time += STEP
        position = self.car.node.get_pos()
        before = self.s
        self.s, self.offset = self.track.locate(position.x, position.y, before)
        length = self.track.length
        self.travelled += (self.s - before + length / 2) % length - length / 2
        self.distance += self.car.speed * STEP
        if self.travelled >= (self.laps + 1) * length if self.track.closed else self.s >= length:
            self.lap_times.append(self.time)
            self.at_end = not self.track.closed
        trajectory = self.trajectory
        trajectory.x.append(position.x)
        trajectory.y.append(position.y)
        trajectory.offset.append(self.offset)
        trajectory.speed.append(self.car.speed)
        trajectory.steering.append(steering)
        side = self.off_road()
        if side:
            self.departures.append(Departure(self.time, self.s, self.car.speed, position.x, position.y, side))
        return not side

    def off_road(self) -> str:
        """Return the side on which a wheel is beyond the edge of the road, "left" or "right", or an empty string."""
        i = self.track.index(self.s)
        edges = self.track.edges[i - 3 : i + 3]
        if abs(self.offset) + WHEEL_REACH < edges.min(initial=WHEEL_REACH if i < 3 else np.inf):
            return ""  # the usual case: no wheel can reach an edge
        matrix = self.car.node.get_mat()
        for wheel in WHEELS:
            position = matrix.xform_point((wheel.right, wheel.forward, 0))
            s, offset = self.track.locate(position.x, position.y, self.s)
            left, right = self.track.edges[self.track.index(s)]
            if offset < -left:
                return "left"
            if offset > right:
                return "right"
        return ""
