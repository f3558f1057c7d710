"""The benchmark: its tasks, its score, its entries, and the same figures wherever its drives run."""

import copy
import json
import os
import socket
import subprocess
import sys
import time
from concurrent.futures import Executor
from functools import partial
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from browser import needs_chromium
from commands import HERE, ROOT
from scenes import Here
from steer_server import STEER, Server

from cloning.base.errors import SimulatorError, UserError
from cloning.base.files import locked
from cloning.base.program import DONE, FAILED
from cloning.network.network import SHIPPED_MODEL, save_model
from cloning.road.autonomy import INTERVENTION_TIME
from cloning.road.disturbances import KINDS, Disturbance
from cloning.road.motion import MPH
from cloning.road.track import Track
from cloning.wire.client import parse_event
from simulator import __main__, driving, workers
from simulator.benchmark import page as report
from simulator.benchmark import replays, scores, tasks
from simulator.benchmark.command import drive, drive_all, run
from simulator.benchmark.tasks import Task
from simulator.run import Departure
from simulator.workers import started_workers
from tools import robustness

TINY = [
    Task("tracks", "lake", "cw", 30, 1, 15),
    Task("roads", "road-1", "ccw", 15, 1, 15),
    Task("splines", "spline-1", "ccw", 15, 1, 30),
    Task("off the lane", "lake", "ccw", 15, 1, 40, (700.0, 2.0, 15.0)),
    Task("disturbed", "lake", "ccw", 15, 1, 10, (100.0, 0.0, 0.0), Disturbance("late", 3)),
]


def test_the_tasks_are_what_the_rules_say():
    whole, quick = tasks.all_tasks(), tasks.quick_tasks()
    for chosen in (whole, quick):
        assert len({task.name for task in chosen}) == len(chosen)
        assert {task.group for task in chosen} == set(tasks.GROUPS)
        assert all(1 <= task.look % 10_000 <= 1000 and task.look < 20_000 for task in chosen)  # never trained on
    driven = {(task.road, task.direction, task.speed) for task in whole if task.group == "roads"}
    roads = [(f"road-{n}", 15) for n in range(1, 101)] + [(f"mountain-{n}", 25) for n in range(1, 7)]
    assert driven == {(road, way, speed) for road, speed in roads for way in ("ccw", "cw")}
    assert sorted(str(task.disturbance) for task in quick if task.disturbance) == sorted(f"{kind}:5" for kind in KINDS)
    assert sum(task.group == "splines" for task in whole) == 20


