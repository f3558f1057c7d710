"""Recovery steering against geometry, warped frames against a rendered plane, and `model.py --robust`."""

import shutil
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from commands import SHORT, begun_training, edited, finished_run, refused, same, started_run, trained, weights
from rendered import plane, render_recording, without_files

from cloning.base.frame import ROAD_ROWS
from cloning.browse import analyse
from cloning.lane import recovery
from cloning.lane.reader import LanePosition
from cloning.network.network import CROP, SEEN_SHAPE, Network, load_model
from cloning.road.camera import CAMERA_OFFSETS, FIRST_BONNET_ROW
from cloning.road.motion import AXLE_TO_CAMERA, MPH, REAR_AXLE, WHEELBASE, curvature, steering_for
from cloning.road.warp import with_alpha
from cloning.training import lanes as lanes_module
from cloning.training import light
from cloning.training.lanes import Lanes, Poses
from cloning.training.observations import Observations
from cloning.training.optimizers import Adam
from cloning.training.robust import PoseViews, sample_bends_more, select_known_lane
from model import ROBUST

N, SPEED = 300, 20.0  # rows; mph


def recording(steering, pause_after=None):
    """One drive of N rows, 15 a second, with no files."""
    found = without_files(N, "drive", 1 / 15, steering=steering, throttle=1, speed=SPEED)
    if pause_after is not None:
        found.time[pause_after + 1 :] += 2
    return found


def lanes(monkeypatch, steering=0.0, offset=0.0, trusted=True, **more) -> Lanes:
    """The lanes of a recording that is `offset` metres right of the centre; trusted: which rows' readings."""
    reading = LanePosition.read(np.full(N, offset), np.zeros(N), np.full(N, trusted))
    monkeypatch.setattr(lanes_module, "lane_position", lambda *_: reading)
    return Lanes.of(recording(steering, **more))


def drive_back(lanes: Lanes, bend: float, right: float, yaw: float, metres: float) -> tuple[float, float]:
    """The pose after so many metres of steering by the labels along a lane of constant curvature."""
    step, middle = 0.1, lanes.take(np.array([100]))
    for _ in range(round(metres / step)):
        turn = np.tan(np.radians(25) * float(middle.steering(right, yaw)[0])) / WHEELBASE
        along = step * np.cos(yaw) / (1 - bend * right)
        right, yaw = right + step * np.sin(yaw), yaw + turn * step - bend * along
    return right, yaw


def bend_of_middle(steering: float) -> float:
    """Of the circle that the car's middle goes round, before the rear axle: 1/m."""
    bend = float(curvature(steering))
    return bend / np.hypot(1, REAR_AXLE * bend)


@pytest.mark.parametrize("steering", [0.0, 0.1, -0.5, 0.7])  # of a straight, and of circles down to 9 m
def test_on_the_lanes_centre_the_label_follows_the_lane(monkeypatch, steering):
    found = lanes(monkeypatch, steering)
    expected = float(steering_for(bend_of_middle(steering)))
    assert found.steering(0.0, 0.0)[found.known] == pytest.approx(expected, abs=5e-3)
    assert found.steering(found.offset, found.yaw)[found.known] == pytest.approx(steering, abs=0.05)


@pytest.mark.parametrize("steering", [0.0, 0.3, -0.5])
@pytest.mark.parametrize("right, yaw", [(1.5, 0.1), (-2, 0), (0, -0.15), (-1, 0.1)])
def test_a_shifted_car_comes_back_and_stays(monkeypatch, steering, right, yaw):
    found = lanes(monkeypatch, steering)
    assert np.abs(drive_back(found, float(curvature(steering)), right, yaw, 30)) == pytest.approx([0, 0], abs=0.04)


@pytest.mark.parametrize("bend", [0.0, 1 / 20, -1 / 20])
@pytest.mark.parametrize("offset", [1.0, -1.5])
def test_the_lane_is_as_far_from_the_human_as_was_estimated(monkeypatch, bend, offset):
    """The human keeps `offset` metres right of the lane's centre, round the same middle."""
    human = 1 / np.sqrt((1 / bend - offset) ** 2 - REAR_AXLE**2) * np.sign(bend) if bend else 0.0
    found = lanes(monkeypatch, float(steering_for(human)), offset)
    assert found.offset[found.known] == pytest.approx(1 / bend - 1 / human if bend else offset, abs=3e-3)
    assert found.steering(0.0, 0.0)[found.known] == pytest.approx(float(steering_for(bend)), abs=6e-4)


