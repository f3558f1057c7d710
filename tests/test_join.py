"""Other people's programs, played by servers here: two dialects, many episodes, a server that goes."""

import base64
import json
import os
import socket
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from steer_server import Server

from cloning.recordings.images import decode
from simulator.__main__ import main
from simulator.dialects import Roads, Stage
from simulator.join import Joined

pytestmark = pytest.mark.usefixtures("at_once")
ROADS = ["0,1.9,0@25,1.9,0@40,1.9,3", "125.0,1.9,5.0@125.0,1.9,25.0@128.0,1.9,45.0"]
LAKE = Stage("lake", None, 0, {})


class Program(Server):
    """A server whose `answer(data, n)` returns the events for a telemetry's data, or None to hang up."""

    def __init__(self, answer, sessions=1):
        self.answer, self.data = answer, []
        super().__init__(self.reply_to, sessions=sessions)

    def reply_to(self, packet, n):
        event, data = json.loads(packet[2:])
        assert event == "telemetry"
        self.data.append(data)
        answers = self.answer(data, n)
        return None if answers is None else ["42" + json.dumps(answer) for answer in answers]


def join(dialect, server, *more):
    return main(["join", "--dialect", dialect, "--port", str(server.port), "--wait", "20", *more])


def steer(steering, throttle):
    return ["steer", {"steering_angle": str(steering), "throttle": str(throttle)}]


def number(data, key):
    return float(data[key])


@pytest.mark.parametrize("more", [[], ["--pace", "2"]])
def test_measures_are_sent_with_the_telemetry(more, capsys):
    def answer(data, n):
        time = int(data["sim_time"])  # as ThirdEye reads it
        return [steer(0.1 if time > 1 else 0, 1)] if time < 3 else None

    with Program(answer) as program:
        assert join("measures", program, *more, "--look", "1") == 0
    assert f"1 episode, {len(program.data)} telemetries, " in capsys.readouterr().out
    first, last = program.data[0], program.data[-1]
    assert all(isinstance(value, str) for value in last.values())
    assert decode(base64.b64decode(last["image"])).shape == (160, 320, 3)
    assert (first["lapNumber"], first["crash"], first["tot_crashes"], first["tot_obes"]) == ("1", "0", "0", "0")
    assert number(first, "distance") == 0, "it has waited"
    least = {"cte": 0.1, "ang_diff": 2, "distance": 5, "speed": 8}  # mph; it has steered to the right
    assert all(number(last, key) > value for key, value in least.items()), last | {"image": ""}
    times = [int(data["sim_time"]) for data in program.data]
    if not more:  # in lock-step the frames are those of any other run
        assert times == (np.ceil(np.arange(len(times)) / 15 / 0.02 - 1e-6) * 0.02 + 1e-6).astype(int).tolist()


def test_a_departure_is_an_out_of_bound_episode_and_the_car_is_set_back():
    def answer(data, n):
        after = sum(each["tot_obes"] == "1" for each in program.data)
        return None if after > 20 else [steer(1 if n > 25 and not after else 0, 0.1 if after else 1)]

    with Program(answer) as program:
        assert join("measures", program) == 0
    assert program.data[-1]["tot_obes"] == "1"
    assert abs(number(program.data[-1], "cte")) < 0.5
    crash = "".join(data["crash"] for data in program.data)
    assert crash.strip("0") == 15 * "1", "for a second, by which programs find the failure"
    assert {data["tot_crashes"] for data in program.data} == {"0"}
    assert min(number(data, "ang_diff") for data in program.data) >= 0


def test_the_last_lap_that_a_program_wants_ends_the_drive(tmp_path, capsys):
    (tmp_path / "road.csv").write_text("0,0\n25,0\n")

    def answer(data, n):
        wanted = {"max_laps": "2".zfill(5000) if n else "-3", "confidence": "1", "loss": "0.01"}
        return [["steer", steer(0, 1)[1] | wanted]] if n < 200 else None

    with Program(answer) as program:
        assert join("measures", program, "--road", str(tmp_path / "road.csv")) == 0
    assert "\"max_laps\" '-3' is no number of laps, and is ignored" in capsys.readouterr().err
    places = {(data["lapNumber"], data["currentWayPoint"]) for data in program.data}
    assert places == {(lap, place) for lap in "12" for place in "012"}, "each lap begins in the first sector"


