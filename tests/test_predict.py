"""Steering for where the car is now: late and lost frames, against a car on a road of which all is known."""

import json
import math
from collections import deque

import numpy as np
import pytest
import real_recordings

import drive as drive_py
from cloning.base.frame import FRAME
from cloning.lane.predict import FOR_HEADING, FOR_OFFSET, LONGEST_PAUSE, Predictor
from cloning.lane.recovery import MAX_LABEL_OFFSET
from cloning.network.network import SHIPPED_MODEL
from cloning.recordings.images import encode
from cloning.recordings.log import read_recording
from cloning.replay import replay
from cloning.replay.model_driver import ModelDriver
from cloning.road.camera import CAMERA_MATRIX
from cloning.road.disturbances import Disturbance
from cloning.road.motion import MPH, TOP_SPEED_MPH, curvature, lagged_curvature, steering_for
from cloning.wire.client import telemetry_packet
from cloning.wire.protocol import Place
from simulator.driving import Conditions, drive

SPEED, PAUSE, SECONDS = TOP_SPEED_MPH * MPH, 1 / 15, 40  # m/s, s between frames, s of a drive


def corrected(predictor, steering, frame, time, speed):
    """Return the steering for where the car is, at the next frame."""
    predictor.move(time, speed)
    return predictor.correct(steering, frame)


class World:
    """A car that is steered by the law that the networks learn, on a road that winds, in front of a far background."""

    def __init__(self, seed: int = 0):
        rng = np.random.default_rng(seed)
        coarse = np.convolve(rng.uniform(0, 255, 4000), np.ones(3) / 3, "same")
        self.panorama = np.interp(np.arange(0, 4000, 0.2), np.arange(4000), coarse)
        self.offset, self.heading, self.turned, self.bend, self.metres = 0.5, 0.0, 0.0, 0.0, 0.0

    @property
    def road(self) -> float:
        """The road's curvature where the car is, 1/m."""
        return 0.015 * math.sin(self.metres / 40)

    def steering(self) -> float:
        """The steering of a network that sees the car where it is."""
        offset = min(MAX_LABEL_OFFSET, max(-MAX_LABEL_OFFSET, self.offset))
        return float(steering_for(self.road - FOR_OFFSET * offset - FOR_HEADING * self.heading))

    def frame(self) -> np.ndarray:
        """The frame that a camera takes now."""
        columns = 1800 + np.arange(FRAME[1]) + CAMERA_MATRIX[0, 0] * self.turned
        seen = np.interp(columns * 5, np.arange(len(self.panorama)), self.panorama)
        return np.broadcast_to(seen[None, :, None], FRAME).astype(np.uint8)

    def move(self, steering: float) -> None:
        """Drive to the next frame."""
        self.bend = lagged_curvature(self.bend, curvature(steering), PAUSE)
        step = SPEED * PAUSE
        self.turned += self.bend * step
        self.heading += (self.bend - self.road) * step
        self.offset += self.heading * step
        self.metres += step


def drive_with(late, lost, predictor):
    """Drive with frames that come so many frames late, or a share of which is lost; return the offsets, m.

    The times that the predictor is told are wrong by some 5 ms, as those of a server that looks at its clock.
    """
    world, shown, rng = World(), deque[tuple[np.ndarray, float]](maxlen=late + 1), np.random.default_rng(1)
    offsets, noise = [], np.random.default_rng(2)
    for number in range(round(SECONDS / PAUSE)):
        if not number or rng.random() >= lost:
            shown.append((world.frame(), world.steering()))
        frame, steering = shown[0]
        time = number * PAUSE + noise.uniform(-0.008, 0.008)
        world.move(float(corrected(predictor, steering, frame, time, SPEED)) if predictor else steering)
        offsets.append(abs(world.offset))
    return offsets


def test_frames_in_time_change_nothing():
    """The network's own number is sent, bit for bit."""
    world, predictor = World(), Predictor()
    for number in range(300):
        steering = np.float32(world.steering())
        assert corrected(predictor, steering, world.frame(), number * PAUSE, SPEED) == steering
        explained = predictor.road - FOR_OFFSET * predictor.seen[0] - FOR_HEADING * predictor.seen[1]
        assert explained == pytest.approx(curvature(float(steering)))
        world.move(float(steering))
    assert predictor.delay.frames == 0