def test_where_most_is_not_trusted_the_humans_path_is_the_lane_and_that_is_told(monkeypatch, capsys):
    found = lanes(monkeypatch, 0.2, offset=1.0, trusted=np.arange(N) % 2 == 0)
    assert not found.offset.any()
    assert found.steering(found.offset, found.yaw)[found.known] == pytest.approx(0.2, abs=1e-3)
    told = f"line 1: the lane is not seen for certain; in {N} rows from here on, the driven path counts as its centre"
    assert told in capsys.readouterr().out
    lanes(monkeypatch, 0.2, trusted=np.arange(N) % 4 > 0)
    assert not capsys.readouterr().out


def test_the_lane_ahead_is_not_known_before_a_break(monkeypatch):
    found = lanes(monkeypatch, pause_after=149)
    rows = recovery.LOOKAHEAD / (SPEED * MPH / 15)
    missing = np.flatnonzero(~found.known)
    for end in (150, N):
        assert len(missing[(missing < end) & (missing > end - 100)]) == pytest.approx(rows, abs=1)
    assert (found.earlier[150:] >= 150).all()


# --------------------------------------------------------------------------------------------------
# Views


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("right, yaw, camera", [(0, 0, 0), (1.2, 0.1, 2), (-1.5, -0.12, 1), (0.5, -0.1, 0)])
def test_a_view_shows_what_the_camera_would_see_there(monkeypatch, mirrored, right, yaw, camera):
    """Mirrored: what the same camera, with the same roll, would see of the mirrored world."""
    one = lanes(monkeypatch, 0.05, offset=0.4).take(np.array([100]))
    poses = Poses.of(one, np.array([right]), np.array([yaw]), np.array([camera]), np.array([mirrored]))
    side = list(CAMERA_OFFSETS.values())[camera]

    def stood(x, z, heading):  # in the lane's frame
        return plane(
            x + AXLE_TO_CAMERA * np.sin(heading) + side * np.cos(heading),
            z + AXLE_TO_CAMERA * np.cos(heading) - side * np.sin(heading),
            heading,
        )[ROAD_ROWS]

    def read(_, before):
        offset, turned = float(one.offset[0]), float(one.yaw[0])
        if not before:
            return stood(offset, 0, turned)
        x, z, heading = one.moved[0].astype(float)
        return stood(
            offset + x * np.cos(turned) + z * np.sin(turned), -x * np.sin(turned) + z * np.cos(turned), turned + heading
        )

    expected = plane(right + AXLE_TO_CAMERA * np.sin(yaw), AXLE_TO_CAMERA * np.cos(yaw), yaw, mirrored)[
        CROP[0] : FIRST_BONNET_ROW
    ]
    wrong = np.abs(poses.view(0, lambda *frame: with_alpha(read(*frame))).astype(int) - expected).max(2)
    assert np.percentile(wrong[12:], 95) <= 3  # of 255
    assert np.median(wrong[12:]) <= 1
    assert poses.steering[0] == pytest.approx(one.steering(right, yaw)[0] * (-1 if mirrored else 1), rel=1e-6)


def test_sampled_poses_are_on_both_sides_and_of_every_camera(monkeypatch):
    found = lanes(monkeypatch).take(np.full(4000, 100))
    poses = found.sample_poses(ROBUST, np.random.default_rng(0), np.zeros(4000, bool))
    assert np.bincount(poses.camera, minlength=3).min() > 1100
    assert abs(poses.steering.mean()) < 0.002
    for camera in range(3):  # the camera does not tell the side
        assert 0.2 < (poses.steering[poses.camera == camera] > 0).mean() < 0.8


@pytest.mark.parametrize("human", [0.0, 1.5, -1.5])
def test_sampled_poses_are_near_the_lane_and_near_the_recorded_car(monkeypatch, human):
    """Far from the recorded car, little of the warped frame would be seen."""
    found = lanes(monkeypatch, offset=human).take(np.full(2000, 100))
    sampled = Mock(wraps=Poses.of)
    monkeypatch.setattr(Poses, "of", sampled)
    found.sample_poses(ROBUST, np.random.default_rng(0), np.zeros(2000, bool))
    _, offset, yaw, *_ = sampled.call_args.args
    least, most = max(-2.0, human - 2.4), min(2.0, human + 2.4)  # m from the lane's centre and from the recorded car
    assert abs(offset.min() - least) < 0.1 and abs(offset.max() - most) < 0.1
    if human == 0:  # nothing is cut off: a triangle's deviation
        assert offset.std() == pytest.approx(2 / np.sqrt(6), abs=0.03)
    assert np.degrees(np.abs(yaw).max()) <= 25 and np.degrees(yaw.std()) == pytest.approx(8, abs=0.5)


