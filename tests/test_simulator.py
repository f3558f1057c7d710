"""The stand-in simulator's roads, car, expert and recordings, against figures measured on the real one."""

import csv
import math
import multiprocessing
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import ROOT
from drive_process import awaited
from scenes import cameras, load

from cloning.base import progress
from cloning.base.errors import RecordingError
from cloning.recordings.log import read_recording
from cloning.recordings.writer import RecordingWriter, csharp_number
from cloning.road.motion import MPH
from cloning.road.points import make_road
from cloning.road.track import LEFT, RIGHT, ROADS, Section, Track
from simulator import record, workers
from simulator.__main__ import main
from simulator.expert import Expert
from simulator.report import lap_report
from simulator.run import Run
from simulator.scenery.lake_terrain import LakeTerrain, in_sections
from simulator.scenery.shapes import Material, ribbon, roadside


def free(track="lake", steps=0):
    """A car that cannot leave its road, after so many steps straight on at full throttle."""
    run: Any = Run(Track(track))
    run.off_road = lambda: ""
    for _ in range(steps):
        run.step(0, 1)
    return run


@pytest.mark.parametrize(("name", "length", "climb"), [("lake", 1138, 0), ("jungle", 1506, 30)])
def test_tracks_have_the_measured_length_and_climb(name, length, climb):
    track = Track(name)
    assert track.length == pytest.approx(length, rel=0.009)
    assert np.ptp(track.points[:, 2]) == pytest.approx(climb, abs=0.1)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_lake_turns_once_in_the_named_direction(direction):
    track = Track("lake", direction)
    turned = track.curvature.sum() * track.step
    assert turned == pytest.approx(-2 * math.pi if direction == "ccw" else 2 * math.pi, rel=1e-9)


@pytest.mark.parametrize("name", ["lake", "jungle"])
@pytest.mark.parametrize("offset", [-3.0, 0.0, 2.5])
def test_a_position_is_located_where_it_was_placed(name, offset):
    track = Track(name)
    for s in np.linspace(0, track.length, 40, endpoint=False):
        pose = track.at(s, offset)
        located, right = track.locate(pose.x, pose.y, near=s + 4)
        assert abs((located - s + 50) % track.length - 50) < 0.03
        assert right == pytest.approx(offset, abs=0.001)


def test_right_is_positive_for_offsets_edges_and_scenery():
    """At the lake's first point, which it passes northwards, right is east."""
    track = Track("lake")
    pose = track.at(0.0)
    right = np.array([math.sin(pose.heading), -math.cos(pose.heading)])
    moved = track.at(0.0, 2.0)
    assert (moved.x - pose.x, moved.y - pose.y) == pytest.approx(2 * right)
    white = np.full((4, 4, 3), 255, np.uint8)
    strip = ribbon(track, [0.0, 1.0], (-1.0, 3.0), 0.0, Material((1, 1, 1), white, 1.0))
    assert (strip.points[:2, :2] - (pose.x, pose.y)) @ right == pytest.approx([-1.0, 3.0], abs=1e-6)
    for side in (LEFT, RIGHT):
        beside = roadside(track, [0.0, 1.0], side, (5.0, 7.0), (0.0, 1.0), Material((1, 1, 1), white, 1.0))
        outwards = sorted([side * 5.0, side * 7.0])
        assert (beside.points[:2, :2] - (pose.x, pose.y)) @ right == pytest.approx(outwards, abs=1e-6)
    terrain = LakeTerrain(track, np.random.default_rng(0))
    _, s, sides = terrain.nearest_road(np.array([(moved.x, moved.y)]))
    assert sides == RIGHT
    assert in_sections([Section(RIGHT, -5, 5)], s, sides, track.length)
    assert not in_sections([Section(LEFT, -5, 5)], s, sides, track.length)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_kerbs_widen_their_own_side_of_the_road(direction):
    track, road = Track("lake", direction), ROADS["lake"]
    forward = direction == road.forward
    for kerb in road.kerbs:
        for s in np.arange(kerb.start + 2, kerb.end - 1, 5.0):
            here = s % track.length if forward else -s % track.length
            side = kerb.side if forward else -kerb.side
            assert track.edges[track.index(here), 0 if side == LEFT else 1] == road.kerb_edge
    assert (track.edges == road.edge).mean() > 0.5