class RoadTests:
    """A test program of the dialect of roads: it drives each road to its end, or off it."""

    def __init__(self, plan):
        self.plan = iter(plan)  # steering on each road
        self.road, self.steering, self.done, self.sent = None, 0.0, True, False
        self.results = []

    def __call__(self, data, n):
        if self.done:
            if self.road and data["track"] == self.road and number(data, "speed") > 0.01:
                return [["reset", {}]]
            steering = next(self.plan, None)
            if steering is None:
                return None
            self.steering = steering
            self.road, self.done, self.sent = ROADS[len(self.results) % len(ROADS)], False, False
        if data["track"] != self.road:
            assert not self.sent, "the road is there at once"
            self.sent = True
            return [["track", {"track_string": self.road}]]
        if abs(number(data, "cte")) > 3 or data["hit"] != "none":
            self.done = True
            self.results.append((data["hit"], round(number(data, "pos_x"), 1), round(number(data, "pos_z"), 1)))
            return [["reset", {}]]
        return [steer(self.steering - 0.6 * number(data, "cte_pid") + number(data, "angl") / 25, 0.8)]


def test_roads_are_laid_driven_to_their_end_and_set_back():
    tests = RoadTests([0.0, 0.0, 3.0])
    with Program(tests) as program:
        assert join("roads", program, "--width", "8", "--land", "forest") == 0
    (one, *end), (other, *other_end), (none, *_) = tests.results
    assert (one, other, none) == ("end of the road", "end of the road", "none")
    assert end + other_end == pytest.approx([40, 3, 128, 45], abs=0.6)
    begun = next(data for data in program.data if data["track"] == ROADS[1])
    assert [number(begun, key) for key in ("pos_x", "pos_z")] == pytest.approx([125, 5], abs=0.01)
    assert number(begun, "pos_y") == pytest.approx(1.9, abs=0.1)  # y is up
    assert number(begun, "speed") < 0.01
    assert number(begun, "angle6") == pytest.approx(357.9, abs=0.1)  # degrees from north to the right
    assert 5 < max(number(data, "speed") for data in program.data) <= 13.5  # m/s: 30 mph


def test_a_weather_is_seen_at_once_and_on_the_roads_sent_after_it(monkeypatch):
    """perturbation-drive sends it after the road, as the whole answer to a telemetry."""
    monkeypatch.setattr("simulator.join.ASK_AGAIN", 30.0)
    plan = [["track", {"track_string": ROADS[0]}], steer(0, 1)]
    for weather in ("Sun", "Fog", "Rain", "MoonShine Skybox"):
        plan += [["weather", {"type": weather, "rate": "30"}], ["track", {"track_string": ROADS[0]}], steer(0, 1)]
    with Program(lambda data, n: [plan[n]] if n < len(plan) else None) as program:
        begin = time.monotonic()
        assert join("roads", program) == 0
    assert time.monotonic() - begin < 20
    images = [decode(base64.b64decode(data["image"])).astype(int) for data in program.data]
    for sun, fog, rain, moon in (images[3::3], images[4::3]):  # on the road that lies there, and on the next
        assert min(np.abs(sun - fog).mean(), np.abs(sun - rain).mean(), np.abs(fog - rain).mean()) > 5
        assert (sun == moon).all()
    places = [number(data, "pos_z") for data in program.data]
    assert min(places[3::3]) > max(places[4::3]), "the car stays where it is"


