"""Training, the network and replays work where no socket library is installed; only serving needs one."""

import subprocess
import sys

from commands import ROOT, SHORT

COMMANDS = """
import importlib.abc, sys

class TakenAway(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"eventlet", "engineio", "socketio", "flask", "wsproto"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, TakenAway())
import cloning.network.network, cloning.network.attention, cloning.network.compute
import model, simulator.__main__ as simulator
recording, trained, *short = sys.argv[1:]
assert model.main([recording, "--robust", *short, "--output", trained]) == 0
assert not {"torch._dynamo", "sympy"} & set(sys.modules)  # torch's own optimizers load its compiler, for seconds
assert simulator.main(["replay", recording, "--model", trained, "--limit", "1", "--reference", "human"]) in (0, 1)
"""


def test_training_and_replays_need_no_socket_library(sample_recording, tmp_path):
    short = (*SHORT, "--epochs", 1, "--samples-per-epoch", 16)
    arguments = map(str, (sample_recording, tmp_path / "model.pt", *short))
    done = subprocess.run([sys.executable, "-c", COMMANDS, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "limit 1 m, from the " in done.stdout and "autonomy" in done.stdout