@pytest.mark.parametrize("late, weaves", [(2, 1.2), (3, 2.5), (5, 5)])
def test_late_frames(late, weaves):
    """The delay is found, and the car keeps to the lane, beside which it weaves so many m without a prediction."""
    predictor = Predictor()
    predicted, alone = drive_with(late, 0, predictor), drive_with(late, 0, None)
    assert predictor.delay.frames in (late, late - 1)  # the background turns half a frame after the steering
    assert max(predicted[300:]) < 0.2 * weaves and max(alone[300:]) > weaves


def test_lost_frames():
    """Where most frames are lost, the car stays nearer to the lane's centre."""
    predicted, alone = drive_with(0, 0.8, predictor := Predictor()), drive_with(0, 0.8, None)
    assert predictor.delay.frames == 0
    assert np.mean(predicted) < 0.5 * np.mean(alone)


def test_a_car_that_stands_is_steered_as_the_network_says():
    """Repeated frames of a car at rest, as the simulator sends them at the start, change nothing."""
    predictor, frame = Predictor(), World().frame()
    assert {float(corrected(predictor, 0.25, frame, number * PAUSE, 0.0)) for number in range(50)} == {0.25}


@pytest.mark.parametrize("frames", [1, 2, 3, 7])
def test_frames_that_recur_are_no_late_or_lost_ones(frames):
    """A program that sends a few frames again and again, at any speed, gets the network's own numbers."""
    world, seen, predictor = World(), [], Predictor()
    for _ in range(frames):
        seen.append((world.frame(), np.float32(world.steering())))
        world.move(float(seen[-1][1]))
    for number in range(400):
        frame, steering = seen[number % frames]
        assert corrected(predictor, steering, frame.copy(), number * PAUSE, SPEED) == steering


def test_a_camera_that_freezes_for_long_and_a_speed_beyond_that_of_cars_do_no_harm():
    """Whatever is told of the speed, the steering is a number of -1..1, and nothing grows."""
    predictor = Predictor()
    drive_with(0, 0.8, predictor)
    frame, until = World(2).frame(), predictor.time
    for number in range(1, 3000):
        speed = (SPEED, 1e300, -1e300)[number % 3] if number > 2000 else SPEED
        assert abs(corrected(predictor, 0.3, frame, until + number * PAUSE, speed)) <= 1
    assert len(predictor.since) <= 1
    assert abs(corrected(predictor, 0.3, World(1).frame(), until + 3000 * PAUSE, SPEED)) <= 1


@pytest.mark.parametrize("pause", [LONGEST_PAUSE + 0.1, -5.0])
def test_a_pause_begins_anew(pause):
    """What the car did before a pause of the simulator, or a time that runs backwards, is forgotten."""
    predictor = Predictor()
    drive_with(4, 0, predictor)
    assert predictor.delay.frames
    world = World()
    assert corrected(predictor, 0.1, world.frame(), predictor.time + pause, SPEED) == np.float32(0.1)
    assert (predictor.delay.frames, len(predictor.since), predictor.pose) == (0, 0, (0.0, 0.0))


def test_telemetries_of_the_same_time_are_no_pause():
    """The stand-in sends several between two physics steps, which show the same: the delay is found nevertheless."""
    predictor, world, shown = Predictor(), World(), deque[tuple[np.ndarray, float]](maxlen=4)
    for number in range(600):
        shown.append((world.frame(), world.steering()))
        for _ in range(2):
            steering = corrected(predictor, shown[0][1], shown[0][0], number * PAUSE, SPEED)
        world.move(float(steering))
        if number > 300:
            assert predictor.delay.frames == 6 and abs(world.offset) < 0.1


