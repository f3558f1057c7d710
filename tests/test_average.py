"""Averaging noisy frames: against the same frames without noise, and in drives."""

import cv2
import numpy as np
import pytest
import real_recordings
from panda3d.core import Point3, TransformState, Vec3

from cloning.lane import average
from cloning.lane.average import Average
from cloning.lane.predict import Step
from cloning.network.network import SHIPPED_MODEL
from cloning.recordings.images import decode
from cloning.recordings.log import read_recording
from cloning.road.disturbances import Disturbance, Disturber, moved
from cloning.road.motion import Stretch
from cloning.road.track import Track
from simulator.benchmark import tasks
from simulator.cameras import Cameras, jpeg
from simulator.driving import drive
from simulator.world import Scene

ROAD = slice(70, 134)  # rows
METRES = 0.6  # from one frame to the next


@pytest.fixture(scope="module")
def driven() -> list[tuple[np.ndarray, Step]]:
    """Frames of a drive along the lake, and how the car moved before each."""
    cameras, track = Cameras(Scene.of("lake", 107), ("center",)), Track("lake")
    poses, found = [track.at(300 + METRES * number) for number in range(60)], []
    for before, pose in zip([poses[0], *poses], poses, strict=False):
        angles = Vec3(np.degrees(pose.heading) - 90, 0, 0)
        frame = cameras.frames(TransformState.make_pos_hpr(Point3(pose.x, pose.y, pose.z), angles))[0]
        found.append((decode(jpeg(frame)), Step(1 / 15, (before.heading - pose.heading) / METRES, METRES)))
    return found


def test_clear_frames_are_left_as_they_are(driven):
    averaged = Average()
    assert all(averaged(frame, step) is frame for frame, step in driven)
    assert averaged.noise < 0.6 * average.LEAST


@pytest.mark.parametrize("grey", [0, 90, 255])
def test_one_frame_without_contrast_has_no_clear_ones_averaged(driven, grey):
    """Such as a black one of a camera that fails for a moment."""
    for at in range(20, 20 + average.TOLD):
        averaged = Average()
        for number, (frame, step) in enumerate(driven):
            seen = np.full_like(frame, grey) if number == at else frame
            assert averaged(seen, step) is seen


@pytest.mark.parametrize(
    ("foul", "pitch", "most"), [("noise:5", 0, 0.7), ("noise:5", 3, 0.7), ("night:5", 0, 0.8), ("snow:4", 0, 0.4)]
)
def test_noisy_frames_become_more_like_those_without_noise(driven, foul, pitch, most):
    """pitch: by how many rows the view goes up and down, as in hills; most: of the error without averaging."""
    averaged, disturber = Average(), Disturber(Disturbance.parse(foul), 1)
    errors = []
    for number, (clear, step) in enumerate(driven):
        frame = moved(clear, (0, pitch * np.sin(number), 0))
        noisy = disturber(frame)
        mean, blurred = averaged(noisy, step), cv2.blur(frame, (3, 3))
        if number > 2 * average.MEMORY:
            # Light that is lost is no noise: what varies is compared, at the same contrast.
            wanted, *seen = (each[ROAD].astype(float).ravel() for each in (blurred, noisy, mean))
            errors.append([1 - np.corrcoef(wanted, each)[0, 1] for each in seen])
    noisy_error, mean_error = np.mean(errors, axis=0)
    assert mean_error < most * noisy_error


def test_a_frames_movement_is_found_unless_the_camera_was_shaken(driven):
    frame, still = driven[30][0], (0.0, 0.0, 0.0)

    def compared(right, down, degrees):
        return average._expected(frame, moved(frame, (right, down, degrees)), still)

    expected, seen = compared(2, -3, 1)
    movement = average._movement(expected, seen)
    assert movement is not None
    assert cv2.absdiff(average._moved(expected, movement), seen).mean() < 0.4 * cv2.absdiff(expected, seen).mean()
    assert average._movement(*compared(0, 5, 0)) is not None and average._movement(*compared(0, 9, 0)) is None
    assert average._movement(expected, np.zeros_like(seen)) is None


def test_a_frame_that_repeats_is_not_averaged_again_and_unknown_movement_averages_nothing(driven):
    averaged, disturber = Average(), Disturber(Disturbance("noise", 5), 1)
    for frame, step in driven[:40]:
        noisy = disturber(frame)
        mean = averaged(noisy, step)
    assert mean is not noisy and averaged(noisy.copy(), Step(1 / 15, 0, METRES)) is mean
    assert averaged.metres == METRES, "since the last new frame"
    other = disturber(frame)
    assert averaged(other, None) is other and averaged.metres == 0


@pytest.mark.skipif(not real_recordings.FOLDERS, reason=real_recordings.MISSING)
@pytest.mark.parametrize("folder", real_recordings.FOLDERS, ids=lambda folder: folder.name)
def test_the_frames_of_real_recordings_are_clear(folder):
    recording = read_recording(folder).take(slice(300))
    stretch, averaged, noise = Stretch.of(recording, slice(0, len(recording))), Average(), []
    for row in range(1, len(recording)):
        metres = stretch.driven[row] - stretch.driven[row - 1]
        bend = (stretch.heading[row] - stretch.heading[row - 1]) / max(metres, 1e-6)
        frame = decode(recording.path(row).read_bytes())
        assert averaged(frame, Step(1 / 15, bend, metres)) is frame
        noise.append(averaged.noise)
    assert np.mean(noise) < 0.75 * average.LEAST


def test_the_shipped_network_drives_better_in_snow(monkeypatch):
    task = next(each for each in tasks.disturbed([5], 25) if each.disturbance == Disturbance("snow", 5))
    conditions = task.conditions(str(SHIPPED_MODEL))._replace(metres=100)
    averaged = drive(conditions, task.road)
    monkeypatch.setattr(Average, "__call__", lambda self, frame, step: frame)
    assert averaged.mean < 0.8 * drive(conditions, task.road).mean
