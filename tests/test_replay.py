"""Replaying recordings: the integration against geometry, known drivers' scores, and the real commands."""

import copy
import json
import multiprocessing
import os
import re
import shutil
import signal
import sys
import time
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import real_recordings
import torch
import warm
from commands import ROOT
from drive_process import serving
from matplotlib.axes import Axes
from rendered import film_of, render_recording

from cloning.base.errors import SimulatorError
from cloning.lane.recovery import MISHAP, LanePosition
from cloning.network.network import CROP, Network, load_model, save_model, steer
from cloning.recordings.check import check_images
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.replay import command, replay
from cloning.replay.command import CAN_FORK
from cloning.replay.model_driver import ModelDriver
from cloning.replay.score import ReplayFilm, driving_metrics, plot, replay_report, report_text, steering_metrics
from cloning.road.autonomy import LIMITS
from cloning.road.motion import MPH, REAR_AXLE, YAW_LAG, curvature
from simulator import __main__ as simulator

ORACLE_DRIVER = replay.ReplayFrame.recovery_steering


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """A recording of 20 seconds through bends; not to be changed."""
    return replay.load_recording(render_recording(tmp_path_factory.mktemp("replay") / "lake", rows=300, seed=4))


@pytest.fixture
def recording(loaded):
    """The same, whose columns a test may change."""
    return copy.deepcopy(loaded)


def run(*arguments) -> int:
    return simulator.main(["replay", *map(str, arguments)])


def human(recording):
    return replay.reference_lines(recording, by_lane=False)


def echo(frame) -> float:
    return frame.human_steering


def test_an_echo_of_the_human_is_exactly_right(recording):
    for limit in LIMITS:
        done = replay.drive(recording, human(recording), limit, echo)
        assert done.autonomy() == 1 and not done.interventions
        assert not np.any(done.offset) and not np.any(done.offset_from_human)
        assert len(done.row) == 300


def test_the_car_goes_where_geometry_says(recording):
    """On a straight, a constant steering drives a circle away from the human's path, once the car has begun to turn."""
    recording.steering[:], recording.speed[:] = 0.0, 15
    done = replay.drive(recording, human(recording), 3.0, lambda frame: 0.02)
    at = next(iter(done.interventions))
    seconds, speed, bend = np.cumsum(done.seconds[:at]), 15 * MPH, curvature(0.02)
    # abreast of the human, on a circle
    yaw = np.arcsin(speed * bend * (seconds - YAW_LAG * (1 - np.exp(-seconds / YAW_LAG))))
    expected = np.r_[0, np.cumsum(np.diff(seconds) * speed * np.tan((yaw[1:] + yaw[:-1]) / 2))]
    assert done.offset_from_human[:at] == pytest.approx(expected + REAR_AXLE * np.sin(yaw), abs=0.03)
    assert done.interventions[at] > 3 and done.offset[at] == 0


@pytest.fixture
def lane(recording, monkeypatch) -> LanePosition:
    """What will be estimated: the human drives 0.8 m right of the lane's centre."""
    n = len(recording)
    position = LanePosition.read(np.full(n, 0.8, np.float32), np.zeros(n, np.float32), np.ones(n, bool))
    monkeypatch.setattr("cloning.lane.known.estimate_lane_position", lambda *_: position)
    return position


def test_the_lane_is_the_reference_where_it_is_trusted(recording, lane):
    """An echo of the human is off by as much, and set back beyond a limit."""
    done = replay.drive(recording, replay.reference_lines(recording), 1.0, echo)
    assert not done.interventions and done.offset == pytest.approx(np.full(300, 0.8))
    lane.lateral_offset[150:] = 1.2
    done = replay.drive(recording, replay.reference_lines(recording), 1.0, echo)
    assert min(done.interventions) == 150 and done.offset[150] == pytest.approx(0, abs=1e-6)
    assert done.offset_from_human[150] == pytest.approx(-1.2)
    lane.lateral_offset[100:200] = 6  # off the road
    assert [line.rows for line in replay.reference_lines(recording)] == [slice(0, 100), slice(200, 300)]
    lane.trusted[:] = False
    [line] = replay.reference_lines(recording)
    assert not line.is_lane_centre and not line.offset.any()


