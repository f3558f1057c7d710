"""Rendered frames: other looks on the same road, shadows, camera positions, recovery recordings, and the film."""

import csv

import cv2
import numpy as np
import pytest
from rendered import film_of
from scenes import Here, cameras, view
from scipy.spatial import cKDTree

from cloning.base.errors import OutputError
from cloning.base.film import DriveFilm
from cloning.recordings.format import SAMPLE_RATE
from cloning.road import track as track_module
from cloning.road.track import LEFT, Track
from simulator import record
from simulator.expert import Recovery
from simulator.film import MAX_BITS, ChaseFilm
from simulator.run import Run
from simulator.scenery import jungle, textures
from simulator.scenery.looks import DARKEST, SHADOWED, expose, make_look, tone_matrix
from simulator.scenery.shade import HALF_WIDTH, LENGTH, OVERLAP, PICTURE_SHAPE, STRETCH, Shade, ShadeStyle
from simulator.scenery.shapes import Light, Material, box, distances, plants, surface


@pytest.mark.parametrize("track", ["lake", "jungle", "road-9"])
def test_another_look_is_another_image_of_the_same_road(track):
    assert np.abs(view(track, 0) - view(track, 4)).mean() > 15
    both = (cameras(track, look).scene.scenery.meshes for look in (0, 4))
    one, other = ([mesh.points for mesh in meshes if mesh.road is not None] for meshes in both)
    assert sum(map(len, one)) > 5000
    assert all(np.array_equal(*points) for points in zip(one, other, strict=True))


def test_the_jungles_surface_is_the_same_where_a_processor_rounds_otherwise(monkeypatch):
    tracks, line = [Track("jungle")], track_module.centre_line("jungle")
    monkeypatch.setattr(track_module, "centre_line", lambda source: line * (1 + 1e-14))
    tracks.append(Track("jungle"))
    asphalt = Material((1, 1, 1), textures.plain(), 8)
    here, there = (surface(track, distances(0, track.length, 1.5), 4.5, asphalt).points for track in tracks)
    assert np.abs(here - there).max() < 1e-9


def test_no_look_has_lines_darker_than_their_road():
    for number in (0, *range(100, 120)):
        look = make_look(number, jungle.LIGHT, jungle.PALETTE)
        road = jungle.road_texture(np.random.default_rng(0), look) * np.array(look.palette["asphalt"])
        columns = (np.arange(road.shape[1]) + 0.5) / road.shape[1] * 2 * jungle.ASPHALT_EDGE - jungle.ASPHALT_EDGE
        line, lane = np.abs(columns - jungle.EDGE_LINE) < 0.08, (columns > 1) & (columns < 4)
        assert road[:, line].mean() > 1.15 * road[:, lane].mean(), number


def test_in_no_look_cliffs_or_palms_stand_on_the_jungles_road():
    track = Track("jungle")
    for look in (0, 100, 104, 135):  # in the last three they did, on the bridge
        terrain = jungle.JungleTerrain(track, np.random.default_rng(look))
        for right in (-4.5, -2.0, 0.0, 2.0, 4.5):
            positions = track.points[:, :2] + right * track.rightward
            assert np.all(terrain.height_at(positions) < track.points[:, 2] - 0.4)
        for mesh in jungle.palms(terrain, np.random.default_rng(look), jungle.LIGHT, jungle.PALETTE):
            away, nearest = cKDTree(terrain.bridge[:, :2]).query(mesh.points[:, :2])
            assert not np.any((away < jungle.ASPHALT_EDGE) & (mesh.points[:, 2] > terrain.bridge[nearest, 2]))