# --------------------------------------------------------------------------------------------------
# The command

OPTIONS = ("--robust", *SHORT)


@pytest.fixture(scope="module")
def finished(sample_recording, tmp_path_factory):
    return finished_run(sample_recording, tmp_path_factory.mktemp("robust"), *OPTIONS)


def test_robust_trains_and_reports_what_was_left_out(finished, sample_recording):
    told, folder = finished
    assert "  repeated, lane ahead unknown  kept" in told
    row = next(line for line in told.splitlines() if line.startswith("total"))
    assert int(row.split()[-1]) == 60 - int(row.split()[-2])
    metres = 2 * recovery.HEADING_CHORD + recovery.LOOKAHEAD  # at the beginning and at the end
    assert int(row.split()[-2]) == pytest.approx(metres / (30.19 * MPH * 0.067), abs=2)
    assert "correlation with the recovery steering" in told
    assert "val_loss is of them and of as many views from other poses" in told
    for name in ("training_generator_LRC_0.png", "training_generator_augmented-0.png"):
        assert (folder / "diagnostic_images" / name).exists()
    arguments = torch.load(folder / "model.pt", weights_only=True)["arguments"]
    recipe = arguments["recipe"]
    assert recipe["name"] == "robust"
    assert (recipe["batch_size"], recipe["learning_rate"]) == (8, 4e-3)  # as given, and as --robust sets it


def test_robust_killed_and_resumed_ends_with_the_same_weights(finished, sample_recording, tmp_path):
    run = started_run(sample_recording, *OPTIONS, "--output", tmp_path / "model.pt", until="Epoch 2")
    run.kill()
    run.wait()
    trained("--output", tmp_path / "model.pt", "--resume")
    for name in ("model.pt", "model-best.pt"):
        assert same(weights(finished[1] / name), weights(tmp_path / name))


def test_a_robust_run_of_an_earlier_version_goes_on_as_it_began(finished, tmp_path):
    shutil.copytree(finished[1], tmp_path, dirs_exist_ok=True)
    figures = ("epochs", "batch_size", "learning_rate", "samples_per_epoch", "repeats")
    optimizer = Adam(Network().parameters())
    with edited(tmp_path / "model-resume.pt") as saved:
        flat = {name: saved["arguments"]["recipe"][name] for name in figures}
        saved["arguments"] = {"recordings": saved["arguments"]["recordings"], "seed": 0, "robust": True, **flat}
        saved["training"]["optimizer"]["state"] = {number: optimizer.zeros(number) for number in range(18)}
    trained("--output", tmp_path / "model.pt", "--resume", "--epochs", 3)
    after = torch.load(tmp_path / "model-resume.pt", weights_only=True)
    recipe = after["arguments"]["recipe"]
    assert [recipe[name] for name in ("name", "optimizer", "momentum", "huber")] == ["robust", "adam", 0.9, None]
    assert recipe["exposure"] == [0.0, 0.0], "dark frames are none other to it"
    assert all("exp_avg_sq" in state for state in after["training"]["optimizer"]["state"].values())


def test_validation_counts_centre_images_and_other_poses_alike(sample_recording, tmp_path):
    run = begun_training(sample_recording, *OPTIONS, "--output", tmp_path / "model.pt")
    with run.pool:
        both, _ = run.validate()
        (center, labels), (warped, other_labels) = run.validation_sets
        run.validation_sets = [(center, labels)]
        plain, _ = run.validate()
        run.validation_sets = [(warped, other_labels)]
        assert both == pytest.approx((plain + run.validate()[0]) / 2, rel=1e-6)
        asked = Mock(side_effect=lambda rows: np.zeros(len(np.unique(rows))))
        run.validation, run.held_out = range(5000), []
        run.recipe = replace(run.recipe, samples_per_epoch=50_000)
        run.validation_sets = [(asked, np.ones(5000))]
        run.predict = lambda network, images, rows: images(rows)
        assert (run.validate()[0], len(*asked.call_args.args)) == (1.0, 4096)
    assert not np.allclose(labels, other_labels)
    assert not np.array_equal(center(np.arange(3)), warped(np.arange(3)))


