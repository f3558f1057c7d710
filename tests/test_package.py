"""The package: its wheel, installed in a fresh environment."""

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from commands import ROOT
from drive_process import ask, found

KEPT = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()


# In one process, because PyTorch takes seconds to load.
IN_PYTHON = """
import sys, cloning.command as installed
for name in installed.COMMANDS:
    sys.argv = ["behavioral-cloning", name, "--help"]
    try:
        installed.main()
    except SystemExit as end:
        assert not end.code, name
import gymnasium
print(gymnasium.make("simulator.environment:behavioral-cloning/Drive-v0").reset()[0].shape)
"""


@pytest.fixture
def wheel(tmp_path) -> Path:
    """The wheel of the sdist of a copy of the files that git keeps: nothing else gets into it, or into the folder."""
    for name in KEPT:
        copy = tmp_path / "source" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy)
    # With this environment's setuptools, which PyTorch requires, too: pip would install another one first.
    build = "import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=tmp_path / "source", check=True, timeout=120)
    [sdist] = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        assert not any("/tests/" in name for name in archive.getnames()), "setuptools takes them without their helpers"
    command = ["pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", tmp_path]
    subprocess.run([sys.executable, "-m", *command, sdist], check=True, timeout=120)
    return next(tmp_path.glob("*.whl"))


def install(folder: Path, *project: str | Path) -> Path:
    """Make an environment with the project, and the libraries of this one; return the folder of its commands."""
    venv.create(folder)
    [packages] = folder.glob("Lib/site-packages" if os.name == "nt" else "lib/python*/site-packages")
    libraries = importlib.metadata.distribution("numpy").locate_file("")
    (packages / "libraries.pth").write_text(f"{libraries}\n", encoding="utf-8")
    command = ["pip", "--python", str(folder), "install", "--quiet", "--no-deps", "--ignore-installed"]
    subprocess.run([sys.executable, "-m", *command, *project], check=True, timeout=120)
    return folder / ("Scripts" if os.name == "nt" else "bin")


def test_the_wheel_in_a_fresh_environment(wheel, tmp_path):
    """It has the project's files and no others; its commands run anywhere, and drive ten seconds of the lake."""
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    wanted = {name for name in KEPT if name.startswith(("cloning/", "simulator/"))}
    assert names == wanted | {f"cloning/scripts/{name}.py" for name in ("model", "drive", "video")}
    assert {"cloning/py.typed", "simulator/py.typed", "cloning/network/shipped.pt"} <= names

    folder, elsewhere = install(tmp_path / "environment", wheel), tmp_path / "elsewhere"
    elsewhere.mkdir()
    editable = install(tmp_path / "editable", "--no-build-isolation", "--editable", tmp_path / "source")
    command = str(folder / "behavioral-cloning")

    def run(*words: str | Path) -> subprocess.CompletedProcess:
        return subprocess.run(words, cwd=elsewhere, capture_output=True, text=True, encoding="utf-8", timeout=120)

    assert run(command).returncode == 2
    assert run(command, "--version").stdout == f"behavioral-cloning {wheel.name.split('-')[1]}\n"
    commands = re.findall(r"^  (\w+)", run(command, "--help").stdout, re.MULTILINE)
    assert commands == ["train", "drive", "video", "simulator", "replay", "browse", "report", "export", "lerobot"]
    done = run(folder / "python", "-c", IN_PYTHON)
    assert done.returncode == 0 and done.stdout.count("usage: behavioral-cloning ") == len(commands), done.stderr
    assert done.stdout.endswith("\n(160, 320, 3)\n")
    assert run(editable / "behavioral-cloning", "video", "--help").returncode == 0, "it finds the scripts in the clone"
    missing = run(command, "train", "nowhere")
    assert missing.returncode == 2 and missing.stderr.startswith("behavioral-cloning train: nowhere: no such folder")
    assert "`behavioral-cloning simulator record data/lake-ccw`" in missing.stderr and not list(elsewhere.iterdir())

    server = subprocess.Popen([command, "drive", "--port", "0"], cwd=elsewhere, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr
        port = found(r"Listening on [\d.]+:(\d+)", server.stderr.readline() + server.stderr.readline())
        assert ask(int(port), "/")[0] == ask(int(port), "/site/style.css")[0] == 200, "it finds its page"
        drive = run(command, "simulator", "drive", "--laps", "0.036", "--port", port, "--report", "lap.json")
        assert drive.returncode == 0, drive.stderr
        assert json.loads((elsewhere / "lap.json").read_text(encoding="utf-8"))["simulated_seconds"] > 10
    finally:
        server.kill()
        server.wait()
