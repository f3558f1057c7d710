"""The stand-in simulator's roads, car, expert and recordings, against the figures measured on the real
one."""

import csv
import hashlib
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from cloning.errors import RecordingError
from cloning.recordings.writer import RecordingWriter, csharp_number
from cloning.road.motion import MPH
from cloning.road.track import Track
from simulator.expert import Expert
from simulator.run import Run

ROOT = Path(__file__).resolve().parent.parent


def free(track="lake"):
    """A car on endless ground: no road to leave."""
    run = Run(Track(track))
    run.off_road = lambda: ""
    return run


def command(*arguments, **keywords):
    return subprocess.run(
        [sys.executable, "-m", "simulator", *map(str, arguments)], capture_output=True, text=True, **keywords
    )


@pytest.mark.parametrize(("name", "length", "climb"), [("lake", 1138, 0), ("jungle", 1506, 30)])
def test_tracks_have_the_measured_length_and_climb(name, length, climb):
    track = Track(name)
    assert track.length == pytest.approx(length, rel=0.01)
    assert np.ptp(track.points[:, 2]) == pytest.approx(climb, abs=0.5)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_lake_turns_once_in_the_named_direction(direction):
    track = Track("lake", direction)
    turned = track.curvature.sum() * track.step
    assert turned == pytest.approx(-2 * math.pi if direction == "ccw" else 2 * math.pi, rel=0.01)


@pytest.mark.parametrize("name", ["lake", "jungle"])
@pytest.mark.parametrize("offset", [-3.0, 0.0, 2.5])
def test_a_place_is_found_again(name, offset):
    track = Track(name)
    for s in np.linspace(0, track.length, 40, endpoint=False):
        place = track.at(s, offset)
        found, right = track.locate(place.x, place.y, near=s + 4)
        assert abs((found - s + 50) % track.length - 50) < 0.35
        assert right == pytest.approx(offset, abs=0.1)


def test_reaches_thirty_mph_as_fast_as_the_real_log_and_no_faster_than_its_clamp():
    run = free()
    while run.speed_mph < 29.5:
        run.step(0, 1)
    assert run.time == pytest.approx(2.9, abs=0.3)
    for _ in range(200):
        run.step(0, 1)
    assert run.speed_mph == pytest.approx(30, abs=0.1)


@pytest.mark.parametrize("steering", [-0.75, -0.3, -0.1, 0.1, 0.4, 0.75])
def test_yaws_as_the_real_car_at_thirty_mph(steering):
    run = free()
    for _ in range(200):
        run.step(0, 1)
    for _ in range(20):
        run.step(steering, 1)
    before = run.car.heading
    for _ in range(25):
        run.step(steering, 1)
    turned = (before - run.car.heading + math.pi) % (2 * math.pi) - math.pi
    assert turned / 0.5 == pytest.approx(0.8 * 30 * MPH / 2.87 * math.tan(math.radians(25 * steering)), rel=0.1)
    assert turned / 0.5 == pytest.approx(1.75 * steering, rel=0.1)


def test_brakes_then_reverses():
    run = free()
    for _ in range(200):
        run.step(0, 1)
    at = run.distance
    while run.speed_mph > 5:
        run.step(0, -1)
    assert 6 < run.distance - at < 14
    for _ in range(300):
        run.step(0, -1)
    assert run.car.vehicle.get_current_speed_km_hour() < -1


@pytest.mark.parametrize("grade_sign", [1, -1])
def test_climbs_and_brakes_on_the_jungles_steepest_grades(grade_sign):
    run = free("jungle")
    run.s = float(np.argmax(grade_sign * run.track.grade)) * run.track.step
    run.set_back()
    assert abs(run.track.at(run.s).grade) > 0.25
    begin = run.s
    expert = Expert(run.track, wander=0)
    for _ in range(150):
        run.step(expert.drive(run)[0], 1)
    assert run.s - begin > 5
    assert run.speed_mph > 8
    for _ in range(150):
        run.step(expert.drive(run)[0], -1 if run.speed_mph > 5 else 0)
        if run.speed_mph < 5.5:
            break
    assert run.speed_mph < 5.5


def test_leaving_the_road_is_noted_and_the_car_set_back():
    run = Run(Track("lake"))
    while run.step(-0.3, 1):
        assert run.time < 20
    (departure,) = run.departures
    assert departure.side == "left"
    assert departure.time == run.time
    assert abs(run.offset) < 0.01
    assert run.speed_mph < 0.1
    assert run.autonomy() == pytest.approx(1 - 6 / run.time)


def in_bends(run):
    """Steering a recording would hold, 15 a second, where the road's radius is under 60 m."""
    track, step = run.track, round(1 / 15 / 0.02)
    places = [track.locate(x, y)[0] for x, y in zip(run.path.x[::step], run.path.y[::step], strict=True)]
    bend = np.abs(track.curvature[(np.array(places) / track.step).astype(int) % len(track.curvature)]) > 1 / 60
    return np.array(run.path.steering[::step])[bend]


