"""Every command killed, and its disk full, at every change to its files: none is cut, and the next run goes on.

Without ALL_KILL_POINTS=1 in the environment, some of the points are left out: see `killed.chosen`.
"""

import http.client
import json
import os
import re
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import ROOT, TINY
from drive_process import ask, awaited
from kill_points import Watched
from killed import ALL, KILLED, Trial, check_whole, chosen, spread, writes
from rendered import render_recording
from steer_server import STEER, Server

from cloning.base.errors import RecordingError
from cloning.recordings.check import check_images
from cloning.recordings.excluded import Cut, add_cuts, read_cuts
from cloning.recordings.log import read_recording
from tools.simulator_client import Simulator, telemetry

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks a process that has loaded its libraries")


@pytest.fixture(scope="module")
def lake(tmp_path_factory) -> Path:
    """A recording of 40 rows, one of which has no image; not to be changed."""
    folder = render_recording(tmp_path_factory.mktemp("data") / "lake", rows=40)
    min((folder / "IMG").glob("left_*")).unlink()
    return folder


# ----------------------------------------------------------------------------------------------------------------------
# Training


@pytest.fixture(scope="module")
def trained(lake, tmp_path_factory) -> Path:
    """The folder of a finished run of one epoch with seed 0, and the cache of checked images; not to be changed."""
    folder = tmp_path_factory.mktemp("earlier") / "trial"
    Trial(folder, training(lake)).whole_run()
    return folder


def training(lake: Path, *arguments) -> list:
    return [ROOT / "model.py", lake, *TINY, *arguments, "--output", "model.pt"]


def test_training_killed_anywhere_and_on_a_full_disk(lake, tmp_path):
    trial = Trial(tmp_path / "trial", training(lake), more=("--resume",))
    trial.killed_everywhere(2)
    trial.disk_full_everywhere(2)


def test_resumed_training_killed_anywhere(lake, trained, tmp_path):
    Trial(tmp_path / "trial", training(lake, "--epochs", 2, "--resume"), trained).killed_everywhere(2)


def test_a_report_killed_anywhere_and_on_a_full_disk(trained, tmp_path):
    trial = Trial(tmp_path / "trial", ["-m", "cloning.report", "."], trained)
    trial.killed_everywhere(1)
    trial.disk_full_everywhere(1)


# ----------------------------------------------------------------------------------------------------------------------
# Recording


RECORDED = "recorded-corrections"
RECORD = ["-m", "simulator", "record", RECORDED, "--laps", "0.00002"]


def rows_of(folder: Path) -> list[tuple]:
    """The usable rows of a recording: names of their images, and their numbers; none if its only row is cut."""
    try:
        recording = read_recording(folder)
    except RecordingError as error:
        assert "no usable row: line 1: " in str(error)
        return []
    total = len((folder / "driving_log.csv").read_bytes().splitlines())
    recording = check_images(recording, show_progress=False)
    assert len(recording) + len(recording.rejected) == total
    images = [[bytes(name) for name in row] for row in recording.names[recording.images]]
    numbers = zip(recording.steering, recording.throttle, recording.speed, strict=True)
    return list(zip(images, [tuple(map(float, row)) for row in numbers], strict=True))


@pytest.fixture(params=["record", "correct"])
def recording(tmp_path, request):
    if request.param == "record":
        yield Trial(tmp_path / "trial", RECORD)
        return
    with ServerForAll("1") as server:  # so the expert takes over after 4 m
        command = ["-m", "simulator", "correct", RECORDED, "--laps", "0.004", "--port", server.port]
        yield Trial(tmp_path / "trial", command)


def test_recording_killed_anywhere(recording):
    """A killed recording can be trained on; one that has no row yet is begun again by the same command."""
    trial = recording
    trial.whole_run()
    complete = rows_of(trial.folder / RECORDED)
    assert complete

    def next_run(wanted: dict[str, object]) -> None:
        log = trial.folder / RECORDED / "driving_log.csv"
        if not log.exists() or not log.stat().st_size:
            trial.goes_on(wanted)
            return
        ended = trial.run(trial.command)
        assert ended.status == 2 and "exists already; name another folder, or delete this one" in ended.printed
        assert rows_of(log.parent) in [complete[:count] for count in range(len(complete) + 1)]

    trial.killed_everywhere(2, next_run)


