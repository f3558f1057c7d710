"""Foul weather and faulty cameras: deterministic, stronger by strength, wherever frames are disturbed, and measured."""

import base64
import io
import json

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes import Here
from steer_server import STEER, Server

from cloning.base.errors import SimulatorError, UserError
from cloning.network.network import SEEN_ROWS, SHIPPED_MODEL
from cloning.recordings.images import decode, read_frame
from cloning.recordings.log import read_recording
from cloning.recordings.writer import RecordingWriter
from cloning.replay import replay
from cloning.replay.model_driver import ModelDriver
from cloning.road.autonomy import LIMITS
from cloning.road.disturbances import HELD_OUT, KINDS, Disturbance, Disturber, disturb
from cloning.road.track import Track
from cloning.training import light
from simulator import driving, record
from simulator.__main__ import main
from simulator.cameras import jpeg
from simulator.correct import CorrectedClient
from simulator.dialects import Episodes, Stage
from simulator.environment import Drive
from simulator.run import Run
from tools import robustness

IMAGE_KINDS = [kind for kind in KINDS if kind not in ("dropped", "late")]
# Mean grey levels by which each of them changes a frame
CHANGES = [10.64, 67.65, 42.05, 96.98, 60.16, 10.6, 3.53, 2.88, 3.7, 43.12]
CHANGES += [20.6, 98.07, 91.93, 34.69, 4.36, 2.63, 10.88, 8.89, 10.35, 6.77]


@pytest.fixture(scope="module")
def frames(sample_recording):
    return [decode(path.read_bytes()) for path in sorted((sample_recording / "IMG").glob("center*.jpg"))[:12]]


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_disturbs_a_drive_in_the_same_way(kind, frames):
    first, second = ([*map(Disturber(Disturbance(kind, 4), 7), frames)] for _ in range(2))
    assert all(np.array_equal(one, other) for one, other in zip(first, second, strict=True))
    assert all(seen.dtype == np.uint8 and seen.shape == frames[0].shape for seen in first)


@pytest.mark.parametrize("kind", IMAGE_KINDS)
def test_a_stronger_disturbance_leaves_less_of_the_frame(kind, frames):
    before = frames[0].copy()

    def likeness(strength):
        seen = [disturb(before, Disturbance(kind, strength), seed) for seed in range(6)]
        if kind == "underexposed":  # what is lost is its steps
            return len(np.unique(seen[0]))
        return np.mean([np.corrcoef(before.ravel(), each.ravel())[0, 1] for each in seen])

    mild, middling, strong = map(likeness, (1, 3, 5))
    assert mild > middling > strong
    assert np.array_equal(before, frames[0]), "the frame itself is not changed"


def test_strength_3_changes_a_frame_by_as_much_as_in_version_3_of_the_rules(frames):
    changes = [cv2.absdiff(disturb(frames[0], Disturbance(kind, 3), 0), frames[0]).mean() for kind in IMAGE_KINDS]
    assert changes == pytest.approx(CHANGES, rel=0.005)


def test_strength_3_is_that_of_the_benchmarks(frames):
    """Hendrycks and Dietterich's and perturbation-drive's: contrast 0.2, JPEG 15, discs of 6, noise 0.18 to 0.22."""
    grey = np.full((160, 320, 3), 128, np.uint8)
    assert disturb(grey, Disturbance("noise", 3), 0).std() / 255 == pytest.approx(0.2, abs=0.02)
    seen = disturb(frames[0], Disturbance("contrast", 3), 0)
    assert seen.std((0, 1)) / frames[0].std((0, 1)) == pytest.approx(0.2, abs=0.02)
    dot = np.zeros((160, 320, 3), np.uint8)
    dot[80, 160] = 255
    spread = np.argwhere(disturb(dot, Disturbance("defocus", 3), 0)[..., 0])
    assert np.ptp(spread, axis=0).tolist() == [12, 12]
    red, file = frames[0] // np.array([1, 2, 4], np.uint8), io.BytesIO()  # so that swapped colours show
    Image.fromarray(red).save(file, "JPEG", quality=15)
    assert cv2.absdiff(disturb(red, Disturbance("jpeg", 3), 0), np.array(Image.open(file))).mean() < 1


def test_drops_and_dirt_stay_where_they_are_and_rain_falls():
    grey = np.full((160, 320, 3), 128, np.uint8)
    for kind in ("dirt", "occluded", "fog", "sun", "rain", "noise"):
        disturber = Disturber(Disturbance(kind, 3), 5)
        assert np.array_equal(disturber(grey), disturber(grey)) == (kind not in ("rain", "noise")), kind
    other = Disturber(Disturbance("dirt", 3), 6)(grey)
    assert not np.array_equal(Disturber(Disturbance("dirt", 3), 5)(grey), other), "another drive has other dirt"


