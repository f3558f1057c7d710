"""The demo: what it takes up again after an interruption, and its page."""

import contextlib
import json
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from browser import LOOKS, chromium, needs_chromium

from cloning.base import program
from cloning.base.errors import SimulatorError
from tools import demo

REPORT = {"distance_m": 1137.9, "mean_speed_mph": 29.6, "departures": [], "offset_mean_m": 0.074, "offset_max_m": 0.281}
DEPARTURE = {"time_s": 1.0}


@pytest.fixture
def commands(tmp_path, monkeypatch) -> list[list[str]]:
    """The commands that the demo runs in an empty folder; stand-ins write what the real ones would."""
    run: list[list[str]] = []

    def record(folder, laps):
        run.append(["record", *(lap.direction for lap in laps)])

    @contextlib.contextmanager
    def server(*command):
        run.append(["server", *map(str, command)])
        yield SimpleNamespace(port=4567)
        run.append(["stopped"])

    def python(*words, **_):
        run.append([*map(str, words)])
        for option, content in (("--output", "model"), ("--report", json.dumps(REPORT)), ("--picture", "p")):
            if option in words:
                Path(words[words.index(option) + 1]).write_text(content, encoding="utf-8")
        return subprocess.CompletedProcess(words, program.DONE, "", "")

    monkeypatch.chdir(tmp_path)
    demo.FOLDER.mkdir()
    monkeypatch.setattr(demo, "render", record)
    monkeypatch.setattr(demo, "ServerProcess", server)
    monkeypatch.setattr(demo, "python", python)
    return run


def test_a_whole_demo_and_then_nothing_is_done_again(commands, capsys):
    assert demo.main([]) == program.DONE
    assert commands[0] == ["record", "ccw", "cw"]
    assert "--robust" in commands[1] and "--resume" not in commands[1]
    assert sum(words[0] == "server" for words in commands) == commands.count(["stopped"]) == 3
    assert {path.name for path in demo.FOLDER.iterdir()} == {"index.html", "model.pt", "jungle", "lake-ccw", "lake-cw"}
    printed = capsys.readouterr()
    assert printed.err == ""
    assert all(text in printed.out for text in (demo.ACTIVATE, *(command for command, _ in demo.NEXT)))
    assert (
        "1138 m at 30 mph, never left the road; 0.07 m from the centre line on average, 0.28 m at most" in printed.out
    )
    commands.clear()
    assert demo.main([]) == program.DONE
    assert commands == [["record", "ccw", "cw"]]  # which finds its recordings


@pytest.mark.parametrize("status", [program.FAILED, program.INCOMPLETE])  # with an error, or a crash
def test_a_stopped_training_is_resumed_and_a_stopped_lap_is_driven_again(commands, monkeypatch, status):
    (demo.FOLDER / "model-resume.pt").touch()
    (demo.FOLDER / "unfinished-jungle").mkdir()
    (demo.FOLDER / "unfinished-jungle" / "lap.png").touch()
    python = demo.python

    def without_room(*words, **more):
        return subprocess.CompletedProcess(words, status, "", "simulator: no room") if "cw" in words else python(*words)

    monkeypatch.setattr(demo, "python", without_room)
    with pytest.raises(SimulatorError, match="simulator: no room; start the demo again to continue"):
        demo.main([])
    assert "--resume" in commands[1]
    assert not (demo.FOLDER / "jungle").exists()
    monkeypatch.setattr(demo, "python", python)
    assert demo.main([]) == program.DONE
    assert not list(demo.FOLDER.glob("unfinished*"))


def test_a_lap_that_left_the_road_is_told_and_ends_with_status_1(commands, capsys):
    lap = demo.DRIVES[0]
    lap.folder.mkdir()
    (lap.folder / "lap.json").write_text(json.dumps(REPORT | {"departures": [DEPARTURE] * 2}), encoding="utf-8")
    assert demo.main([]) == program.INCOMPLETE
    assert f"{lap.title}: 1138 m at 30 mph, left the road 2 times" in capsys.readouterr().out


def test_the_page_needs_nothing_but_the_files_beside_it(commands):
    demo.main([])
    page = (demo.FOLDER / "index.html").read_text(encoding="utf-8")
    assert "//" not in re.sub(r"<style>.*?</style>|/\*.*?\*/", "", page, flags=re.DOTALL)
    named = set(re.findall(r'(?:src|href)="([^"]+)"', page))
    assert named == {
        *(f"{lap.name}/lap.{suffix}" for lap in demo.DRIVES for suffix in ("mp4", "png")),
        "diagnostic_images/training_generator_LRC_0.png",
        "diagnostic_images/training_generator_augmented-0.png",
    }
    assert all(text in page for text in (demo.ACTIVATE, *(command for command, _ in demo.NEXT)))


@needs_chromium
def test_the_page_fits_every_screen_and_bars_nobody_and_its_films_start_by_themselves(commands, tmp_path):
    demo.main([])
    with chromium(tmp_path / "profile") as page:
        for width, dark in LOOKS:
            page.look(width, 900, dark)
            page.open((demo.FOLDER / "index.html").resolve().as_uri())
            page.wait("document.readyState == 'complete'")
            assert page.fits() and page.has_colours(dark) and page.barriers() == []
            assert page.run("[...document.querySelectorAll('video')].every(film => film.autoplay && film.muted)")
            assert page.run(
                "document.querySelector('dd').clientWidth > 0.8 * document.querySelector('main').clientWidth"
            )
