"""The repository: wrong imports are found, documents name what exists and works, requirements are what is used."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
from commands import ROOT
from PIL import Image

from cloning.network.attention import visual_backprop
from cloning.network.network import NETWORKS, load_model

PACKAGES = ("cloning", "simulator", "tools")
SCRIPTS = ("model.py", "drive.py", "video.py")
DOCUMENTS = [*ROOT.glob("*.md"), ROOT / "data" / "README.md", *ROOT.glob("tools/**/*.md"), *ROOT.glob("cloning/*/*.md")]
NOT_INSTALLED = {"distributed"}  # of the extra dask, whose test is skipped without it
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
WRONG_IMPORTS = {  # contract -> the files that break it, and with what import
    "tools import simulator, which imports cloning": {"cloning/recordings/log.py": "simulator.run"},
    "the packages of cloning import downwards": {"cloning/recordings/log.py": "cloning.road.track"},
    "packages do not import the scripts": {"simulator/run.py": "drive"},
    "only simulator.environment needs Gymnasium": {"simulator/film.py": "gymnasium"},
    "only cloning.server needs eventlet": {"cloning/replay/score.py": "eventlet"},
    "no import cycles": {
        "cloning/road/track.py": "cloning.road.camera",
        "cloning/road/camera.py": "cloning.road.track",
    },
}


def test_every_contract_finds_a_wrong_import(tmp_path):
    """In a copy of the packages; `make lint` has shown that there is none without these."""
    assert set(WRONG_IMPORTS) == {contract["name"] for contract in PROJECT["tool"]["importlinter"]["contracts"]}
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for files in WRONG_IMPORTS.values():
        for file, module in files.items():
            with (tmp_path / file).open("a", encoding="utf-8") as source:
                source.write(f"\nimport {module}\n")
    command = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run(
        [sys.executable, "-c", command, "--no-logo", "--no-cache"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "utf-8"},
        capture_output=True,
        encoding="utf-8",
    )
    assert done.returncode == 1
    for contract in WRONG_IMPORTS:
        assert f"{contract} BROKEN" in done.stdout


def imported_packages(tree: ast.Module) -> set[str]:
    """The top-level names that a file imports, at its top or within a function."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