def test_recording_on_a_full_disk(tmp_path):
    """The rows before it are complete, also if the process is killed while it takes back the last one."""
    trial = Trial(tmp_path / "trial", RECORD)
    _, points = trial.whole_run()
    complete = rows_of(trial.folder / RECORDED)
    for full in writes(points, 2):
        trial.restore()
        ended = trial.run(RECORD, full=full)
        assert ended.status == 2 and "No space left on device; the" in ended.printed, ended.printed
        assert "Traceback" not in ended.printed
        check_whole(trial.folder)
        log_file = trial.folder / RECORDED / "driving_log.csv"
        log = log_file.read_bytes() if log_file.exists() else b""  # without a row, the recording is removed
        images = set((trial.folder / RECORDED).glob("IMG/*"))
        rows = log.count(b"\n")
        assert f"the {rows} rows before it" in ended.printed
        assert log == b"" or log.endswith(b"\n")
        assert len(images) == 3 * rows, "what was written of the last row is taken back"
        later = list(range(full + 1, len(ended.points) + 1))
        for kill in later if ALL else spread(later, 2):
            trial.restore()
            assert trial.run(RECORD, full=full, kill=kill).status == KILLED
            check_whole(trial.folder)
            if log_file.exists() and log_file.stat().st_size:
                assert rows_of(trial.folder / RECORDED) == complete[:rows]


# ----------------------------------------------------------------------------------------------------------------------
# Saving frames


def printed_port(running: Watched, pattern: str) -> int | None:
    """The port that a server prints, None if it is gone."""
    awaited(lambda: re.search(pattern, running.printed()) or running.process.poll() is not None)
    port = re.search(pattern, running.printed())
    return int(port[1]) if port else None


class Car:
    """A simulator that sends six telemetries, or until the server is gone, and then has the server end."""

    def __init__(self, jpegs: list[bytes]):
        self.jpegs, self.answers = jpegs, 0

    def drive(self, running: Watched) -> None:
        self.answers = 0
        if not (port := printed_port(running, r"Listening on [\d.]+:(\d+)[\s\S]+Watch at")):
            return
        try:
            with Simulator(port) as simulator:
                simulator.open()
                for n in range(6):
                    simulator.drive(telemetry(self.jpegs[n]))
                    self.answers += 1
        except (ConnectionError, TimeoutError):
            return
        running.process.send_signal(signal.SIGINT)


@pytest.fixture
def driving(model_file, jpegs, tmp_path):
    """drive.py, which saves frames in a folder with two old ones, one of them half-written."""
    begin = tmp_path / "begin"
    (begin / "run1").mkdir(parents=True)
    (begin / "run1" / "2018_07_16_17_11_43_382.jpg").write_bytes(jpegs[7])
    (begin / "run1" / ".2018_07_16_17_11_43_383.jpg.0123abcd.part").write_bytes(jpegs[7][:100])
    command = [ROOT / "drive.py", model_file, "run1", "--port", 0]
    trial = Trial(tmp_path / "trial", command, begin, done=128 + signal.SIGINT)
    car = Car(jpegs)
    trial.companion = car.drive
    return trial, car


def saved(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(folder.glob("[0-9]*.jpg"))]


def test_driving_killed_anywhere(driving, jpegs):
    """The frames that are there are whole, video.py films them, and the next drive deletes them all."""
    trial, car = driving
    _, points = trial.whole_run()
    for number in chosen(points, 4):
        trial.restore()
        assert trial.run(trial.command, kill=number).status == KILLED
        check_whole(trial.folder)
        frames = [jpeg for jpeg in saved(trial.folder / "run1") if jpeg != jpegs[7]]
        assert frames == jpegs[: len(frames)]
        if frames:
            trial.companion = lambda running: None
            film = trial.run([ROOT / "video.py", "run1"])
            trial.companion = car.drive
            assert film.status == 0 and f"run1.mp4: {len(frames)} frames" in film.printed
        assert trial.run(trial.command).status == trial.done
        assert saved(trial.folder / "run1") == jpegs[:6]
        assert not list((trial.folder / "run1").glob(".*"))


