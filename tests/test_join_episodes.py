"""udacity-gym and its like, played by a Socket.IO server of today: episodes on named tracks, with pauses and events."""

import base64
import json
import threading
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import socketio
from steer_server import Server
from test_join import LAKE, join, number
from werkzeug.serving import make_server

from cloning.base.errors import SimulatorError, TrackError
from cloning.recordings.images import decode
from simulator.dialects import Episodes
from simulator.join import Joined
from simulator.scenery.segments import CAR, GROUND, ROAD, SKY

pytestmark = pytest.mark.usefixtures("at_once")


class EpisodeProgram:
    """A test program of the dialect of episodes: `plan` yields what to send in answer to a telemetry."""

    def __init__(self, plan):
        self.sio = socketio.Server(async_mode="threading", transports=["websocket"], async_handlers=False)
        self.heard: list[tuple[str, Any]] = []
        self.plan = plan(self)
        events = "episode_metrics", "episode_events", "episode_event", "episode_started", "episode_ended"
        for event in (*events, "sim_paused", "sim_resumed"):
            self.sio.on(event, lambda sid, data, event=event: self.heard.append((event, data)))
        self.sio.on("connect", self.connect)
        self.sio.on("car_telemetry", self.telemetry)
        self.data = None
        self.server = make_server("127.0.0.1", 0, socketio.WSGIApp(self.sio), threaded=True)
        self.port = self.server.server_port
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def start(self, track, weather="sunny", daytime="day"):
        self.sio.emit("end_episode")
        self.sio.emit("start_episode", {"track_name": track, "weather_name": weather, "daytime_name": daytime})

    def connect(self, sid, environ, auth=None):
        time.sleep(0.3)  # the program is not ready yet
        next(self.plan)

    def telemetry(self, sid, data):
        self.data = data
        try:
            next(self.plan)
        except StopIteration:
            self.sio.disconnect(sid)

    def act(self, steering=0.0, throttle=1.0):
        self.sio.emit("action", {"steering_angle": str(steering), "throttle": str(throttle)})

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.server.server_close()


def test_an_episode_may_begin_instead_of_an_answer(monkeypatch):
    monkeypatch.setattr("simulator.join.ASK_AGAIN", 30.0)
    began = []

    def plan(program):
        program.start("lake")
        yield
        program.act()
        yield
        for _ in range(2):
            began.append(time.monotonic())
            program.start("lake")
            yield
        began.append(time.monotonic())

    with EpisodeProgram(plan) as program:
        assert join("episodes", program) == 0
    assert began[2] - began[0] < 15


def test_a_driver_in_another_process_is_waited_for():
    """udacity-gym answers at once, with the last action of a driver that takes each frame from a shared state."""
    answers: dict[str, list[str]] = {}  # by the car's place: of which place the driver had seen the frame

    def plan(program):
        seen, over = ["0"], threading.Event()

        def think():
            while not over.wait(0.05):
                place = program.data["pos_x"] if program.data else "0"
                time.sleep(0.05)
                seen.append(place)

        threading.Thread(target=think).start()
        program.start("lake")
        yield
        while len(answers) < 12:
            answers.setdefault(program.data["pos_x"], []).append(seen[-1])
            program.act(float(seen[-1]) / 1000)
            program.sio.emit("resume_sim")
            yield
        over.set()

    with EpisodeProgram(plan) as program:
        assert join("episodes", program) == 0
    assert all(place in frames for place, frames in list(answers.items())[:-1])


