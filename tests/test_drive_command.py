"""drive.py's command line: which model drives, where frames are saved, how it ends, and what it tells of mistakes."""

import os
import re
import shutil
import signal
import socket
import sys

import numpy as np
import pytest
import torch
import warm
from commands import HERE
from drive_process import STOP, script, serving

from cloning.base.errors import UserError
from cloning.network.network import SHIPPED_MODEL, load_model, steer
from cloning.recordings.images import decode
from cloning.server.versions import check_versions
from tools.simulator_client import Simulator, telemetry


def failing(*arguments, first="") -> str:
    process = warm.run(
        [*script("drive.py", first), *map(str, arguments)],
        env={**os.environ, **HERE},
        timeout=120,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 2 and "Traceback" not in process.stderr
    assert process.stderr.splitlines()[-1].startswith("drive.py: ")
    return process.stderr


def test_mistakes_are_reported(model_file, tmp_path):
    torch.save({"weights": [1]}, tmp_path / "foreign.pt")
    assert "not a model of this project" in failing(tmp_path / "foreign.pt")
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("words", encoding="utf-8")
    assert "thesis.txt" in failing(model_file, mine)
    (tmp_path / "run1").mkdir()
    frame = tmp_path / "run1" / "2018_07_16_17_11_43_382.jpg"
    frame.write_bytes(b"frame")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert f"can't listen on 127.0.0.1:{port}" in failing(model_file, tmp_path / "run1", "--port", port)
    with serving(model_file) as other:  # two servers must not share a port, which SO_REUSEPORT would let them do
        message = failing(model_file, tmp_path / "run1", "--port", other.port)
        assert f"can't listen on 127.0.0.1:{other.port}" in message
    assert frame.exists(), "a server that cannot start deletes nothing"


def test_other_versions_of_the_socket_libraries_are_refused():
    message = failing(first="import importlib.metadata; importlib.metadata.version = lambda name: '5.18.1'")
    assert "python-socketio is 5.18.1 and must be 4.6.1" in message and "pip install -r requirements.txt" in message


def test_the_versions_come_from_requirements_txt(tmp_path):
    check_versions(tmp_path / "none.txt")  # an installed package, whose versions pip has seen to
    (tmp_path / "requirements.txt").write_text("eventlet==0.0.1  # older\npython-socketio==4.6.1\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"^eventlet is [\d.]+ and must be 0\.0\.1: .*pip install -r requirements.txt"):
        check_versions(tmp_path / "requirements.txt")


def test_without_a_model_it_names_and_takes_model_pt_or_the_shipped_one(model_file, jpegs, steering, tmp_path):
    with serving(cwd=tmp_path) as process, Simulator(process.port) as simulator:
        simulator.open()
        answer = np.float32(simulator.drive(telemetry(jpegs[0]))["steering_angle"])
        assert answer == steer(load_model(SHIPPED_MODEL), decode(jpegs[0]))
        assert f"Driving with {SHIPPED_MODEL} (the model that comes with the project).\n" in process.lines
    shutil.copy(model_file, tmp_path / "model.pt")
    with serving(cwd=tmp_path) as process, Simulator(process.port) as simulator:
        simulator.open()
        assert np.float32(simulator.drive(telemetry(jpegs[0]))["steering_angle"]) == steering[0]
        assert "Driving with model.pt.\n" in process.lines


# Takes away what other systems do not have, after torch, whose Linux build needs some of it.
ELSEWHERE = """
import os, signal, socket, torch
for module, name in [(socket, "TCP_QUICKACK"), (signal, "SIGTERM"), (os, "fork"), (os, "sched_getaffinity")]:
    vars(module).pop(name, None)
"""


def test_driving_and_filming_without_what_only_linux_has(model_file, jpegs, steering, tmp_path):
    folder = tmp_path / "run1"
    with serving(model_file, folder, first=ELSEWHERE) as process, Simulator(process.port) as simulator:
        simulator.open()
        for n in range(8):
            assert np.float32(simulator.drive(telemetry(jpegs[n]))["steering_angle"]) == steering[n]
        assert process.stop() == 0
    assert len(list(folder.iterdir())) == 8
    film = warm.run(
        [*script("video.py", ELSEWHERE), str(folder), "--overlay", str(model_file)],
        env={**os.environ, **HERE},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert film.returncode == 0 and "run1.mp4: 8 frames" in film.stdout, film.stderr


WINDOWS_KILLS = pytest.mark.skipif(sys.platform == "win32", reason="there SIGTERM ends a process at once")


@pytest.mark.parametrize("number", [STOP, pytest.param(signal.SIGTERM, marks=WINDOWS_KILLS)])
def test_nothing_is_lost_when_it_is_stopped(model_file, jpegs, tmp_path, number):
    with serving(model_file, "run1", cwd=tmp_path) as process, Simulator(process.port) as simulator:
        simulator.open()
        for n in range(200):
            simulator.drive(telemetry(jpegs[n % 8]))
        simulator.drive({})
        assert process.stop(number) == 0
    assert process.lines[-1] == "drive.py: session ended: 200 frames driven, 1 unusable; driven frames saved in run1\n"
    saved = sorted((tmp_path / "run1").iterdir())
    assert [path.read_bytes() for path in saved] == [jpegs[n % 8] for n in range(200)]
    assert all(re.fullmatch(r"\d{4}(_\d\d){5}_\d{3}\.jpg", path.name) for path in saved)
