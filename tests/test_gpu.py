"""What a GPU makes and computes is what the CPU does, but for rounding; most of it is tested on the CPU."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

import model
from cloning.network.network import Network
from cloning.recordings.check import check_images
from cloning.recordings.log import read_recording
from cloning.training.gpu import GpuFrames
from cloning.training.pieces import Batch, SquaredErrors
from cloning.training.recipe import Augmentation
from model import REPORT, ROBUST, Generator


@pytest.fixture(scope="module")
def pool():
    with ThreadPoolExecutor(2) as threads:
        yield threads


@pytest.mark.parametrize("recipe", [REPORT, ROBUST], ids=["report", "robust"])
def test_a_gpus_images_are_the_cpus(sample_recording, pool, recipe):
    found = recipe.select(check_images(read_recording(sample_recording)), recipe)
    on_gpu = found.on_gpu(torch.device("cpu"), pool)
    expected, made = (Generator(each, recipe, 0, pool).start_batch(5)() for each in (found, on_gpu))
    np.testing.assert_array_equal(made.labels, expected.labels)
    np.testing.assert_array_equal(made.keep, expected.keep)
    difference = np.abs(made.images.numpy().astype(int) - expected.images)
    assert difference.mean() < 0.3  # OpenCV interpolates and changes colours in fixed-point numbers
    assert np.quantile(difference, 0.999) <= 3
    rows = np.arange(0, len(found), 7)
    for gpu_set, cpu_set in zip(*(recipe.validation_sets(each, recipe, 0) for each in (on_gpu, found)), strict=True):
        np.testing.assert_allclose(gpu_set.images(rows).float(), cpu_set.images(rows), atol=20)
        np.testing.assert_array_equal(gpu_set.labels, cpu_set.labels)


@pytest.mark.parametrize("huber", [None, 0.1])
def test_images_that_fill_a_batch_up_do_not_count(pool, huber):
    """17 images make a batch of 32 on a GPU."""
    torch.manual_seed(0)
    rng, network = np.random.default_rng(0), Network()
    images = rng.integers(0, 255, (17, 75, 320, 3), np.uint8)
    batch = Batch(images, rng.uniform(-1, 1, 17).astype(np.float32), rng.random((17, network.units)) < 0.5, 17)
    errors = SquaredErrors(network, torch.float32, pool, huber)
    total = errors(batch)
    total.backward()
    found, gradients = errors.on_gpu(batch)
    assert float(found) == pytest.approx(float(total.detach()), rel=1e-5)
    for gradient, parameter in zip(gradients, network.parameters(), strict=True):
        assert parameter.grad is not None
        torch.testing.assert_close(gradient, parameter.grad, rtol=1e-3, atol=1e-4 * float(parameter.grad.abs().max()))


def test_only_frames_that_are_used_are_loaded_and_only_for_what_a_gpu_can_change(sample_recording, pool):
    found = REPORT.select(check_images(read_recording(sample_recording)), REPORT)
    frames = found.take(np.arange(20, 30)).on_gpu(torch.device("cpu"), pool).gpu
    assert frames and frames.count == 3 * 10
    own = Augmentation("own", lambda images, *_: images)
    assert REPORT.on_gpu() and ROBUST.on_gpu() and not replace(ROBUST, disturbed=0.4).on_gpu()
    assert not replace(REPORT, augmentations=(own,)).on_gpu()


def test_frames_that_do_not_fit_are_left_to_the_cpu(sample_recording, pool, monkeypatch, capsys):
    monkeypatch.setattr(GpuFrames, "fit", lambda self: False)
    found = REPORT.select(check_images(read_recording(sample_recording)), REPORT)
    assert found.on_gpu(torch.device("cpu"), pool).gpu is None
    assert "do not fit into the GPU's memory" in capsys.readouterr().out


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU of NVIDIA")
def test_a_gpu_trains_as_the_cpu_does(sample_recording, tmp_path):
    recipe, losses = replace(ROBUST, samples_per_epoch=1500, epochs=1), []
    for device in ("cpu", "cuda"):
        assert model.train(recipe, [sample_recording], tmp_path / device / "model.pt", device=device) == 0
        losses.append((tmp_path / device / "training_log.csv").read_text().splitlines()[1].split(",")[3:5])
    np.testing.assert_allclose(np.array(losses[1], float), np.array(losses[0], float), rtol=0.3)
