"""The line painted along a road's centre: where it is found in strips, and how exactly it locates a drive."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import recorded

from cloning.lane import marking
from cloning.lane.ahead import line_ahead
from cloning.lane.localise import localise_recording, shipped_networks
from cloning.lane.reader import DIRECTION_TO_STRIP, MOUNT_OFFSETS, STRIP_SHAPE, estimate_centres, read_strips
from cloning.road.camera import CAMERA_HEIGHT
from cloning.road.motion import AXLE_TO_CAMERA, WHEELBASE, stretches
from cloning.road.track import ROADS, Track

WIDTH = 0.2  # m, of a painted line
CORNERS = [(-WIDTH / 2, 2.5), (WIDTH / 2, 2.5), (WIDTH / 2, 20), (-WIDTH / 2, 20)]  # m right and ahead
STRAIGHT = np.stack([np.zeros(len(marking.AHEAD)), np.ones(len(marking.AHEAD))])  # straight ahead of the centre camera
ASIDE = np.array([[1.0], [0]])  # m to the right


def find_line(strips, expected):
    """Return what `find_lines` finds in one row."""
    return marking.find_lines(strips[None], expected[None])[0]


def paint(lines, brightness=210, road=110, factor=1.0, slope=0.0):
    """Return strips of a straight road, uint8 (3, 32, 160, 3), with lines at these m right of the centre camera.

    factor: by which distances seem larger than they are; slope: m to the right for each metre ahead, from 5 m on.
    """
    strips = np.random.default_rng(0).normal(road, 4, (3, *STRIP_SHAPE)).clip(0, 255).astype(np.uint8)
    for strip, mount in zip(strips, MOUNT_OFFSETS, strict=True):
        for line in lines:
            right = line - mount * factor
            points = [(right + side + slope * (z - 5), CAMERA_HEIGHT, z) for side, z in CORNERS]
            sides = np.array(points) @ DIRECTION_TO_STRIP.T
            cv2.fillPoly(strip, [np.round(sides[:, :2] / sides[:, 2:] * 16).astype(int)], [brightness] * 3, 8, 4)
    return strips


@pytest.mark.parametrize("right", [-1.0, -0.4, 0.0, 0.25, 0.9])
@pytest.mark.parametrize("road, brightness", [(110, 210), (40, 60)])
def test_a_line_is_found_where_it_is_painted(right, road, brightness):
    found = find_line(paint([right], brightness, road), STRAIGHT)
    assert found == pytest.approx(right, abs=0.05)
    assert find_line(paint([right + 1.5], brightness, road), STRAIGHT + 1.5 * ASIDE) == pytest.approx(right, abs=0.1)


@pytest.mark.parametrize("slope", [-0.55, -0.3, 0.2, 0.5])
def test_a_line_is_found_in_another_direction_than_expected(slope):
    expected = 0.3 + slope * (marking.DISTANCES - 5)
    assert find_line(paint([0.3], slope=slope), STRAIGHT) == pytest.approx(expected, abs=0.1)


def test_no_line_is_found_where_there_is_none_or_more_than_one():
    assert np.isnan(find_line(paint([]), STRAIGHT)).all()
    assert np.isnan(find_line(paint([2.5]), STRAIGHT)).all()  # out of reach
    assert np.isnan(find_line(paint([-0.5, 0.5]), STRAIGHT)).all()
    assert np.isnan(find_line(paint([0]), np.full_like(STRAIGHT, np.nan))).all()  # behind a crest
    shadow = paint([])
    shadow[:, :, 80:] //= 3
    assert np.isnan(find_line(shadow, STRAIGHT)).all()  # the edge of a shadow


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_the_cameras_agree_on_a_line_where_the_road_falls_or_rises(factor):
    """All seems nearer or further than it is there, and the cameras as much nearer to each other or further apart."""
    strips = paint([0.3], factor=factor)
    assert find_line(strips, STRAIGHT * [[1], [factor]]) == pytest.approx(0.3, abs=0.04)
    assert find_line(strips, STRAIGHT) != pytest.approx(0.3, abs=0.04)


@pytest.mark.parametrize("bend", [-1, 1])
def test_where_a_line_is_seen_where_the_road_falls_or_rises(bend):
    """At the jungle's sharpest crest and dip, against its points, one by one, from a car as steep as the road below."""
    track = Track("jungle")
    s = track.step * (bend * (np.roll(track.grade, -10) - track.grade)).argmax()
    pose, front = track.at(s, right=0.5), track.at(s + WHEELBASE)
    heading = pose.heading - 0.07
    level = np.array([np.cos(heading), np.sin(heading), 0])
    ahead = level * WHEELBASE + [0, 0, front.z - pose.z]
    ahead /= np.linalg.norm(ahead)
    right = np.array([level[1], -level[0], 0])
    up = np.cross(right, ahead)
    camera = np.array([pose.x, pose.y, pose.z]) + AXLE_TO_CAMERA * ahead + CAMERA_HEIGHT * up
    points = np.array([(at.x, at.y, at.z) for at in map(track.at, np.arange(s + 3, s + 25, 0.1))]) - camera
    factors = -CAMERA_HEIGHT / (points @ up)  # to where the ray to the point meets flat ground
    seen = points @ ahead * factors
    end = (np.diff(seen) <= 0).argmax() + 1 if (np.diff(seen) <= 0).any() else len(seen)
    distances = np.arange(2.0, 6, 0.25)
    found, factor = line_ahead(track, s, np.array([pose.x, pose.y]) + AXLE_TO_CAMERA * level[:2], heading, distances)
    expected = np.interp(distances, seen[:end], (points @ right * factors)[:end], right=np.nan)
    hidden, beyond = np.isnan(found), np.isnan(expected)
    assert hidden.any() == (bend < 0) and (~hidden).sum() > 5
    assert (hidden != beyond).sum() <= 1  # the track's points are 1 m apart
    visible = ~hidden & ~beyond
    assert found[visible] == pytest.approx(expected[visible], abs=0.02)
    assert factor[visible] == pytest.approx(np.interp(distances, seen[:end], factors[:end])[visible], abs=0.02)
    assert ((factor[visible] - 1) * bend > 0.1).any()


def test_the_line_corrects_what_the_network_detects(tmp_path, monkeypatch):
    """Detections 0.3 m to the right of where they should be, as they were in a real recording."""
    recording, true = recorded(tmp_path / "jungle", Track("jungle"), 0.1, 15, seed=1000, look=1000)
    driven, strips, network = stretches(recording), read_strips(recording), next(shipped_networks())
    biased = estimate_centres(strips, network) + 0.3

    def error():
        found, _ = localise_recording(recording, driven, lambda _: biased, strips.__getitem__, [network])
        assert found.trusted.all()
        return np.abs(found.lateral_offset - true).mean()

    assert error() < 0.085  # measured: 0.067
    monkeypatch.setitem(ROADS, "jungle", replace(ROADS["jungle"], centre_line=False))
    assert error() > 0.25  # measured: 0.264
