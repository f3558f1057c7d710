"""The position in the lane: geometry, the shipped network on rendered frames of known pose, and unknown roads.

Thresholds are about 1.25 times what was measured with bfloat16; with float32 the errors differ by less than 0.003.
"""

import copy
import re
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import real_recordings
import torch
from scenes import Here, recorded
from test_parts import localised

from cloning.base.errors import ModelError, OutputError, RecordingError
from cloning.base.frame import FRAME, ROAD_ROWS
from cloning.lane import parts, reader
from cloning.lane.ahead import centre_ahead
from cloning.lane.localise import SAMPLE, estimate_lane_position, localise_recording
from cloning.lane.reader import (
    DISTANCES_AHEAD,
    MOUNT_OFFSETS,
    STRIP_SHAPE,
    STRIP_TO_FRAME,
    LaneNetwork,
    detect_centres,
    estimate_centres,
    extract_strip,
    fuse_detections,
    load_network,
    read_strips,
)
from cloning.lane.recovery import LanePosition
from cloning.lane.search import MIN_LOG_LIKELIHOOD, Localisation
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import read_frame
from cloning.recordings.log import read_recording
from cloning.road.camera import CAMERA_HEIGHT, CAMERA_MATRIX
from cloning.road.motion import REAR_AXLE, stretches, wrap_angle
from cloning.road.track import Track
from tools import lane_accuracy, lane_frames, likeness, train_lane
from tools.lane_frames import RenderedScene, render_strips
from tools.train_lane import consistency_loss, strip_homography, visible_mask

SHORT_TRAINING = ("--looks", "0", "--roads", "1", "--mountains", "0", "--frames", "3")
UNSEEN = 1003  # a look that the network was not trained on


def test_a_strip_is_the_frames_road_at_half_the_resolution():
    frame = np.random.default_rng(0).integers(0, 100, FRAME).astype(np.uint8)
    pixel = STRIP_TO_FRAME @ (80, 16, 1)
    column, row = np.round(pixel[:2] / pixel[2]).astype(int).tolist()
    cv2.circle(frame, (column, row), 4, (255, 0, 0), -1)
    found = extract_strip(frame)
    assert found.shape == STRIP_SHAPE and found.dtype == np.uint8
    row, column = np.unravel_index(found[..., 0].argmax(), STRIP_SHAPE[:2])
    assert abs(row - 16) <= 2 and abs(column - 80) <= 2
    road = np.zeros_like(frame)
    road[ROAD_ROWS] = frame[ROAD_ROWS]
    assert np.array_equal(extract_strip(road), found), "no other rows matter"


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_where_the_centre_lies_ahead(direction):
    """On a straight: a camera 1 m right of the centre, turned right by 3 degrees."""
    track = Track("lake", direction)
    straight = np.convolve(np.abs(track.curvature), np.ones(60), "same").argmin()
    pose, yaw = track.at(straight * track.step, 1.0), np.radians(3)
    found = centre_ahead(track, straight * track.step, np.array([pose.x, pose.y]), pose.heading - yaw)
    assert found == pytest.approx(-1 / np.cos(yaw) - DISTANCES_AHEAD * np.tan(yaw), abs=0.04)


def test_a_drive_is_localised_on_its_road(lake_drive):
    """By what the network sees, a quarter of it made nonsense."""
    recording, true = lake_drive
    stretch = stretches(recording)[0]
    rows = stretch.rows
    centres = detect_centres(recording)[rows]
    rng = np.random.default_rng(0)
    nonsense = rng.random(len(centres)) < 0.25
    centres[nonsense] = rng.uniform(-4, 4, centres[nonsense].shape)
    found = localised(stretch, centres)
    assert (found.track.name, found.track.direction) == ("lake", "ccw")
    assert found.is_certain()
    assert np.abs(found.middle()[:, 0] - true[rows]).mean() < 0.15  # measured: 0.131
    assert localised(stretch, -centres).log_likelihood < MIN_LOG_LIKELIHOOD  # a road that it is not


