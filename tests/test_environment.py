"""The Gymnasium environment: against Gymnasium's own checks, and against the simulator driven without it."""

import math
import pickle
import re
import textwrap
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env
from panda3d.core import RenderState

from cloning.base.errors import SimulatorError, TrackError
from cloning.recordings.format import SAMPLE_RATE
from cloning.road.points import make_road
from simulator import environment, scenery
from simulator.cameras import Cameras
from simulator.car import STEP
from simulator.run import Run
from simulator.world import Scene

STRAIGHT = {"s": 300.0}  # where the lake's road is straight for 50 m


@pytest.fixture(scope="module")
def lake():
    return environment.Drive(laps=0.01)


def drive(env, actions, **reset):
    """The frames and the infos of an episode's first steps."""
    steps = [env.reset(**reset)]
    for action in actions:
        frame, _, _, _, info = env.step(np.asarray(action))
        steps.append((frame, info))
    return np.stack([frame for frame, _ in steps]), [info for _, info in steps]


def end_of_episode(env, *action):
    """The rewards of driving in this way to the end of an episode, and what its last step returned."""
    rewards, ended = [], False
    while not ended:
        last = env.step(np.asarray(action))
        rewards.append(last[1])
        ended = last[2] or last[3]
    return rewards, last


@pytest.mark.filterwarnings("error")
def test_gymnasium_finds_no_fault():
    env = gymnasium.make(environment.ID, track="jungle", random_start=True, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.reset(seed=0)
    frame: Any = env.render()
    assert frame.shape == (360, 640, 3)


def test_the_observation_is_the_centre_cameras_frame(lake):
    frame, info = lake.reset(options={"s": 300, "offset": 1.5})
    run = Run(lake.track, "autonomous")
    run.s = 300
    run.set_back(1.5)
    eyes = Cameras(Scene(scenery.build("lake")), ("center",))
    assert np.array_equal(frame, eyes.frames(run.car.node.get_transform())[0])
    assert (info["s"], info["offset"], info["speed"]) == (300, 1.5, 0)


def test_a_step_lasts_until_the_next_of_15_frames_a_second(lake):
    lake.reset()
    times = []
    for _ in range(20):
        lake.step(np.asarray([0, 0]))
        times.append(lake.run.time)
    assert times == pytest.approx([STEP * math.ceil(n / SAMPLE_RATE / STEP - 1e-9) for n in range(1, 21)])


def test_rewards_are_the_metres_driven_and_steering_is_right_positive(lake):
    for side in (-1, 1):
        _, before = lake.reset(options=STRAIGHT)
        rewards, (_, _, terminated, truncated, info) = end_of_episode(lake, side * 0.1, 1)
        assert (terminated, truncated) == (False, True)
        assert sum(rewards) == pytest.approx(info["s"] - before["s"], abs=1e-6)
        assert 0.01 * lake.track.length <= sum(rewards) < 0.012 * lake.track.length
        assert 0.1 < side * info["offset"] < 2
        assert info["departures"] == 0


def test_the_episode_ends_where_the_car_leaves_the_road(lake):
    lake.reset(options={**STRAIGHT, "offset": 2})
    rewards, (frame, _, terminated, truncated, info) = end_of_episode(lake, 0.5, 1)
    assert (terminated, truncated) == (True, False)
    assert min(rewards[:-1]) > -0.01
    assert -100 <= rewards[-1] < -98
    run = Run(lake.track, "autonomous")
    run.s = 300
    run.set_back(2)
    while run.step(0.5, 1):
        pass
    assert lake.run.departures == run.departures
    assert info["departures"] == 1
    assert info["offset"] == run.trajectory.offset[-1] > 2  # it has not been set back
    assert info["speed"] > 3
    with pytest.raises(ResetNeeded):
        lake.step(np.asarray([0, 1]))
    again, info = lake.reset()
    assert info["departures"] == info["offset"] == 0
    assert not np.array_equal(frame, again)


def test_the_car_never_exceeds_the_set_speed_and_a_lap_is_counted():
    env = environment.Drive(speed=10, laps=2)
    env.reset()
    env.run.travelled = env.track.length - 8
    speeds = [env.step(np.asarray([0, 2]))[4]["speed"] for _ in range(45)]
    assert max(speeds) == pytest.approx(10, abs=0.01)
    assert env.step(np.asarray([0, 1]))[4]["laps"] == 1


def test_seeds_choose_the_start_and_two_environments_do_not_disturb_each_other():
    actions = [(0.1 * math.sin(n), 1.0) for n in range(12)]
    one, two = (gymnasium.make(environment.ID, random_start=True) for _ in range(2))
    frames, infos = drive(one, actions, seed=5)
    two.reset(seed=6)
    for env in (one, two):
        env.reset(seed=5)
    for action, frame in zip(actions, frames[1:], strict=True):
        assert np.array_equal(one.step(np.asarray(action))[0], frame)
        assert np.array_equal(two.step(np.asarray(action))[0], frame)
    starts = [infos[0]["s"], *(one.reset(seed=seed)[1]["s"] for seed in (6, 7))]
    assert len(set(starts)) == 3
    assert one.reset(options=STRAIGHT)[1]["s"] == 300


def test_environments_in_processes_of_their_own_see_the_same(lake):
    actions = [(0.2, 1.0)] * 5
    frames, _ = drive(lake, actions)
    vector = gymnasium.make_vec(environment.ID, num_envs=2, vectorization_mode="async")
    try:
        both, _ = drive(vector, [[action, action] for action in actions])
    finally:
        vector.close()
    assert np.array_equal(both, np.stack([frames, frames], axis=1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"direction": "left"}, "'ccw', 'cw' or None"),
        ({"look": 1.0}, "a whole number from 0, as an int"),
        ({"speed": 31}, r"1 to 30 \(mph\)"),
        ({"laps": math.nan}, "a number above 0"),
        ({"track": 3}, "a name, such as 'lake'"),
        ({"speed": "fast"}, r"1 to 30 \(mph\)"),
        ({"random_start": "no"}, "True or False"),
    ],
)
def test_wrong_arguments_are_reported(arguments, message):
    with pytest.raises(TrackError, match="moon: there is no such track"):
        gymnasium.make(environment.ID, track="moon")
    (name,) = arguments
    with pytest.raises(SimulatorError, match=f"^{name} .* it must be {message}"):
        gymnasium.make(environment.ID, **arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"s": 2000}, "less than 1137.9"),
        ({"s": math.nan}, "less than 1137.9"),
        ({"offset": -3.5, "s": 300}, "the road's left edge; at 300.0 m the edges are at -3.95 and 3.95 m"),
        ({"offset": 10**400}, "it must be a number on the road"),
        ({"speed": 3}, "the options of reset are s, offset, turn, track"),
        ({"s": np.array([300.0])}, "less than 1137.9"),
        ({"offset": None}, "it must be a number"),
        ({"turn": 4}, "it must be -π to π"),
        ({"look": -1}, "a whole number"),
        ({"track": 7}, "a name, such as 'lake'"),
        ({"direction": "up"}, "'ccw', 'cw' or None"),
        ([300], "the options of reset are s, offset, turn, track"),
    ],
)
def test_wrong_options_are_reported_and_begin_no_episode(lake, options, message):
    lake.reset()
    with pytest.raises(SimulatorError, match=message):
        lake.reset(options=options)
    with pytest.raises(ResetNeeded):
        lake.step(np.asarray([0, 1]))
    with pytest.raises(ResetNeeded):
        lake.render()