def test_horizon_and_vanishing_point_lie_where_the_real_frames_have_them():
    """The road's edges, straight here, meet at row 60 to 62 and column 157 to 162, in a frame rolled by 1.2 degrees."""
    frame = view("lake", 0)[0].astype(np.uint8)
    level = cv2.getRotationMatrix2D((159.5, 79.5), 1.2, 1.0)
    frame = cv2.warpAffine(frame, level, (320, 160)).astype(int)
    yellow = frame[..., 0] + frame[..., 1] - 2 * frame[..., 2]
    lines = []
    for side in (-1, 1):
        rows = np.arange(82, 110)
        line = []
        for row in rows:  # the line is 3.5 m to the side, seen from a height of 1.26 m
            near = 159.5 + side * 3.5 / 1.26 * (row - 61)
            columns = np.arange(max(0, round(near) - 12), min(320, round(near) + 13))
            line.append(columns[np.argmax(yellow[row, columns])])
        lines.append(np.polyfit(rows, line, 1))
    (left, a), (right, b) = lines
    row = (b - a) / (left - right)
    assert row == pytest.approx(61, abs=1)
    assert left * row + a == pytest.approx(159.5, abs=4)


def test_the_side_cameras_see_from_the_sides():
    """A car 0.8 m further left sees with its centre camera what the left camera saw, and likewise on the right."""
    centre, left, right = view("lake", 0)

    def difference(one, other):
        road = np.s_[70:130]
        return np.abs(one[road] - other[road]).mean()

    assert difference(left, right) > 20
    for offset, side in ((-0.806, left), (0.825, right)):
        moved = view("lake", 0, offset=offset)[0]
        assert difference(moved, side) < 0.35 * difference(centre, side)


def test_recovery_records_only_the_returns():
    run = Run(Track("lake"))
    expert = Recovery(run.track, seed=1)
    returns, offsets = 0, []
    while run.time < 60:
        before = expert.recordable
        run.step(*expert.drive(run))
        if expert.recordable:
            offsets.append(abs(run.offset))
        if before and not expert.recordable:
            returns += 1
            assert abs(run.offset) < 0.25
            assert offsets[0] > 1.2
            assert offsets[-1] < offsets[0]
            offsets = []
    assert returns >= 8
    assert not run.departures


def test_a_recovery_recording_has_a_pause_between_the_returns(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "started_workers", Here)
    monkeypatch.setattr(record, "_render", lambda *_: [b"a JPEG"] * 3)
    run, rows = record.record(tmp_path / "recovery", Track("lake"), laps=0.2, recovery=True)
    assert rows < 0.7 * run.time * SAMPLE_RATE
    names = [row[0] for row in csv.reader((tmp_path / "recovery" / "driving_log.csv").read_text().splitlines())]
    seconds = [int(name[-13:-11]) * 60 + int(name[-10:-8]) + int(name[-7:-4]) / 1000 for name in names]
    assert sum(np.diff(seconds) > 0.5) >= 1
    assert len(list((tmp_path / "recovery" / "IMG").iterdir())) == 3 * len(names) == 3 * rows


def test_films_the_drive(tmp_path):
    run = Run(Track("lake"))
    film = ChaseFilm(str(tmp_path / "drive.mp4"), cameras("lake", 0).scene)
    for _ in range(100):
        run.step(0.0, 1.0)
        film.watch(run)
    film.close()
    rate, frames = film_of(tmp_path / "drive.mp4")
    assert len(frames) == pytest.approx(2.0 * 15, abs=1)
    assert frames[0].shape == (360, 640, 3)
    assert rate == 15
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 5
    assert list(tmp_path.iterdir()) == [tmp_path / "drive.mp4"]
    with pytest.raises(OutputError, match=r"\.mp4"):
        ChaseFilm(str(tmp_path / "nowhere" / "drive.mp4"), film.view.scene)


def test_a_films_limit_of_bits_holds_for_frames_that_cannot_be_compressed(tmp_path):
    """Noise takes megabits a second at the films' quality."""
    rng, film = np.random.default_rng(0), DriveFilm(str(tmp_path / "noise.mp4"), 15, 28, MAX_BITS)
    for _ in range(60):
        film.add(rng.integers(0, 255, (180, 320, 3), np.uint8))
    film.close()
    assert 8 * (tmp_path / "noise.mp4").stat().st_size < 1.6 * 4 * MAX_BITS  # the first seconds may fill the buffer


# ----------------------------------------------------------------------------------------------------------------------
# Shadows: where they fall, how dark they are, and that nothing else differs


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
    road = centre("jungle", SHADOWED + 104, 1413.0)[85:130, 100:220]  # black before, all across the frame
    assert 0.7 * DARKEST < np.median(road) < 2 * DARKEST
