"""The scoreboard: what is in sample and what the summary pools, by hand; and the command itself."""

import argparse
import json
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from commands import ROOT
from drive_process import warm_python
from rendered import render_recording

from cloning.base.errors import UserError
from cloning.base.program import DONE
from cloning.network.network import Network, save_model
from cloning.road.track import Track
from simulator.run import Run
from tools import score_table, scoreboard
from tools.score_table import drive_in_sample, replay_in_sample, table

TRAINED_ON = ["jungle3", "lake-ccw", "jungle-cw-look5", "jungle-cw-look10007", "road-8-ccw-look8"]


def test_a_recording_is_in_sample_by_its_name_or_that_of_a_numbered_copy():
    assert replay_in_sample("jungle", TRAINED_ON) and replay_in_sample("lake-ccw", TRAINED_ON)
    assert not replay_in_sample("jungle-shadows", TRAINED_ON) and not replay_in_sample("lake-cw", TRAINED_ON)
    assert not replay_in_sample("jungle-cw", TRAINED_ON), "a rendered recording is no copy of a real one"
    assert replay_in_sample("bend", ["bend-repetitive"]) and not replay_in_sample("bend", ["bend-left"])


@pytest.mark.parametrize(
    ("track", "look", "in_sample"),
    [
        ("jungle", 5, True),
        ("jungle", 6, False),
        ("jungle", 10005, False),  # with shadows, which look 5 has not
        ("jungle", 10007, True),
        ("jungle", 7, False),
        ("lake", 5, False),
        ("lake", 0, True),  # trained on real recordings of both
        ("jungle", 0, True),
        ("jungle", 10000, False),
        ("road-8", 8, True),
        ("road-8", 300, True),  # its bends are known
        ("road-80", 8, False),
    ],
)
def test_a_drive_is_in_sample_by_track_and_look(track, look, in_sample):
    assert drive_in_sample(track, look, TRAINED_ON) == in_sample
    rendered = [name for name in TRAINED_ON if "look" in name]
    assert drive_in_sample(track, look, rendered) == (in_sample and look > 0), "look 0 resembles real recordings"


def drive(track, look=0, speed_mph=10, **more):
    values = {"laps": 1, "laps_with_departure": 0, "departures": 0, "distance_km": 1.0}
    values |= {"offset_mean_m": 0.2, "offset_max_m": 0.5, "roughness_per_s": 0.1}
    return {"track": track, "direction": "cw", "speed_mph": speed_mph, "look": look, **values, **more}


def replayed(percent, interventions, metres):
    return {"autonomy_percent": percent, "interventions": interventions, "distance_mean_m": metres}


@pytest.fixture
def board():
    """Two networks, "one" trained on TRAINED_ON, "two" on nothing of this, with results in other sections."""
    one: dict[str, Any] = {
        "replays": {
            "jungle": {"1": replayed(94.0, 1, 0.2)},
            "jungle-shadows": {"1": replayed(40.0, 10, 0.3)},
            "jungle-2": {"1": replayed(70.0, 10, 0.4)},
            "jungle-fast": {"1": replayed(70.0, 2, 0.4)},
        },
        "drives": [
            drive("jungle", 0, departures=5, laps_with_departure=1),
            drive("jungle", 6, departures=3, laps=10, laps_with_departure=2, distance_km=12.0),
            drive("lake", 10003, departures=1, laps_with_departure=1, distance_km=2.0),
            drive("road-8", 8),
            drive("road-1001", 1001, distance_km=3.0, offset_mean_m=0.1, roughness_per_s=0.2),
            drive("road-1002", 1002, departures=2, laps_with_departure=1, offset_mean_m=0.5, roughness_per_s=0.4),
            drive("road-1002", 11002),
            drive("road-1001", 1001, 15),
        ],
    }
    recordings: dict[str, Any] = {
        name: {"seconds": seconds, "lane_centre_percent": 100.0, "oracle": {}}
        for name, seconds in (("jungle", 100.0), ("jungle-shadows", 100.0), ("jungle-2", 200.0), ("jungle-fast", 40.0))
    }
    recordings["jungle"]["oracle"]["1"] = replayed(100.0, 0, 0.12)
    recordings["jungle-shadows"]["lane_centre_percent"] = 75.4
    two = {"replays": {"jungle": {"1": replayed(88.0, 2, 0.5)}}, "drives": []}
    about = {"what": "trained somehow", "sha256": ""}
    networks = {"one": {**about, "trained_on": TRAINED_ON, **one}, "two": {**about, "trained_on": ["other"], **two}}
    return {"recordings": recordings, "networks": networks}