def test_a_bend_turns_between_the_rear_axle_and_the_cars_middle():
    """The oracle puts cars onto the jungle's bends by their middle; the axle is beside another place of the road."""
    track, rng = Track("jungle"), np.random.default_rng(0)
    true = np.column_stack([rng.uniform(-2, 2, 300), rng.uniform(-0.3, 0.3, 300)])
    states = []
    for offset, heading_error in true:
        middle = track.at(s := rng.uniform(0, track.length), offset)
        heading = middle.heading - heading_error
        x, y = middle.x - REAR_AXLE * np.cos(heading), middle.y - REAR_AXLE * np.sin(heading)
        beside, right = track.locate(x, y, s)
        states.append((beside, right, wrap_angle(track.at(beside).heading - heading)))
    assert Localisation(track, np.array(states), 0, 0).middle() == pytest.approx(true, abs=0.03)


@pytest.mark.parametrize("pose", [(0.8, 0, 0), (0.3, 4, 0.05), (-1.2, 1, -0.1)])
def test_two_cameras_agree_on_a_straight_road(pose):
    """The centre is a straight line; a second camera stands `pose` (m right, m forward, yaw) from the first."""
    offset, slope = 0.6, 0.04
    right, forward, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    # The line (offset + slope * z, z) in the second camera's axes, at its DISTANCES_AHEAD.
    z = (DISTANCES_AHEAD - (offset - right) * s + forward * c) / (c + slope * s)
    aside = (offset + slope * z - right) * c - (z - forward) * s
    first = torch.tensor(offset + slope * DISTANCES_AHEAD, dtype=torch.float32)[None]
    second = torch.tensor(aside, dtype=torch.float32)[None]
    poses = torch.tensor([[*pose, np.inf]], dtype=torch.float32)
    assert float(consistency_loss(first, second, poses)) == pytest.approx(0, abs=1e-8)
    assert float(consistency_loss(first, second + 0.5, poses)) > 0.1


def test_the_ground_moves_with_the_camera():
    """A point of the ground, seen from 0.5 m further right and turned right by 4 degrees, lies where geometry says."""
    into_strip = np.linalg.inv(STRIP_TO_FRAME) @ CAMERA_MATRIX
    yaw = np.radians(4)
    for right, ahead in ((0.3, 4.0), (-1.0, 9.0)):
        before = into_strip @ (right, CAMERA_HEIGHT, ahead)
        aside = right - 0.5
        there = (aside * np.cos(yaw) - ahead * np.sin(yaw), CAMERA_HEIGHT, ahead * np.cos(yaw) + aside * np.sin(yaw))
        after, carried = into_strip @ there, strip_homography(0.5, yaw) @ (before / before[2])
        assert carried[:2] / carried[2] == pytest.approx(after[:2] / after[2], abs=1e-6)
    assert not visible_mask(strip_homography(1, 0))[-1, -1] and visible_mask(strip_homography(1, 0))[-1, 0]


# m: mean absolute error up to 6.5 m ahead, its mean, and the slope's difference from 1. Measured: 0.193, -0.030, 0.028;
# 0.233, -0.075, 0.017; 0.426, +0.050, 0.234; 0.358, -0.018, 0.106. It learned from a jungle that was too narrow.
@pytest.mark.parametrize(
    "track, look, error, bias, slope",
    [
        ("lake", 0, 0.24, 0.04, 0.036),
        ("lake", UNSEEN, 0.30, 0.095, 0.03),
        ("jungle", 0, 0.53, 0.062, 0.29),
        ("jungle", UNSEEN, 0.45, 0.03, 0.13),
    ],
)
def test_the_shipped_network_on_rendered_frames(track, look, error, bias, slope):
    strips, true = render_strips(RenderedScene(track, look, 60), 5)
    found = estimate_centres(strips)
    assert np.nanmean(np.abs(found - true)[:, :3]) < error
    assert np.abs(np.nanmean((found - true)[:, :3])) < bias
    for k in range(3):
        assert np.polyfit(true[:, k], found[:, k], 1)[0] == pytest.approx(1, abs=slope)


def test_mirrored_frames_mirror_the_position():
    strips, _ = render_strips(RenderedScene("lake", UNSEEN, 8), 6)
    found, mirrored = estimate_centres(strips), estimate_centres(strips[:, :, ::-1])
    assert mirrored == pytest.approx(-found, abs=0.02)  # two steps of bfloat16 at 3 m


