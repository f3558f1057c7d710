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


@pytest.fixture
def repository(tmp_path) -> Path:
    """A git repository with this working tree's files, all of them committed."""
    if not (ROOT / ".git").exists() or not shutil.which("git"):
        pytest.skip("needs git and a checkout")
    listed = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=ROOT).split("\0")
    for name in filter(None, listed):
        if (ROOT / name).is_file():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / name)
    author = ("-c", "user.name=test", "-c", "user.email=test@localhost")
    for command in (("init",), ("add", "--all"), (*author, "commit", "-m", "test")):
        run("git", *command, cwd=tmp_path)
    return tmp_path


def test_driving_and_filming_change_no_tracked_file(repository):
    with drive_server("run1", "--speed", "15", cwd=repository) as port:
        outputs = ("--report", "lap.json", "--picture", "lap.png", "--film", "lap.mp4")
        command = (sys.executable, "-m", "simulator", "drive", "--port", port, "--laps", "0.005")
        run(*command, *outputs, cwd=repository)
    run(sys.executable, "video.py", "run1", cwd=repository)
    assert all((repository / name).stat().st_size for name in ("lap.json", "lap.png", "lap.mp4", "run1.mp4"))
    assert any((repository / "run1").iterdir())
    assert run("git", "status", "--porcelain", cwd=repository) == ""