def test_a_car_that_is_set_back_in_a_bend_follows_it(recording, lane):
    """The human drives a circle along the lane's centre: the road's direction beside the middle is not the car's."""
    recording.steering[:], lane.lateral_offset[:] = 0.2, 0
    lane.heading_error[:] = -REAR_AXLE * curvature(0.2)
    [line] = replay.reference_lines(recording)
    car = replay.ReplayedCar(recording, line)
    car.set_back(150)
    assert car.yaw == pytest.approx(0, abs=0.01) and car.offset(150) == pytest.approx(0)


def test_a_report_tells_known_rows_from_others(recording, lane):
    """The first third placed, then a mishap, then rows whose lane is not trusted."""
    lane.placed[:100], lane.trusted[100:] = True, False
    lane.piece[100:140], lane.piece[140:] = MISHAP, 2
    lines = replay.reference_lines(recording)
    done = replay.drive(recording, lines, 1.0, lambda frame: 0.02 * (frame.row % 2))
    done.interventions = {30: 1.1, 150: 1.2, 180: -1.3}  # of the rows driven: 100 by the lane, 160 by the human's path
    report = replay_report(recording, lines, [done], "lane")
    assert report["reference"] == {"lane_centre": 100, "human_way": 160} and report["rows_placed"] == 100
    mishap, unread = report["unknown"]
    assert (mishap["first"], mishap["last"], mishap["rows"]) == (recording.name(100), recording.name(139), 40)
    assert unread["first"] == recording.name(140) and unread["rows"] == 160 and unread["why"] != mishap["why"]
    metrics = report["limits"]["1"]
    parts = metrics["by_reference"]
    assert [part["interventions"] for part in parts.values()] == [1, 2] and metrics["interventions"] == 3
    seconds = np.array(done.seconds)
    assert parts["lane_centre"]["autonomy_percent"] == pytest.approx(100 * (1 - 6 / seconds[:100].sum()), abs=1e-3)
    assert parts["human_way"]["autonomy_percent"] == pytest.approx(100 * (1 - 12 / seconds[100:].sum()), abs=1e-3)
    assert metrics["steering_roughness_per_s"] == pytest.approx(0.02 * 258 / seconds.sum(), abs=1e-3)
    assert report["mean_speed_mph"] == pytest.approx(np.abs(recording.speed).mean(), abs=0.05)
    text = report_text(report)
    assert re.search(r"from the lane's centre: autonomy .*\b1 intervention\b", text), "one is counted as one"
    assert text.index("from the lane's centre: autonomy") < text.index("recorded driver's path: autonomy")
    assert text.index("recorded driver's path: autonomy") < text.index("from both: autonomy")
    assert f"40 rows from {mishap['first']} to {mishap['last']}: not driven" in text and "33.3 % of the rows" in text
    lines = replay.reference_lines(recording, by_lane=False)
    asked = replay_report(recording, lines, [replay.drive(recording, lines, 1.0, lambda _: 0.0)], "human")
    assert asked["rows_placed"] is None and "placed" not in report_text(asked)
    assert [each["why"].endswith("as asked") for each in asked["unknown"]] == [True]


def test_the_oracle_drives_to_the_reference_line_and_along_it(recording, lane):
    """From the human's path; where that is the reference, it stays on it."""
    for by_lane, begin in ((True, 0.8), (False, 0.0)):
        done = replay.drive(recording, replay.reference_lines(recording, by_lane), 1.0, ORACLE_DRIVER)
        assert not done.interventions and done.offset[0] == pytest.approx(begin)
        after_2_s = np.abs(done.offset[30:])
        assert after_2_s.max() < 0.3 and after_2_s.mean() < 0.15, "it cuts the slalom's bends a little"
    slow = recording.take(slice(40), speed=np.full(40, 3, np.float32))  # so near, no lane ahead is known
    assert np.abs(replay.drive(slow, human(slow), 1.0, ORACLE_DRIVER).steering).max() < 1


def test_the_oracle_drives_the_real_jungle():
    """Three quarters of a minute, without an intervention at either limit: so the measure allows it."""
    if not (folders := [folder for folder in real_recordings.FOLDERS if folder.name == "jungle"]):
        pytest.skip(real_recordings.MISSING)
    recording = check_images(read_recording(folders[0]).take(slice(700, 1400)), show_progress=False)
    lines = replay.reference_lines(recording)
    for limit in LIMITS:
        metrics = driving_metrics(replay.drive(recording, lines, limit, ORACLE_DRIVER))
        assert metrics["interventions"] == 0 and metrics["distance_mean_m"] == pytest.approx(0.18, abs=0.02)