def test_reaches_thirty_mph_as_fast_as_the_real_log_and_no_faster_than_its_clamp():
    run = free()
    while run.speed_mph < 29.5:
        run.step(0, 1)
    assert run.time == pytest.approx(2.9, abs=0.1)
    for _ in range(200):
        run.step(0, 1)
    assert run.speed_mph == pytest.approx(30, abs=0.001)


@pytest.mark.parametrize("steering", [-0.75, -0.3, -0.1, 0.1, 0.4, 0.75])
def test_yaws_as_the_real_car_at_thirty_mph(steering):
    run = free(steps=200)
    for _ in range(20):
        run.step(steering, 1)
    before = run.car.heading
    for _ in range(25):
        run.step(steering, 1)
    turned = (before - run.car.heading + math.pi) % (2 * math.pi) - math.pi
    assert turned / 0.5 == pytest.approx(0.8 * 30 * MPH / 2.87 * math.tan(math.radians(25 * steering)), rel=0.1)
    assert turned / 0.5 == pytest.approx(1.75 * steering, rel=0.045)


def test_brakes_then_reverses():
    run = free(steps=200)
    start = run.distance
    while run.speed_mph > 5:
        run.step(0, -1)
    assert 7 < run.distance - start < 9
    for _ in range(300):
        run.step(0, -1)
    assert run.car.vehicle.get_current_speed_km_hour() < -2


@pytest.mark.parametrize("grade_sign", [1, -1])
def test_climbs_and_brakes_on_the_jungles_steepest_grades(grade_sign):
    run = free("jungle")
    run.s = float(np.argmax(grade_sign * run.track.grade)) * run.track.step
    run.set_back()
    assert abs(run.track.at(run.s).grade) > 0.3
    start = run.s
    expert = Expert(run.track, wander=0)
    for _ in range(150):
        run.step(expert.drive(run)[0], 1)
    assert run.s - start > 5.5
    assert run.speed_mph > 9.5
    for _ in range(50):
        run.step(expert.drive(run)[0], -1 if run.speed_mph > 5 else 0)
        if run.speed_mph < 5.5:
            break
    assert run.speed_mph < 5.5


def test_a_departure_is_noted_and_the_car_set_back():
    run = Run(Track("lake"))
    while run.step(-0.3, 1):
        assert run.time < 4
    (departure,) = run.departures
    assert (departure.side, departure.time) == ("left", run.time)
    driven = run.trajectory
    assert (departure.x, departure.y, departure.speed) == (driven.x[-1], driven.y[-1], driven.speed[-1])
    assert abs(run.offset) < 0.001 and run.speed_mph < 0.001
    assert lap_report(run)["autonomy"] == pytest.approx(1 - 6 / run.time, abs=1e-4)


@pytest.mark.parametrize(("name", "mph"), [("lake", 30), ("jungle", 30), ("road-3", 15), ("road-5", 15)])
@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_expert_drives_a_lap_on_the_road(name, mph, direction):
    """The generated roads have bends of less than 15 m radius and grades of more than 0.15; road-3 is 6.3 m wide."""
    run = Run(Track(name, direction))
    run.car.speed_limit = mph * MPH
    expert, in_bends = Expert(run.track, seed=3, top_speed=mph * MPH), []
    while not run.laps:
        steering, throttle = expert.drive(run)
        if abs(run.track.curvature[run.track.index(run.s)]) > 1 / 60:  # of less than 60 m radius
            in_bends.append(steering)
        run.step(steering, throttle)
    assert not run.departures
    assert np.abs(run.trajectory.offset).max() < 2.5
    assert np.mean(np.array(in_bends) == 0) < 0.01
    assert lap_report(run)["track"] == name