@pytest.mark.parametrize("action", [[math.nan, 1], [0, math.inf], [0], 0.5, "left", None, [[0, 1], [0]]])
def test_an_action_that_is_not_two_finite_numbers_is_refused(lake, action):
    lake.reset()
    with pytest.raises(InvalidAction, match="two finite numbers"):
        lake.step(action)


def test_reset_chooses_the_road_the_look_and_the_start(lake):
    env = environment.Drive(laps=1, render_mode="rgb_array")
    road = make_road([(0, 0), (30, 0), (60, 9)], width=7)
    frame, _ = env.reset(options={"track": road, "look": np.uint8(3), "s": 20, "offset": 1.0, "turn": 0.1})
    other = environment.Drive(road, look=3)
    expected, _ = other.reset(options={"s": 20, "offset": 1.0, "turn": 0.1})
    assert np.array_equal(frame, expected)
    assert env.run.lane == pytest.approx((1.0, 0.1), abs=0.01)
    view: Any = env.render()
    assert view.std() > 10
    assert env.reset()[1]["s"] == 0, "it stays on the road"
    backwards = env.reset(options={"direction": "cw"})[1]["pos"]
    assert backwards == pytest.approx((60, 0, 9), abs=0.1)
    with pytest.raises(TrackError, match="moon"):
        env.reset(options={"track": "moon"})
    with pytest.raises(SimulatorError, match="less than"):
        env.reset(options={"track": "jungle", "s": 2000})
    assert env.reset()[1]["pos"] == backwards, "what is refused changes nothing"
    lake_frame, _ = env.reset(options={"track": "lake", "look": 0})
    assert np.array_equal(lake_frame, lake.reset()[0])