def test_a_driver_in_another_thread_is_waited_for_and_gets_the_same_drive_however_slow_it_is(monkeypatch):
    """The program answers at once, with the last command of a driver that has seen another frame meanwhile."""
    for name in ("BRIEFLY", "PATIENTLY"):
        monkeypatch.setattr(f"simulator.join.{name}", 10.0)

    def drive(pause):
        tests, lock = RoadTests([0.0]), threading.Condition()
        latest: dict[str, Any] = {}

        def think():
            while latest.get("over") is None:
                with lock:
                    if not lock.wait_for(lambda: "data" in latest, 1):
                        continue
                    data = latest.pop("data")
                time.sleep(pause)
                steering = -0.6 * number(data, "cte") + number(data, "angl") / 25
                latest["command"] = steer(steering, 1 - (number(data, "speed") / 10) ** 2)

        def answer(data, n):
            answers = tests(data, n)
            if not answers or answers[0][0] != "steer":
                return answers
            with lock:
                latest["data"] = data
                lock.notify()
            return [latest.get("command", steer(0.0, 0.0))]

        driver = threading.Thread(target=think)
        driver.start()
        with Program(answer) as program:
            assert join("roads", program, "--fps", "5") == 0
        latest["over"] = True
        driver.join()
        assert tests.results[0][0] == "end of the road"
        return list({json.dumps(data): None for data in program.data if number(data, "speed") > 1})

    fast = drive(0.005)
    assert len(fast) > 12 and fast == drive(0.03)


@pytest.mark.parametrize("run", [1, 3])
def test_a_driver_is_waited_for_little_longer_than_it_takes_even_if_its_commands_repeat(run, monkeypatch):
    """Programs end an episode after 30 s of real time. A command stays the same for `run` frames."""
    clock, frame = SimpleNamespace(now=0.0), SimpleNamespace(n=0, begin=0.0, seen=0)
    clock.monotonic = lambda: clock.now
    joined = Joined(Roads(LAKE), "", 0, 1, 0, 15)
    joined.dialect.still = False

    def listen(joined, pause):
        clock.now += pause

    def ask(joined, telemetry):
        clock.now += 0.005
        joined.dialect.same = clock.now < frame.begin + 0.02 or frame.n % run > 0
        return True

    monkeypatch.setattr("simulator.join.time", clock)
    monkeypatch.setattr(Joined, "_listen", listen)
    monkeypatch.setattr(Joined, "_ask", ask)
    for frame.n in range(300):
        frame.begin, joined.dialect.same = clock.now, True
        joined._await_driver(joined.dialect.run, "")
        frame.seen += not joined.dialect.same
    assert frame.seen == 300 / run, "each is seen"
    assert clock.now < 30


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ({"track_string": "0,0,0@1,x,0"}, "track_string: point 2: '1,x,0' is not x,y,z"),
        ({"track_string": [[0, 0], [40, 0]]}, 'event "track" has no text "track_string"'),
        (ROADS[0], 'event "track" has no text "track_string"'),
    ],
)
def test_what_is_no_road_ends_the_drive_with_its_reason(data, reason, capsys):
    with Program(lambda *_: [["track", data]]) as program:
        assert join("roads", program) == 2
    assert f"python: the program's {reason}" in capsys.readouterr().err


def test_a_road_that_crosses_itself_is_laid_all_the_same():
    eight = "@".join(f"{60 * np.cos(a)},1.9,{40 * np.sin(2 * a)}" for a in np.linspace(0.2, 6.2, 80))
    dialect = Roads(LAKE)
    assert dialect.handle("track", {"track_string": eight})
    assert json.loads(dialect.telemetry()[2:])[1]["track"] == eight


def test_a_server_may_open_the_session_late(monkeypatch):
    """Flask-SocketIO 4 opens it when its connect handler returns: udacity-gym's waits there for the first track."""
    monkeypatch.setattr("cloning.wire.session.ClientSession.connect_timeout", 0.3)

    class Late(Program):
        def send(self, client, text):
            time.sleep(1.0 if text.startswith("0") else 0.0)
            super().send(client, text)

    with Late(lambda data, n: [steer(0, 1)] if n < 3 else None) as program:
        assert join("measures", program) == 0
    assert len(program.data) == 4