def road_column(frame: np.ndarray) -> float:
    """The mean column of the grey road in the rows near the car."""
    red, _, blue = np.moveaxis(frame[90:130].astype(int), -1, 0)
    return np.nonzero(np.abs(red - blue) < 35)[1].mean()


def test_the_model_sees_the_recorded_file_itself_on_the_humans_path(recording):
    seen = []

    def driver(frame):
        seen.append((frame.jpeg(), frame.recorded, frame.view))
        return frame.human_steering + (0.3 if len(seen) == 100 else 0)

    done = replay.drive(recording, human(recording), 2.5, driver)
    names = [recording.folder / "IMG" / os.fsdecode(recording.names[image]) for image in recording.images[:, 0]]
    assert all(jpeg == path.read_bytes() for (jpeg, *_), path in zip(seen[:100], names, strict=False))
    jpeg, recorded, view = seen[150]
    assert np.abs(view.astype(int) - recorded)[70:130].mean() > 5, "moved"
    assert done.offset_from_human[150] > 0.1
    assert road_column(view) < road_column(recorded) - 3, "from further right, the road is further left"
    assert np.abs(decode(jpeg).astype(int) - view)[60:135].mean() < 4, "sent as seen"


def test_errors_and_correlations_are_what_they_say():
    human = np.sin(np.arange(200) / 9)
    assert steering_metrics(human, human) == {"error": 0, "correlation": 1}
    assert steering_metrics(-human, human)["correlation"] == -1
    still = steering_metrics(np.zeros(200), human)
    assert still == {"error": pytest.approx(np.sqrt(np.mean(human**2)), abs=1e-4), "correlation": None}


def test_the_command_gives_the_same_figures_over_the_wire(sample_recording, model_file, tmp_path, capsys):
    folder = "--reference", "human", sample_recording
    outputs = "--picture", tmp_path / "way.png", "--film", tmp_path / "seen.mp4"
    assert run(*folder, "--model", model_file, "--report", tmp_path / "a.json", *outputs) == 0
    alone = capsys.readouterr().out
    with serving(model_file, "--as-mounted") as server:  # it takes these drawn frames for those of a shifted camera
        assert run(*folder, "--port", server.port, "--report", tmp_path / "b.json") == 0
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert alone == capsys.readouterr().out
    [report] = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert set(report["limits"]) == {"1", "2.5"} and report["rows_driven"] == 60
    assert report["reference"] == {"lane_centre": 0, "human_way": 60} and "unknown" not in alone
    one = report["limits"]["1"]
    assert one["interventions"] == len(one["where"]) and one["autonomy_percent"] < 100
    assert (folder[-1] / "IMG" / one["where"][0]["image"]).is_file()
    nothing = {"interventions": 0, "distance_mean_m": 0, "distance_p95_m": 0}
    assert one["compared"]["human"] == {"autonomy_percent": 100, **nothing}
    oracle = one["compared"]["oracle"]
    assert oracle["autonomy_percent"] == 100 and oracle["distance_mean_m"] == pytest.approx(0.11, abs=0.03)
    assert f"driven): autonomy 100.0 %, 0 interventions; distance: mean {oracle['distance_mean_m']:.2f} m" in alone
    assert (tmp_path / "way.png").read_bytes()[:4] == b"\x89PNG"
    assert [frame.shape[1] for frame in film_of(tmp_path / "seen.mp4")[1]] == [1280] * 60


def test_the_film_runs_at_the_recordings_own_rate(recording, tmp_path):
    recording = recording.take(slice(None), time=recording.time * 1.25)
    film = ReplayFilm(str(tmp_path / "seen.mp4"))
    film.begin(recording)
    film.add(np.zeros((298, 1280, 3), np.uint8))
    film.begin(recording.take(slice(None), time=recording.time * 2))  # of another recording: the film has its rate
    film.close()
    assert 1 / film_of(tmp_path / "seen.mp4")[0] == pytest.approx(np.diff(recording.time).mean(), rel=1e-3)


