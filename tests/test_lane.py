"""The place in the lane: geometry, the shipped network on drawn frames whose place is known, and unknown roads."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import ROOT, draw_recording

from cloning.errors import ModelError
from cloning.lane.place import LIKELY, centre_ahead, placed, read_lane
from cloning.lane.reader import (
    AHEAD,
    MOUNT_OFFSETS,
    STRIP,
    TO_FRAME,
    Lane,
    LaneNetwork,
    combine,
    estimate,
    load,
    normal,
    see,
    strip,
)
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import decode
from cloning.recordings.log import find_folders, logs_below, read_recording
from cloning.road.camera import CAMERA_HEIGHT, CAMERA_MATRIX
from cloning.road.motion import REAR_AXLE, stretches
from cloning.road.track import Track
from simulator.car import STEP
from simulator.record import record
from tools.train_lane import disagreement, draw, in_sight, seen_from

UNSEEN = 1003  # a look that the network was not trained on
REAL = sorted(logs_below(ROOT / "data"))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drawn drive on the lake, as the real one looks: the recording, and how far right of the centre each row is."""
    folder = tmp_path_factory.mktemp("lane") / "lake"
    run = record(folder, Track("lake"), 0.12, 30, seed=3)
    recording = read_recording(folder)
    steps = np.round((recording.time - recording.time[0]) / STEP).astype(int)
    return recording, np.array(run.trajectory.offset)[steps]


def test_a_strip_is_level_and_looks_straight_ahead():
    """The lane's edges on a straight road, seen from its centre, are each other's mirror image."""
    into_strip = np.linalg.inv(TO_FRAME) @ CAMERA_MATRIX
    for ahead in (3, 8, 40):
        left, right = (into_strip @ (side, CAMERA_HEIGHT, ahead) for side in (-3.5, 3.5))
        left, right = left[:2] / left[2], right[:2] / right[2]
        assert left[0] + right[0] == pytest.approx(STRIP[1] - 1, abs=1e-6)
        assert left[1] == pytest.approx(right[1], abs=1e-6)


def test_a_strip_is_the_frame_at_half_the_resolution():
    frame = np.zeros((160, 320, 3), np.uint8)
    pixel = TO_FRAME @ (80, 16, 1)
    cv2.circle(frame, np.round(pixel[:2] / pixel[2]).astype(int).tolist(), 4, (255, 0, 0), -1)
    found = strip(frame)
    assert found.shape == STRIP and found.dtype == np.uint8
    row, column = np.unravel_index(found[..., 0].argmax(), STRIP[:2])
    assert abs(row - 16) <= 2 and abs(column - 80) <= 2


def test_light_and_contrast_are_taken_off():
    rng = np.random.default_rng(0)
    picture = rng.integers(40, 120, STRIP).astype(np.uint8)
    brighter = (picture * 2 + 10).astype(np.uint8)
    assert np.abs(normal(picture) - normal(brighter)).mean() < 0.1
    assert normal(picture).mean((0, 1)) == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_where_the_centre_lies_ahead(direction):
    """On a straight: a camera 1 m right of the centre, turned right by 3 degrees."""
    track = Track("lake", direction)
    straight = np.convolve(np.abs(track.curvature), np.ones(60), "same").argmin()
    place, yaw = track.at(straight * track.step, 1.0), np.radians(3)
    found = centre_ahead(track, straight * track.step, place.x, place.y, place.heading - yaw)
    assert found == pytest.approx(-1 / np.cos(yaw) - AHEAD * np.tan(yaw), abs=0.12)


def test_a_drive_is_placed_on_its_road(drive):
    """By what the network sees, a quarter of it made nonsense."""
    recording, true = drive
    stretch = stretches(recording)[0]
    rows = stretch.rows
    seen = see(recording)[rows]
    rng = np.random.default_rng(0)
    nonsense = rng.random(len(seen)) < 0.25
    seen[nonsense] = rng.uniform(-4, 4, seen[nonsense].shape)
    found = placed(stretch, seen)
    assert (found.track.name, found.track.direction) == ("lake", "ccw")
    assert found.likely > LIKELY
    off = found.place[:, 1] + REAR_AXLE * np.sin(found.place[:, 2]) - true[rows]
    assert np.abs(off).mean() < 0.15
    assert placed(stretch, -seen).likely < LIKELY  # a road that it is not


@pytest.mark.parametrize("pose", [(0.8, 0, 0), (0.3, 4, 0.05), (-1.2, 1, -0.1)])
def test_two_cameras_agree_on_a_straight_road(pose):
    """The centre is a straight line; a second camera stands `pose` (m right, m forward, yaw) from the first."""
    offset, slope = 0.6, 0.04
    right, forward, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    # The line (offset + slope * z, z) in the second camera's axes, at its distances AHEAD.
    z = (AHEAD - (offset - right) * s + forward * c) / (c + slope * s)
    aside = (offset + slope * z - right) * c - (z - forward) * s
    seen = [torch.tensor(values, dtype=torch.float32)[None] for values in (offset + slope * AHEAD, aside)]
    poses = torch.tensor([[*pose, np.inf]], dtype=torch.float32)
    assert float(disagreement(*seen, poses)) == pytest.approx(0, abs=1e-8)
    assert float(disagreement(seen[0], seen[1] + 0.5, poses)) > 0.1


