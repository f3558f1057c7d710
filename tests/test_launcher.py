"""The launcher that other people's programs start in place of the simulator, and how `join` is started and ended."""

import signal
import socket
import subprocess
import sys

import pytest
from test_join import Program, RoadTests

from simulator.__main__ import main

pytestmark = pytest.mark.usefixtures("at_once")
SCRIPTS = pytest.mark.skipif(sys.platform == "win32", reason="Windows starts no shell scripts")


@SCRIPTS
def test_a_launcher_is_taken_for_the_simulator_and_writes_its_log(tmp_path):
    launcher = tmp_path / "sim.x86_64"
    (tmp_path / "simulator.py").write_text("raise SystemExit(7)", encoding="utf-8")  # the program's own
    assert main(["join", "--dialect", "roads", "--launcher", str(launcher), "--wait", "2", "--marking", "kerb"]) == 0
    with Program(RoadTests([0.0])) as program:
        options = ["-batchmode", "-nographics", "--port", str(program.port), "-logFile", "unitylog.txt"]
        process = subprocess.run([launcher, *options], cwd=tmp_path, capture_output=True, timeout=60)
    assert (process.returncode, process.stdout, process.stderr) == (0, b"", b"")
    assert "1 episode, " in (tmp_path / "unitylog.txt").read_text()


def test_a_log_that_is_named_as_a_dash_is_the_terminal_as_for_unity(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["join", "--dialect", "measures", "--port", "9", "--wait", "0.1", "-logFile", "-"]) == 2
    assert "waited 0.1 s" in capsys.readouterr().err and not any(tmp_path.iterdir())


@SCRIPTS
def test_a_launcher_replaces_none_but_an_earlier_one(tmp_path, capsys):
    launcher = tmp_path / "udacity.x86_64"
    launcher.write_bytes(b"\x7fELF the real simulator")
    command = ["join", "--dialect", "roads", "--launcher", str(launcher)]
    assert main(command) == 2 and "name another file" in capsys.readouterr().err
    assert launcher.read_bytes() == b"\x7fELF the real simulator"
    launcher.unlink()
    assert main(command) == main([*command, "--fps", "10"]) == 0 and "--fps 10" in launcher.read_text()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["roads", "--road", "none.csv"], "none.csv: No such file"),
        (["measures", "--width", "6"], "--width is of a road of your own"),
        (["episodes", "--track", "jungle"], "the program names the tracks; leave out --track and --road"),
    ],
)
def test_options_that_would_do_nothing_are_refused_before_a_launcher_is_written(words, reason, tmp_path, capsys):
    launcher = tmp_path / "sim.x86_64"
    assert main(["join", "--launcher", str(launcher), "--dialect", *words]) == 2
    assert reason in capsys.readouterr().err and not launcher.exists()


def test_on_windows_no_launcher_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "platform", "win32")
    assert main(["join", "--dialect", "roads", "--launcher", str(tmp_path / "udacity.exe")]) == 2
    assert "a shell script, which Windows can't start" in capsys.readouterr().err and not any(tmp_path.iterdir())


@SCRIPTS
def test_a_program_may_end_the_simulator_by_a_signal(tmp_path):
    launcher = tmp_path / "sim.x86_64"
    assert main(["join", "--dialect", "measures", "--launcher", str(launcher)]) == 0
    with socket.create_server(("127.0.0.1", 0)) as listener:
        process = subprocess.Popen([launcher, "--port", str(listener.getsockname()[1])])
        listener.accept()[0].close()
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == -signal.SIGTERM