def test_requirements_are_what_the_code_imports():
    files = [ROOT / script for script in SCRIPTS]
    files += [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    imported = set().union(*(imported_packages(ast.parse(path.read_text(encoding="utf-8"))) for path in files))
    own = {*PACKAGES, *(Path(script).stem for script in SCRIPTS)}
    foreign = imported - own - set(sys.stdlib_module_names) - NOT_INSTALLED
    distributions = packages_distributions()
    used = {distributions[name][0].lower() for name in foreign}
    extras = PROJECT["project"]["optional-dependencies"]
    wanted = [each for name in extras if name != "dev" for each in extras[name]] + PROJECT["project"]["dependencies"]
    assert used == names_of(wanted) - NOT_INSTALLED


def names_of(requirements: list[str]) -> set[str]:
    return {re.split("[<>=]", each)[0].lower() for each in requirements}


def test_every_requirement_is_listed_with_its_purpose_and_pinned():
    section = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split("## Dependencies")[1].split("## ")[0]
    pinned = names_of((ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines())
    extras = PROJECT["project"]["optional-dependencies"]
    for requirements in (PROJECT["project"]["dependencies"], *extras.values()):
        for name in names_of(requirements):
            assert re.search(rf"\b{name}\b", section) and (name in pinned or name in NOT_INSTALLED), name
    assert {each for each in pinned if re.match("types-|.*-stubs$", each)} <= names_of(extras["dev"])


@pytest.mark.skipif(os.name == "nt" or not shutil.which("make"), reason="needs make and sh")
def test_make_lock_leaves_out_what_only_linux_has(tmp_path):
    python = tmp_path / "python"  # stands for Python and for that of the new environment, with PyPI's PyTorch on Linux
    listed = "cuda-toolkit==13.0\\nnvidia-nvtx==13.0\\ntorch==2.13.0+cu130\\ntriton==3.7.1\\n"
    makes = 'mkdir -p .venv-lock/bin; cp "$0" .venv-lock/bin/python'
    python.write_text(f"#!/bin/sh\ncase $* in *venv*) {makes};; *list*) printf '{listed}';; esac\n", encoding="utf-8")
    python.chmod(0o755)
    shutil.copy(ROOT / "requirements.txt", tmp_path)
    subprocess.run(["make", "-f", ROOT / "Makefile", "lock", "PYTHON=./python"], cwd=tmp_path, check=True)
    assert (tmp_path / "requirements.txt").read_text(encoding="utf-8").splitlines()[2:] == ["torch==2.13.0"]


def anchors(document: Path) -> set[str]:
    """The names by which a web page of the document links to its headings, as GitHub forms them."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documents_name_what_exists(document):
    text = document.read_text(encoding="utf-8")
    for link in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (document.parent / link).exists(), link
    for file, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#([^)]+)", text):
        assert anchor in anchors(document.parent / file if file else document), f"{file}#{anchor}"
    for tool in re.findall(r"python -m tools\.([a-z_]+)", text):
        assert any((ROOT / "tools" / file).exists() for file in (f"{tool}.py", f"{tool}/__main__.py")), tool
    for path in re.findall(r"`((?:cloning|simulator|tools|tests)/[a-z_/.]*)`", text):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_lines_of_documents_are_at_most_120_characters(document):
    lines = document.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if len(line) > 120 and not line.startswith("|")] == []


def test_what_runs_write_is_not_tracked(finished):
    """What model.py leaves, and what drives, films and reports are called in the documents."""
    if not (ROOT / ".git").exists() or not shutil.which("git"):
        pytest.skip("needs git and a checkout")
    names = [path.relative_to(finished[1]).as_posix() for path in finished[1].rglob("*") if path.is_file()]
    names += ["model-previous.pt", "rejected_rows.csv", "report.html", "data/lake/driving_log.csv", "run1.mp4"]
    names += ["run1/2018_07_16_17_11_43_382.jpg", "lap.json", "lap.png", "lap.mp4"]
    ignored = subprocess.run(["git", "check-ignore", *names], cwd=ROOT, capture_output=True, text=True).stdout
    assert set(ignored.splitlines()) == set(names)


# ----------------------------------------------------------------------------------------------------------------------
# What CONTRIBUTING.md shows works as it stands there

SHORT = "replace(REPORT, epochs=1, samples_per_epoch=64, batch_size=8, "  # else the code is the document's


def run_example(heading: str) -> None:
    """Run the code below a heading, with a shorter training."""
    section = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split(f"\n## {heading}\n")[1]
    code = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert code and "replace(REPORT, " in code[1]
    exec(compile(code[1].replace("replace(REPORT, ", SHORT), heading, "exec"), {"__name__": "example"})


def test_an_augmentation_is_added(linked, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_example("How to add an augmentation")
    assert (tmp_path / "runs/noisy/model.pt").exists()
    picture = Image.open(tmp_path / "runs/noisy/diagnostic_images/training_generator_augmented-0.png")
    fifth = np.asarray(picture)[-300:, : picture.width // 2].astype(int)  # in a third row, enlarged three times
    assert np.abs(np.diff(fifth[::3], axis=0)).mean() > 5


def test_a_network_is_added(linked, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cloning.network.network.NETWORKS", NETWORKS)
    try:
        run_example("How to add a network")
        network = load_model(tmp_path / "runs/small/model.pt")
    finally:
        NETWORKS.pop("small", None)
    assert type(network).__name__ == "SmallNetwork"
    assert sum(weights.numel() for weights in network.parameters()) < 559_419 / 5
    steering, mask = visual_backprop(network, np.full((160, 320, 3), 90, np.uint8))
    assert abs(steering) <= 1 and mask.shape == (160, 320) and mask.max() > 0
