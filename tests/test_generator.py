"""From recordings to batches: the recipe's probabilities, ranges and geometry, and what a GPU makes of them."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from rendered import without_files as recording

import model
from cloning.base.frame import FRAME, ROAD_ROWS
from cloning.network.network import Network
from cloning.recordings.check import check_images
from cloning.recordings.frames import FrameCache
from cloning.recordings.log import read_recording
from cloning.training.gpu import GpuFrames
from cloning.training.lanes import Lanes
from cloning.training.light import brighten, shade
from cloning.training.observations import Observations
from cloning.training.pieces import Batch, SquaredErrors
from cloning.training.recipe import Augmentation
from model import REPORT, ROBUST, Generator, balance, split
from tools.bench_training import one_by_one


def all_rows(found):
    return Observations.of_rows(found, np.arange(len(found)), found.steering, Lanes.unknown(len(found)))


def observations(steering, recordings=None, frame=None):
    found = Observations.of_recordings([all_rows(each) for each in recordings or [recording(len(steering))]])
    frame = np.arange(len(found), dtype=np.uint64) if frame is None else frame
    return found.take(slice(None), steering=np.asarray(steering, np.float32), frame=frame)


def loaded(folder):
    return all_rows(check_images(read_recording(folder)))


@pytest.fixture(scope="module")
def pool():
    with ThreadPoolExecutor(2) as threads:
        yield threads


@pytest.fixture
def generator(sample_recording, pool):
    return Generator(loaded(sample_recording), REPORT, 0, pool)


def test_validation_is_a_fifth_in_stretches_of_two_seconds_over_the_whole_recording():
    everything = observations(np.zeros(2800), [recording(1400), recording(1400, "other", first=7e6)])
    drive, seconds = everything.drives()
    assert np.bincount(drive).tolist() == [1400, 1400] and seconds[[0, 1400]].tolist() == [0, 0]
    train, validation = split(everything, REPORT, seed=3)
    assert sorted([*train, *validation]) == list(range(2800))
    assert len(validation) / 2800 == pytest.approx(0.2, abs=0.02)
    for part in np.split(everything.time[validation], np.flatnonzero(np.diff(validation) > 1) + 1):
        assert 1.8 <= np.ptp(part) <= 2.0  # neighbours go together
    assert np.diff(validation).max() <= 5 * 28 + 28  # and no stretch of a recording is without


def test_copies_of_a_frame_are_all_on_one_side():
    copies = np.tile(np.arange(700, dtype=np.uint64), 3)  # the same folder under three names
    everything = observations(np.zeros(2100), [recording(700, str(i), first=7e6 * i) for i in range(3)], copies)
    for seed in range(5):
        train, validation = split(everything, REPORT, seed)
        assert len(validation)
        assert not set(copies[train]) & set(copies[validation])


def test_resampling_has_the_recipes_shares():
    steering = np.repeat([0.0, 0.019, -0.02, 0.2, 0.21, -0.5, 0.51, 1], 10000)
    got = balance(observations(steering), REPORT, seed=1).steering
    straight = (np.abs(got) < 0.0195).sum()
    assert straight / 20000 == pytest.approx(0.8, abs=0.01)
    for once in (-0.02, 0.2, 0.51, 1):
        assert (np.abs(got - once) < 1e-6).sum() == 10000
    for turn in (0.21, -0.5):
        near = got[np.abs(got / turn - 1) <= 0.01001] / turn - 1
        assert len(near) == 20000  # the row and one copy
        jitter = near[np.abs(near) > 1e-6]
        assert (jitter.min(), jitter.max()) == (pytest.approx(-0.01, abs=1e-4), pytest.approx(0.01, abs=1e-4))
        assert jitter.mean() == pytest.approx(0, abs=3e-4)


@pytest.mark.parametrize("repeats", [1, 4, 9])
def test_problem_areas_are_repeated(repeats):
    names = ["lake", "bridge-repetitive", "data-corrections"]
    everything = observations(np.full(30, 0.1), [recording(10, name) for name in names])
    got = balance(everything, replace(REPORT, repeats=repeats), 0)
    assert np.bincount(got.recording).tolist() == [10, 10 * repeats, 10 * repeats]


@pytest.mark.parametrize("factor", [0.4, 0.83, 1.2])
def test_brightness_is_opencvs_hsv_value_clipped_and_never_wrapped(factor):
    image = np.random.default_rng(0).integers(0, 256, (75, 320, 3), np.uint8)
    image[:20] = 250  # would wrap
    value = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)[..., 2].astype(float)
    changed, one = brighten(np.stack([image, image]), 0, np.array([factor, 1]))
    got = cv2.cvtColor(changed, cv2.COLOR_RGB2HSV)[..., 2]
    assert np.abs(got - np.minimum(value * factor, 255)).max() <= 1
    exact = image * np.minimum(factor, 255 / np.maximum(image.max(-1, keepdims=True), 1))  # same hue and saturation
    assert np.abs(changed - exact).mean() < 1.5
    assert np.abs(one.astype(int) - image).mean() < 1.5  # each image by its own factor


@pytest.mark.parametrize("left", [True, False])
def test_shadow_is_opencvs_hls_lightness_on_one_side_of_the_line(left):
    image = np.random.default_rng(0).integers(0, 256, (160, 320, 3), np.uint8)
    top, bottom, factor = 250.0, 40.0, 0.3
    chosen = np.array([factor]), np.array([[top, bottom]]), np.array([left])
    got = shade(image[None], 0, *chosen)[0]
    polygon = np.array([[0, 0], [top, 0], [bottom, 160], [0, 160]], np.int32)  # OpenCV's own drawing as the oracle
    inside = cv2.fillPoly(np.zeros((160, 320), np.uint8), [polygon], 1) == (1 if left else 0)
    edge = cv2.dilate(cv2.Canny(inside.astype(np.uint8) * 255, 1, 2), np.ones((5, 5))) > 0
    assert np.array_equal(got[~inside & ~edge], image[~inside & ~edge])
    lightness = cv2.cvtColor(image, cv2.COLOR_RGB2HLS)[..., 1].astype(float)
    dark = cv2.cvtColor(got, cv2.COLOR_RGB2HLS)[..., 1]
    assert np.abs(dark - lightness * factor)[inside & ~edge].max() <= 2
    np.testing.assert_array_equal(shade(image[None, 60:135], 60, *chosen)[0], got[60:135])  # the crop of the frame


def test_probabilities_and_ranges_over_many_batches(generator):
    draws = [generator.sample(number) for number in range(200)]
    n = 200 * 128
    shares = sum((d.slots >= 0).sum(0) for d in draws) / n
    np.testing.assert_allclose(shares, [1, 0.9, 1, 0.8], atol=0.01)
    np.testing.assert_allclose(np.bincount(np.concatenate([d.camera for d in draws])) / n, [1 / 3] * 3, atol=0.01)
    [brightness], [darkness, line, left] = (
        [np.concatenate(v) for v in zip(*chosen, strict=True)]
        for chosen in ([d.augmenting[augmentation] for d in draws] for augmentation in (2, 3))
    )
    for values, low, high in ((brightness, 0.4, 1.2), (darkness, 0.2, 0.5), (line, 0, 320)):
        assert low <= values.min() and values.max() <= high
        assert values.mean() == pytest.approx((low + high) / 2, rel=0.01)
        assert values.std() == pytest.approx((high - low) / 12**0.5, rel=0.02)
    assert left.mean() == pytest.approx(0.5, abs=0.01)
    assert np.mean([d.keep.mean() for d in draws]) == pytest.approx(0.5, abs=0.001)
    assert np.mean([len(d.keep) for d in draws]) == pytest.approx(473.6, rel=0.005)  # the original log's batches


def test_a_pass_takes_every_observation_once_and_the_next_one_in_another_order(generator):
    size = len(generator.observations)
    seen = np.concatenate([generator.sample(number).observation for number in range(size)])  # 128 passes
    first, second = seen[:size], seen[size : 2 * size]
    assert sorted(first) == sorted(second) == list(range(size))
    assert list(first) != list(second)


def test_frames_that_are_kept_are_those_that_were_decoded_and_are_decoded_once():
    cache, folder = FrameCache(2), Path("a")
    decoded = np.random.default_rng(0).integers(0, 255, (3, *FRAME), np.uint8)
    for image, frame in enumerate(decoded):
        cache.put((folder, image), frame)
    for image, frame in enumerate(decoded):
        again = (lambda: pytest.fail("it is kept")) if image < 2 else (lambda: decoded[2])
        assert np.array_equal(cache.get((folder, image), again), frame[ROAD_ROWS])


def test_images_and_angles_of_an_observation(generator):
    choices, everything = generator.sample(5), generator.observations
    batch = generator.start_batch(5)()
    assert (batch.images.shape[1:], batch.images.dtype) == ((75, 320, 3), np.uint8)
    for i in range(0, 128, 9):
        at, camera = choices.observation[i], choices.camera[i]
        name = ("center", "left", "right")[camera]
        assert Path(everything.path(at, camera)).name.startswith(name)
        jpeg: Any = cv2.imread(str(everything.path(at, camera)))
        jpeg = jpeg[60:135, :, ::-1]
        angle = everything.steering[at] + {"center": 0, "left": 0.2, "right": -0.2}[name]
        slots = choices.slots[i]
        np.testing.assert_array_equal(batch.images[slots[0]], jpeg)
        np.testing.assert_allclose(
            batch.labels[slots[slots >= 0]], np.array([angle, -angle, angle, angle])[slots >= 0], rtol=1e-6
        )
        if slots[1] >= 0:
            np.testing.assert_array_equal(cv2.flip(batch.images[slots[1]], 1), jpeg)  # twice is the identity
        brightness = choices.augmenting[2][0][i : i + 1]
        np.testing.assert_array_equal(batch.images[slots[2]], brighten(jpeg[None], 60, brightness)[0])


def test_the_benchmarks_batch_is_the_generators(generator):
    made, angles = one_by_one(generator, 3)
    batch = generator.start_batch(3)()
    assert made.shape == batch.images.shape
    for ours, theirs in ((batch.images, made), (batch.labels, angles.astype(np.float32))):
        assert sorted(one.tobytes() for one in ours) == sorted(one.tobytes() for one in theirs)


def test_a_batch_depends_on_seed_and_number_alone(generator):
    third = generator.start_batch(3)()
    resumed = Generator(generator.observations, REPORT, 0, generator.pool, first=2)
    resumed.next_batch()
    again = resumed.next_batch()
    assert third.keep is not None and again.keep is not None
    np.testing.assert_array_equal(third.images, again.images)
    np.testing.assert_array_equal(third.keep, again.keep)
    other = Generator(generator.observations, REPORT, 1, generator.pool)
    assert not np.array_equal(other.sample(3).camera, generator.sample(3).camera)


def test_without_dropout_a_batch_is_the_same_but_keeps_every_unit(generator):
    usual = generator.start_batch(3)()
    batch = Generator(generator.observations, replace(REPORT, dropout=False), 0, generator.pool).start_batch(3)()
    assert batch.keep is None and batch.total == usual.total
    np.testing.assert_array_equal(batch.images, usual.images)
    some, network = Batch(batch.images[:40], batch.labels[:40], batch.keep, 40), Network().eval()
    errors = SquaredErrors(network, torch.float32, generator.pool)(some)
    predicted = network(torch.from_numpy(some.images)).detach().numpy()
    assert errors.item() == pytest.approx(float(((predicted - some.labels) ** 2).sum()), rel=1e-4)


def test_an_augmentation_of_no_share_is_not_made(generator):
    assert (generator.sample(0).slots >= 0).any(axis=0).all()
    for left_out, recipe in ((1, replace(REPORT, flip=0.0)), (3, replace(REPORT, shadow=0.0))):
        without = Generator(generator.observations, recipe, 0, generator.pool)
        assert (without.sample(0).slots >= 0).any(axis=0).tolist() == [other != left_out for other in range(4)]


def test_a_batch_of_rare_augmentations_has_an_image(generator):
    rare = replace(REPORT, batch_size=2, augmentations=(REPORT.augmentations[0]._replace(share=0.5),))
    few = Generator(generator.observations, rare, 0, generator.pool)
    assert {few.start_batch(number)().total for number in range(20)} == {1, 2}


# ----------------------------------------------------------------------------------------------------------------------
# On a GPU all is as on the CPU, but for rounding; most of it is tested on the CPU


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