def test_frames_come_late_or_not_at_all(frames):
    late = [*map(Disturber(Disturbance("late", 3)), frames)]
    assert all(np.array_equal(seen, frames[max(0, i - 3)]) for i, seen in enumerate(late))
    dropped = Disturber(Disturbance("dropped", 3), 1)
    numbered = [np.full((4, 4, 3), i % 256, np.uint8) for i in range(2000)]
    seen = np.array([dropped(frame)[0, 0, 0] for frame in numbered])
    shown = np.array([frame[0, 0, 0] for frame in numbered])
    assert np.mean(seen != shown) == pytest.approx(0.6, abs=0.03)
    assert seen[0] == 0


def test_a_third_of_the_kinds_is_held_out():
    assert set(HELD_OUT) < set(KINDS)
    assert len(HELD_OUT) >= len(KINDS) // 3


OTHER_ROWS = {"contrast": 18, "defocus": 1.7, "pixelated": 1.6, "shifted": 25, "turned": 40, "shaken": 25}
ALIKE = {disturbance.kind for disturbance in light.TRAINED} - set(OTHER_ROWS)


@pytest.mark.parametrize("kind", sorted(ALIKE))
def test_a_training_image_is_disturbed_as_the_same_part_of_a_frame(kind, frames):
    """But for its edges, which are compressed together with other rows of a frame."""
    which, inner = light.TRAINED.index(Disturbance(kind, 4)), slice(4 + 1, 4 + 64 - 1)  # of whole blocks of 16 rows
    for drive in range(5):
        whole = decode(jpeg(disturb(frames[0], Disturbance(kind, 4), drive)))
        made = light.disturbed(frames[0][SEEN_ROWS], which << 20 | drive << 10)
        assert np.array_equal(made[inner], whole[SEEN_ROWS][inner])


@pytest.mark.parametrize("kind, most", OTHER_ROWS.items())
def test_a_training_image_is_nearly_that_of_a_frame_whose_other_rows_count(kind, most, frames):
    """By its own rows alone, contrast and large pixels are 20 and 2.3 of 255 away."""
    code = light.TRAINED.index(Disturbance(kind, 5)) << 20
    for frame in frames:
        expected = decode(jpeg(disturb(frame, Disturbance(kind, 5), 0)))[SEEN_ROWS].astype(int)
        assert np.abs(light.disturbed(frame[SEEN_ROWS], code) - expected).mean() < most


@pytest.mark.parametrize("text", ["fog", "fog:0", "fog:6", "fog:x", "smog:3", "fog:3:1", ""])
def test_what_is_no_disturbance_is_refused(text):
    with pytest.raises(ValueError, match=r"is not KIND:STRENGTH, such as fog:3; kinds: rain, fog"):
        Disturbance.parse(text)
    assert str(Disturbance.parse("fog:3")) == "fog:3"


# ----------------------------------------------------------------------------------------------------------------------
# Where they are used: in drives, recordings, replays, other programs' episodes, Gymnasium and tools.robustness


def sent(tmp_path, *options):
    """The images that a server gets in a short drive, and the drive's report."""
    images, report = [], tmp_path / "report.json"

    def steer(packet, n):
        images.append(base64.b64decode(json.loads(packet[2:])[1]["image"]))
        return [STEER % (f"{0.02 * (n * 7919 % 5 - 2):.3f}", "0.7")]

    with Server(steer) as server:
        words = ["drive", "--laps", "0.01", "--port", str(server.port), "--report", str(report), *options]
        assert main(words) == 0
    return images, json.loads(report.read_text(encoding="utf-8"))


def test_late_lost_and_rainy_frames_reach_the_driver_so_and_the_report_says_it(tmp_path, capsys):
    clear, report = sent(tmp_path)
    assert "disturbance" not in report and report["departures"] == []
    late, again = sent(tmp_path, "--disturb", "late:3")
    assert len(late) == len(clear) > 20
    assert late == [clear[max(0, i - 3)] for i in range(len(late))]
    assert again.pop("disturbance") == "late:3"
    assert {key for key in again if again[key] != report[key]} <= {"round_trip_ms", "own_ms_a_frame"}, "the same drive"
    assert "disturbance: late:3\n" in capsys.readouterr().out
    lost, _ = sent(tmp_path, "--disturb", "dropped:3")
    repeated = [i for i in range(1, len(lost)) if lost[i] == lost[i - 1]]
    assert 0.3 < len(repeated) / len(lost) < 0.8
    assert all(lost[i] == clear[i] for i in range(len(lost)) if i not in repeated)
    rain, again = (sent(tmp_path, "--disturb", "rain:4")[0] for _ in range(2))
    assert rain == again != clear


