"""Other people's public networks, rebuilt: their layers, their augmentation, and files that enter the benchmark."""

import sys
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch

from cloning.base.errors import RecordingError
from cloning.base.program import DONE
from cloning.recordings.images import read_frame
from simulator.driving import load_driver
from tools import public_networks
from tools.public_networks import PUBLISHED, augment

# By the tables in the README.md of three of them; comma.ai's has none, so this is by its layers.
PARAMETERS = {"naokishibuya": 252_219, "commaai": 6_621_809, "ksakmann": 416_481, "xslittlegrass": 63}


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_layers_have_the_published_parameters(name):
    assert sum(numbers.numel() for numbers in PUBLISHED[name].layers().parameters()) == PARAMETERS[name]


def test_a_moved_image_asks_for_the_steering_that_was_published():
    """By naokishibuya 0.002 for a pixel; by ksakmann a third of 40 pixels' share, and a sixth of the sheared angle."""
    frame = np.zeros((160, 320, 3), np.uint8)
    frame[:, 158:163] = 255

    def column(image, row):
        return image[row, :, 0].argmax() + 2  # the line's middle

    for seed in range(5):
        rng = np.random.default_rng(seed)
        shifted, steering = augment(frame, 0.0, PUBLISHED["naokishibuya"]._replace(flip=0, brightness=0), rng)
        moved = column(shifted, 80) - 160
        assert steering == pytest.approx(0.002 * moved, abs=0.003) and column(shifted, 120) - 160 == moved
        how = PUBLISHED["ksakmann"]._replace(flip=0, brightness=0, shift=(0, 0, 0))
        sheared, steering = augment(frame, 0.0, how, rng)
        leaning = (column(sheared, 80) - 160) / 80
        assert steering == pytest.approx(np.degrees(leaning) / 25 / 6, abs=0.015)
        assert column(sheared, 159) == pytest.approx(160, abs=2)
    mirrored, steering = augment(frame, 0.3, PUBLISHED["xslittlegrass"]._replace(flip=1), rng)
    assert steering == -0.3 and np.array_equal(mirrored, frame[:, ::-1])


def test_a_rebuilt_network_enters_the_benchmark(sample_recording, tmp_path, monkeypatch, capsys):
    """The file that the benchmark takes steers as the trained network does, on a frame prepared as was published."""
    save = Mock(side_effect=public_networks.save)
    monkeypatch.setattr(public_networks, "save", save)
    brief = PUBLISHED["ksakmann"]._replace(batch=16, samples=160, epochs=2, held_out=0.2)
    monkeypatch.setitem(PUBLISHED, "ksakmann", brief)
    words = [str(sample_recording), "--networks", "ksakmann", "--folder", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["public_networks", *words])
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "onnxscript", None)
        with pytest.raises(ModuleNotFoundError, match="onnxscript"):
            public_networks.main()
        assert not save.called, "it is told before the training"
    assert public_networks.main() == DONE and brief.source in capsys.readouterr().out
    frame = read_frame(next((sample_recording / "IMG").glob("center*")))
    pixels = cv2.resize(frame[60:136, 20:300], (64, 64)).transpose(2, 0, 1)[None] / np.float32(127.5) - 1
    expected = save.call_args.args[0](torch.from_numpy(pixels)).item()
    assert load_driver(str(tmp_path / "ksakmann.onnx"))(frame) == pytest.approx(expected, abs=1e-4)
    assert abs(expected) > 1e-3


def test_recordings_without_a_usable_row_are_named(linked, tmp_path, monkeypatch):
    for image in (linked / "IMG").iterdir():
        image.unlink()
    monkeypatch.setattr(sys, "argv", ["public_networks", str(linked), "--folder", str(tmp_path / "public")])
    with pytest.raises(RecordingError, match=f"{linked}: no usable row is left to train on"):
        public_networks.main()
    assert not (tmp_path / "public").exists()