def test_a_rendered_drive(lake_drive):
    recording, true = lake_drive
    found = estimate_lane_position(recording, stretches(recording))
    assert isinstance(found, LanePosition) and found.lateral_offset.dtype == found.heading_error.dtype == np.float32
    assert found.lateral_offset.shape == found.heading_error.shape == found.trusted.shape == (len(recording),)
    assert found.trusted.all()
    rolling = slice(SAMPLE_RATE, None)
    assert np.abs(found.lateral_offset - true)[rolling].mean() < 0.17  # measured: 0.136
    assert np.abs(found.heading_error).max() < np.radians(11.5)  # measured: 9.3


def test_a_road_that_no_network_was_trained_on(tmp_path):
    """In a look that none was trained on, with shadows; other such roads have 0.05 to 0.36 m."""
    recording, true = recorded(tmp_path / "road", Track("road-5"), 0.06, 20, look=10105)
    found = estimate_lane_position(recording, stretches(recording))
    error = np.abs(found.lateral_offset - true)
    assert error[SAMPLE_RATE:].mean() < 0.15  # measured: 0.121
    assert found.trusted.mean() > 0.95  # measured: 1


def test_strips_are_those_of_the_rows_asked_for(lake_drive):
    assert np.array_equal(read_strips(lake_drive[0], slice(5, 9)), read_strips(lake_drive[0], slice(0, 10))[5:9])


def test_a_long_recordings_strips_are_never_all_in_memory(lake_drive, monkeypatch):
    recording, driven, sizes = lake_drive[0], stretches(lake_drive[0]), []
    kept = estimate_lane_position(recording, driven)

    def read(*arguments):
        sizes.append(len(strips := read_strips(*arguments)))
        return strips

    monkeypatch.setattr("cloning.lane.localise.read_strips", read)
    monkeypatch.setattr("cloning.lane.localise.KEPT_STRIPS", 0)
    monkeypatch.setattr("cloning.lane.localise.DETECTED_ROWS", 16)
    found = estimate_lane_position(recording, driven)
    assert np.array_equal(found.lateral_offset, kept.lateral_offset) and sizes[0] == 16 < len(recording)


def test_cameras_and_rows_are_fused(lake_drive):
    """Perfect detections of a straight road from a car that drives along it, 0.7 m right of the centre."""
    recording = copy.deepcopy(lake_drive[0])
    recording.steering[:], recording.speed[:] = 0, 30
    seen = np.broadcast_to(-0.7 - MOUNT_OFFSETS[:, None], (len(recording), 3, len(DISTANCES_AHEAD)))
    found = fuse_detections(recording, seen.astype(np.float32))
    assert found.trusted.all()
    assert found.lateral_offset == pytest.approx(0.7, abs=1e-6) and found.heading_error == pytest.approx(0, abs=1e-6)
    narrow = fuse_detections(recording, (0.6 * seen).astype(np.float32))  # as of a road that is wider than it seems
    assert narrow.trusted.all() and narrow.lateral_offset == pytest.approx(0.7 * 0.6**0.5, abs=0.005)
    for wrong in (seen[:, [0, 2, 1]], 0.2 * seen):
        assert not fuse_detections(recording, wrong.astype(np.float32)).trusted.any()


