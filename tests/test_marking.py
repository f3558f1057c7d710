"""The line painted along a road's centre: where it is found in strips, and how exactly it locates a drive."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cloning.lane import marking
from cloning.lane.place import place, shipped_networks
from cloning.lane.reader import DIRECTION_TO_STRIP, MOUNT_OFFSETS, STRIP_SHAPE, estimate_centres, read_strips
from cloning.recordings.log import read_recording
from cloning.road.camera import CAMERA_HEIGHT
from cloning.road.motion import stretches
from cloning.road.track import ROADS, Track
from simulator.car import STEP
from simulator.record import record

WIDTH = 0.2  # m, of a painted line
CORNERS = [(-WIDTH / 2, 2.5), (WIDTH / 2, 2.5), (WIDTH / 2, 20), (-WIDTH / 2, 20)]  # m right and ahead
STRAIGHT = np.zeros(len(marking.AHEAD))  # a line that is expected straight ahead of the centre camera


def find_line(strips, expected):
    """Return what `find_lines` finds in one row."""
    return marking.find_lines(strips[None], expected[None])[0]


def paint(lines, brightness=210, road=110):
    """Return strips of a straight road, uint8 (3, 32, 160, 3), with lines at these m right of the centre camera."""
    strips = np.random.default_rng(0).normal(road, 4, (3, *STRIP_SHAPE)).clip(0, 255).astype(np.uint8)
    for strip, mount in zip(strips, MOUNT_OFFSETS, strict=True):
        for line in lines:
            sides = np.array([(line - mount + side, CAMERA_HEIGHT, z) for side, z in CORNERS]) @ DIRECTION_TO_STRIP.T
            cv2.fillPoly(strip, [np.round(sides[:, :2] / sides[:, 2:] * 16).astype(int)], [brightness] * 3, 8, 4)
    return strips


@pytest.mark.parametrize("right", [-1.0, -0.4, 0.0, 0.25, 0.9])
@pytest.mark.parametrize("road, brightness", [(110, 210), (40, 60)])
def test_a_line_is_found_where_it_is_painted(right, road, brightness):
    found = find_line(paint([right], brightness, road), STRAIGHT)
    assert found == pytest.approx(right, abs=0.04)
    assert find_line(paint([right + 1.5], brightness, road), STRAIGHT + 1.5) == pytest.approx(right, abs=0.1)


def test_no_line_is_found_where_there_is_none_or_more_than_one():
    assert np.isnan(find_line(paint([]), STRAIGHT)).all()
    assert np.isnan(find_line(paint([2.5]), STRAIGHT)).all()  # out of reach
    assert np.isnan(find_line(paint([-0.5, 0.5]), STRAIGHT)).all()
    assert np.isnan(find_line(paint([0]), np.full_like(STRAIGHT, np.nan))).all()  # behind a crest


def test_the_edge_of_a_shadow_is_no_line():
    strips = paint([])
    strips[:, :, 80:] //= 3
    assert np.isnan(find_line(strips, STRAIGHT)).all()


def test_each_row_is_searched_on_its_own():
    strips = np.stack([paint([right]) for right in (-0.6, 0.4, 2.5)])
    expected = np.stack([STRAIGHT, STRAIGHT + 0.1, STRAIGHT])
    np.testing.assert_array_equal(
        marking.find_lines(strips, expected), [find_line(*row) for row in zip(strips, expected, strict=True)]
    )


def test_detections_need_support():
    """Against a loop over all pairs."""
    rng = np.random.default_rng(0)
    found = np.where(rng.random((80, 3)) < 0.5, rng.normal(0, 0.2, (80, 3)), np.nan)
    found[40:] += rng.uniform(-2, 2, (40, 3))
    expected = np.full_like(found, np.nan)
    for row, part in np.argwhere(~np.isnan(found)):
        near = found[max(0, row - marking.NEAR_ROWS) : row + marking.NEAR_ROWS + 1]
        if (np.abs(near - found[row, part]) < marking.AGREEMENT).sum() - 1 >= marking.SUPPORT:
            expected[row, part] = found[row, part]
    kept = marking.supported(found)
    np.testing.assert_array_equal(kept, expected)
    assert 40 < (~np.isnan(kept)).sum() < (~np.isnan(found)).sum() - 20


def test_the_line_corrects_what_the_network_detects(tmp_path, monkeypatch):
    """Detections 0.3 m to the right of where they should be, as they were in a real recording."""
    run, _ = record(tmp_path / "jungle", Track("jungle"), 0.15, 15, seed=1000, look=1000)
    recording = read_recording(tmp_path / "jungle")
    steps = np.round((recording.time - recording.time[0]) / STEP).astype(int)
    true, driven, strips = np.array(run.trajectory.offset)[steps], stretches(recording), read_strips(recording)

    def biased(network):
        return estimate_centres(strips, network) + 0.3

    def error():
        found, _ = place(recording, driven, biased, strips.__getitem__, shipped_networks())
        assert found.trusted.all()
        return np.abs(found.lateral_offset - true).mean()

    assert error() < 0.15  # measured: 0.118
    monkeypatch.setitem(ROADS, "jungle", replace(ROADS["jungle"], centre_line=False))
    assert error() > 0.25  # measured: 0.280
