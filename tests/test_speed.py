"""The throttle that keeps a speed, and that stops a car: in the stand-in's jungle, and where it tried the wrong one."""

import numpy as np
import pytest

from cloning.recordings.writer import SampleClock
from cloning.road.motion import MPH
from cloning.road.track import Track
from cloning.server.speed import SpeedController
from simulator.expert import Expert
from simulator.run import Run


class Car:
    """A car of mass 1 whose speed follows throttle, drag and slope, in the simulator's figures roughly."""

    def __init__(self):
        self.speed = 0.0

    def step(self, throttle: float, slope: float = 0.0):
        self.speed = max(0.0, self.speed + 0.067 * (13 * throttle - 0.1 * self.speed - 22 * slope))


@pytest.mark.parametrize("set_speeds", [(9, 25, 12), (30,)])
def test_controller_settles_at_each_set_speed_and_is_not_wound_up_by_a_wait_or_a_hill(set_speeds):
    controller, car = SpeedController(set_speeds[0]), Car()
    for _ in range(2000):
        assert -1 <= controller.throttle(0) <= 1  # held by a wall for two minutes
    for set_speed in set_speeds:
        before, controller.set_speed, speeds = car.speed, set_speed, []
        for frame in range(2000):
            car.step(controller.throttle(car.speed), slope=0.3 if 600 < frame < 1200 else 0)
            speeds.append(car.speed)
        beyond = max(speeds[:600]) - set_speed if set_speed > before else set_speed - min(speeds[:600])
        assert beyond < 2, "mph over the set speed, or under a lower one"
        assert abs(car.speed - set_speed) < 0.5, "settled again after the hill"


def test_a_set_speed_of_0_brakes_until_the_car_is_at_rest_and_never_drives_it_backwards():
    controller = SpeedController(9)
    assert [controller.throttle(speed) for speed in (8, 50)] == pytest.approx([0.102, -1]), "as Udacity's"
    controller.set_speed = 0
    assert [controller.throttle(speed) for speed in (9, 6, 4, 4, 4.4, 2, 1, 0.4)] == [-1] * 7 + [0]
    assert controller.throttle(0.1) == controller.throttle(3) == 0, "nothing brakes a car that rolls so slowly"
    controller.set_speed = 9
    assert controller.throttle(1) == pytest.approx(0.1 * 8 + 0.002 * (1 + 8)), "50 mph have not wound it up"
    controller.set_speed = 0
    assert [controller.throttle(speed) for speed in (1.2, 1.1, 1.2)] == [-1, -1, 0], "where it stops on a slope"


@pytest.mark.parametrize("grade, fastest", [(0.0, 3), (0.22, 7), (-0.09, 5.5)])
def test_a_stopped_car_hardly_rolls_on_a_slope(grade, fastest):
    """In the jungle, where it had 12 mph backwards on the second slope, and later left the road there, rolling slowly.

    The last one is where the road begins to fall.
    """
    track = Track("jungle", "ccw")
    grades = np.array([track.at(s).grade for s in range(int(track.length))])
    run, controller = Run(track, "autonomous"), SpeedController(15)
    run.s = int(np.abs(grades[60:-60] - grade).argmin()) + 60 - 25.0
    run.set_back()
    expert, clock, speeds = Expert(track, top_speed=7, wander=0), SampleClock(1 / 15), []
    while run.time < 50:
        controller.set_speed = 15 if run.time < 5 else 0
        steering, throttle, due = expert.drive(run)[0], controller.throttle(run.speed_mph), False
        while not due:
            run.step(steering, throttle)
            due = clock.due(run.time)
        speeds.append(run.speed_mph)
    assert max(speeds[: 5 * 15]) > 10 and max(speeds[7 * 15 :]) < fastest and not run.departures


@pytest.mark.parametrize("slope", [-0.2, -0.05, 0.0, 0.05, 0.25])
@pytest.mark.parametrize("throttle", [0.05, 0.5])
def test_a_stopped_car_comes_to_rest_also_where_its_throttle_told_another_slope(slope, throttle):
    """The speed that is told has no sign. The throttle acts as gravity does, and nothing else slows the car down."""
    controller, speed, way, speeds = SpeedController(9), 1.0, 0.0, []
    controller.error_sum = (throttle - 0.1 * 8) / 0.002
    controller.throttle(1.0)
    controller.set_speed = 0
    for _ in range(60 * 15):
        speed += (13 * controller.throttle(abs(speed)) - 22 * slope) / 15
        way += speed * MPH / 15
        speeds.append(abs(speed))
    assert max(speeds) < 12 and max(speeds[-15 * 15 :]) < 2 and abs(way) < 70