def test_numbers_are_written_as_the_simulators():
    values = (0.0, -0.0, 1.0, 6.9e-05, 30.1903, -0.0597, 1 / 3)
    assert [csharp_number(value) for value in values] == ["0", "0", "1", "6.9E-05", "30.1903", "-0.0597", "0.3333333"]


def test_recordings_are_as_the_simulators(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    assert main(["record", str(tmp_path / "a"), "--laps", "0.015", "--seed", "5"]) == 0
    rows = list(csv.reader((tmp_path / "a" / "driving_log.csv").read_text(encoding="utf-8").splitlines()))
    times = []
    for row in rows:
        assert len(row) == 7
        for path, camera in zip(row[:3], ("center", "left", "right"), strict=True):
            assert Path(path).parent == tmp_path / "a" / "IMG"
            match = re.fullmatch(rf"{camera}_\d{{4}}(_\d\d){{4}}_(\d\d)_(\d{{3}})\.jpg", Path(path).name)
            assert match, path
            times.append(int(match[2]) + int(match[3]) / 1000)
            assert load(path).shape == (160, 320, 3)
        assert -1 <= float(row[3]) <= 1
    pauses = np.diff(times[::3]) % 60
    assert pauses.mean() == pytest.approx(1 / 15, abs=0.001)
    assert np.median(pauses) == pytest.approx(1 / 15, abs=0.0075)  # a whole number of physics steps
    quality_75 = bytes([8, 6, 6, 7, 6, 5, 8, 7])  # how the JPEG standard's luminance table at quality 75 begins
    assert quality_75 in (tmp_path / "a" / "IMG" / rows[0][0]).read_bytes()[:64]
    pattern = r"a: (\d+) rows from (\d+) simulated seconds, at [\d.]+ times real time\n$"
    printed = capsys.readouterr()
    assert re.search(r"\d %, \d+/17 m, ", printed.err), "metres, with no thousands as k"
    closing = re.search(pattern, printed.out)
    assert closing and int(closing[1]) == len(rows) and int(closing[2]) == pytest.approx(len(rows) / 15, abs=0.6)
    assert main(["record", str(tmp_path / "b"), "--recovery", "--laps", "0.005"]) == 0
    assert capsys.readouterr().out.startswith("nothing was recorded from ") and not (tmp_path / "b").exists()


def test_recordings_are_the_same_where_processes_cannot_fork_or_there_is_only_one(tmp_path, monkeypatch):
    """macOS and Windows start every process with a fresh interpreter. The look has shadows."""

    def files(name):
        folder = tmp_path / name
        record.record(folder, Track(make_road([(0, 0), (30, 0), (60, 9)])), laps=0.08, look=10_000)
        own = str(folder).encode()  # stands in its log
        return {path.name: path.read_bytes().replace(own, b"") for path in folder.rglob("*.*")}

    forked = files("default")
    monkeypatch.setattr(workers, "_context", lambda: multiprocessing.get_context("spawn"))
    monkeypatch.setattr(record, "MAX_RENDERERS", 1)
    assert len(forked) > 20 and "driving_log.csv" in forked
    assert forked == files("spawn")


def test_recording_does_not_load_pytorch():
    """It would take most of the start-up time, and more memory than all else."""
    code = "import sys, simulator.record; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def descendants(process: int) -> list[int]:
    """The processes that a process has started, and those that they have."""
    files = Path(f"/proc/{process}/task").glob("*/children")
    children = [int(child) for file in files for child in file.read_text().split()]
    return [*children, *(each for child in children for each in descendants(child))]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="without /proc processes cannot be listed")
def test_the_rendering_processes_of_a_killed_recording_end(tmp_path):
    process = subprocess.Popen([sys.executable, "-m", "simulator", "record", str(tmp_path)], stderr=subprocess.DEVNULL)
    log = tmp_path / "driving_log.csv"
    while not log.exists() or log.stat().st_size < 3000:
        assert process.poll() is None
        time.sleep(0.01)
    started = descendants(process.pid)
    assert len(started) > 1
    process.kill()
    process.wait()
    awaited(lambda: not any(Path(f"/proc/{each}").exists() for each in started))


