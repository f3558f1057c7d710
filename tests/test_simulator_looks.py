"""Rendered frames: other looks on the same road, camera positions, recovery recordings, and the film."""

import csv

import cv2
import numpy as np
import pytest
from scenes import Here, cameras, view
from scipy.spatial import cKDTree

from cloning.base.errors import OutputError
from cloning.base.film import DriveFilm
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import decode
from cloning.road.track import Track
from simulator import record
from simulator.cameras import jpeg
from simulator.expert import Recovery
from simulator.film import MAX_BITS, ChaseFilm
from simulator.run import Run
from simulator.scenery import jungle
from simulator.scenery.looks import make_look


@pytest.mark.parametrize("track", ["lake", "jungle", "road-9"])
def test_another_look_is_another_image_of_the_same_road(track):
    assert np.abs(view(track, 0) - view(track, 4)).mean() > 15
    one, other = (
        [mesh.points for mesh in cameras(track, look).scene.scenery.meshes if mesh.road is not None] for look in (0, 4)
    )
    assert sum(map(len, one)) > 5000
    assert all(np.array_equal(*points) for points in zip(one, other, strict=True))


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
    reader = cv2.VideoCapture(str(tmp_path / "drive.mp4"))
    frames = []
    while (got := reader.read())[0]:
        frames.append(got[1])
    assert len(frames) == pytest.approx(2.0 * 15, abs=1)
    assert frames[0].shape == (360, 640, 3)
    assert reader.get(cv2.CAP_PROP_FPS) == 15
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


def test_jpegs_are_the_simulators_size_and_rgb():
    frame = np.zeros((160, 320, 3), np.uint8)
    frame[..., 0] = 200
    decoded = decode(jpeg(frame))
    assert np.abs(decoded[80, 160].astype(int) - (200, 0, 0)).max() < 2