def cells(text: str, row: str) -> list[str]:
    """The cells of the only row with this title."""
    [line] = [line for line in text.splitlines() if line.startswith(f"| {row} |")]
    return line.strip("| ").split(" | ")[1:]


def test_a_line_of_the_summary_pools_held_out_results_else_those_in_sample(board):
    text = table(board)
    jungle = cells(text, "one: jungle")
    assert jungle == [
        "70.0 %, 12 interventions in 240 s, held out",  # 1 - 12 * 6 / 240; not `jungle`, which it was trained on
        "8 of 10 laps without a departure, 0.25 departures per km, held out",  # not look 0
    ]
    assert cells(text, "one: shadows") == [
        "40.0 %, 10 interventions in 100 s, held out",
        "0 of 1 laps without a departure, 0.50 departures per km, held out",
    ]
    # Of 1001 and 1002: four laps, one of which left the road twice in 6 km.
    assert cells(text, "one: unknown roads") == [
        "-",
        "3 of 4 laps without a departure, 0.33 departures per km, held out",
    ]
    assert cells(text, "two: jungle") == ["88.0 %, 2 interventions in 100 s, held out", "-"]
    del board["networks"]["one"]["replays"]["jungle-2"], board["networks"]["one"]["replays"]["jungle-fast"]
    assert cells(table(board), "one: jungle")[0] == "94.0 %, 1 intervention in 100 s, in sample"
    assert "limit 2.5 m" not in text and "one: lake" not in text and "two: shadows" not in text, "nothing to show"


def test_generated_roads_share_a_row_and_columns_without_results_are_left_out(board):
    drives = table(board).split("## Laps in the stand-in simulator")[1]
    assert "two" not in drives.split("## The networks")[0]
    assert cells(drives, "jungle cw, 10 mph, look 6") == [
        "3 departures in 12.0 km, 0.20 m, at most 0.50 m, roughness 0.10/s, held out"
    ]
    # By distance: 3 km at 0.1 m and 1 km at 0.5 m; 3 km at 0.2 and 1 km at 0.4.
    assert cells(drives, "10 mph, looks without shadows, held out") == [
        "2 roads: 1 of 2 laps without a departure, 0.50 departures per km, 0.20 m, roughness 0.25/s"
    ]
    assert cells(drives, "10 mph, looks with shadows, held out")[0].startswith("1 road: 1 of 1 laps")
    assert cells(drives, "10 mph, looks without shadows, in sample")[0].startswith("1 road: 1 of 1 laps")
    assert cells(drives, "15 mph, looks without shadows, held out")[0].startswith("1 road: 1 of 1 laps")


def lap_report(**more) -> Any:
    report = {"track": "lake", "direction": "cw", "laps": 1, "seconds_a_lap": [100.0], "distance_m": 1138.0}
    report |= {"offset_mean_m": 0.1, "offset_max_m": 0.2, "steering_roughness_per_s": 0.3, "departures": []}
    return report | more


@pytest.mark.parametrize(
    ("times", "laps", "finished", "expected"),
    [([], 2, True, (2, 0)), ([3, 99], 2, True, (2, 1)), ([3, 101], 2, True, (2, 2)), ([], 5, False, (3, 1))],
)
def test_laps_are_counted_by_their_departures(times, laps, finished, expected):
    report = lap_report(laps=2, seconds_a_lap=[100.0, 80.0], departures=[{"time_s": time} for time in times])
    result = score_table.driven(report, 9, 0, laps, finished)
    assert (result["laps"], result["laps_with_departure"]) == expected
    assert result["departures"] == len(times) and result["distance_km"] == 1.14


def test_a_road_may_be_driven_in_its_own_look():
    looks = [scoreboard.parse_look(text) for text in ("3", "own", "own+10000")]
    assert [scoreboard.look_of("road-7", chosen) for chosen in looks] == [3, 7, 10007]
    assert [scoreboard.look_of("jungle", chosen) for chosen in looks] == [3, 0, 10000]
    for wrong in ("mine", "own3", "3+4", "-1"):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a number, own"):
            scoreboard.parse_look(wrong)


def test_what_a_model_was_trained_on_is_in_its_file(tmp_path):
    folders = ["/home/me/data/lake-ccw", "C:\\data\\jungle2", "lake-cw-look3"]
    save_model(tmp_path / "model.pt", Network(), arguments={"recordings": folders})
    assert scoreboard.trained_on(tmp_path / "model.pt", ["more"]) == ["jungle2", "lake-ccw", "lake-cw-look3", "more"]
    save_model(tmp_path / "weights.pt", Network())
    assert scoreboard.trained_on(tmp_path / "weights.pt", ["more"]) == ["more"]
    with pytest.raises(UserError, match=r"does not say what it was trained on; .* --trained-on"):
        scoreboard.trained_on(tmp_path / "weights.pt", [])


