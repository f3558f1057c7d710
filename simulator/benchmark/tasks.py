"""What the benchmark drives. Another task, look, limit or disturbance makes another VERSION of the rules."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cloning.base.errors import TrackError
from cloning.road.disturbances import KINDS, STRENGTHS, Disturbance
from cloning.road.generated import PointRoad
from cloning.road.motion import MPH
from cloning.road.points import spline_road
from cloning.road.track import ROADS, Track
from simulator.driving import Conditions
from simulator.scenery.looks import SHADOWED

VERSION = 3
GROUPS = {
    "tracks": "lake and jungle in unknown looks, with and without shadows",
    "roads": "unknown generated roads, of which mountain roads with hairpins at 25 mph",
    "splines": "flat roads 8 m wide by the rules of other teams' road tests",
    "off the lane": "starts beside the lane's centre, and turned",
    "disturbed": "frames disturbed by weather, lens, light, camera and delay",
}
# The real recordings, as data/README.md names them, with where they are from
RECORDINGS = ("lake-ccw", "lake-cw", "jungle", "jungle-shadows")
DIRECTIONS = ("ccw", "cw")
COURSES = (("lake", 15), ("lake", 30), ("jungle", 15))  # and mph
MOUNTAIN = 25  # mph on the roads that are as winding and steep as the jungle
FOUL = (("lake", "ccw", 30), ("jungle", "cw", 15))  # where frames are disturbed
SPLINE, SPLINE_SEED = "spline-", 2  # the names of roads by other teams' rules, and the seed before their numbers
# Turn at a node in degrees, and distance in m from that before, least and greatest: maxitwo's and MultiSim's
NODES, TURNS, LENGTHS = 8, (-35, 35), (10, 25)
OFFSETS, BESIDE = (-2.0, -1.0, 1.0, 2.0), (-15.0, 0.0, 15.0)  # of starts: m to the right, degrees to the right


class Task(NamedTuple):
    """A drive of the benchmark; group: one of GROUPS; the others: see `driving.Conditions`."""

    group: str
    road: str
    direction: str
    speed: float
    look: int
    metres: float | None = None
    start: tuple[float, float, float] | None = None
    disturbance: Disturbance | None = None

    @property
    def name(self) -> str:
        """What it is called in tables."""
        words = f"{self.road} {self.direction}, {self.speed:g} mph, look {self.look}"
        if self.disturbance:
            words += f", {self.disturbance}"
        if self.start:
            s, offset, turn = self.start
            words += f", from {s:.0f} m" + (f", {offset:+g} m, {turn:+g}°" if offset or turn else "")
        return words + (f", {self.metres:g} m" if self.metres else "")

    def conditions(self, driver: str) -> Conditions:
        """Return how a driver drives it: the car is set back after departures, and its speed is held for it."""
        where = self.speed, self.look, self.direction, self.metres, self.start
        foul = self.disturbance
        return Conditions(driver, *where, set_back=True, own_throttle=False, disturbance=foul, foretell=True)

    @property
    def source(self) -> str | PointRoad:
        """The road, as `Track` takes it."""
        return unknown_spline(int(self.road.removeprefix(SPLINE))) if self.road.startswith(SPLINE) else self.road


def unknown_spline(number: int) -> PointRoad:
    """Return a road by the rules of other teams' road tests; the same number gives the same road."""
    rng = np.random.default_rng([SPLINE_SEED, number])
    while True:
        turns, lengths = (rng.uniform(*limits, NODES - 1) for limits in (TURNS, LENGTHS))
        try:
            return spline_road(np.column_stack([turns, lengths, np.zeros(NODES - 1)]), name=f"{SPLINE}{number}")
        except TrackError:  # it would cross itself
            continue


@functools.cache
def length_of(road: str) -> float:
    """Return the length of a track, m."""
    return Track(road).length


def look_of(number: int) -> int:
    """Return the look of the road or lap with this number: every second one has shadows; no look was trained on."""
    return number + SHADOWED * (number % 2)


def all_tasks() -> list[Task]:
    """Return the whole benchmark's tasks."""
    tasks = [
        Task("tracks", track, direction, speed, look_of(look))
        for track, speed in COURSES
        for look in range(1, 5)
        for direction in DIRECTIONS
    ]
    tasks += [Task("roads", f"road-{n}", way, 15, look_of(n)) for n in range(1, 101) for way in DIRECTIONS]
    tasks += [Task("roads", f"mountain-{n}", way, MOUNTAIN, look_of(n)) for n in range(1, 7) for way in DIRECTIONS]
    tasks += [Task("splines", f"{SPLINE}{n}", "ccw", 15, look_of(n)) for n in range(1, 21)]
    return tasks + starts(metres=100) + disturbed(STRENGTHS[2:], seconds=60)


def quick_tasks() -> list[Task]:
    """Return the tasks of the quick benchmark: the whole one's, but shorter, fewer, and only the worst disturbances."""
    tasks = [
        Task("tracks", "jungle", "cw", 15, look_of(1), 700),
        Task("tracks", "jungle", "ccw", 15, look_of(2), 400),
        Task("tracks", "lake", "cw", 30, look_of(3), 700),
        Task("tracks", "lake", "ccw", 15, look_of(4), 300),
    ]
    tasks += [Task("roads", f"road-{n}", DIRECTIONS[n % 4 // 2], 15, look_of(n), 250) for n in range(3, 100, 19)]
    tasks += [Task("roads", f"mountain-{n}", DIRECTIONS[n % 2], MOUNTAIN, look_of(n), 400) for n in range(1, 5)]
    tasks += [Task("splines", f"{SPLINE}{n}", "ccw", 15, look_of(n)) for n in range(1, 6)]
    foul = disturbed(STRENGTHS[4:], seconds=20)
    return tasks + starts(metres=60)[::5] + foul[::4] + foul[3::4]  # each kind on one of the two tracks


def starts(metres: float) -> list[Task]:
    """Return drives of so many metres that begin beside the lane's centre, all around both tracks."""
    poses = [(offset, turn) for offset in OFFSETS for turn in BESIDE]
    return [
        Task("off the lane", road, "ccw", 15, look_of(5), metres, (i / len(poses) * length_of(road), *pose))
        for road in ROADS
        for i, pose in enumerate(poses)
    ]


def disturbed(strengths: Sequence[int], seconds: float) -> list[Task]:
    """Return drives of so many seconds with disturbed frames, all around both tracks, for each kind and strength."""
    every = [Disturbance(kind, strength) for kind in KINDS for strength in strengths]
    tasks = []
    for i, disturbance in enumerate(every):
        for road, way, speed in FOUL:
            start = i / len(every) * length_of(road), 0.0, 0.0
            metres = round(seconds * speed * MPH)
            tasks.append(Task("disturbed", road, way, speed, look_of(6), metres, start, disturbance))
    return tasks
