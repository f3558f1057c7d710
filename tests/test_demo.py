"""The demo: its steps, and what it takes up again after an interruption."""

import contextlib
import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from cloning.base import program
from cloning.base.errors import SimulatorError, UserError
from tools import demo

REPORT = {"distance_m": 1137.9, "mean_speed_mph": 29.6, "departures": [], "offset_mean_m": 0.074, "offset_max_m": 0.281}
DEPARTURE = {"time_s": 1.0}
DRIVES = demo.drives(demo.FOLDER)


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
        written = ("--output", "model"), ("--report", json.dumps(REPORT)), ("--picture", "p"), ("--film", "f")
        for option, content in written:
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
    laps = [lap.picture for lap in DRIVES]
    assert commands[-1] == ["-m", "cloning.report", "demo", "--lap", *map(str, laps)]
    files = {lap.with_suffix(kind) for lap in laps for kind in (".png", ".json", ".mp4")}
    assert {*(demo.FOLDER / "laps").iterdir()} == files
    printed = capsys.readouterr()
    assert printed.err == ""
    named = [program.ACTIVATE, *(command.format("demo") for command, _ in demo.NEXT)]
    assert all(command in printed.out for command in named)
    driven = "1138 m at 30 mph, never left the road; 0.07 m from the centre line on average, 0.28 m at most"
    assert driven in printed.out
    for lap in DRIVES:  # nobody waits a minute without knowing for what
        assert 0 < printed.out.index(f"{lap.title}: it sets off") < printed.out.index(f"{lap.title}: 1138 m")
    commands.clear()
    assert demo.main([]) == program.DONE
    assert [words[0] for words in commands] == ["record", "-m"]  # which finds its recordings; and the report
    assert "sets off" not in capsys.readouterr().out


@pytest.mark.parametrize("status", [program.FAILED, program.INCOMPLETE])  # with an error, or a crash
def test_a_stopped_training_is_resumed_and_a_stopped_lap_is_driven_again(commands, monkeypatch, status):
    (demo.FOLDER / "model-resume.pt").touch()
    python = demo.python

    def without_room(*words, **more):
        return subprocess.CompletedProcess(words, status, "", "simulator: no room") if "cw" in words else python(*words)

    monkeypatch.setattr(demo, "python", without_room)
    with pytest.raises(SimulatorError, match="simulator: no room; start the demo again to continue"):
        demo.main([])
    assert "--resume" in commands[1]
    assert not any(lap.picture.exists() for lap in DRIVES if lap.direction == "cw")
    monkeypatch.setattr(demo, "python", python)
    assert demo.main([]) == program.DONE
    assert not list(demo.FOLDER.glob("unfinished*"))


def test_a_lap_that_left_the_road_is_told_and_ends_with_status_1(commands, capsys):
    lap = DRIVES[0]
    lap.picture.parent.mkdir()
    lap.picture.touch()
    left = json.dumps(REPORT | {"departures": [DEPARTURE] * 2})
    lap.picture.with_suffix(".json").write_text(left, encoding="utf-8")
    assert demo.main([]) == program.INCOMPLETE
    assert f"{lap.title}: 1138 m at 30 mph, left the road 2 times" in capsys.readouterr().out


def test_a_damaged_report_of_a_lap_is_named(commands):
    lap = DRIVES[0]
    lap.picture.parent.mkdir()
    lap.picture.touch()
    lap.picture.with_suffix(".json").write_text("{", encoding="utf-8")
    with pytest.raises(UserError, match=rf"{lap.title}\.json: damaged"):
        demo.main([])


def test_recordings_of_ones_own_are_trained_on_and_driven(commands, linked, capsys):
    assert demo.main([str(linked), "--track", "jungle"]) == program.DONE
    own = str(Path("demo", "own"))
    assert commands[0][1] == str(linked) and commands[0][-1] == str(Path(own, "model.pt")), "nothing is recorded"
    driven = [words for words in commands if "drive" in words]
    assert [words[words.index("--direction") - 1] for words in driven] == ["jungle", "jungle"]
    assert commands[-1][:3] == ["-m", "cloning.report", own]
    assert "python drive.py demo/own/model.pt" in capsys.readouterr().out
    arguments, link = demo.OWN / "training_arguments.json", linked.with_name("link")
    link.symlink_to(linked)
    arguments.write_text(json.dumps({"recordings": [str(link)]}), encoding="utf-8")
    assert demo.main([str(link)]) == program.DONE, "it goes on"
    arguments.write_text(json.dumps({"recordings": ["/gone"]}), encoding="utf-8")
    with pytest.raises(UserError, match="a demo with other recordings, /gone: delete the folder first"):
        demo.main([str(linked)])
