"""Shadows in rendered frames: where they fall, how dark they are, and that nothing else differs."""

import numpy as np
import pytest
from scenes import cameras, view

from cloning.road.track import LEFT, Track
from simulator.scenery import textures
from simulator.scenery.looks import DARKEST, SHADOWED, expose, tone_matrix
from simulator.scenery.shade import HALF_WIDTH, LENGTH, OVERLAP, PICTURE_SHAPE, STRETCH, Shade, ShadeStyle
from simulator.scenery.shapes import Light, box, plants

LIT = {"lake": 750.0, "jungle": 326.0}  # s in m where neither hills nor plants shade the road in look SHADOWED
DARK = {"lake": 1135.0, "jungle": 540.0}  # s in m where a cliff shades all of the road before the car


def centre(track, look, s):
    return view(track, look, s)[0]


@pytest.mark.parametrize("track", ["lake", "jungle"])
def test_the_shadowed_twin_has_the_same_things_in_the_same_places(track):
    plain, twin = (cameras(track, look).scene.scenery for look in (0, SHADOWED))
    assert plain.shade is None
    for one, other in zip([*plain.meshes, plain.bonnet], [*twin.meshes, twin.bonnet], strict=True):
        for name in ("points", "colours", "uv", "faces", "texture"):
            assert np.array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("track", ["lake", "jungle"])
def test_shadows_only_darken_and_are_as_deep_as_their_style(track):
    road = np.s_[105:130, 80:240]
    shade = cameras(track, SHADOWED).scene.scenery.shade
    assert shade
    for s, expected in ((LIT[track], np.ones(3)), (DARK[track], shade.factor)):
        plain, twin = centre(track, 0, s), centre(track, SHADOWED, s)
        assert (twin <= plain + 1).mean() > 0.999
        ratio = twin[road].mean(axis=(0, 1)) / plain[road].mean(axis=(0, 1))
        assert ratio == pytest.approx(expected, abs=0.03)


def test_shadows_lie_where_the_sun_throws_them():
    """The sun stands at 45 degrees to the left of the road: posts and plants throw shadows as long as they are tall."""
    track, s = Track("lake"), 330.0
    foot, white = track.at(s, 5.0 * LEFT), textures.plain()
    away = foot.heading + np.pi / 2
    light = Light((np.cos(away), np.sin(away), 1.0), (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    post = box((foot.x, foot.y, foot.z), (0.5, 0.5, 3.0), foot.heading, (1, 1, 1), white)
    tree = track.at(s + 20, 5.0 * LEFT)
    opaque = np.full((64, 64, 4), 255, np.uint8)
    opaque[32:, :, 3] = 0  # only a crown, from 4 m up to 8 m
    foot_of_tree, size = np.array([[tree.x, tree.y, tree.z]]), np.array([8.0])
    crown = plants(foot_of_tree, size, size / 20, np.ones((1, 3)), opaque, np.random.default_rng(0))
    shade = Shade(track, [post, crown], light, ShadeStyle(depth=1.0, softness=0.02), 45.0)
    assert shade.factor == pytest.approx(0.5)  # as much light from the sky as from the sun
    picture = shade.on_road(int(s / STRETCH))
    assert picture is not None
    rows, columns = np.nonzero(picture[::-1, :, 0] < 150)  # from its start on
    along = (rows + 0.5) / PICTURE_SHAPE[0] * LENGTH - OVERLAP - s % STRETCH
    right = ((columns + 0.5) / PICTURE_SHAPE[1] * 2 - 1) * HALF_WIDTH
    for thing, start, end in ((np.abs(along) < 5, -5.25, -2.0), (np.abs(along - 20) < 5, -1.0, 3.0)):
        assert right[thing].min() == pytest.approx(start, abs=0.3)
        assert right[thing].max() == pytest.approx(end, abs=0.3)
    assert np.abs(along[right < -2.3]).max() < 0.5
    assert shade.on_road(0) is None


def test_the_car_throws_a_shadow_before_itself_with_the_sun_behind_it_and_none_in_the_shade():
    before_bonnet = np.s_[128:134, 140:180]
    sun = cameras("lake", SHADOWED).scene.scenery.light.sun
    for s, towards_sun, shadow in ((100.0, -1, True), (750.0, 1, False)):
        heading = Track("lake").at(s).heading
        assert towards_sun * (np.cos(heading) * sun[0] + np.sin(heading) * sun[1]) > 0.7
        ratio = centre("lake", SHADOWED, s)[before_bonnet].mean() / centre("lake", 0, s)[before_bonnet].mean()
        assert ratio < 0.85 if shadow else ratio == pytest.approx(1, abs=0.01)
        assert not cameras("lake", SHADOWED).scene.car_shadow.is_hidden()
    centre("lake", SHADOWED, DARK["lake"])
    assert cameras("lake", SHADOWED).scene.car_shadow.is_hidden()


def test_no_look_makes_the_road_darker_than_the_darkest_real_frame():
    dark = np.array([60.0, 50.0, 40.0])
    for tone in (None, tone_matrix(1.25, 0.5, np.array([-22.0, -18.0, -20.0]))):
        lifted = expose(tone, dark / 5)
        assert lifted is not None and (lifted @ np.r_[dark / 5, 1]).mean() == pytest.approx(DARKEST, abs=0.01)
        if tone is not None:
            np.testing.assert_array_equal(lifted[:, :3], tone[:, :3])
    assert expose(None, dark) is None
    for look in (SHADOWED + 104, SHADOWED + 111):  # black before, all across the frame
        road = centre("jungle", look, 1413.0)[85:130, 100:220]
        assert 0.7 * DARKEST < np.median(road) < 2 * DARKEST
