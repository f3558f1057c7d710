"""The robustness tool: its figures are those of single drives, and an interrupted run goes on."""

import json

from rendered import render_recording
from scenes import Here

from cloning.network.network import SHIPPED_MODEL
from cloning.road.disturbances import Disturbance
from cloning.road.track import Track
from simulator import driving
from tools import robustness


def test_drives_and_replays_are_measured_once_and_a_run_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(robustness, "started_workers", Here)
    folder = render_recording(tmp_path / "lake", rows=40)
    words = ["--kinds", "late", "--strengths", "5", "--tracks", "lake", "--laps", "0.01"]
    words += ["--recordings", str(folder), "--output", str(tmp_path / "found")]
    assert robustness.main(words) == 0
    file = tmp_path / "found" / "robustness.json"
    found = json.loads(file.read_text(encoding="utf-8"))
    assert len(found) == 6 and all(name.startswith("shipped ") for name in found)

    def of(words):
        return next(name for name in found if name.endswith(words))

    late = of(" lake cw, 30 mph, look 0, 0.01 laps, late:5")
    conditions = driving.Conditions(
        str(SHIPPED_MODEL),
        30,
        0,
        "cw",
        0.01 * Track("lake").length,
        set_back=True,
        disturbance=Disturbance("late", 5),
        seed=1,
    )
    alone = driving.drive(conditions, "lake")
    assert found[late] == {"autonomy": 100, "departures": 0, "distance": round(alone.mean, 3)}
    for course in (" lake cw, 30 mph, look 0, 0.01 laps", f"{folder}"):
        assert found[of(f"{course}, clear")]["distance"] != found[of(f"{course}, late:5")]["distance"]
    assert (tmp_path / "found" / "robustness.png").read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()

    found[late]["departures"] = 9
    missing = of("lake cw, 30 mph, look 0, 0.01 laps, clear")
    file.write_text(json.dumps({name: found[name] for name in found if name != missing}), encoding="utf-8")
    assert robustness.main(words) == 0
    assert json.loads(file.read_text(encoding="utf-8")) == found, "only what was missing is driven"
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "found" / "robustness.md").read_text(encoding="utf-8")
    assert "| late (held out) | 100.0 %, 9, " in printed
    assert "| **held out: kinds without a departure** | 0 of 1 |" in printed