def test_on_an_unknown_road_the_humans_path_is_the_reference(copied, tmp_path, model_file, capsys):
    rng = np.random.default_rng(0)
    for path in (copied / "IMG").iterdir():  # coarse, or else the film takes long to write
        cv2.imwrite(str(path), cv2.resize(rng.integers(0, 255, (10, 20, 3), np.uint8), (320, 160)))
    outputs = "--film", tmp_path / "x.mp4", "--report", tmp_path / "r.json"
    assert run(copied, "--model", model_file, "--limit", *"212", *outputs) == 0
    printed = capsys.readouterr().out
    assert "lane's centre unknown in 60 rows from center_" in printed
    assert "2 m, from the recorded driver's path: autonomy" in printed and "0.0 % of the rows" in printed
    assert "from both" not in printed
    limits = list(json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))[0]["limits"])
    assert limits == ["2", "1"], "one given twice counts once"
    assert [frame.shape[1] for frame in film_of(tmp_path / "x.mp4")[1]] == [1280] * 60, "one drive writes the film"


@pytest.mark.parametrize("crop", [CROP, (85, 0)])
def test_in_process_the_network_sees_exactly_what_a_server_receives(recording, tmp_path, crop, monkeypatch):
    monkeypatch.setattr(torch, "set_num_threads", lambda _: pytest.fail("the caller decides"))
    torch.manual_seed(0)
    save_model(tmp_path / "model.pt", Network(crop))
    network, driver = load_model(tmp_path / "model.pt"), ModelDriver(str(tmp_path / "model.pt"))
    recording = recording.take(slice(60 if crop == CROP else 40))
    poses = []

    def compared(frame):
        received = decode(frame.jpeg())
        assert np.array_equal(frame.received(driver.rows), received[driver.rows])
        steering = float(steer(network, received))
        assert driver(frame) == steering, "to the bit"
        poses.append(frame.pose)
        return np.clip(steering + 0.4 * np.sin(frame.row / 9), -1, 1)  # far to both sides, so that all cameras are used

    replay.drive(recording, human(recording), 2.5, compared)
    right, yaw = np.array(poses).T
    assert right.min() < -0.8 and right.max() > 0.8 and np.abs(yaw).max() > 0.1


@pytest.mark.parametrize("parallel", [False, True])
def test_drives_at_several_limits_are_those_at_each_limit(recording, tmp_path, parallel):
    """Until they part they are one; then those but the last go on in processes of their own, if they can."""

    def weaving(frame) -> float:
        return float(np.clip(frame.human_steering + 0.03 * (frame.row > 100), -1, 1))

    limits, lines, watched = (2.0, 1.0, 2.5), human(recording), []
    expected = [replay.drive(recording, lines, limit, weaving) for limit in limits]

    def driver(frame):
        (tmp_path / str(os.getpid())).touch()
        return weaving(frame)

    done = command.drive_at_limits(recording, lines, driver, limits, lambda _, d: watched.append(d.limit), parallel)
    assert done == expected and len(done[0].interventions) < len(done[1].interventions)
    assert watched == [2.5] * len(recording)
    assert (tmp_path / str(os.getpid())).exists()
    assert len(list(tmp_path.iterdir())) == (3 if parallel and CAN_FORK else 1)


def test_drives_that_never_part_are_driven_once(recording):
    lines, rows = human(recording), list[int]()

    def driver(frame):
        rows.append(frame.row)
        return 0.99 * frame.human_steering

    done = command.drive_at_limits(recording, lines, driver, (1.0, 2.5))
    assert rows == [*range(300)] and done == [replay.drive(recording, lines, limit, driver) for limit in (1.0, 2.5)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["FOLDER", "--model", "MODEL", "--picture", "MODEL"], "is read, and would be replaced; name another file"),
        (["FOLDER", "--model", "MODEL", "--report", "LOG"], "driving_log.csv: is read, and would be replaced; name"),
        (["FOLDER", "--model", "MODEL", "--report", "x", "--film", "./x"], "x: is named for two outputs"),
        (["FOLDER", "--port", "1", "--wait", "0.5"], "no server at"),
    ],
)
def test_unusable_arguments_are_reported(sample_recording, model_file, arguments, message, capsys):
    known = {"FOLDER": sample_recording, "MODEL": model_file, "LOG": sample_recording / "driving_log.csv"}
    assert run(*[known.get(argument, argument) for argument in arguments]) == 2
    assert message in capsys.readouterr().err