INTERRUPTED = """
import os, runpy, signal, sys
from multiprocessing.process import BaseProcess
start = BaseProcess.start
def interrupted(process):
    start(process)
    os.kill(os.getpid(), signal.SIGINT)
BaseProcess.start = interrupted
sys.argv[1:] = ["record", sys.argv[1], "--laps", "0.01"]
runpy.run_module("simulator", run_name="__main__", alter_sys=True)
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
def test_ctrl_c_while_rendering_processes_are_started_leaves_no_recording(tmp_path):
    command = [sys.executable, "-c", INTERRUPTED, str(tmp_path / "x")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "simulator: stopped; the files that it has written are complete\n")
    assert not any(tmp_path.iterdir())


DRIVING = """
import multiprocessing, os, signal, threading, time
from half import work
from cloning.base import program
from simulator.workers import results, started_workers
program.end_on_interrupt("test")
def main():
    other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    other.start()
    try:
        with started_workers(2) as pool:
            threading.Timer(1, os.kill, (os.getpid(), signal.SIGINT)).start()
            list(results(pool, work, [60, 60, 60]))
    finally:
        print(other.is_alive(), flush=True)
        other.kill()
program.run(main)
"""


SENDING_HALF = """
import os, time
from multiprocessing.connection import Connection
def work(_):
    Connection._send = lambda self, data, write=os.write: [write(self.fileno(), data[:2]), time.sleep(60)]
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
@pytest.mark.parametrize("module", ["from time import sleep as work", SENDING_HALF], ids=["working", "sending"])
def test_ctrl_c_ends_workers_with_what_they_do_but_no_other_process(tmp_path, module):
    (tmp_path / "half.py").write_text(module, encoding="utf-8")
    command, environment = [sys.executable, "-c", DRIVING], {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=50)
    assert (done.returncode, done.stdout, done.stderr) == (130, "True\n", "test: stopped\n")


def test_a_frame_depends_on_the_pose_alone():
    """Not on the frames before it, as with panda3d's cache of transforms."""
    run, poses = Run(Track("lake")), []
    for i in range(400):
        run.step(0.0004 * (i % 100 - 20), 1)
        if i % 8 == 0:
            poses.append(run.car.node.get_transform())
    eyes = cameras("lake", 0)
    frames = [eyes.frames(pose) for pose in poses]
    for pose, frame in list(zip(poses, frames, strict=True))[::-1]:
        assert np.array_equal(eyes.frames(pose), frame)


def test_an_existing_recording_is_kept(tmp_path, capsys):
    """And one that another process writes, whose rows would be mixed with these."""
    for command in ("record", "correct"):
        folder = tmp_path / f"{command}-corrections"
        with RecordingWriter(folder):
            assert main([command, str(folder)]) == 2
            assert "another program writes there; wait for its end" in capsys.readouterr().err
        folder.mkdir()
        (folder / "driving_log.csv").write_text("precious\n", encoding="utf-8")
        assert main([command, str(folder)]) == 2
        assert "exists already; name another folder" in capsys.readouterr().err
        assert (folder / "driving_log.csv").read_text(encoding="utf-8") == "precious\n"


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a file's name is text")
def test_a_folder_may_have_a_name_in_any_encoding(tmp_path):
    """As a zip from another system leaves it, or a shell without a UTF-8 locale."""
    folder = tmp_path / os.fsdecode(b"\xe9 lake")
    with RecordingWriter(folder) as recording:
        recording.add(0, [b"centre", b"left", b"right"], [0, 1, 0, 30], (0, 0))
    assert len(read_recording(folder)) == 1


def test_a_row_replaces_no_images_of_those_before(tmp_path):
    """As those of a program's second drive did, whose time began at 0 again."""
    with RecordingWriter(tmp_path / "drives") as recording:
        recording.add(0, [b"centre", b"left", b"right"], [0, 1, 0, 30], (0, 0))
        with pytest.raises(RecordingError, match="let time go on"):
            recording.add(0, [b"other", b"left", b"right"], [0.1, 1, 0, 30], (0, 0))
    assert next((tmp_path / "drives/IMG").glob("center*")).read_bytes() == b"centre"