def test_weather_is_in_front_of_all_else_that_changes_an_image(sample_recording, tmp_path):
    run = begun_training(sample_recording, *OPTIONS, "--disturbed", 1, "--output", tmp_path / "model.pt")
    with run.pool:
        choices, batch = run.generator.sample(0), run.generator.start_batch(0)()
    first, which = np.zeros(1, int), [augmentation.name for augmentation in ROBUST.augmentations].index("brightened")
    view, codes = choices.views.images(first)[which], choices.views.poses[which].disturbance
    brightened = light.brighten(view, CROP[0], *(column[first] for column in choices.augmenting[which]))[0]
    seen = batch.images[choices.slots[0, which]]
    assert np.array_equal(seen, light.disturbed(brightened, int(codes[0]))) and not np.array_equal(seen, brightened)
    example = choices.views.example(0).images[which]
    assert np.array_equal(example, view)


def test_networks_are_measured_as_they_drive(sample_recording, tmp_path):
    """Ordinary frames are dark to this network, which brightens them when it drives, and not when it learns."""
    run = begun_training(sample_recording, *OPTIONS, "--output", tmp_path / "model.pt")
    run.network.exposure = (200.0, 60.0)
    run.files.pictures.mkdir()
    with run.pool:
        run.network.eval()
        run.epoch()
        assert run.network.training
        run.progress.finish_epoch(0.1, 0.1)
        run.save(run.files.last, run.files.best)
        measured, _ = run.validate()
        run.network.train()
        errors = next(line.split() for line in run.summary().splitlines() if line.startswith("steering of 0 to 1 "))
        run.network = load_model(run.files.best)
        assert run.validate()[0] == measured
    assert errors[-1] == errors[-2]


def test_drives_too_short_are_named(tmp_path):
    short = render_recording(tmp_path / "short", rows=20)
    assert "too short" in refused(short, *OPTIONS, "--output", tmp_path / "model.pt")


def test_tints_keep_grey_nearly_grey():
    grey, red = (np.array([100, 100, 100], np.float32), np.array([200, 50, 50], np.float32))
    colours = light.tints(ROBUST, np.random.default_rng(0), 2000)
    assert colours.shape == (2000, 3, 3) and colours.dtype == np.float32
    plain = (colours == np.eye(3)).all((1, 2))
    assert plain.mean() == pytest.approx(1 - ROBUST.tinted, abs=0.03)
    made = (colours @ grey)[~plain]
    assert made.min() >= 100 * 0.5 * 0.85 - 0.1 and made.max() <= 100 * 1.15 * 1.15 + 0.1
    brightness = made.mean(1, keepdims=True)
    assert brightness.min() < 55 and brightness.max() > 110
    assert (made / brightness).std(0) == pytest.approx(0.07, abs=0.02)
    paler = np.ptp(colours[~plain] @ red, axis=1) / 150 / brightness[:, 0] * 100
    assert paler.min() < 0.2 and paler.max() > 1.4


def test_shadows_darken_parts_of_some_images_and_as_many_are_disturbed_as_asked():
    shades = light.sample_shades(ROBUST.shaded, np.random.default_rng(0), 3000)
    assert (shades >= 0).mean() == pytest.approx(ROBUST.shaded, abs=0.03)
    assert shades.min() == -1 and shades.max() == light.SHADES - 1
    disturbances = light.sample_disturbances(0.4, np.random.default_rng(0), 3000)
    assert (disturbances >= 0).mean() == pytest.approx(0.4, abs=0.03)
    assert set(map(light.name_of, disturbances)) == {"", *map(str, light.TRAINED)}
    image = np.full(SEEN_SHAPE, 200, np.uint8)
    same = np.eye(3, dtype=np.float32)
    np.testing.assert_array_equal(light.relight(image, same, -1), image)
    lit = np.stack([light.relight(image, same, number) for number in range(light.SHADES)])
    assert lit.max() == 200 and lit.min() < 40
    in_shade = (lit < 150).any(-1).mean((1, 2))
    assert 0.02 < np.quantile(in_shade, 0.25) < np.quantile(in_shade, 0.75) < 0.9  # neither none nor all of an image
    red, _, blue = lit[lit[..., 0] < 100].mean(0)
    assert blue > 1.2 * red  # the sky lights the shade