def test_what_cannot_be_replayed_is_left_out_of_the_others_report(sample_recording, model_file, tmp_path, capsys):
    """Pictures of recordings with one name are kept apart, as of two people who each have a recording called lake."""
    short, unusable = render_recording(tmp_path / "short", rows=20), render_recording(tmp_path / "unusable", rows=20)
    for image in (unusable / "IMG").iterdir():
        image.write_bytes(b"")
    options = ("--model", model_file, "--reference", "human", "--limit", 1, "--report", tmp_path / "r.json")
    assert run(short, unusable, *options) == 2
    printed = capsys.readouterr()
    assert f"left out: {short}: no two seconds" in printed.out
    assert f"{unusable / 'driving_log.csv'}: no usable row" in printed.err
    folders = [shutil.copytree(sample_recording, tmp_path / person / "lake") for person in ("a", "b")]
    assert run(short, folders[0], unusable, folders[1], *options, "--picture", tmp_path / "way.png") == 0
    printed = capsys.readouterr()
    assert printed.out.count("left out: ") == 2 + 5, "recordings, and the first of the images"
    reports = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert [report["recording"] for report in reports] == list(map(str, folders))
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["way-a-lake.png", "way-b-lake.png"]


def test_a_full_disk_costs_the_film_alone(sample_recording, model_file, tmp_path, capsys, longest_file):
    outputs = "--film", tmp_path / "x.mp4", "--report", tmp_path / "r.json", "--picture", tmp_path / "p.png"
    options = "--reference", "human", sample_recording, "--model", model_file, "--limit", "2", *outputs
    longest_file(300_000)  # enough for the plot, half of the film
    assert run(*options) == 2
    longest_file()
    printed = capsys.readouterr()
    assert re.search(r"^python: \S+x\.mp4: .*no film was written", printed.err, re.MULTILINE)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.png", "r.json"]
    assert "autonomy" in printed.out
    assert json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))[0]["limits"]["2"]


def fail():
    raise SimulatorError("the network's steering is not finite")


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(20)  # as ClientSession, until its patience ends


@pytest.mark.skipif(not CAN_FORK, reason="on this system drives follow one another")
@pytest.mark.parametrize(
    ("at_fault", "message", "here"),
    [
        (fail, "not finite", False),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "was killed", False),
        (fail, "not finite", True),
        (interrupt, None, True),
    ],
)
def test_an_error_or_ctrl_c_at_one_limit_ends_the_drives_at_the_others(recording, at_fault, message, here):
    """here: in this process, where the last limit is driven; else in those of the others."""
    rows, this, begin = [], os.getpid(), time.monotonic()

    def driver(frame):
        if (os.getpid() == this) == here and frame.row == 50:
            at_fault()
        time.sleep(0.01)
        rows.append(frame.row)
        return 0.0

    with pytest.raises(SimulatorError if message else KeyboardInterrupt, match=message):
        command.drive_at_limits(recording, human(recording), driver, (1.0, 2.0, 3.0), parallel=True)
    assert len(rows) < 200 and not multiprocessing.active_children() and time.monotonic() - begin < 15


@pytest.mark.skipif(not CAN_FORK, reason="on this system drives follow one another")
def test_ctrl_c_ends_drives_in_processes_with_one_message(loaded, model_file, tmp_path):
    """The terminal sends it to all of them."""
    log = tmp_path / "log"
    with log.open("w") as file:
        command_line = [sys.executable, "-m", "simulator", "replay", loaded.folder, "--model", model_file]
        command_line += ["--reference", "human", "--limit", *"123456789"]
        process = warm.Popen(command_line, cwd=ROOT, stderr=file, start_new_session=True)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        while len(children.read_text().split()) < 8:
            assert process.poll() is None
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        status = process.wait(20)
    assert (status, log.read_text()) == (130, "simulator: stopped; the files that it has written are complete\n")


def test_stretches_are_joined_in_one_report_and_no_line_of_its_plot_goes_from_one_to_the_other(recording):
    recording.time[150:] += 60
    times: list[float] = []
    done = replay.drive(recording, human(recording), 1.0, echo, lambda frame, _: times.append(frame.time))
    assert times[0] == times[150] == 0 and times[149] == pytest.approx(149 * 0.067, abs=0.01), "of each stretch its own"
    assert len(human(recording)) == 2 and sum(done.seconds) == pytest.approx(298 * 0.067, abs=0.01)
    with patch.object(Axes, "plot", autospec=True, side_effect=Axes.plot) as drawn:
        plot(recording, [done])
    offsets = [call.args[2] for call in drawn.call_args_list[:2]]
    assert all(np.isnan(offset[150]) and not np.isnan(offset[151:]).any() for offset in offsets)