def test_driving_on_a_full_disk(driving, jpegs):
    """All frames are answered; those that are lost are counted, in the session's summary and at the end."""
    trial, car = driving
    _, points = trial.whole_run()
    for number in writes(points, 2):
        trial.restore()
        ended = trial.run(trial.command, full=number)
        lost = sum(point.startswith("write") and ".jpg" in point for point in points[number - 1 :])
        assert car.answers == 6
        assert ended.status == 1 and "Traceback" not in ended.printed
        told = f"session ended: 6 frames driven, 0 unusable; {6 - lost} frames saved in run1, {lost} LOST"
        assert told in ended.printed
        assert f"drive.py: run1: {lost} of 6 frames were not saved" in ended.printed.splitlines()[-1]
        assert saved(trial.folder / "run1") == jpegs[: 6 - lost]
        assert not list((trial.folder / "run1").glob(".*"))


# ----------------------------------------------------------------------------------------------------------------------
# Browsing


class Browser:
    """Sends one request about the only recording, and then has the server end."""

    def __init__(self, path: str, content: object):
        self.path, self.content, self.answer = path, content, dict[str, Any]()

    def post(self, running: Watched) -> None:
        if not (port := printed_port(running, r"http://[\d.]+:(\d+)/")):
            return
        try:
            ask(port, "/analyses", "DELETE")  # one would outlive a killed server, and write into the folder later
            here = f"/recordings/{json.loads(ask(port, '/recordings')[1])[0]['id']}"
            version = json.loads(ask(port, f"{here}/details")[1])["version"]
            self.answer = json.loads(ask(port, f"{here}/{self.path}?version={version}", "POST", self.content)[1])
        except (ConnectionError, http.client.HTTPException):
            return
        running.process.send_signal(signal.SIGINT)


def test_a_cut_killed_anywhere(lake, tmp_path):
    """An earlier cut stays; the new one is there or not, and can be made again."""
    names = rows_of(lake)
    recorded = tmp_path / "begin" / "lake"
    (recorded / "IMG").mkdir(parents=True)
    shutil.copy(lake / "driving_log.csv", recorded)
    center = [images[0].decode() for images, _ in names]
    earlier, new = Cut(center[1], center[2], "off"), Cut(center[5], center[9], "off")
    add_cuts(recorded, earlier)
    command = ["-m", "cloning.browse", "lake", "--port", 0]
    trial = Trial(tmp_path / "trial", command, tmp_path / "begin", done=128 + signal.SIGINT)
    browser = Browser("cuts", [{"first": new.first, "last": new.last, "reason": new.reason}])

    def checked() -> None:
        cuts = [each.row() for each in read_cuts(trial.folder / "lake")]
        assert cuts in ([earlier.row()], [earlier.row(), new.row()])
        assert len(read_recording(trial.folder / "lake")) in (38, 33)

    trial.companion, trial.checked = browser.post, checked
    trial.killed_everywhere(4)
    _, points = trial.whole_run()
    for number in writes(points, 10):
        trial.restore()
        assert trial.run(command, full=number).status == trial.done
        assert "excluded.csv: No space left on device" in browser.answer["message"]
        assert [each.row() for each in read_cuts(trial.folder / "lake")] == [earlier.row()]
        assert sorted(path.name for path in (trial.folder / "lake").iterdir()) == sorted(os.listdir(recorded))


def test_an_exported_part_is_whole_or_no_recording(tmp_path):
    """Also with a `lane.csv`; on a full disk nothing is left of it."""
    recorded = render_recording(tmp_path / "begin" / "lake", rows=3)
    centers = [images[0].decode() for images, _ in rows_of(recorded)]
    known = "".join(f"{center},0.1,0\n" for center in centers)
    header = "center image,lateral offset (m),heading error (radians)\n"
    (recorded / "lane.csv").write_text(header + known, encoding="utf-8")
    command = ["-m", "cloning.browse", "lake", "--port", 0]
    trial = Trial(tmp_path / "trial", command, tmp_path / "begin", done=128 + signal.SIGINT)
    browser, part = Browser("export", {"rows": "1-3", "name": "part"}), trial.folder / "part"
    trial.companion = browser.post

    def check_part() -> None:
        written = check_images(read_recording(part), show_progress=False)
        assert [written.name(row) for row in range(len(written))] == centers[1:]
        assert (part / "lane.csv").read_text(encoding="utf-8").splitlines() == [header.strip(), *known.splitlines()[1:]]

    def next_run(wanted: dict[str, object]) -> None:
        if (part / "driving_log.csv").exists():
            check_part()
        shutil.rmtree(part, ignore_errors=True)  # its name is taken
        trial.goes_on(wanted)

    _, points = trial.whole_run()
    check_part()

    trial.killed_everywhere(3, next_run)
    for number in writes(points, 2):
        trial.restore()
        assert trial.run(command, full=number).status == trial.done
        assert "No space left on device; mend it, and export again" in browser.answer["message"]
        assert not part.exists()