@pytest.mark.parametrize("begin", [0, 90])
def test_an_episode_on_an_open_road_ends_where_the_road_ends_wherever_it_began(begin):
    env = environment.Drive(make_road([(0, 0), (50, 0), (100, 0)], width=6))
    env.reset(options={"s": begin})
    frame, _, terminated, truncated, info = end_of_episode(env, 0, 1)[1]
    assert (terminated, truncated, info["laps"]) == (False, True, 1)
    assert info["s"] == pytest.approx(100, abs=0.4) and frame[100:].std() > 5


def test_a_reward_is_progress_also_where_a_second_lap_of_an_open_road_begins():
    env = environment.Drive(make_road([(0, 0), (50, 0), (100, 0)]), laps=2)
    env.reset(options={"s": 80})
    rewards, _ = end_of_episode(env, 0, 1)
    assert max(rewards) < 1.5 and sum(rewards) == pytest.approx(20 + 100, abs=1)


def test_info_has_the_names_that_users_of_gym_donkeycar_know():
    env = environment.Drive(make_road([(0, 0, 3), (0, 30, 3)]), laps=2)
    info = env.reset(options={"offset": 0.5})[1]
    assert info["pos"] == pytest.approx((0.5, 3, 0), abs=0.1)
    assert (info["cte"], info["hit"], info["lap_count"], info["last_lap_time"]) == (0.5, "none", 0, 0.0)
    while not info["lap_count"]:
        info = env.step(np.asarray([0, 1]))[4]
    first = info["last_lap_time"]
    assert first == env.run.lap_times[0] > 2
    while info["hit"] == "none":
        info = env.step(np.asarray([-1, 1]))[4]
    assert (info["hit"], info["last_lap_time"]) == ("left", first)


def test_a_pickled_environment_drives_as_the_original():
    env = environment.Drive(make_road([(0, 0), (50, 9)]), look=2, speed=12, random_start=True)
    frames, _ = drive(env, [(0.1, 1.0)] * 3, seed=4)
    copy = pickle.loads(pickle.dumps(env))
    with pytest.raises(ResetNeeded):
        copy.step(np.zeros(2))
    assert np.array_equal(drive(copy, [(0.1, 1.0)] * 3, seed=4)[0], frames)
    env.close()
    copy.close()


def test_a_closed_environment_frees_its_scene_and_says_that_it_is_closed():
    before = None
    for _ in range(3):
        env = environment.Drive(render_mode="rgb_array")
        with pytest.raises(ResetNeeded, match="before render"):
            env.render()
        env.reset()
        env.render()
        env.close()
        env.close()
        states, before = RenderState.get_num_states(), before or RenderState.get_num_states()
        assert states <= before, "panda3d keeps no texture of it"
    for call in (env.reset, env.render, lambda: env.step(np.zeros(2))):
        with pytest.raises(ClosedEnvironmentError, match="make another"):
            call()


def test_the_documented_example_drives_the_shipped_network(capsys):
    example = re.findall(r"\n((?: {4}.*\n|\n)+)", environment.__doc__ or "")[0]
    exec(textwrap.dedent(example).replace("speed=15", "speed=15, laps=0.015"), {})
    assert re.match(r"drove a lap \{'s': .*'departures': 0", capsys.readouterr().out)
