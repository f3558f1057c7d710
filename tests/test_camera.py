"""The car's trajectory and the cameras' geometry, against geometry worked out otherwise, and warped frames."""

import numpy as np
import pytest
import real_recordings
from rendered import plane

from cloning.recordings.log import read_recording
from cloning.replay.views import StretchViews
from cloning.road import camera, motion, warp


@pytest.mark.parametrize("pose", [(0.8, 0, 0), (-1.2, 0, 0), (0, 1.5, 0), (0, 0, 0.1), (0.9, 0.5, -0.12)])
def test_a_warped_frame_is_what_is_seen_from_there(pose):
    made, seen = warp.warp(plane(0, 0, 0), *pose)
    expected = plane(*pose)
    near = seen & (np.arange(160) > 72)[:, None]  # further away a pixel covers metres
    assert near[75:135].mean() > 0.82  # measured: 0.856 to 1
    assert (made[:50] == 127).all(), "the sky"
    difference = np.abs(made.astype(int) - expected)[near]
    assert difference.mean() < 0.36 and np.percentile(difference, 99) < 4  # measured: 0.282, 3


def test_unseen_pixels_are_marked_and_the_bonnet_is_not_road():
    frame = np.zeros((160, 320, 3), np.uint8)
    _, seen = warp.warp(frame, 0, 0, 0)
    assert seen[2:134, 2:-2].all() and not seen[136:].any()
    _, seen = warp.warp(frame, 1.5, 0, 0)  # to the right: its right is unknown
    assert not seen[120, 300] and seen[120, 20]


def test_the_ground_is_projected_where_it_is_warped_from():
    """A point 10 m ahead and 2 m to the right is seen in the middle of the road from 2 m to the right."""
    near, far = camera.project_ground(np.array([2.0, 0.0]), np.array([10.0, 10.0]))
    ground, _ = camera.homographies(2, 0, 0)
    moved = ground @ [*near, 1]
    assert moved[:2] / moved[2] == pytest.approx(far, abs=1e-9)


def test_a_camera_is_where_the_cars_pose_and_its_mounting_put_it():
    """In a trajectory's frame (right, forward) and on a track (x east, y north), against complex numbers."""
    yaw, axle, offset = 0.3, np.array([2.0, -1.0]), 0.825
    turned = (motion.AXLE_TO_CAMERA - 1j * offset) * np.exp(-1j * yaw)  # forward real, left imaginary
    found = camera.camera_position(axle, motion.forward_vector(yaw), offset)
    assert found == pytest.approx(np.add(axle, [-turned.imag, turned.real]))
    turned = (motion.AXLE_TO_CAMERA - 1j * offset) * np.exp(1j * yaw)  # east real, north imaginary
    found = camera.camera_position(axle, np.array([np.cos(yaw), np.sin(yaw)]), offset)
    assert found == pytest.approx(np.add(axle, [turned.real, turned.imag]))


def test_the_curvature_of_a_steering():
    steering = np.linspace(-1, 1, 21)
    assert motion.steering_for(motion.curvature(steering)) == pytest.approx(steering)
    assert motion.curvature(1.0) == pytest.approx(np.tan(np.radians(25)) / 2.87)


def test_a_constant_steering_drives_a_circle(sample_recording):
    recording = read_recording(sample_recording)
    recording.steering[:], recording.speed[:] = 0.5, 20
    path = motion.Stretch.of(recording, slice(0, len(recording)))
    radius = 1 / motion.curvature(0.5)
    assert np.hypot(path.right - radius, path.forward) == pytest.approx(radius, rel=1e-3)
    assert path.heading == pytest.approx(path.driven / radius)
    assert path.driven[-1] == pytest.approx(20 * motion.MPH * (recording.time[-1] - recording.time[0]))


def test_the_car_follows_its_wheels_with_a_lag(sample_recording):
    recording = read_recording(sample_recording)
    recording.steering[:], recording.speed[:] = 0.0, 20
    recording.steering[20:] = 0.5
    path = motion.Stretch.of(recording, slice(0, len(recording)))
    turning = np.diff(path.heading) / np.diff(path.driven)
    seconds = recording.time[21:] - recording.time[20]
    assert not turning[:20].any()
    assert turning[20:] == pytest.approx(motion.curvature(0.5) * (1 - np.exp(-seconds / motion.YAW_LAG)), rel=1e-6)
    assert path.slip == pytest.approx(-motion.SLIP * turning * (20 * motion.MPH) ** 2), "to the outside of the bend"


def test_breaks_are_not_driven_over(sample_recording):
    recording = read_recording(sample_recording).take(np.tile(np.arange(60), 4), time=np.arange(240) / 15)

    def rows():
        return [stretch.rows for stretch in motion.stretches(recording)]

    assert rows() == [slice(0, 240)]
    recording.time[100:] += 5  # a gap
    recording.speed[150:160] = 0.1  # it stands; before and after, it stops and starts more quickly than a car can
    assert rows() == [slice(0, 100), slice(100, 150), slice(160, 240)]
    recording.speed[200] = 9  # set back
    assert rows()[-1] == slice(201, 240)
    recording.speed[:] = 2  # mph, less than 1 m/s
    assert rows() == []


@pytest.mark.skipif(not real_recordings.FOLDERS, reason=real_recordings.MISSING)
@pytest.mark.parametrize("folder", real_recordings.FOLDERS, ids=lambda folder: folder.name)
def test_a_real_centre_frame_warped_to_the_side_cameras_is_theirs(folder):
    recording = read_recording(folder)
    straight = np.flatnonzero(np.abs(recording.steering) < 0.05)[::40]
    views = StretchViews(recording, motion.Stretch.of(recording, slice(0, len(recording))))
    gains = []
    for at in straight:
        for which, side in ((1, camera.CAMERA_OFFSETS["left"]), (2, camera.CAMERA_OFFSETS["right"])):
            truth, before = views.frame(int(at), which).astype(int), views.frame(int(at), 0).astype(int)
            made, seen = warp.warp(views.frame(int(at), 0), side, 0, 0)
            road = seen & (np.arange(160) >= 66)[:, None]
            gains.append(np.abs(before - truth)[road].mean() / np.abs(made.astype(int) - truth)[road].mean())
    assert np.median(gains) > 1.65  # measured: 2.12 to 2.46