@pytest.mark.parametrize("repeats", [1, 4, 36])
def test_problem_areas_are_sampled_so_many_times_as_often(monkeypatch, repeats):
    def part(folder):
        rows = np.arange(50)
        known = lanes(monkeypatch, 0.05).take(rows + 50)
        return Observations.of_rows(without_files(50, folder), rows, rows * 0.0, known)

    both = Observations.of_recordings([part("plain"), part("bend-repetitive")])
    recipe = replace(ROBUST, repeats=repeats)
    chosen = np.concatenate([sample_bends_more(both, recipe, np.random.default_rng(seed)) for seed in range(100)])
    assert (chosen >= 50).mean() == pytest.approx(repeats / (repeats + 1), abs=0.02)


def test_a_pass_samples_rows_by_their_weights_and_mirrors_half_of_the_views(monkeypatch):
    many = lanes(monkeypatch, 0.4)
    both = Lanes.joined([Lanes.unknown(2000), many.take(np.full(2000, 100))])
    n, labels = len(both), both.steering(both.offset, both.yaw)
    everything = Observations.of_rows(recording(0.4), np.full(n, 100), labels, both)
    turn = sample_bends_more(everything, ROBUST, np.random.default_rng(0))
    assert len(turn) == n
    expected = both.weights(ROBUST.straight_weight)[2000:].sum()  # of the rows in a bend
    bend = abs(both.steering(np.zeros(n), np.zeros(n))[-1])  # is its weight, and 0.2 more as of a straight
    assert bend > 0.2 and expected == pytest.approx((0.2 + bend) / (0.4 + bend), rel=1e-5)
    assert (turn >= 2000).mean() == pytest.approx(expected, abs=0.03)
    views = PoseViews(everything, turn, np.zeros(n, int), ROBUST, np.random.default_rng(1))
    for poses in views.poses:
        assert poses.mirrored.mean() == pytest.approx(0.5, abs=0.03)


def test_the_label_is_the_recovery_steering_and_not_the_drivers(monkeypatch):
    """Rows whose lane is 1 m to the left of a car that a human drives straight on."""
    lanes(monkeypatch, offset=1.0)
    selected = select_known_lane(recording(0.0), ROBUST)
    assert (selected.steering < -0.1).all()
    assert selected.steering == pytest.approx(selected.lanes.steering(1.0, 0.0), abs=1e-4)
    assert 0.5 * N < len(selected) < N


def test_copies_of_rows_end_no_stretch(monkeypatch):
    """As in a log in which somebody has repeated the bends."""

    def centred(found, _):
        zeros = np.zeros(len(found))
        return LanePosition.read(zeros, zeros, zeros == 0)

    monkeypatch.setattr(lanes_module, "lane_position", centred)
    driven = recording(0.2)
    repeated = driven.take(np.repeat(np.arange(N), 1 + np.arange(N) % 3))
    plain, copied = (select_known_lane(each, ROBUST) for each in (driven, repeated))
    assert len(plain) > 0.5 * N
    assert np.array_equal(plain.frame, copied.frame) and np.array_equal(plain.steering, copied.steering)


def test_the_page_of_a_recording_shows_the_labels_that_are_learned(monkeypatch):
    """Also beside a mishap, in which no row has one."""
    reading = LanePosition.read(np.full(N, 0.8), np.zeros(N), np.arange(N) // 120 != 1)
    reading.piece[120:240] = recovery.MISHAP
    monkeypatch.setattr(lanes_module, "lane_position", lambda *_: reading)
    monkeypatch.setattr(analyse, "known_position", lambda _: None)
    monkeypatch.setattr(analyse, "localise_recording", lambda *_: (reading, []))
    driven = recording(0.1)
    learned = Lanes.of(driven)
    expected = np.where(learned.known, learned.steering(learned.offset, learned.yaw), np.nan)
    assert np.isfinite(expected[20:100]).all() and np.isnan(expected[120:240]).all()
    np.testing.assert_array_equal(analyse.lane(driven).columns["label"], expected.astype(np.float32))


def test_a_recipe_of_shifts_neither_turns_the_car_nor_changes_the_light():
    lanes, mirrored = Lanes.unknown(200), np.zeros(200, bool)
    unlit = replace(ROBUST, tinted=0.0, shaded=0.0)
    turned, shifted = (
        lanes.sample_poses(recipe, np.random.default_rng(0), mirrored)
        for recipe in (unlit, replace(unlit, pose_yaw=0.0))
    )
    assert (turned.colours == np.eye(3)).all() and (turned.shade == -1).all()
    assert not np.allclose(turned.steering, shifted.steering)
    offsets = np.random.default_rng(0).triangular(-2, 0, 2, 200)
    assert np.allclose(shifted.steering, lanes.steering(offsets, np.zeros(200)))