def test_roads_by_other_teams_rules():
    """Nodes are 10 to 25 m apart, and from one to the next the road turns by at most 35°."""
    roads = [tasks.unknown_spline(number) for number in range(1, 21)]
    assert roads[4] == tasks.unknown_spline(5) and len(set(roads)) == 20
    for road in roads:
        nodes = road.points[::10]
        steps = np.diff(nodes[:, :2], axis=0)
        turn = np.degrees(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
        assert len(nodes) == 8 and np.abs(turn).max() < 35.1 and not road.closed and road.width == 8
        assert np.linalg.norm(steps, axis=1).min() > 9.9 and np.linalg.norm(steps, axis=1).max() < 25.1
        assert np.ptp(road.points[:, 2]) == 0
    assert max(np.abs(Track(road).curvature).max() for road in roads) > 1 / 20


def driven(task, departures, planned, ended="arrived"):
    places = tuple(Departure(float(n), 0, 5, 0, 0, "left") for n in range(departures))
    return scores.driven(task, driving.Drive(3, planned, ended, 10, (), 0.5, planned, places))


def test_the_score_is_the_rules_formula():
    assert driven(TINY[0], 2, 30)["score"] == 60  # 100 (1 - 2 * 6 s / 30 s)
    assert driven(TINY[0], 9, 30)["score"] == 0
    assert driven(TINY[0], 0, 30, "late")["score"] == 0
    drives = [driven(task, n, 60) for n, task in enumerate(TINY)]  # 100, 90, 80, 70, 60
    replayed = driven(TINY[0]._replace(group="replays"), 10, 60)
    groups = scores.by_group([*drives, driven(TINY[0], 5, 60), replayed])
    assert groups["tracks"]["score"] == 75 and groups["tracks"]["departures"] == 5
    assert scores.score(groups) == (75 + 90 + 80 + 70 + 60) / 5
    row = scores.line("mine", {"groups": groups, "score": scores.score(groups)})
    assert row == "| mine | **75.00** | 75.00 | 90.00 | 80.00 | 70.00 | 60.00 | 0.00 | 0.50 |"
    head = next(line for line in (ROOT / "LEADERBOARD.md").read_text(encoding="utf-8").splitlines() if line[:1] == "|")
    assert row.count("|") == head.count("|")


def test_alarms_count_in_windows_as_selforacle_counts_them():
    """An alarm foretells a departure 1 to 6 s ahead, after the last one; without a departure, each 5 s count."""
    assert scores.alarmed([10.0, 30.0], [4.1, 29.5], 40) == (1, 2)
    assert scores.alarmed([10.0, 10.5], [], 40) == (0, 1)  # nobody foretells the second, half a second after the first
    assert scores.alarmed([10.0, 13.0], [9.5, 11.0], 40) == (1, 2)
    assert scores.alarmed([], [1.0, 2.0, 12.0, 17.0], 17.5) == (2, 3)
    drives = [driven(TINY[0], n, 60) | {"alarms": (n, 3)} for n in (0, 1, 2)]
    told = scores.foretelling(drives)
    assert told == (  # others are among the groups' departures
        "of 6 departures more than 1 s after the start or the one before, 3 foretold 1 to 6 s ahead; "
        "false alarms in 0 of 3 times 5 s of drives without a departure"
    )
    assert scores.foretelling([driven(TINY[0], 1, 60)]) is None


def test_the_shipped_network_foretells_while_it_drives_as_without():
    conditions = TINY[1].conditions(str(SHIPPED_MODEL))
    done = driving.drive(conditions, TINY[1].source)
    plain = driving.drive(conditions._replace(foretell=False), TINY[1].source)
    assert done.alarms == () and plain.alarms is None and done.path == plain.path


def test_a_drive_goes_on_after_a_departure_until_it_can_score_nothing():
    task = Task("tracks", "jungle", "cw", 15, 1, 300)
    done = drive("straight", task)
    planned = 300 / (15 * MPH)
    assert done.failed and done.planned == pytest.approx(planned)
    assert len(done.departures) == np.ceil(planned / INTERVENTION_TIME) and done.seconds < planned
    assert not drive("expert", task).departures


def test_the_film_of_a_drive_that_went_otherwise_before_says_so():
    """A server need not answer twice alike: here it left the road long before the moment that is to be filmed."""
    until = drive("straight", TINY[2]).departures[0].time
    same, other = (report.film("straight", (TINY[2], at)) for at in (round(until, 2), 30.0))
    assert (same.again, other.again) == (True, False)
    assert all(clip.film.startswith("data:video/mp4;base64,") for clip in (same, other))


def test_a_server_is_told_the_time_and_no_place_and_its_speed_is_held_for_it():
    steered = [0.0]
    with Server(lambda packet, n: [STEER % (n / 1000, "0")] * 2) as server:
        conditions = TINY[1].conditions(f"127.0.0.1:{server.port}")
        done = driving.drive(conditions, TINY[1].source, lambda run, _: steered.append(run.steering))
    told = [message for message in server.messages if message.startswith("42")]
    assert done.ended == "arrived" and 2 < done.seconds < 8  # 15 m, at first at rest
    assert 1000 * steered[-1] > len(told) - 4, "the second answer to a frame is none to the next one"
    sent = [(parse_event(packet) or ("", {}))[1] for packet in told]
    assert {key for fields in sent for key in fields} == {"steering_angle", "throttle", "speed", "image", "stand_in"}
    times = [fields["stand_in"].pop("time") for fields in sent]
    assert times[0] == 0 and times[-1] == pytest.approx(done.seconds, abs=0.1) and not sent[-1]["stand_in"]


def test_a_benchmark_goes_on_after_the_drives_before_its_server_ended(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tasks, "quick_tasks", lambda: TINY)
    monkeypatch.setattr(report, "failures", lambda *drives: [])
    ends = 1 + 3  # the connection in the third drive, after one that only asks whether a server is there
    most = ends + 1 + 1 + 3  # the fourth drive may begin before the third one's error ends it

    def answer(packet, n):
        return None if len(server.requests) == ends and n == 5 else [STEER % ("0", "0")]

    with Server(answer, sessions=most) as server:
        words = ["benchmark", f"127.0.0.1:{server.port}", "--quick", "--folder", str(tmp_path)]
        assert __main__.main(words) == FAILED and "with --resume, the benchmark goes on" in capsys.readouterr().err
        monkeypatch.setattr(driving, "started_workers", Here)  # which saves six seconds
        assert __main__.main([words[0], "straight", *words[2:], "--resume"]) == FAILED
        assert f"has drives of entry 127.0.0.1:{server.port}, not straight; leave out" in capsys.readouterr().err
        with locked(tmp_path):
            assert __main__.main([words[0], "straight", *words[2:]]) == FAILED
        assert "another program writes there; wait" in capsys.readouterr().err
        assert __main__.main([words[0], "straight", *words[2:-1], __file__]) == FAILED
        assert f"{__file__}: not a folder; name another folder" in capsys.readouterr().err
        kept = json.loads((tmp_path / "unfinished.json").read_text(encoding="utf-8"))
        assert list(kept["drives"]) == [task.name for task in TINY[:2]]
        kept["drives"][TINY[0].name]["mean_m"] = 99  # as no drive has
        (tmp_path / "unfinished.json").write_text(json.dumps(kept), encoding="utf-8")
        assert __main__.main([*words, "--resume"]) == DONE
        while server.thread.is_alive():  # a session is left over if the fourth drive did not begin
            socket.create_connection(("127.0.0.1", server.port)).close()
            server.thread.join(0.1)  # without a pause, more connections may wait than the listener holds
    found = json.loads((tmp_path / "benchmark.json").read_text(encoding="utf-8"))
    assert [each["name"] for each in found["drives"]] == [task.name for task in TINY]
    assert [each["mean_m"] == 99 for each in found["drives"]] == [True, *[False] * 4]
    assert {path.name for path in tmp_path.iterdir()} == {"benchmark.json", "report.html"}


@pytest.mark.parametrize("damaged", ['{"about": {', "[]", "{}"])
def test_a_damaged_file_of_the_drives_that_are_done_is_told(tmp_path, damaged):
    file, nobody = tmp_path / "unfinished.json", SimpleNamespace()
    file.write_text(damaged, encoding="utf-8")
    with pytest.raises(UserError, match=r"unfinished\.json: damaged \(.*\); leave out --resume"):
        drive_all(cast(Executor, nobody), "straight", TINY, file, {"entry": "straight"}, resume=True)


def test_a_network_of_another_program_is_told_how_it_can_drive(tmp_path):
    (tmp_path / "model.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(UserError, match=r"model\.h5: a model of Keras.*; LEADERBOARD\.md tells how others"):
        driving.load_driver(str(tmp_path / "model.h5"))


def test_a_model_that_is_trained_anew_drives_with_its_new_weights(network, tmp_path):
    file, frame, steered = tmp_path / "model.pt", np.full((160, 320, 3), 90, np.uint8), list[float]()
    changed = copy.deepcopy(network)
    for bias in (0.0, 0.25):
        torch.nn.init.constant_(changed.dense[-1].bias, bias)
        save_model(file, changed)
        steered.append(driving.load_driver(str(file))(frame))
    assert steered[1] - steered[0] == pytest.approx(0.25, abs=1e-3)


def test_a_model_that_is_trained_anew_while_it_drives_ends_the_measurement(tmp_path, monkeypatch):
    """Else the figures of two networks would be told as those of one."""
    model, file = tmp_path / "model.pt", tmp_path / "found.json"

    def replaced(*_):
        model.write_bytes(b"new")
        return robustness.Figures(100, 0, 0)

    monkeypatch.setattr("simulator.benchmark.command.drive", replaced)
    monkeypatch.setattr(robustness, "measure", replaced)
    drive = robustness.Drive("model", "", "lake", 1, TINY[1].conditions(str(model)))
    for measure in (
        lambda sha256: drive_all(Here(), str(model), TINY, file, {"sha256": sha256}, resume=False),
        lambda sha256: robustness.measure_all([drive._replace(sha256=sha256)], file, Here()),
    ):
        model.write_bytes(b"old")
        with pytest.raises(UserError, match=r"model\.pt: was replaced while it drove"):
            measure(driving.digest_of(model))
        assert not file.exists()


def test_a_steering_that_is_no_number_is_told_in_replays_too(monkeypatch):
    steering = Mock(side_effect=ArithmeticError("the network's steering is not finite"))
    monkeypatch.setattr(replays, "load_driver", lambda _: steering)
    seen: Any = SimpleNamespace(received=lambda rows: None)
    with pytest.raises(SimulatorError, match=r"own\.onnx: the network's steering is not finite; train the model again"):
        replays.driver_of("own.onnx")(seen)


def test_the_command_scores_in_another_process_what_is_driven_here(model_file, tmp_path, monkeypatch, capsys):
    worst = report.failures
    monkeypatch.setattr(tasks, "quick_tasks", lambda: TINY)
    monkeypatch.setattr(report, "failures", lambda *drives: worst(*drives)[:1])  # a film takes a second
    words = [str(model_file), "--quick", "--folder", str(tmp_path), "--processes", "1"]
    assert __main__.main(["benchmark", *words]) == DONE
    printed, found = capsys.readouterr().out, json.loads((tmp_path / "benchmark.json").read_text(encoding="utf-8"))
    here = [scores.driven(task, drive(str(model_file), task)) for task in TINY[::4]]
    assert len(found["drives"]) == len(TINY) and found["drives"][::4] == json.loads(json.dumps(here))
    assert printed.splitlines()[-1] == scores.line("model", found) and "replays: not run" in printed
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("data:video/mp4") == 1 and "drove differently" not in page
    assert all(task.name in page for task in TINY)


@needs_chromium
def test_its_page_is_read_on_a_phone(page, tmp_path):
    figures = {"drives": 1, "score": 100.0, "departures": 0, "mean_m": 0.1}
    found = {"entry": "/a_long_name" * 9, "score": 100.0, "quick": True, "version": 1, "foretelling": "", "drives": []}
    html = report.page(found | {"groups": dict.fromkeys(tasks.GROUPS, figures)}, [])
    (tmp_path / "report.html").write_text(html, encoding="utf-8")
    page.look(390, 900)
    page.open((tmp_path / "report.html").as_uri())
    page.wait("document.readyState == 'complete'")
    page.check_look(390, False)
    assert page.box("tbody th")[2] > 100, "not one letter below the other"


def test_the_address_of_a_server_is_told_from_a_file():
    assert driving.server_address("127.0.0.1:65535") == ("127.0.0.1", 65535)
    assert driving.server_address("[::1]:4567") == ("::1", 4567)
    with pytest.raises(UserError, match=r"127\.0\.0\.1:70103: no such file"):
        driving.workers_for("127.0.0.1:70103", 1, None)  # which a socket takes for 4567


def test_real_recordings_that_are_missing_are_told_before_anything_is_driven(tmp_path):
    with pytest.raises(UserError, match=r"lake-ccw: no driving_log\.csv; data/README\.md says where"):
        run(__main__.parse_arguments(["benchmark", "straight", "--recordings", str(tmp_path)]))


def test_drives_give_the_same_on_dasks_workers_of_which_one_is_killed(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    file, processes = tmp_path / "scheduler.json", []

    def start(*words):
        command = [sys.executable, "-m", "dask", *map(str, words), "--scheduler-file", str(file)]
        processes.append(subprocess.Popen(command, env={**os.environ, **HERE}, stderr=subprocess.DEVNULL))

    try:
        start("scheduler", "--port", 0, "--no-dashboard")
        while not file.exists():
            time.sleep(0.1)
        address = json.loads(file.read_text(encoding="utf-8"))["address"]
        with monkeypatch.context() as impatient, pytest.raises(UserError, match="on each machine `dask worker`"):
            impatient.setattr(workers, "WAIT", 0.1)
            with started_workers(1, address):
                pass
        for _ in range(2):
            start("worker", "--nthreads", 1, "--no-nanny", "--no-dashboard")
        every = [task._replace(look=look) for look in (1, 2, 3) for task in TINY]
        with started_workers(1, address) as pool:
            results = pool.map(partial(drive, "straight"), every)
            done = [next(results)]
            processes[1].kill()
            done += results
        assert done == [drive("straight", task) for task in every]
    finally:
        for process in processes:
            process.kill()
            process.wait()