@pytest.mark.parametrize("known", [0, 60])
@pytest.mark.parametrize(("difference", "which"), [(0.5, 1), (-0.5, 1), (0.05, 0)])
def test_an_unknown_road_is_read_by_the_network_for_any_road(lake_drive, difference, which, known, monkeypatch):
    """Though the one for the tracks is trusted in more rows; where both agree, that one counts.

    It is all of the recording, or what follows a drive on a known track.
    """
    recording = copy.deepcopy(lake_drive[0])
    recording.steering[:], recording.speed[:] = 0, 30
    recording.time[known:] += 100 * (known > 0)
    of_tracks = np.broadcast_to(-0.7 - MOUNT_OFFSETS[:, None], (len(recording), 3, 5)).astype(np.float32)
    of_any_road = of_tracks + difference
    of_any_road[known : known + 20, 1] += 1
    found, networks = (of_tracks, of_any_road), (LaneNetwork(), LaneNetwork())
    detections = iter(found)
    track = Track("lake")
    states = np.tile([track.straight(30) + 15, -0.2, 0.0], (known, 1))
    parts = [(slice(0, known), Localisation(track, states, 0, 0))] if known else []
    monkeypatch.setattr("cloning.lane.localise.localise_all", lambda *_: iter(parts))
    strips = np.zeros((len(recording), 3, *STRIP_SHAPE), np.uint8)
    position, localised = localise_recording(
        recording, stretches(recording), lambda _: next(detections), strips.__getitem__, networks
    )
    assert localised == parts and position.trusted.all() == (which == 0)
    wanted = fuse_detections(recording, found[which]).lateral_offset
    wanted[:known] = -0.2
    assert position.lateral_offset[:known] == pytest.approx(wanted[:known], abs=1e-3)
    assert np.array_equal(position.lateral_offset[known:], wanted[known:])
    assert position.placed[:known].all() and not position.placed[known:].any()


@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("real", [False, *real_recordings.FOLDERS], ids=str)
def test_images_with_red_and_blue_exchanged_are_told(lake_drive, real, exchanged, tmp_path, capsys):
    whole = read_recording(real) if real else lake_drive[0]
    recording = whole.take(np.linspace(0, len(whole) - 1, SAMPLE).astype(int))  # the rows by which it is told
    changed = replace(recording, folder=tmp_path)
    (tmp_path / "IMG").mkdir()
    for row, camera in np.ndindex(len(recording), 3):
        image = read_frame(recording.path(row, camera))  # RGB
        cv2.imwrite(str(changed.path(row, camera)), image if exchanged else image[..., ::-1])
    estimate_lane_position(changed, [])
    assert ("red and blue exchanged" in capsys.readouterr().out) == exchanged


@pytest.mark.skipif(not real_recordings.FOLDERS, reason=real_recordings.MISSING)
@pytest.mark.parametrize("folder", real_recordings.FOLDERS, ids=lambda folder: folder.name)
def test_real_recordings_are_trusted(folder):
    recording = read_recording(folder).take(slice(600))
    trusted = fuse_detections(recording, detect_centres(recording)).trusted.mean()
    assert trusted > (0.98 if "lake" in folder.name else 0.7)  # measured: 1 on two lakes, 0.84 and 0.76 on two jungles


def test_training_leaves_weights_that_load(tmp_path, sample_recording, monkeypatch, capsys):
    shipped = reader.SHIPPED_WEIGHTS.read_bytes()
    monkeypatch.setattr(lane_frames, "started_workers", Here)
    monkeypatch.setattr(train_lane, "one_thread", lambda: None)  # other tests have theirs
    monkeypatch.chdir(tmp_path)
    assert train_lane.main([str(sample_recording), *SHORT_TRAINING, "--steps", "2"]) == 0
    assert "step 2/2" in capsys.readouterr().out
    assert reader.SHIPPED_WEIGHTS.read_bytes() == shipped  # no run changes a tracked file
    network = load_network(tmp_path / "lane.pt")
    assert isinstance(network, LaneNetwork) and not network.training
    shape = network(torch.zeros(2, *STRIP_SHAPE)).shape
    assert shape == (2, len(DISTANCES_AHEAD))
    # Trained on, for a step on one road, at so low a rate that the weights stay as they are.
    options = (*SHORT_TRAINING, "--steps", "1", "--start", "lane.pt")
    assert train_lane.main([*options, "--rate", "1e-9", "--output", "on.pt"]) == 0
    name = "dense.2.weight"
    assert torch.equal(load_network(tmp_path / "on.pt").state_dict()[name], network.state_dict()[name])


def test_unusable_weights_are_named_with_the_remedy_and_those_of_earlier_versions_load(tmp_path):
    path = tmp_path / "bad.pt"

    def refused(message):
        load_network.cache_clear()
        with pytest.raises(ModelError, match=f"bad\\.pt: {message}.*python -m tools.train_lane"):
            load_network(path)

    refused("no such file")
    weights = torch.load(reader.SHIPPED_WEIGHTS, weights_only=True)
    weights["dense.2.bias"] += 0.01
    torch.save(weights, path)
    refused(".*digest")
    del weights["digest"]  # as of an earlier version
    torch.save(weights, path)
    assert torch.equal(load_network(path).state_dict()["dense.2.bias"], weights["dense.2.bias"].float())
    weights["dense.2.bias"][0] = torch.nan
    torch.save(weights, path)
    refused("holds no weights .*dense\\.2\\.bias.*not finite")