def test_episodes_have_weather_pauses_metrics_and_segments():
    seen = {}

    def plan(program):
        program.start("lake")
        yield
        while number(program.data, "speed") < 3:
            program.act()
            program.sio.emit("resume_sim")
            yield
        seen["sunny"] = program.data
        program.act()
        program.sio.emit("pause_sim")
        yield
        for _ in range(3):
            seen.setdefault("paused", []).append(program.data["pos_x"])
            program.act()
            program.sio.emit("pause_sim")
            yield
        while not any(event == "episode_event" for event, _ in program.heard):
            program.act(1.0)
            program.sio.emit("resume_sim")
            yield
        program.act()
        program.start("lake", "foggy", "daynight")
        yield
        while [event for event, _ in program.heard].count("episode_started") < 2:  # of the episode before
            program.act()
            yield
        seen["foggy"] = program.data

    with EpisodeProgram(plan) as program:
        assert join("episodes", program) == 0
    data = seen["sunny"]
    assert {"lap", "sector", "next_cte", "cte", "pos_x", "pos_y", "pos_z", "speed", "steering_angle"} <= set(data)
    frame = decode(base64.b64decode(data["image"]))
    fog = decode(base64.b64decode(seen["foggy"]["image"]))
    assert np.ptp(frame[2].astype(int), axis=-1).mean() > 40, "a blue sky"
    assert np.ptp(fog[2].astype(int), axis=-1).mean() < 15, "a grey one"
    png = np.frombuffer(base64.b64decode(data["semantic_segmentation"]), np.uint8)
    segments = cv2.cvtColor(np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB)
    assert segments.shape == frame.shape
    assert tuple(segments[110, 160]) == ROAD
    road = segments[:, :, 2] == 255  # as udacity-gym's programs find it
    assert road[100:130, 150:170].all() and not road[:50].any() and 0.1 < road.mean() < 0.5
    assert tuple(segments[5, 5]) in (SKY, GROUND)
    assert tuple(segments[158, 160]) == CAR
    assert len(set(map(tuple, segments.reshape(-1, 3)))) <= 6
    assert len(set(seen["paused"][1:])) == 1
    heard = [event for event, _ in program.heard]
    assert {"sim_paused", "sim_resumed"} <= set(heard)
    before, metrics = (data for event, data in program.heard if event == "episode_metrics")
    assert (before["outOfTrackCount"], metrics["outOfTrackCount"], metrics["collisionCount"]) == (0, 1, 0)
    assert metrics["track"] == "lake"
    event = next(data for event, data in program.heard if event == "episode_event")
    assert event["key"] == "out_of_track"
    assert abs(time.time() - int(event["timestamp"]) / 1000) < 600
    assert dict(program.heard)["episode_events"]["events"] == [event]
    assert heard.index("episode_started") < heard.index("sim_resumed")
    assert heard.count("episode_started") == heard.count("episode_ended") == 2


def test_an_episode_can_be_ended_at_any_time_and_then_telemetry_goes_on():
    dialect = Episodes(LAKE)
    for begin in (lambda: None, lambda: dialect.handle("start_episode", {"track_name": "lake"})):
        begin()
        dialect.replies.clear()
        dialect.handle("end_episode", None)
        names = [json.loads(packet[2:])[0] for packet in dialect.replies]
        assert names == ["episode_metrics", "episode_events", "episode_ended"]
    assert dialect.ready and dialect.still
    data = json.loads(dialect.telemetry()[2:])[1]
    assert (data["lap"], data["sector"], data["next_cte"]) == ("1", "0", data["cte"])
    assert abs(number(data, "angular_difference")) < 0.1


def test_the_bridge_is_a_segment_of_the_road_and_its_walls_are_not():
    dialect = Episodes(LAKE)
    dialect.run.s = 730.0
    dialect.run.set_back()
    seen = dialect.views[1].segments(dialect.run.car.node.get_transform())
    assert tuple(seen[110, 160]) == ROAD != tuple(seen[80, 5])


def test_flakes_do_not_depend_on_how_many_telemetries_a_pause_had():
    dialect, images = Episodes(LAKE), []
    for telemetries in (1, 3):
        dialect.handle("start_episode", {"track_name": "lake", "weather_name": "snowy"})
        for _ in range(telemetries):
            dialect.telemetry()
        dialect.step()
        images.append(json.loads(dialect.telemetry()[2:])[1]["image"])
    assert images[0] == images[1]


def test_a_program_is_told_nothing_that_an_earlier_one_was_to_hear_and_its_driver_is_sought_anew(monkeypatch):
    monkeypatch.undo()  # what `at_once` has changed
    heard = []

    def answer(packet, n):
        heard.append(json.loads(packet[2:])[0])
        if len(server.requests) == 1:
            server.send(server.client, '42["start_episode",{"track_name":"lake"}]')
            for _ in range(50):  # it has gone before the last one is obeyed
                server.send(server.client, '42["end_episode"]')

    dialect = Episodes(LAKE)
    dialect.ready = True
    with Server(answer, sessions=2) as server, pytest.raises(SimulatorError):
        joined = Joined(dialect, "127.0.0.1", server.port, wait=1.0, pace=0, rate=15)
        joined.driver.apart = False  # for the earlier one
        joined.run()
    assert heard == 2 * ["car_telemetry"]
    assert joined.driver.apart is None


def test_unknown_names_are_refused_and_known_ones_all_start():
    dialect = Episodes(replace(LAKE, direction="ccw"))
    for names, reason in (
        (("moon", "sunny", "day"), "no such track"),
        (("lake", "hail", "day"), "no such weather; there are sunny, rainy, snowy, foggy"),
        (("lake", "sunny", "night"), "no such daytime"),
    ):
        with pytest.raises(TrackError, match=reason):
            dialect.start(*names)
    images = []
    for names in (("mountain", "rainy", "day"), ("jungle", "snowy", "daynight")):
        dialect.start(*names)
        images.append(json.loads(dialect.telemetry()[2:])[1]["image"])
        assert dialect.track.direction == "ccw", "also in the jungle, whose own is cw"
    assert dialect.ready and images[0] != images[1]
