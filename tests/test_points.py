"""Roads of one's own: read from files, refused with reason and place, driven, recorded."""

import json
import math
import pickle
import re

import numpy as np
import pytest
from scenes import Here

from cloning.base.errors import TrackError
from cloning.lane.known import known_position
from cloning.recordings.log import read_recording
from cloning.road.generated import LANDS, MARKINGS, PointRoad
from cloning.road.motion import MPH
from cloning.road.points import make_road, read_road, spline_road
from cloning.road.track import Track
from simulator import __main__ as simulator
from simulator import record, report, scenery
from simulator.expert import Expert
from simulator.run import Run

TURN = np.linspace(0, 2 * math.pi, 61)
CIRCLE = np.c_[50 * np.cos(TURN), 50 * np.sin(TURN)]  # its last point is its first
BEND = [(0, 0), (30, 0), (55, 8), (80, 30)]


def test_a_circle_is_measured_as_a_circle():
    track = Track(make_road(CIRCLE, width=7))
    assert (track.closed, track.direction) == (True, "ccw")
    assert track.length == pytest.approx(2 * math.pi * 50, rel=1e-3)
    assert Track(make_road(22 * CIRCLE)).length == pytest.approx(2 * math.pi * 1100, rel=1e-3), "as long as Spa"
    assert track.curvature == pytest.approx(np.full(len(track.points), -1 / 50), rel=0.02)  # to the left
    assert track.locate(53, 0) == (pytest.approx(0, abs=0.1), pytest.approx(3, abs=0.01))
    assert np.all(track.edges == 3.5)
    assert make_road(CIRCLE, width=np.int64(7)) == make_road(CIRCLE, width=np.float32(7)) == track.source
    assert Track(make_road(CIRCLE[::-1])).direction == "cw"
    assert Track(track.source, "cw").points[0] == pytest.approx(track.points[0]), "a loop's first point remains it"
    assert Track(make_road(CIRCLE[:-1], closed=True)).length == pytest.approx(track.length)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_an_open_road_begins_and_ends_at_its_ends_and_goes_on_straight_beyond(direction):
    track = Track(make_road([(0, 0, 2), (40, 0, 2), (80, 0, 6)]), direction)
    start, end = ((0, 0, 2), (80, 0, 6))[:: 1 if direction == "ccw" else -1]
    first, last = track.at(0), track.at(track.length)
    assert (first.x, first.y, first.z) == pytest.approx(start, abs=1e-6)
    assert (last.x, last.y, last.z) == pytest.approx(end, abs=1e-6)
    forward = 1 if direction == "ccw" else -1
    assert track.at(track.length + 20).x == pytest.approx(end[0] + 20 * forward, abs=0.1)
    assert track.at(-20).x == pytest.approx(start[0] - 20 * forward, abs=0.1)
    for s in (-20.0, 0.0, 33.3, track.length + 20):
        pose = track.at(s, 1.5)
        assert track.locate(pose.x, pose.y, near=s) == (pytest.approx(s, abs=1e-6), pytest.approx(1.5, abs=1e-6))
    assert track.starts == {"training": 0.0, "autonomous": 0.0}


def test_points_that_are_millimetres_apart_are_thinned_out_and_their_road_is_as_long():
    assert Track(make_road([(0.005 * i, 0) for i in range(8001)])).length == pytest.approx(40, abs=0.01)