def test_the_ground_moves_with_the_camera():
    """A point of the ground, seen from 0.5 m further right and turned right by 4 degrees, lies where geometry says."""
    into_strip = np.linalg.inv(TO_FRAME) @ CAMERA_MATRIX
    yaw = np.radians(4)
    for right, ahead in ((0.3, 4.0), (-1.0, 9.0)):
        before = into_strip @ (right, CAMERA_HEIGHT, ahead)
        aside = right - 0.5
        there = (aside * np.cos(yaw) - ahead * np.sin(yaw), CAMERA_HEIGHT, ahead * np.cos(yaw) + aside * np.sin(yaw))
        after, carried = into_strip @ there, seen_from(0.5, yaw) @ (before / before[2])
        assert carried[:2] / carried[2] == pytest.approx(after[:2] / after[2], abs=1e-6)
    assert not in_sight(seen_from(1, 0))[-1, -1] and in_sight(seen_from(1, 0))[-1, 0]


@pytest.mark.parametrize("track", ["lake", "jungle"])
@pytest.mark.parametrize("look, error, scale", [(0, 0.35, 0.1), (UNSEEN, 0.7, 0.3)])
def test_the_shipped_network_on_drawn_frames(track, look, error, scale):
    strips, true = draw(track, look, 60, 5)
    found = estimate(strips)
    assert np.nanmean(np.abs(found - true)[:, :3]) < error
    assert np.abs(np.nanmean((found - true)[:, :3])) < 0.15
    for k in range(3):
        assert np.polyfit(true[:, k], found[:, k], 1)[0] == pytest.approx(1, abs=scale)


def test_mirrored_frames_mirror_the_place():
    strips, _ = draw("lake", UNSEEN, 8, 6)
    assert estimate(strips[:, :, ::-1]) == pytest.approx(-estimate(strips), abs=0.02)  # bfloat16
    assert np.array_equal(estimate(strips), estimate(strips))


def test_a_drawn_drive(drive):
    recording, true = drive
    found = read_lane(recording, stretches(recording))
    assert isinstance(found, Lane) and found.offset.dtype == found.yaw.dtype == np.float32
    assert found.offset.shape == found.yaw.shape == found.trusted.shape == (len(recording),)
    assert found.trusted.mean() > 0.9
    rolling = slice(SAMPLE_RATE, None)
    assert np.abs(found.offset - true)[rolling].mean() < 0.25
    assert np.abs(found.yaw).max() < np.radians(12)


def test_the_side_cameras_stand_where_they_are_mounted(drive):
    recording, _ = drive
    strips = np.stack(
        [
            [strip(decode((recording.folder / "IMG" / recording.names[image].decode()).read_bytes())) for image in row]
            for row in recording.images[::4]
        ]
    )
    seen = estimate(strips.reshape(-1, *STRIP)).reshape(-1, 3, len(AHEAD))
    for camera in (1, 2):
        assert (seen[:, 0] - seen[:, camera])[:, :3].mean(0) == pytest.approx(MOUNT_OFFSETS[camera], abs=0.15)


def test_cameras_time_and_way_are_laid_together(drive):
    """What perfect cameras see of a straight road from a car that drives along it, 0.7 m right of the centre."""
    recording, _ = drive
    recording.steering[:], recording.speed[:] = 0, 30
    seen = np.broadcast_to(-0.7 - MOUNT_OFFSETS[:, None], (len(recording), 3, len(AHEAD)))
    found = combine(recording, seen.astype(np.float32))
    assert found.trusted.all()
    assert found.offset == pytest.approx(0.7, abs=1e-3) and found.yaw == pytest.approx(0, abs=1e-3)
    swapped = combine(recording, seen[:, [0, 2, 1]].astype(np.float32))
    assert not swapped.trusted.any()


def test_noise_is_an_unknown_road(tmp_path):
    folder = draw_recording(tmp_path / "noise", rows=40)
    rng = np.random.default_rng(0)
    for path in (folder / "IMG").iterdir():
        cv2.imwrite(str(path), rng.integers(0, 256, (160, 320, 3)).astype(np.uint8))
    recording = read_recording(folder)
    assert read_lane(recording, stretches(recording)).trusted.mean() < 0.1


def test_a_drawing_of_another_kind_is_an_unknown_road(drawn):
    recording = read_recording(drawn)
    assert read_lane(recording, stretches(recording)).trusted.mean() < 0.5


@pytest.mark.skipif(not REAL, reason="no recordings under data/")
def test_real_side_cameras():
    for folder in find_folders([ROOT / "data"]):
        recording = read_recording(folder)
        recording.keep(np.arange(min(len(recording), 600)))
        assert combine(recording, see(recording)).trusted.mean() > 0.5


def test_training_leaves_weights_that_load(tmp_path, drawn):
    output = tmp_path / "lane.pt"
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "tools.train_lane",
            drawn,
            "--looks",
            "1",
            "--frames",
            "6",
            "--steps",
            "2",
            "--output",
            output,
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "step 2/2" in done.stdout
    network = load(output)
    assert isinstance(network, LaneNetwork) and not network.training
    shape = network(torch.zeros(2, *STRIP)).shape
    assert shape == (2, len(AHEAD))


def test_bad_files_are_named(tmp_path):
    with pytest.raises(ModelError, match="no such file"):
        load(tmp_path / "none.pt")
    Path(tmp_path / "bad.pt").write_bytes(b"nothing")
    with pytest.raises(ModelError, match="no weights"):
        load(tmp_path / "bad.pt")
    done = subprocess.run(
        [sys.executable, "-m", "tools.train_lane", tmp_path / "nowhere"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2 and "nowhere" in done.stderr
