"""The commands as they are typed: the shipped network drives both tracks, and no run changes a tracked file."""

import json
import shutil
import subprocess

import pytest
from commands import ROOT, python
from drive_process import serving

from cloning.road.track import Track


# The mean offsets were measured in lock-step on a CPU, where a drive is the same on every run.
@pytest.mark.parametrize(("track", "mean_offset"), [("lake", 0.071), ("jungle", 0.173)])
def test_the_shipped_network_stays_on_the_road(track, mean_offset, tmp_path):
    laps, report = 150 / Track(track).length, tmp_path / "lap.json"
    with serving("cloning/network/shipped.pt", "--speed", 15, cwd=ROOT) as server:
        drive = ("-m", "simulator", "drive", "--track", track, "--port", server.port, "--report", report)
        done = python(*drive, "--laps", f"{laps:.4f}")
    assert done.returncode == 0, done.stdout + done.stderr
    lap = json.loads(report.read_text(encoding="utf-8"))
    assert lap["departures"] == []
    assert lap["distance_m"] == pytest.approx(150, abs=5)
    assert lap["unusable_answers"] == lap["reconnections"] == 0
    assert 0 < lap["offset_mean_m"] <= 1.3 * mean_offset


def test_what_runs_write_is_not_tracked(finished):
    """What model.py leaves, and what drives, films and reports are called in the documents."""
    if not (ROOT / ".git").exists() or not shutil.which("git"):
        pytest.skip("needs git and a checkout")
    names = [path.relative_to(finished[1]).as_posix() for path in finished[1].rglob("*") if path.is_file()]
    names += ["model-previous.pt", "rejected_rows.csv", "report.html", "data/lake/driving_log.csv", "run1.mp4"]
    names += ["run1/2018_07_16_17_11_43_382.jpg", "lap.json", "lap.png", "lap.mp4"]
    ignored = subprocess.run(["git", "check-ignore", *names], cwd=ROOT, capture_output=True, text=True).stdout
    assert set(ignored.splitlines()) == set(names)