def test_no_delay_is_seen_without_a_background():
    """Frames of one colour, or of noise, tell nothing."""
    rng = np.random.default_rng(0)
    for frames in (np.zeros((100, *FRAME), np.uint8), rng.integers(0, 255, (100, *FRAME), np.uint8)):
        predictor = Predictor()
        for number, frame in enumerate(frames):
            corrected(predictor, math.sin(number / 3), frame, number * PAUSE, SPEED)
        assert predictor.delay.frames == 0


@pytest.mark.parametrize("disturbance", ["late:5", "dropped:4"])
def test_the_shipped_network_stays_on_the_road(disturbance):
    """At 30 mph on the lake, with frames 0.4 s late, or with three of four lost."""
    conditions = Conditions(str(SHIPPED_MODEL), 30, 1, "ccw", 250, (300.0, 0.0, 0.0))
    driven = drive(conditions._replace(disturbance=Disturbance.parse(disturbance)), "lake")
    assert (driven.ended, driven.farthest < 1.5) == ("arrived", True)


def test_a_disturbed_replay_is_corrected_in_each_stretch_anew(sample_recording, network, monkeypatch):
    """What the pilot steers counts; frames as they were recorded are in time."""
    recording, pilots = read_recording(sample_recording), []

    def pilot(steer):
        pilots.append(steer)
        return lambda frame, time, speed: (np.float32(0.25), None)

    monkeypatch.setattr("cloning.replay.model_driver.Pilot", pilot)
    lines = replay.reference_lines(recording, by_lane=False)
    driven = replay.drive(recording, lines * 2, 2.5, ModelDriver(network), None, Disturbance("late", 3))
    assert set(driven.steering) == {0.25} and len(pilots) == 2
    replay.drive(recording, lines, 2.5, ModelDriver(network))
    assert len(pilots) == 2


@pytest.mark.skipif(not real_recordings.FOLDERS, reason=real_recordings.MISSING)
def test_a_real_recording_is_driven_with_late_frames():
    """A lake at 30 mph, with frames 0.3 s late, needs no intervention."""
    recording = read_recording(next(each for each in real_recordings.FOLDERS if "lake" in each.name)).take(slice(600))
    lines = replay.reference_lines(recording)
    driven = replay.drive(recording, lines, 2.5, ModelDriver(str(SHIPPED_MODEL)), None, Disturbance("late", 4))
    assert not driven.interventions and np.abs(driven.offset).mean() < 0.4


def test_drive_py_tells_once_how_late_frames_are(network, monkeypatch, caplog):
    """What is sent is the corrected steering, and a line says why."""
    world, shown = World(), deque[tuple[np.ndarray, float]](maxlen=5)
    session = drive_py.Session(drive_py.DriveServer(network))
    monkeypatch.setattr(drive_py, "steer", lambda network, frame: np.float32(shown[0][1]))

    def steered(time: float) -> float:
        packet = telemetry_packet(0, 0, SPEED / MPH, encode(shown[0][0], 90), Place("lake", 0.0, 0.0, 0.0, 0, time))
        return float(session.answer(json.loads(packet[2:])[1])["steering_angle"])

    for number in range(200):
        shown.append((world.frame(), world.steering()))
        world.move(steered(number * PAUSE))
    assert abs(world.offset) < 0.3 and session.unusable == 0
    told = ["frames come late, by 4 frames: steering for where the car is now"]
    assert caplog.messages == told
    steered(260 * PAUSE)  # as after a person has driven: whether frames are still late is not known
    assert caplog.messages == [*told, "frames are no longer known to come late"]


def test_drive_py_tells_frames_apart_that_come_within_a_tick(network, monkeypatch):
    """As on Windows, where time.monotonic() may stand still for 15.6 ms, in which a car at 30 mph drives 0.2 m."""
    monkeypatch.setattr(drive_py.time, "monotonic", lambda: 1000.0)
    world, session = World(), drive_py.DriveServer(network).session("sid")
    for _ in range(2):
        session.answer(json.loads(telemetry_packet(0, 0, SPEED / MPH, encode(world.frame(), 90))[2:])[1])
    step = session.pilot.predictor.step
    assert step and 0 < step.metres < SPEED