def test_an_analysis_of_the_lane_killed_anywhere(lake, tmp_path):
    Trial(tmp_path / "trial", ["-m", "cloning.browse.analyse", lake, "lane"]).killed_everywhere(1)


@pytest.fixture(params=["to LeRobot", "from LeRobot"])
def converting(tmp_path, request):
    command = ["-m", "cloning.lerobot", render_recording(tmp_path / "lake", rows=6), "--output", "lake"]
    to_lerobot = Trial(tmp_path / "trial", command)
    if request.param == "to LeRobot":
        return to_lerobot
    to_lerobot.whole_run()
    shutil.move(tmp_path / "trial", tmp_path / "begin")
    command = ["-m", "cloning.lerobot", "lake", "--output", "recording"]
    return Trial(tmp_path / "trial", command, tmp_path / "begin")


def test_a_data_set_and_a_recording_of_one_killed_anywhere_and_on_a_full_disk(converting):
    converting.killed_everywhere(1)
    converting.disk_full_everywhere(1)


# ----------------------------------------------------------------------------------------------------------------------
# Films and reports


def test_filming_saved_frames_killed_anywhere(jpegs, tmp_path):
    folder = tmp_path / "begin" / "run1"
    folder.mkdir(parents=True)
    for n, jpeg in enumerate(jpegs):
        (folder / f"2018_07_16_17_11_43_{n:03d}.jpg").write_bytes(jpeg)
    trial = Trial(tmp_path / "trial", [ROOT / "video.py", "run1"], tmp_path / "begin")
    trial.killed_everywhere(3)
    trial.killed_at_every_length("run1.mp4", 40 if ALL else 5)


class ServerForAll(Server):
    """Answers every session, one after the other, until it is closed, with the same steering."""

    def __init__(self, steering="0"):
        super().__init__(lambda packet, n: [STEER % (steering, "0.3")], sessions=10_000)

    def __exit__(self, *_):
        self.sessions = 0
        self.listener.shutdown(2)
        self.listener.close()
        self.thread.join(20)


def test_a_simulated_drive_killed_anywhere_and_on_a_full_disk(tmp_path):
    files = ("--report", "drive.json", "--picture", "above.png", "--film", "film.mp4")
    with ServerForAll() as server:
        command = ["-m", "simulator", "drive", "--laps", "0.002", "--port", server.port, *files]
        trial = Trial(tmp_path / "trial", command)
        trial.killed_everywhere(1)
        trial.killed_at_every_length("film.mp4", 20 if ALL else 1)
        trial.disk_full_everywhere(1)


def test_writing_a_launcher_killed_anywhere_and_on_a_full_disk(tmp_path):
    command = ["-m", "simulator", "join", "--dialect", "roads", "--launcher", "sim.x86_64"]
    trial = Trial(tmp_path / "trial", command)
    trial.killed_everywhere(3)
    trial.disk_full_everywhere(1)


def test_a_replay_killed_anywhere_and_on_a_full_disk(lake, model_file, tmp_path):
    files = ("--report", "replay.json", "--picture", "replay.png", "--film", "replay.mp4")
    command = ["-m", "simulator", "replay", lake, "--model", model_file, "--limit", 1, "--reference", "human", *files]
    trial = Trial(tmp_path / "trial", command)
    trial.killed_everywhere(1)
    trial.killed_at_every_length("replay.mp4", 20 if ALL else 1)
    trial.disk_full_everywhere(1)
