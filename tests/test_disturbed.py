"""Disturbances where they are used: in drives, recordings, replays, other programs' episodes and Gymnasium."""

import base64
import json

import numpy as np
import pytest
from rendered import render_recording
from steer_server import STEER, Server

from cloning.base.errors import SimulatorError
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.replay import replay
from cloning.road.disturbances import Disturbance, Disturber
from simulator.__main__ import main
from simulator.dialects import Episodes, Stage
from simulator.environment import Drive


def sent(tmp_path, *options):
    """The images that a server gets in a short drive, and the drive's report."""
    images, report = [], tmp_path / "report.json"

    def steer(packet, n):
        images.append(base64.b64decode(json.loads(packet[2:])[1]["image"]))
        return [STEER % ("0.01", "1")]

    with Server(steer) as server:
        words = ["drive", "--laps", "0.01", "--port", str(server.port), "--report", str(report), *options]
        assert main(words) == 0
    return images, json.loads(report.read_text(encoding="utf-8"))


def test_late_and_lost_frames_reach_the_driver_so_and_the_report_says_it(tmp_path, capsys):
    clear, report = sent(tmp_path)
    assert "disturbance" not in report
    late, report = sent(tmp_path, "--disturb", "late:3")
    assert len(late) == len(clear) > 20
    assert late == [clear[max(0, i - 3)] for i in range(len(late))]
    assert report["disturbance"] == "late:3"
    assert "disturbance: late:3\n" in capsys.readouterr().out
    lost, _ = sent(tmp_path, "--disturb", "dropped:3")
    repeated = [i for i in range(1, len(lost)) if lost[i] == lost[i - 1]]
    assert 0.3 < len(repeated) / len(lost) < 0.8
    assert all(lost[i] == clear[i] for i in range(len(lost)) if i not in repeated)


def test_a_disturbed_drive_is_the_same_again(tmp_path):
    rain = sent(tmp_path, "--disturb", "rain:4")
    assert rain[0] == sent(tmp_path, "--disturb", "rain:4")[0]
    assert rain[0] != sent(tmp_path)[0]


def test_a_recording_shows_the_disturbance_in_all_cameras_and_is_the_same_again(tmp_path):
    def recorded(name, *options):
        assert main(["record", str(tmp_path / name), "--laps", "0.004", *options]) == 0
        recording = read_recording(tmp_path / name)
        return [[recording.path(row, camera).read_bytes() for camera in range(3)] for row in range(len(recording))]

    clear = recorded("clear")
    assert recorded("late", "--disturb", "late:2") == [clear[max(0, i - 2)] for i in range(len(clear))]
    dirty = recorded("dirty", "--disturb", "dirt:4")
    assert dirty == recorded("again", "--disturb", "dirt:4")
    change = np.abs(np.array([decode(image) for image in dirty[5]]).astype(int) - [decode(image) for image in clear[5]])
    assert (change.max(axis=-1) > 25).mean((1, 2)) == pytest.approx(0.3, abs=0.07), "of each camera's lens"


def test_a_replay_disturbs_the_warped_frame_once_whoever_looks(tmp_path):
    recording = replay.load_recording(render_recording(tmp_path / "lake", rows=60))
    lines = replay.reference_lines(recording, by_lane=False)
    views, seen = [], []

    def clear(frame):
        views.append(frame.view)
        return frame.human_steering + 0.05

    def foggy(frame):
        seen.append((frame.received(slice(60, 135)), frame.view, decode(frame.jpeg())))
        return frame.human_steering + 0.05

    replay.drive(recording, lines, 9.0, clear)
    replay.drive(recording, lines, 9.0, foggy, disturbance=Disturbance("rain", 4))
    expected = list(map(Disturber(Disturbance("rain", 4), 0), views))
    for rain, (received, view, sent_so) in zip(expected, seen, strict=True):
        assert np.array_equal(view, rain)
        assert np.array_equal(received, sent_so[60:135])
    assert np.abs(seen[30][2].astype(int) - expected[30]).mean() < 5


def test_episodes_begin_anew_and_rain_falls_in_rainy_weather():
    def images(stage, weather):
        program = Episodes(stage)
        found = []
        for _ in range(2):
            program.start("lake", weather, "day")
            found.append([decode(base64.b64decode(program.state()["image"])) for _ in range(2)])
        return np.array(found)

    noisy = images(Stage("lake", None, 0, {}, Disturbance("noise", 4)), "sunny")
    assert np.array_equal(noisy[0], noisy[1]) and not np.array_equal(noisy[0, 0], noisy[0, 1])
    rainy, foggy = (images(Stage("lake", None, 0, {}), weather) for weather in ("rainy", "foggy"))
    assert not np.array_equal(rainy[0, 0], rainy[0, 1]), "the drops fall"
    assert np.array_equal(foggy[0, 0], foggy[0, 1]), "the haze stands"


def test_an_environment_is_disturbed_by_its_seed_until_another_disturbance_is_chosen():
    env = Drive(disturb="drops:4")
    first, again, other = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    clear = env.reset(options={"disturb": None})[0]
    assert np.array_equal(clear, env.reset()[0])
    assert np.abs(clear.astype(int) - first).mean() > 1
    for wrong in ("hail:3", 3):
        with pytest.raises(SimulatorError, match=r"disturb: .* is not KIND:STRENGTH, such as fog:3; kinds: rain"):
            env.reset(options={"disturb": wrong})


@pytest.mark.parametrize("command", [["drive"], ["record", "x"], ["replay", "x"], ["window"]])
def test_a_wrong_text_is_refused(command, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([*command, "--disturb", "hail:3"])
    assert "--disturb: 'hail:3' is not KIND:STRENGTH, such as fog:3; kinds: rain, fog" in capsys.readouterr().err
