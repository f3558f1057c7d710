"""The commands as they are typed: the shipped network drives both tracks, and no run changes a tracked file."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import warm

from cloning.road.track import Track

ROOT = Path(__file__).parent.parent


def run(*command: object, cwd: Path) -> str:
    """Run a command that must succeed; return its standard output."""
    start = warm.run if command[0] == sys.executable else subprocess.run
    done = start([*map(str, command)], cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@contextmanager
def drive_server(*arguments: object, cwd: Path) -> Iterator[int]:
    """A running drive.py of the shipped network on a free port, which it prints."""
    command = [sys.executable, "drive.py", "cloning/network/shipped.pt", *map(str, arguments), "--port", "0"]
    process = warm.Popen(command, cwd=cwd, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr
        output = []
        for line in process.stderr:
            output.append(line)
            if port := re.search(r"127\.0\.0\.1:(\d+)", line):
                yield int(port[1])
                return
        raise AssertionError("".join(output))
    finally:
        process.terminate()
        process.communicate(timeout=60)


# The mean offsets were measured in lock-step on a CPU, where a drive is the same on every run.
@pytest.mark.parametrize(("track", "mean_offset"), [("lake", 0.071), ("jungle", 0.173)])
def test_the_shipped_network_stays_on_the_road(track, mean_offset, tmp_path):
    laps, report = 150 / Track(track).length, tmp_path / "lap.json"
    with drive_server("--speed", "15", cwd=ROOT) as port:
        command = (sys.executable, "-m", "simulator", "drive", "--track", track, "--port", port)
        run(*command, "--laps", f"{laps:.4f}", "--report", report, cwd=ROOT)
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
    assert set(run("git", "check-ignore", *names, cwd=ROOT).splitlines()) == set(names)