def test_forms_of_a_file_give_the_same_road(tmp_path):
    files = {
        "a.csv": "x,y\n0,0\n30,0\n55,8\n80,30\n",
        "b.txt": "0,0,0\n30,0,0\n55,8,0\n80,30,0\n  \n",
        "names.csv": "Y, Z, X\n0,0,0\n0,0,30\n8,0,55\n30,0,80\n",
        "c.json": json.dumps(BEND),
        "d": json.dumps({"road_points": BEND, "risk": "anything"}),
        "e.road": "@".join(f"{x},0.0,{y}" for x, y in BEND),  # y is up
        "objects.json": json.dumps({"road_points": [{"sequenceNumber": 1, "x": x, "y": y} for x, y in BEND]}),
        "prose.txt": "# x and y in metres, by me@home\n0 0\n30 0\n55 8\n80 30\n",
        "spaces.txt": "0 0\n30.0   0\n55\t8\n 80 30 \n",
        "track.csv": "# x_m,y_m,w_tr_right_m,w_tr_left_m\n0,0,4,5\n30,0,4,5\n55,8,4,5\n80,30,4,5\n",
        "raceline.csv": "# 3e7d\n#\n# s_m; x_m; y_m; psi\n0; 0; 0; 1\n30; 30; 0; 1\n56; 55; 8; 1\n90; 80; 30; 1\n",
        "units.csv": "x [m],y [m],v\n# by me@home\n0,0,1\n30,0,1\n55,8,1\n80,30,1\n",
        "poses.csv": '"x","y","z","yaw","note"\n0,0,0,1,\n30,0,0,1,a\n# half\n55,8,0,1,b\n80,30,0,1,\n',
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        assert read_road(tmp_path / name, name="road") == make_road(BEND)
    assert read_road(tmp_path / "a.csv").name == "a"
    own = {"road_points": CIRCLE[:-1].tolist(), "closed": True, "width": 6.5, "marking": "rail", "land": "canyon"}
    (tmp_path / "own.json").write_text(json.dumps(own))
    road = read_road(tmp_path / "own.json", land="desert")
    assert (road.closed, road.width, road.marking, road.land) == (True, 6.5, "rail", "desert")
    heights = read_road(tmp_path / "e.road").points[:, 2]
    assert np.all(heights == 0)
    (tmp_path / "heights.csv").write_text("# x, y, z (m)\n0,0,2\n30,0,2\n")
    assert np.all(read_road(tmp_path / "heights.csv").points[:, 2] == 2)


def test_equal_roads_are_equal_also_in_another_process():
    road = make_road(BEND)
    copy = pickle.loads(pickle.dumps(road))
    assert copy == road == make_road(BEND)
    assert hash(copy) == hash(road)
    assert road != make_road(BEND, width=6)


EIGHT = np.c_[60 * np.cos(TURN), 40 * np.sin(2 * TURN)]
REFUSED = [
    ({"points": EIGHT}, r"crosses itself, 107 m along it \(0.1, 0.2\) and 322 m along it"),
    ({"points": CIRCLE[:-1]}, "comes within .*; if it is a loop, repeat the first point at the end"),
    ({"points": [(0, 0), (60, 0), (75, 7), (75, 13), (60, 7), (0, 7)]}, "folds|comes within"),
    ({"points": np.c_[4 * np.cos(TURN), 60 * np.sin(TURN)]}, r"folds within its own width, \d+ m along it \(-?0"),
    ({"points": [(0, 0), (19.99, 0)]}, "19.99 m long; it must be 20 to 8000 m"),
    ({"points": [(0, 0), (9000, 0)]}, "9000 m long"),
    ({"points": [(i, 0, i % 2 * 9000) for i in range(401)], "checked": False}, "climbs and falls by 3600000.0 m"),
    ({"points": [(0, 0)]}, "1 point at least 0.01 m apart; a road needs 2"),
    ({"points": []}, "0 points at least"),
    ({"points": [(0, 0), (30, 0), (0, 0)]}, "2 points at least 0.01 m apart; a road needs 2, and a closed one 3"),
    ({"points": [(0, 0), (60, 0), (30, 50), (0, 0)], "closed": False}, "needs 9 m$"),
    ({"points": [(0, 0, 0), (30, 0, 20)]}, "too steep"),
    ({"points": [(0, 0), (math.nan, 0)]}, "point 2 is"),
    ({"points": [(0, 0), (5e6, 0)]}, "point 2 is"),
    ({"points": [(0, 0), ("a", 0)]}, "point 2 is"),
    ({"points": [(0, 0), 7]}, "point 2 is 7"),
    ({"points": [(0, 0, 1), (30, 0)]}, "point 2 has 2 numbers, the first one 3: all must have z, or none"),
    ({"points": BEND, "width": 30}, "width 30: it must be 5 to 12"),
    ({"points": BEND, "width": "8"}, "width '8'"),
    ({"points": BEND, "marking": "blue"}, "marking 'blue': it must be one of yellow double"),
    ({"points": BEND, "land": ["sea"]}, "land .*: it must be one of meadow"),
]


@pytest.mark.parametrize(("arguments", "reason"), REFUSED)
def test_what_is_no_road_is_refused_with_reason_and_place(arguments, reason):
    with pytest.raises(TrackError, match=reason):
        make_road(**arguments)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("0,0\n30:0\n", "line 2: 30:0 is not a point"),
        ("0;0\n30,5;0,5\n", "line 2: 30,5;0,5 is not a point"),
        ("0,0\n30,0\nfoo\n", "line 3: foo"),
        ("0,0,0@30,0@60,0,0", "point 2: '30,0' is not x,y,z"),
        ('{"road_points": [[0, 0], [30, 0]', "not JSON"),
        ('{"points": [[0, 0], [30, 0]]}', 'under the key "road_points"'),
        ('[{"road_points": [{"x": 0, "y": 0}]}]', "no list of one road's points"),
        ('[{"y": 0, "z": 0}, {"y": 30, "z": 0}]', "no list of one road's points"),
        ('{"road_points": [[0, 0], [30, 0]], "closed": 1}', "closed 1: it must be true or false"),
        ("", "0 points at least"),
        ("\x00\x01", "line 1: .* is not a point x,y or x,y,z, nor a line of the columns' names"),
        ("lat,lon\n48,11\n", "line 1: lat,lon is not a point x,y or x,y,z, nor a line of the columns' names"),
        ("x,y,x_m\n0,0,0\n30,30,0\n", "line 1: x,y,x_m is not a point"),
        ("# a road\n0 0 0 50\n", "line 2: 0 0 0 50 is not .* names, such as x,y,z,speed; begin with one"),
        ("# x,y,v\n0,0,1\n30,0\n60,0,1\n", "line 3: 30,0 is not a point"),
        ("0,0\n30,0,0,50\n", "line 2: 30,0,0,50 is not a point"),
        ("0,0.7,0\n0,0.7,30\n20,0.7,60\n", "too steep, .*; if z is not the height, .* x,z,y or x,y,speed"),
        ("x,y\n0,0,0\n30,30,0\n", "line 2: 0,0,0 is not a point"),
        ("0" * 200_000 + ",0", "line 1: not CSV: field larger than"),
    ],
)
def test_what_is_no_file_of_points_is_refused(text, reason, tmp_path):
    (tmp_path / "road").write_text(text)
    with pytest.raises(TrackError, match=f"{re.escape(str(tmp_path / 'road'))}: .*{reason}"):
        read_road(tmp_path / "road")


