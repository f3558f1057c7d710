"""What CONTRIBUTING.md shows works as it stands there."""

import re

import numpy as np
from commands import ROOT
from PIL import Image

from cloning.network.attention import visual_backprop
from cloning.network.network import NETWORKS, load_model

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