@pytest.fixture
def measure(tmp_path):
    """Run the command on a model, with its results in tmp_path, and return its exit status."""

    def run(model, name, *more):
        return scoreboard.main([str(model), "--name", name, "--table", str(tmp_path / "table.md"), *map(str, more)])

    return run


def test_a_model_drives_a_recording_and_a_road(tmp_path, measure, model_file, monkeypatch):
    """Without stand-ins: a replay, and two drives at the same time, in the road's own look."""
    monkeypatch.setattr(scoreboard, "python", warm_python)
    recording = render_recording(tmp_path / "lake", rows=32)
    courses = ("--tracks", "road-3", "--looks", "own", "--speeds", "20", "--laps", "0.01")
    assert measure(model_file, "one", "--trained-on", "lake", "--recordings", recording, *courses) == DONE
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    [line] = [line for line in text.splitlines() if line.startswith("| lake, limit 1 m")]
    assert line.count(" %, ") == 2 and line.endswith("m, in sample |")
    [cell] = cells(text, "20 mph, looks without shadows, held out")
    assert cell.startswith("1 road: 0 of 2 laps"), "an untrained network leaves it for good"


@pytest.fixture
def simulated(monkeypatch):
    """What stands in for the drives: laps of so many `metres`."""
    answers = SimpleNamespace(metres=1000.0)

    def drive_laps(model, mph, laps, on):
        report = lap_report(direction=on[1], distance_m=answers.metres)
        return score_table.driven(report, mph, on[2], laps, finished=True)

    monkeypatch.setattr(scoreboard, "drive_laps", drive_laps)
    monkeypatch.setattr(scoreboard, "started_workers", lambda *_: ThreadPoolExecutor(1))
    return answers


def test_drives_are_kept_by_network_and_replaced_by_course(tmp_path, measure, simulated):
    for name, seed in (("one", 1), ("two", 2)):
        torch.manual_seed(seed)
        save_model(tmp_path / f"{name}.pt", Network(), arguments={"recordings": ["/data/jungle"]})
    lake = ("--tracks", "lake", "--speeds", "9", "--looks")
    assert measure(tmp_path / "one.pt", "one", *lake, "0", "7", "--what", "untrained") == DONE
    assert measure(tmp_path / "two.pt", "two", *lake, "7") == DONE
    simulated.metres = 2000.0
    assert measure(tmp_path / "one.pt", "one", *lake, "7") == DONE
    board = json.loads((tmp_path / "table.json").read_text(encoding="utf-8"))
    found = {
        name: [(drive["direction"], drive["look"], drive["distance_km"]) for drive in network["drives"]]
        for name, network in board["networks"].items()
    }
    assert found == {
        "one": [("ccw", 0, 1), ("ccw", 7, 2), ("cw", 0, 1), ("cw", 7, 2)],
        "two": [("ccw", 7, 1), ("cw", 7, 1)],
    }
    assert "* one: untrained\n* two: \n" in (tmp_path / "table.md").read_text(encoding="utf-8")
    before = (tmp_path / "table.json").read_bytes()
    with pytest.raises(UserError, match="one: has results of another model file; give another --name"):
        measure(tmp_path / "two.pt", "one", "--tracks")
    assert (tmp_path / "table.json").read_bytes() == before


def test_a_drive_that_does_not_arrive_counts_as_a_lap_left(monkeypatch):
    def drive(conditions, track, watch):
        watch(Run(Track(track, conditions.direction)), None)
        return SimpleNamespace(failed=True)

    monkeypatch.setattr(scoreboard, "drive", drive)
    result = scoreboard.drive_laps("model.pt", 9, 1.0, ("lake", "cw", 0))
    assert (result["laps"], result["laps_with_departure"], result["direction"]) == (1, 1, "cw")


def test_results_in_another_form_are_left_alone(tmp_path, measure, model_file):
    (tmp_path / "table.json").write_text('{"shipped": {}}', encoding="utf-8")
    with pytest.raises(UserError, match=r"table\.json: holds results in another form"):
        measure(model_file, "one", "--trained-on", "lake", "--tracks")
    assert (tmp_path / "table.json").read_text(encoding="utf-8") == '{"shipped": {}}'


def test_the_projects_tables_are_those_of_its_results():
    board = scoreboard.read_board(ROOT / "tools" / "scoreboard.json")
    assert (ROOT / "tools" / "scoreboard.md").read_text(encoding="utf-8") == table(board)