def test_a_missing_file_and_options_that_do_not_go_together_are_clear_errors(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "road.csv").write_text("0,0\n30,0\n")
    for more, reason in (
        (["--road", "none.csv"], "none.csv: No such file"),
        (["--road", "."], ".: "),  # on Windows, that permission is denied
        (["--road", "road.csv", "--track", "lake"], "leave one of them out"),
        (["--land", "desert"], "--land is of a road of your own"),
    ):
        assert simulator.main(["record", "folder", *more]) == 2
        assert reason in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["road.csv"]


def test_every_lap_of_an_open_road_starts_at_rest_at_its_start_and_ends_at_its_end(tmp_path):
    run = Run(Track(make_road(BEND, name="\udcfc$\\frac$")))  # a file may be called so
    expert = Expert(run.track, top_speed=15 * MPH)
    run.car.speed_limit = 15 * MPH
    begun = []
    while run.laps < 2:
        new = run.at_end or not run.time
        run.step(*expert.drive(run))
        if new:
            begun.append((run.travelled, run.car.speed))
    assert run.at_end
    assert run.s == pytest.approx(run.track.length, abs=0.2)
    (first, slow), (second, slow_again) = begun
    assert (first, second) == (pytest.approx(0, abs=0.01), pytest.approx(run.track.length, abs=0.01))
    assert max(slow, slow_again) < 0.1
    assert not run.departures
    assert report.lap_report(run)["laps"] == 2
    report.write_picture(tmp_path / "map.png", run)
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_the_command_records_an_open_road_with_a_drive_a_lap_and_its_lane(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "started_workers", Here)
    (tmp_path / "road.json").write_text(json.dumps({"road_points": BEND[:2], "marking": "kerb"}))
    folder, road = str(tmp_path / "recording"), str(tmp_path / "road.json")
    assert simulator.main(["record", folder, "--road", road, "--laps", "2", "--land", "desert"]) == 0
    recording = read_recording(folder)
    assert np.sum(np.diff(recording.time) > 1.0) == 1
    lane = known_position(recording)
    assert lane and lane.trusted.all()
    assert 0 < np.abs(lane.lateral_offset).max() < 2


def test_every_marking_and_land_can_be_built():
    for i in range(max(len(MARKINGS), len(LANDS))):
        road = make_road(BEND, marking=MARKINGS[i % len(MARKINGS)], land=LANDS[i % len(LANDS)])
        assert isinstance(road, PointRoad)
        assert len(scenery.build(road, 10_000 * (i == 1)).meshes) > 4


def test_a_spline_road_is_the_catmull_rom_spline_through_its_nodes():
    steps = np.array([(20, 12, 0.1), (-30, 20, 0), (35, 15, -0.1), (10, 24, 0)], float)
    points = spline_road(steps).points
    heading, nodes = 0.0, [np.zeros(3)]
    for turn, length, grade in steps:
        heading += np.radians(turn)
        nodes.append(nodes[-1] + length * np.array([np.cos(heading), np.sin(heading), grade]))
    assert np.allclose(points[::10], nodes, atol=1e-3)
    before, first, second, after = nodes[1:5]  # the usual formula, between the third node and the fourth
    for i in range(11):
        t = i / 10
        terms = 2 * first + (second - before) * t + (2 * before - 5 * first + 4 * second - after) * t**2
        expected = (terms + (3 * first - before - 3 * second + after) * t**3) / 2
        assert np.allclose(points[20 + i], expected, atol=2e-3)