def test_a_recording_shows_the_disturbance_in_all_cameras_and_is_the_same_again(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "started_workers", Here)

    def recorded(name, *options):
        record._cameras.cache_clear()
        assert main(["record", str(tmp_path / name), "--laps", "0.004", *options]) == 0
        recording = read_recording(tmp_path / name)
        return [[recording.path(row, camera).read_bytes() for camera in range(3)] for row in range(len(recording))]

    clear = recorded("clear")
    assert recorded("late", "--disturb", "late:2") == [clear[max(0, i - 2)] for i in range(len(clear))]
    dirty = recorded("dirty", "--disturb", "dirt:4")
    assert dirty == recorded("again", "--disturb", "dirt:4")
    change = np.abs(np.array([decode(image) for image in dirty[5]]).astype(int) - [decode(image) for image in clear[5]])
    assert (change.max(axis=-1) > 25).mean((1, 2)) == pytest.approx(0.3, abs=0.07), "of each camera's lens"


def test_a_replay_disturbs_the_warped_frame_once_whoever_looks(sample_recording):
    recording = replay.load_recording(sample_recording)
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
        program, found = Episodes(stage), list[list[np.ndarray]]()
        for _ in range(2):
            program.start("lake", weather, "day")
            found.append([])
            for _ in range(2):
                found[-1].append(decode(base64.b64decode(program.state()["image"])))
                program.seen = -1.0  # drawn again, as after a step
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


def test_drives_and_replays_are_measured_once_and_a_run_goes_on(sample_recording, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(robustness, "started_workers", Here)
    words = ["--kinds", "late", "--strengths", "5", "--tracks", "lake", "--laps", "0.01"]
    words += ["--recordings", str(sample_recording), "--output", str(tmp_path / "found")]
    assert robustness.main(words) == 0
    file = tmp_path / "found" / "robustness.json"
    found = json.loads(file.read_text(encoding="utf-8"))
    assert len(found) == 6 and all(name.startswith("shipped ") for name in found)
    assert all(f", rules {robustness.VERSION}, " in name for name in found), "what others gave is driven anew"

    def of(words):
        return next(name for name in found if name.endswith(words))

    late = of(" lake cw, 30 mph, look 0, 0.01 laps, late:5")
    conditions = driving.Conditions(str(SHIPPED_MODEL), 30, 0, "cw", 0.01 * Track("lake").length, seed=1)
    alone = driving.drive(conditions._replace(set_back=True, disturbance=Disturbance("late", 5)), "lake")
    assert found[late] == {"autonomy": 100, "departures": 0, "distance": round(alone.mean, 3)}
    replayed = found[of(f"{sample_recording}, late:5")]
    recording, driver = replay.load_recording(sample_recording), ModelDriver(str(SHIPPED_MODEL))
    lines = replay.reference_lines(recording)
    done = replay.drive(recording, lines, LIMITS[-1], driver, disturbance=Disturbance("late", 5))
    assert replayed["distance"] == pytest.approx(np.abs(done.offset).mean(), abs=1e-3), "corrected as in drives"
    for course in (" lake cw, 30 mph, look 0, 0.01 laps", f"{sample_recording}"):
        assert found[of(f"{course}, clear")]["distance"] != found[of(f"{course}, late:5")]["distance"]
    assert (tmp_path / "found" / "robustness.png").read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()

    found[late]["departures"] = 9
    missing = of("lake cw, 30 mph, look 0, 0.01 laps, clear")
    file.write_text(json.dumps({name: found[name] for name in found if name != missing}), encoding="utf-8")
    assert robustness.main(words) == 0
    assert json.loads(file.read_text(encoding="utf-8")) == found, "only what was missing is driven"
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "found" / "robustness.md").read_text(encoding="utf-8")
    assert "| late (held out) | 100.0 %, 9, " in printed
    assert "| **held out: kinds without a departure** | 0 of 1 |" in printed
    file.write_text("{", encoding="utf-8")
    with pytest.raises(UserError, match=r"robustness\.json: damaged .*; delete it, and start again"):
        robustness.main(words)


def test_late_frames_of_a_recorded_drive_are_none_of_the_drive_before(tmp_path):
    late, run = Disturbance("late", 5), Run(Track("road-1"), "autonomous")
    for name, disturbance in (("clear", None), ("late", late)):
        record.record(tmp_path / name, Track("road-1"), 0.12, recovery=True, disturbance=disturbance)
    clear, disturbed = (read_recording(tmp_path / name) for name in ("clear", "late"))
    row = int(np.diff(clear.time).argmax()) + 1  # the first of another return
    assert (read_frame(disturbed.path(row)) == read_frame(clear.path(row))).all()
    with RecordingWriter(tmp_path / "corrections") as recording:
        client = CorrectedClient(run, driving.scene_of("road-1", 0), 9, recording, "", 0, 1, late)
        for cameras in (client.cameras, client.recorded):
            cameras.frames(run.car.node.get_transform())
        run.offset = 2.0
        client.next_frame()
        assert not client.recorded.disturbers[0].shown and not client.cameras.disturbers[0].shown