def test_a_damaged_image_is_named(copied):
    damaged = sorted((copied / "IMG").glob("left*"))[3]
    damaged.write_bytes(damaged.read_bytes()[:-200])
    with pytest.raises(RecordingError, match=f"{damaged.name}: cut short"):
        detect_centres(read_recording(copied))


def test_what_a_network_may_notice_of_a_frame_is_measured():
    flat, sharp = np.full((1, 20, 30, 3), (40, 20, 20), np.uint8), np.full((1, 20, 30, 3), 100, np.uint8)
    sharp[:, :, 15:] = 200
    assert likeness.measures(flat).tolist() == [100, 127.5 + 0.5, 0, 0]  # dark, half saturated
    dark, saturation, edges, laplacian = likeness.measures(sharp)
    assert (dark, saturation) == (0, 0) and edges == pytest.approx(100 / 30) and laplacian > 100


def test_rendered_frames_are_like_themselves(lake_drive, tmp_path, monkeypatch, capsys):
    """The table of differences, of a rendered recording against the same places rendered again."""
    recording, _ = lake_drive
    monkeypatch.setattr("cloning.lane.parts.WINDOW", len(recording) // 2)  # the drive is short
    picture = tmp_path / "both.png"
    monkeypatch.setitem(parts.ANCHOR_TURN_RESIDUAL, "lake", ((0, 1), (0.5, 0.5)))
    assert likeness.main([str(recording.folder), "--frames", "8", "--picture", str(picture)]) == 0
    table = capsys.readouterr().out
    assert table.startswith(f"lake, ccw, {len(stretches(recording)[0])} rows\n")
    shown: Any = cv2.imread(str(picture))
    assert shown.shape == (8 * FRAME[0], 6 * FRAME[1], 3)
    assert likeness.main([str(recording.folder), "--frames", "8", "--look", "3"]) == 0
    same, other = (float(re.findall(r"mean difference ([\d.]+)", text)[0]) for text in (table, capsys.readouterr().out))
    assert same < 5 and other > 2 * same  # not 0, because so short a drive is placed only to some metres


def test_an_output_in_no_folder_is_refused_before_the_training(tmp_path):
    with pytest.raises(OutputError, match="no such folder"):
        train_lane.main(["--output", str(tmp_path / "nowhere" / "lane.pt")])


def test_a_training_without_any_road_is_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        train_lane.main(["--looks", "0", "--roads", "0", "--mountains", "0"])
    assert "are all 0: nothing to render" in capsys.readouterr().err


def test_the_accuracy_on_a_recording_is_printed(lake_drive, capsys):
    """The side cameras appear to be where they are mounted, and the car as far off the centre as it was driven."""
    recording, true = lake_drive
    assert lane_accuracy.main(["--laps", "0", str(recording.folder)]) == 0
    printed = capsys.readouterr().out
    assert f"{len(recording)} rows" in printed
    for side, mounted in (("left", MOUNT_OFFSETS[1]), ("right", MOUNT_OFFSETS[2])):
        [appears] = re.findall(rf"{side} camera appears to be at +([-+.\d]+) ±", printed)
        assert float(appears) == pytest.approx(mounted, abs=0.04)
    [offset] = re.findall(r"lateral offset +([.\d]+) m", printed)
    assert float(offset) == pytest.approx(np.abs(true).mean(), abs=0.15)


def test_how_certain_readings_are_is_counted():
    error, certain = np.array([0.1, -0.4, 0.2, 2.0]), np.array([True, True, True, False])
    assert lane_accuracy.certainty(error, certain) == "certain 75.0%, 66.7% of them within 0.3 m"
    assert lane_accuracy.certainty(error, ~certain) == "certain 25.0%, 0.0% of them within 0.3 m"
