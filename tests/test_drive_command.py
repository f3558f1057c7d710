"""drive.py's command line: which model drives, where frames are saved, how it ends, and what it tells of mistakes."""

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import warm
from commands import HERE, ROOT, call_here
from drive_process import STOP, ask, awaited, found, script, serving
from steer_server import unused_port

import drive
from cloning.base.errors import UserError
from cloning.base.program import in_commands
from cloning.network.network import SHIPPED_MODEL, load_model, steer
from cloning.recordings.images import decode
from tools.simulator_client import Simulator, telemetry


def test_mistakes_are_reported(model_file, tmp_path):
    torch.save({"weights": [1]}, tmp_path / "foreign.pt")
    for folder, name in (("mine", "thesis.txt"), ("run1", "2018_07_16_17_11_43_382.jpg")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_bytes(b"frame")
    with serving(model_file) as other:  # two servers must not share a port, which SO_REUSEPORT would let them do
        for arguments, words in (
            ((tmp_path / "foreign.pt",), "not a model of this project"),
            ((tmp_path / "my run",), f".pt '{tmp_path / 'my run'}'`"),
            ((model_file, tmp_path / "mine"), "thesis.txt"),
            ((model_file, "--stop-when-lost"), "nothing tells when it is lost"),
            ((model_file, tmp_path / "run1", "--port", other.port), "Udacity's simulator connects to 4567 only"),
            ((model_file, "--host", "192.0.2.1"), "--host must be an address of this machine"),
        ):
            done = call_here(drive.main, "drive.py", *arguments)
            assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1
    assert any((tmp_path / "run1").iterdir()), "a server that cannot start deletes nothing"


def test_the_page_of_a_host_with_a_name_is_shown_with_its_address(model_file, monkeypatch):
    """Under a name a browser is refused; the simulators and localhost are served, too."""
    monkeypatch.setattr("cloning.server.connections.noted_signals", lambda: [])
    monkeypatch.setattr("cloning.server.connections.serve", lambda listener, app, stopped, *_: stopped.append(2))
    told = call_here(drive.main, "drive.py", model_file, "--host", "localhost", "--port", 0).stderr
    assert re.search(r"\nListening on localhost:(\d+)\.[\s\S]+\nWatch at http://127\.0\.0\.1:\1/ ", told), told


@pytest.mark.parametrize("module", ["drive", "cloning.browse.__main__"])
@pytest.mark.parametrize(
    "change, words",
    [
        ("sys.modules.update(eventlet=None)", "import of eventlet halted"),
        ("importlib.metadata.version = lambda _: '4.6.1'", "python-socketio is 4.6.1 and must be 5"),
    ],
)
def test_other_socket_libraries_are_refused_by_the_command_and_no_harm_to_an_import(module, change, words):
    """The page of recordings does not need PyTorch either."""
    code = (
        f"import importlib.metadata, sys; {change}; import {module} as command\n"
        "print('torch' in sys.modules); command.program.run(command.main)"
    )
    start = warm.run if module == "drive" else subprocess.run  # the warm process has PyTorch
    done = start([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout == f"{module == 'drive'}\n" and done.returncode == 2, done.stderr
    assert words in done.stderr and "Traceback" not in done.stderr
    assert in_commands("`pip install .`") in done.stderr


def test_which_model_drives(jpegs, tmp_path, monkeypatch):
    with serving(cwd=tmp_path) as process, Simulator(process.port).open() as simulator:
        answer = np.float32(simulator.drive(telemetry(jpegs[0]))["steering_angle"])
        assert answer == steer(load_model(SHIPPED_MODEL), decode(jpegs[0]))
        assert f"Driving with {SHIPPED_MODEL} (the model that comes with the project).\n" in process.lines
    monkeypatch.chdir(tmp_path)
    assert drive.choose_model(None, None) == SHIPPED_MODEL
    (tmp_path / "model.pt").touch()
    assert drive.choose_model(None, None) == Path("model.pt")
    assert drive.choose_model(Path("none.pt"), None) == Path("none.pt"), "whose loading tells that it is missing"
    (tmp_path / "run1").mkdir()
    for folder in ("run1", "run2"):
        with pytest.raises(UserError, match=f"`python drive.py model.pt {folder}`"):
            drive.choose_model(Path(folder), None)
    for other in ("none.pth", "model.h5"):
        assert drive.choose_model(Path(other), None) == Path(other), "no folder either"


@pytest.mark.parametrize("text", ["model.pt run1 --port 1", "model.pt --port 1 run1", "--port 1 model.pt run1"])
def test_the_folder_may_follow_options(text):
    arguments = drive.parse_arguments(text.split())
    assert (str(arguments.model), str(arguments.folder), arguments.port) == ("model.pt", "run1", 1)


# Takes away what other systems do not have, after torch, whose Linux build needs some of it.
ELSEWHERE = """
import os, signal, socket, torch
for module, name in [(socket, "TCP_QUICKACK"), (signal, "SIGTERM"), (os, "fork"), (os, "sched_getaffinity")]:
    vars(module).pop(name, None)
"""


def test_driving_and_filming_without_what_only_linux_has(model_file, jpegs, steering, tmp_path):
    folder = tmp_path / "run1"
    with serving(model_file, folder, first=ELSEWHERE) as process, Simulator(process.port).open() as simulator:
        for n in range(8):
            assert np.float32(simulator.drive(telemetry(jpegs[n]))["steering_angle"]) == steering[n]
        assert process.stop() == 128 + STOP
    assert len(list(folder.glob("*.jpg"))) == 8
    command = [*script("video.py", ELSEWHERE), str(folder), "--overlay", str(model_file)]
    film = warm.run(command, env={**os.environ, **HERE}, capture_output=True, text=True, timeout=120)
    assert film.returncode == 0 and "run1.mp4: 8 frames" in film.stdout, film.stderr


def test_nothing_is_lost_when_it_is_stopped(model_file, jpegs, tmp_path):
    with serving(model_file, "run1", cwd=tmp_path) as process, Simulator(process.port).open() as simulator:
        for n in range(60):
            simulator.drive(telemetry(jpegs[n % 8]))
        simulator.drive({})
        for recording in (False, True):  # after each, one more frame
            assert ask(process.port, "/record", "POST", {"recording": recording})[0] == 200
            simulator.drive(telemetry(jpegs[0]))
        assert process.stop() == 128 + STOP
    told = "62 frames driven, 1 unusable; 60 frames saved in run1; 1 frames saved in run1-2"
    assert process.lines[-1] == f"drive.py: session ended: {told}\n"
    saved = sorted((tmp_path / "run1").glob("*.jpg"))
    assert [path.read_bytes() for path in saved] == [jpegs[n % 8] for n in range(60)]
    assert all(re.fullmatch(r"\d{4}(_\d\d){5}_\d{3}\.jpg", path.name) for path in saved)


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
def test_the_signal_that_comes_as_soon_as_it_listens_ends_it_as_usual(model_file):
    with serving(model_file) as process:
        assert process.stop(signal.SIGTERM) == 128 + signal.SIGTERM


def test_a_terminal_that_nobody_reads_and_requests_that_fill_it_stop_no_car(model_file, jpegs):
    """A pipe takes 64 KiB; http.server writes two lines about each of these requests."""
    command = [*script("drive.py"), str(model_file), "--port", "0"]
    process = warm.Popen(command, env={**os.environ, **HERE}, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr
        port = int(found(r"Listening on [\d.]+:(\d+)", "".join(process.stderr.readline() for _ in range(3))))
        for _ in range(500):
            with socket.create_connection(("127.0.0.1", port), 10) as client:
                client.sendall(b"G\r\n\r\n")
                client.recv(10)
        with Simulator(port).open() as simulator:
            for _ in range(500):
                with Simulator(port).open() as other:
                    other.drive({})  # a warning of its own session, and a line about its end
                simulator.drive(telemetry(jpegs[0]))
        process.send_signal(STOP)
        assert process.wait(10) == 128 + STOP
        assert len(process.stderr.read()) < 50_000
    finally:
        process.kill()


def test_a_terminal_that_is_gone_before_the_first_line_stops_no_car_and_no_signal(model_file, jpegs, tmp_path):
    def simulator() -> Simulator | None:
        try:
            return Simulator(port).open()
        except ConnectionRefusedError:
            return None

    reader, writer = os.pipe()
    os.close(reader)
    port = unused_port()
    command = [*script("drive.py"), str(model_file), str(tmp_path / "run1"), "--port", str(port)]
    process = warm.Popen(command, env={**os.environ, **HERE}, stderr=writer)
    os.close(writer)
    try:
        with awaited(simulator) as car:
            car.drive(telemetry(jpegs[0]))
            process.send_signal(STOP)
            assert process.wait(20) == 128 + STOP
    finally:
        process.kill()
    assert len(list((tmp_path / "run1").glob("*.jpg"))) == 1