@pytest.mark.parametrize(("usable", "status"), [(0, 2), (2, 0)])
def test_answers_that_cannot_be_used_are_told_of_once_and_are_no_success(usable, status, monkeypatch, capsys):
    monkeypatch.setattr("simulator.join.ASK_AGAIN", 0.2)
    monkeypatch.setattr("cloning.base.program.warned", set())
    wrong = ["steer", {"steering_angle": 0, "throttle": 1}]
    with Program(lambda data, n: [steer(0, 1) if n < usable else wrong] if n < usable + 3 else None) as program:
        assert join("measures", program) == status
    printed = capsys.readouterr()
    assert printed.err.count('it must have "steering_angle" and "throttle", as texts, such as "0.1"') == 1
    none = "no usable word in 0.2 s; if none comes, the program may speak another --dialect"
    assert printed.out.count(none) == (not usable)
    assert f", {usable + 4} telemetries, 0 simulated seconds" in printed.out


def test_a_program_that_begins_no_episode_may_speak_another_dialect(monkeypatch, capsys):
    monkeypatch.setattr("simulator.join.ASK_AGAIN", 0.2)

    class Elsewhere(Program):
        def session(self, client):
            threading.Timer(1.0, client.shutdown, [socket.SHUT_RDWR]).start()
            super().session(client)

    with Elsewhere(None) as program:
        assert join("episodes", program) == 2
    assert program.data == []
    assert capsys.readouterr().out.count("no usable word in 0.2 s; if none comes, the program may speak another") == 1


def test_a_program_that_thinks_long_and_hangs_up_before_its_first_answer_is_joined_again(monkeypatch):
    monkeypatch.undo()  # what `at_once` has changed

    def answer(data, n):
        if len(program.data) > 1:
            return [steer(0, 1)] if n < 3 else None
        time.sleep(1.3)  # more than --wait
        return None

    with Program(answer, sessions=2) as program:
        assert join("measures", program, "--wait", "1") == 0
    assert len(program.data) == 5


def test_a_lost_answer_stops_nothing(monkeypatch):
    monkeypatch.setattr("simulator.join.ASK_AGAIN", 1.0)
    with Program(lambda data, n: [] if n == 3 else [steer(0, 1)] if n < 6 else None) as program:
        assert join("measures", program) == 0
    distances = [data["distance"] for data in program.data]
    assert distances[4] == distances[3] != distances[5]


def test_a_telemetry_that_was_answered_late_has_a_second_answer_and_a_later_one_its_own(monkeypatch):
    monkeypatch.setattr("simulator.join.ASK_AGAIN", 0.5)

    def answer(data, n):
        time.sleep(0.8 * (n == 3))
        return [steer(n / 1000, 1)] if n < 20 else None

    with Program(answer) as program:
        assert join("measures", program) == 0
    assert number(program.data[-1], "steering_angle") == pytest.approx(25 * 19 / 1000), "of the answer just before"


def test_a_greeting_that_comes_after_connect_is_no_answer():
    class Late(Program):
        def send(self, client, text):
            super().send(client, text)
            if text == "40":
                time.sleep(0.05)
                super().send(client, "42" + json.dumps(steer(0.5, 0)))

    with Late(lambda data, n: [steer(n / 1000, 1)] if n < 3 else None) as program:
        program.greet = False
        assert join("measures", program) == 0
    assert [number(data, "steering_angle") / 25 for data in program.data] == pytest.approx([0.5, 0, 0.001, 0.002])


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_many_episodes_take_no_more_memory():
    dialect, sizes = Roads(LAKE), list[float]()
    for i in range(14):
        assert dialect.handle("track", {"track_string": f"0,1.9,0@{40 + i},1.9,0@80,1.9,9"})
        dialect.telemetry()
        for _ in range(3):
            dialect.handle("steer", {"steering_angle": "0", "throttle": "1"})
            dialect.step()
            dialect.handle("reset", {})
        sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20)
    assert sizes[-1] - sizes[5] < 4, f"MiB, of {sizes}"
