"""Training, the network and replays work where no socket library is installed; only serving needs one."""

import subprocess
import sys

from commands import ROOT, SHORT

TAKEN_AWAY = """
import importlib.abc, runpy, sys

class TakenAway(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"eventlet", "engineio", "socketio", "flask", "wsproto"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, TakenAway())
"""


def run(code: str, *arguments: object) -> str:
    """The output of Python code in a process without socket libraries."""
    done = subprocess.run(
        [sys.executable, "-c", TAKEN_AWAY + code, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_training_and_replays_need_no_socket_library(sample_recording, tmp_path):
    trained = tmp_path / "model.pt"
    run("import cloning.network.network, cloning.network.attention, cloning.network.compute")
    run("runpy.run_path('model.py', run_name='__main__')", sample_recording, *SHORT, "--output", trained)
    replay = "runpy.run_module('simulator', run_name='__main__', alter_sys=True)"
    printed = run(replay, "replay", sample_recording, "--model", trained)
    assert "limit 1 m: autonomy" in printed
