"""The search for roads on which a driver fails, with a driver that goes straight on."""

import json
import tracemalloc

import numpy as np
import pytest
from scenes import Here
from steer_server import STEER, Server

from cloning.base.program import DONE
from cloning.road.points import make_road, read_road
from simulator import driving
from tools import search

KIND = search.Kind(sharpest=35, steepest=0.2, marking="white", land="meadow")


def test_a_search_finds_failures_that_repeat_and_writes_roads_for_others(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(driving, "started_workers", Here)
    folder = tmp_path / "found"
    words = [str(folder), "--driver", "straight", "--roads", "2", "--searches", "random"]
    assert search.main(words) == DONE
    printed, told = capsys.readouterr().out, json.loads((folder / "search.json").read_text(encoding="utf-8"))
    assert "2 of 2 failures were the same" in printed
    assert [figures["failures"] for figures in told["searches"]] == [2]
    assert (folder / "failures.png").read_bytes().startswith(b"\x89PNG")
    for file in folder.glob("random-1-*.json"):
        failure, road = json.loads(file.read_text(encoding="utf-8")), read_road(file)
        again = driving.drive(driving.Conditions("straight", 20, 0), road)
        assert again.figures().items() <= failure.items()
        # By geometry: the car's middle stays on the tangent at the start, and a wheel is 0.8 m beside it.
        along, beside = (np.array(again.path[-1]) - road.points[0, :2]) @ rotation(road.points)
        assert abs(beside) < 0.3 and along > 10
        assert 2.5 < again.farthest < 4


def rotation(points):
    east, north = (points[1] - points[0])[:2] / np.linalg.norm((points[1] - points[0])[:2])
    return np.array([(east, -north), (north, east)])


def test_a_server_drives_until_the_end_of_the_road_or_until_it_is_late(monkeypatch):
    monkeypatch.setattr(driving, "PATIENCE", 1.0)  # instead of half a minute, in 450 frames
    road = make_road([(0, 0), (20, 0), (40, 0)])
    ends = {}
    for throttle in ("1", "0"):
        with Server(lambda packet, n, throttle=throttle: [STEER % ("0", throttle)]) as server:
            ends[throttle] = driving.drive(driving.Conditions(f"127.0.0.1:{server.port}", 30, 0), road)
    assert ends["1"].ended == "arrived" and ends["1"].along == pytest.approx(40, abs=0.5)
    assert ends["1"].farthest < 0.1 and not ends["1"].failed
    assert ends["0"].ended == "late" and ends["0"].failed


def test_evolution_keeps_the_worst_driven_and_changes_it_within_the_limits():
    """Here the driver is worst where the road turns most to the left; the same seed gives the same roads."""

    def drive_all(roads):
        return [driving.Drive(search.Track(road).heading[-1], 1.0, "arrived", 1.0, ()) for road in roads]

    found = {}
    for name in search.SEARCHES:
        one, two = (list(search.explore(name, 5, 60, KIND, drive_all)) for _ in range(2))
        assert [road for road, _ in one] == [road for road, _ in two]
        found[name] = [drive.farthest for _, drive in one]
    assert np.mean(found["evolution"][50:]) > np.mean(found["random"]) + 1


def test_diversity_is_the_angle_between_straight_and_turned_roads():
    """A quarter of a circle turns evenly from 0 to 90°: its RMS difference from a straight road is 90°/√3."""
    angle = np.linspace(0, np.pi / 2, 40)
    straight = make_road([(x, 0) for x in range(0, 80, 4)])
    arc = make_road(np.column_stack([60 * np.sin(angle), 60 * (1 - np.cos(angle))]))
    assert search.diversity([straight, arc]) == pytest.approx(90 / np.sqrt(3), abs=1)
    assert search.diversity([arc, arc]) == 0
    assert search.diversity([arc]) is None


def test_the_diversity_of_thousands_of_roads_takes_little_memory(monkeypatch):
    road = make_road([(x, 0) for x in range(0, 80, 4)])
    track = search.Track(road)
    monkeypatch.setattr(search, "Track", lambda _: track)
    tracemalloc.start()
    assert search.diversity([road] * 1000) == 0 and tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_wrong_drivers_and_folders_are_refused_and_a_server_drives_one_car(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with pytest.raises(search.UserError, match="is not empty; name a new folder"):
        search.main([str(tmp_path)])
    with pytest.raises(search.UserError, match=r"none\.pt"):
        search.main([str(tmp_path / "new"), "--driver", "none.pt"])
    with pytest.raises(search.UserError, match=r"none\.onnx: no such file; "):
        search.main([str(tmp_path / "new"), "--driver", "none.onnx"])
    with Server(lambda packet, n: [], sessions=2) as server:
        address = f"127.0.0.1:{server.port}"
        with pytest.raises(search.UserError, match="drives one car at a time; leave out --scheduler"):
            search.main([str(tmp_path / "new"), "--driver", address, "--scheduler", "none"])
        monkeypatch.setattr(driving, "started_workers", lambda *how: how)
        assert driving.workers_for(address, 8, None) == (1,)
    assert not (tmp_path / "new").exists()