@pytest.mark.parametrize(("name", "direction"), [("lake", "ccw"), ("lake", "cw"), ("jungle", "ccw"), ("jungle", "cw")])
def test_expert_drives_a_lap_on_the_road(name, direction):
    run = Run(Track(name, direction))
    expert = Expert(run.track, seed=3)
    while not run.laps:
        run.step(*expert.drive(run))
    assert not run.departures
    assert np.mean(in_bends(run) == 0) < 0.05


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (-0.0, "0"),
        (1.0, "1"),
        (6.9e-05, "6.9E-05"),
        (30.1903, "30.1903"),
        (-0.0597, "-0.0597"),
        (1 / 3, "0.3333333"),
    ],
)
def test_numbers_are_written_as_the_simulators(value, text):
    assert csharp_number(value) == text


def digest(folder):
    """Of the images and of the rows without the folder's own path."""
    log = (folder / "driving_log.csv").read_text().replace(str(folder), "")
    images = b"".join(hashlib.sha256(path.read_bytes()).digest() for path in sorted((folder / "IMG").iterdir()))
    return hashlib.sha256(log.encode() + images).hexdigest()


def test_recordings_are_as_the_simulators_and_the_same_in_two_processes(tmp_path):
    for name in "ab":
        done = command("record", tmp_path / name, "--laps", 0.1, "--seed", 5)
        assert done.returncode == 0, done.stderr
    assert digest(tmp_path / "a") == digest(tmp_path / "b")
    rows = list(csv.reader((tmp_path / "a" / "driving_log.csv").read_text().splitlines()))
    times = []
    for row in rows:
        assert len(row) == 7
        for path, camera in zip(row[:3], ("center", "left", "right"), strict=True):
            match = re.fullmatch(rf"{tmp_path}/a/IMG/{camera}_\d{{4}}(_\d\d){{4}}_(\d\d)_(\d{{3}})\.jpg", path)
            assert match, path
            assert cv2.imread(path).shape == (160, 320, 3)
        times.append(int(match[2]) + int(match[3]) / 1000)
        assert -1 <= float(row[3]) <= 1
    assert np.median(np.diff(times) % 60) == pytest.approx(1 / 15, abs=0.015)
    quality_75 = bytes([8, 6, 6, 7, 6, 5, 8, 7])  # how the JPEG standard's luminance table at quality 75 begins
    assert quality_75 in (tmp_path / "a" / "IMG" / rows[0][0]).read_bytes()[:64]
    assert len(rows) == pytest.approx(0.1 * 1138 / 12.4 * 15, rel=0.2)


def test_a_kill_leaves_a_readable_folder(tmp_path):
    folder = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-m", "simulator", "record", str(folder)], stderr=subprocess.DEVNULL)
    log = folder / "driving_log.csv"
    while not log.exists() or log.stat().st_size < 3000:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    text = log.read_text()
    assert text.endswith("\n")
    for row in csv.reader(text.splitlines()):
        assert len(row) == 7
        assert all(cv2.imread(path) is not None for path in row[:3])
    ends = time.monotonic() + 20
    while any(str(folder).encode() in file.read_bytes() for file in processes()):
        assert time.monotonic() < ends  # the processes that draw end with it
        time.sleep(0.1)


def processes() -> list[Path]:
    return [file for file in Path("/proc").glob("[0-9]*/cmdline") if file.exists()]


DRAW = """
import sys, zlib
from cloning.road import track
from simulator import cameras, run, scenery, world
drive, eyes = run.Run(track.Track("lake")), cameras.Cameras(world.Scene(scenery.build("lake", 0)))
for i in range(1000):
    drive.step(0.0004 * (i % 100 - 20), 1)
    if i % int(sys.argv[1]) == 0:
        print(i, zlib.crc32(eyes.frames(drive.car.node.get_transform())))
"""


def test_a_frame_depends_on_the_place_alone():
    few, many = (
        subprocess.run(
            [sys.executable, "-c", DRAW, step], capture_output=True, text=True, check=True, cwd=ROOT
        ).stdout.splitlines()
        for step in ("8", "4")
    )
    assert len(few) == 125
    assert few == many[::2]


def test_a_full_disk_is_told_and_leaves_whole_rows(tmp_path, monkeypatch):
    images = [b"a whole JPEG"] * 3
    with RecordingWriter(tmp_path / "full") as recording:
        recording.add(0, images, 0, 1, 0, 10)

        def full(*_):
            raise OSError(28, os.strerror(28))

        monkeypatch.setattr("pathlib.Path.write_bytes", full)
        with pytest.raises(RecordingError, match="No space left"):
            recording.add(1, images, 0, 1, 0, 10)
    assert len((tmp_path / "full" / "driving_log.csv").read_text().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["record"], "folder"),
        (["record", "x", "--speed", "40"], "1 to 30"),
        (["record", "x", "--laps", "0"], "above 0"),
        (["record", "x", "--track", "moon"], "moon"),
        (["fly"], "fly"),
        (["record", "x", "--seed", "-1"], "0 or more"),
    ],
)
def test_bad_arguments_are_told(arguments, said, tmp_path):
    done = command(*arguments, cwd=os.getcwd())
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_an_existing_recording_is_kept(tmp_path):
    (tmp_path / "driving_log.csv").write_text("precious\n")
    done = command("record", tmp_path)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert (tmp_path / "driving_log.csv").read_text() == "precious\n"
