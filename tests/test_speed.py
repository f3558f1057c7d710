"""The throttle that stops a car: in the stand-in's jungle, and where it tried the wrong one first."""

import numpy as np
import pytest

from cloning.recordings.writer import SampleClock
from cloning.road.track import Track
from cloning.server.speed import PUSH, SpeedController
from simulator.expert import Expert
from simulator.run import Run


@pytest.mark.parametrize("grade, fastest", [(0.0, 3), (0.22, 4), (-0.09, 5.5)])
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


def test_a_stopped_car_that_rolls_the_other_way_than_it_seemed_is_stopped_too():
    """It braked on a slope that it seemed to come down, or was driven with a throttle as if uphill."""
    controller = SpeedController(9)
    for before, driven, tried, then in ((9, 9, -1, PUSH), (0, 2, -1, PUSH), (2, 2, PUSH, -1)):
        controller.set_speed, controller.error_sum = 9, 0.0
        controller.throttle(before)
        controller.throttle(driven)
        controller.set_speed = 0
        found = [controller.throttle(speed) for speed in (1, 0.4, *np.arange(5.5, 15, 0.5))]
        assert [*dict.fromkeys(found[2:])] == [tried, 0, then], "and a frame in between"
