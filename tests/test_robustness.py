"""The robustness tool: its figures are those of single drives, and an interrupted run goes on."""

import json

from rendered import render_recording

from cloning.network.network import SHIPPED_MODEL
from cloning.road.disturbances import Disturbance
from cloning.road.track import Track
from tools import driving, robustness


def test_drives_and_replays_are_measured_once_and_a_run_goes_on(tmp_path, capsys):
    folder = render_recording(tmp_path / "lake", rows=60)
    words = ["--kinds", "late", "--strengths", "5", "--tracks", "lake", "--laps", "0.02", "--processes", "1"]
    words += ["--recordings", str(folder), "--output", str(tmp_path / "found")]
    assert robustness.main(words) == 0
    file = tmp_path / "found" / "robustness.json"
    results = json.loads(file.read_text(encoding="utf-8"))
    assert len(results) == 6 and {each["model"] for each in results} == {"shipped"}
    found = {(each["course"], each["disturbance"]): each for each in results}
    clear, late = (found["lake cw, 30 mph, look 0, 0.02 laps", name] for name in ("none", "late:5"))
    assert clear["distance_mean_m"] != late["distance_mean_m"]
    way = ("cw", 0.02 * Track("lake").length, True, Disturbance("late", 5), 1)
    alone = driving.drive(driving.Conditions(str(SHIPPED_MODEL), 30, 0, *way), "lake")
    assert late["distance_mean_m"] == round(alone.mean, 3) and late["departures"] == len(alone.departures) == 0
    assert found[str(folder), "none"]["distance_mean_m"] != found[str(folder), "late:5"]["distance_mean_m"]
    assert (tmp_path / "found" / "robustness.png").read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()

    late["departures"] = 9
    file.write_text(json.dumps([each for each in results if each is not clear]), encoding="utf-8")
    assert robustness.main(words) == 0
    again = json.loads(file.read_text(encoding="utf-8"))
    assert again == results, "only what was missing is driven"
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "found" / "robustness.md").read_text(encoding="utf-8")
    assert "| late (held out) | 100.0 %, 9, " in printed and "| **held out, likewise** | 0 of 1 |" in printed
