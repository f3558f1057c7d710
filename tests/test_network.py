"""The network against the report's table and plain arithmetic, and its gradient in pieces."""

import functools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scenes import view
from torch import nn

from cloning.network import fast_layers
from cloning.network.fast_layers import OverPairs
from cloning.network.layer_table import layer_table
from cloning.network.network import SHIPPED_MODEL, Network, exposed, load_model, save_model, steer
from cloning.road.track import Track
from cloning.training.pieces import Batch, SquaredErrors

REPORT = """
lambda_1 (Lambda)                (None, 160, 320, 3)   0           lambda_input_1[0][0]
cropping2d_1 (Cropping2D)        (None, 75, 320, 3)    0           lambda_1[0][0]
convolution2d_1 (Convolution2D)  (None, 36, 158, 24)   1824        cropping2d_1[0][0]
convolution2d_2 (Convolution2D)  (None, 16, 77, 36)    21636       convolution2d_1[0][0]
convolution2d_3 (Convolution2D)  (None, 6, 37, 48)     43248       convolution2d_2[0][0]
convolution2d_4 (Convolution2D)  (None, 4, 35, 64)     27712       convolution2d_3[0][0]
convolution2d_5 (Convolution2D)  (None, 2, 33, 64)     36928       convolution2d_4[0][0]
flatten_1 (Flatten)              (None, 4224)          0           convolution2d_5[0][0]
dropout_1 (Dropout)              (None, 4224)          0           flatten_1[0][0]
dense_1 (Dense)                  (None, 100)           422500      dropout_1[0][0]
dense_2 (Dense)                  (None, 50)            5050        dense_1[0][0]
dense_3 (Dense)                  (None, 10)            510         dense_2[0][0]
dense_4 (Dense)                  (None, 1)             11          dense_3[0][0]
"""


@pytest.fixture
def network():
    torch.manual_seed(0)
    return Network()


@pytest.fixture
def frames():
    return torch.from_numpy(np.random.default_rng(0).integers(0, 256, (5, 160, 320, 3), np.uint8))


def test_layer_table_is_the_reports(network):
    table = [line.split() for line in layer_table(network).splitlines() if "[0][0]" in line]
    assert table == [line.split() for line in REPORT.strip().splitlines()]
    assert layer_table(network).endswith("559,419")


def test_a_network_whose_layers_do_not_follow_one_another_is_shown_as_well():
    class Gray(Network):
        def layers(self):
            convolutions, dense = super().layers()
            return [nn.Conv2d(1, 24, 5, 2), *convolutions[1:]], dense

        def forward(self, frames, keep=None):
            raise NotImplementedError

    assert layer_table(Gray()).endswith("558,219")


def test_forward_is_the_reports(network, frames):
    """Against a Sequential of torch's own layers, on an image transposed by numpy (`view` would scramble it)."""
    layers = []
    for convolution in network.convolutions:
        layers += [convolution, nn.ELU()]
    layers += [nn.Flatten()]
    for dense in network.dense:
        layers += [dense, nn.ELU()]
    x = np.stack([frame.transpose(2, 0, 1) for frame in frames.numpy()])[:, :, 60:135].astype(np.float32) / 127.5 - 1
    expected = nn.Sequential(*layers[:-1])(torch.from_numpy(np.ascontiguousarray(x)))[:, 0]
    torch.testing.assert_close(network(frames), expected)
    torch.testing.assert_close(network(frames[:, 60:135]), expected)  # cropped already


def in_blocks(x, weight, bias):
    return nn.functional.conv2d(fast_layers.InBlocks.apply(x), fast_layers.in_blocks(weight), bias)


@pytest.mark.parametrize(
    ("fast", "shape"),
    [
        *((in_blocks, (3, 24, *size)) for size in ((36, 158), (16, 77), (15, 20), (9, 11))),
        *((OverPairs.apply, shape) for shape in ((2, 24, 36, 158), (3, 4, 9, 8))),
    ],
)
def test_a_fast_convolution_and_its_gradients_are_torchs(fast, shape):
    torch.manual_seed(0)
    x = torch.randn(shape, dtype=torch.float64).contiguous(memory_format=torch.channels_last).requires_grad_()
    layer = nn.Conv2d(shape[1], 36, 5, 2).double()
    layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)
    inputs = (x, *layer.parameters())
    expected, out = layer(x), fast(*inputs)
    torch.testing.assert_close(out, expected, rtol=1e-12, atol=1e-12)
    direction = torch.randn_like(expected)
    gradients = torch.autograd.grad(out, inputs, direction)
    for got, wanted in zip(gradients, torch.autograd.grad(expected, inputs, direction), strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-12, atol=1e-11)
    padded = fast is in_blocks and (shape[2] % 2 or shape[3] % 2)  # what was padded is cut off, without a copy
    assert padded or gradients[0].is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("has_table", [True, False])
def test_elu_of_every_bfloat16_and_its_gradient_are_torchs(monkeypatch, has_table):
    monkeypatch.setattr(fast_layers, "elu_table", fast_layers.elu_table if has_table else lambda: None)
    every = torch.arange(1 << 16, dtype=torch.int32).to(torch.uint16).view(torch.bfloat16)
    x = every.reshape(2, 16, 64, 32).contiguous(memory_format=torch.channels_last)
    results = []
    for elu in (functools.partial(nn.functional.elu, inplace=True), fast_layers.elu):
        leaf = x.clone().requires_grad_()
        out = elu(leaf * 1)
        (gradient,) = torch.autograd.grad(out, leaf, torch.full_like(x, 0.7))
        results.append((out.detach(), gradient))
    for expected, got in zip(*results, strict=True):
        assert got.is_contiguous(memory_format=torch.channels_last)
        torch.testing.assert_close(got, expected, rtol=0, atol=0, equal_nan=True)


def test_dropout_keeps_what_is_given_and_doubles_it(network, frames):
    keep = torch.zeros(5, 4224, dtype=torch.bool)
    flat = []
    network.dense[0].register_forward_pre_hook(lambda _, inputs: flat.append(inputs[0]))
    network(frames)
    keep[:, ::2] = True
    network(frames, keep)
    torch.testing.assert_close(flat[1][:, ::2], flat[0][:, ::2] * 2)
    assert not flat[1][:, 1::2].any()


def test_later_batches_are_computed_with_the_weights_of_then(network):
    batch = Batch(np.zeros((2, 75, 320, 3), np.uint8), np.zeros(2, np.float32), None, 2)
    with ThreadPoolExecutor(1) as pool:
        errors = SquaredErrors(network, torch.bfloat16, pool)
        errors(batch)
        with torch.no_grad():
            network.dense[-1].bias.fill_(1000)
        assert errors(batch).item() == pytest.approx(2e6, rel=0.02)


def random_batch(n: int, keep: np.ndarray | None = None) -> Batch:
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (n, 75, 320, 3), np.uint8)
    return Batch(images, rng.normal(0, 0.2, n).astype(np.float32), keep, n)


@pytest.mark.parametrize("limit", [None, 0.1])
@pytest.mark.parametrize("dropout", [False, True])
def test_the_gradient_is_that_of_the_loss_and_the_value_the_squared_errors(network, limit, dropout):
    batch = random_batch(45, np.random.default_rng(1).random((45, 4224)) < 0.5 if dropout else None)
    keep = None if batch.keep is None else torch.from_numpy(batch.keep)
    predicted, wanted = network(torch.from_numpy(batch.images), keep), torch.from_numpy(batch.labels)
    assert 4 < int(((predicted - wanted).abs() < 0.1).sum()) < 41  # both sides of the limit
    squared = torch.nn.functional.mse_loss(predicted, wanted, reduction="sum")
    huber = 2 * torch.nn.functional.huber_loss(predicted, wanted, reduction="sum", delta=0.1)
    expected = torch.autograd.grad(huber if limit else squared, list(network.parameters()))
    with ThreadPoolExecutor(2) as pool:
        errors = SquaredErrors(network, torch.float32, pool, limit)(batch)
        (errors * 3).backward()
        again = SquaredErrors(network, torch.float32, pool, limit)(batch)
    assert torch.equal(errors, again)  # whichever thread was faster
    assert errors.item() == pytest.approx(squared.item(), rel=1e-4)
    for parameter, gradient in zip(network.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient * 3, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("amx", [False, True])
def test_bfloat16_steps_where_float32_does(network, monkeypatch, amx):
    """Some processors only emulate it; the gradient's direction shows that it is the same function."""
    monkeypatch.setattr(fast_layers, "has_amx", lambda: amx)
    gradients = []
    with ThreadPoolExecutor(1) as pool:
        for precision in (torch.float32, torch.bfloat16):
            network.zero_grad()
            SquaredErrors(network, precision, pool)(random_batch(4)).backward()
            gradients.append(torch.cat([parameter.grad.flatten() for parameter in network.parameters()]))
            assert gradients[-1].dtype == torch.float32
    assert torch.cosine_similarity(gradients[0], gradients[1], dim=0) > 0.99


def test_dark_images_and_those_without_contrast_are_lifted_when_it_drives(tmp_path, frames):
    """By 5 and 8 times at most; ordinary ones stay, to the bit."""
    plain = Network().eval()
    save_model(tmp_path / "model.pt", plain)
    lifting = load_model(tmp_path / "model.pt")
    lifting.exposure = (80.0, 20.0)
    save_model(tmp_path / "lifting.pt", lifting)
    lifting = load_model(tmp_path / "lifting.pt")
    images = frames[:, 60:135].float()
    images -= images.mean((1, 2, 3), keepdim=True)
    images *= 30 / images.square().mean((1, 2, 3), keepdim=True).sqrt()

    def image(mean, contrast):
        return (mean + contrast * images).clamp(0, 255).byte()

    ordinary, dark, black, foggy, grey = (
        image(*of) for of in ((120, 1), (50, 0.6), (10, 0.1), (150, 0.3), (150, 0.04))
    )
    with torch.inference_mode():
        assert torch.equal(lifting(ordinary), plain(ordinary))
        for changed, mean, deviation in ((dark, 80, 28.8), (black, 50, 20), (foggy, 150, 20), (grey, 150, 9.6)):
            lifted = exposed(changed.permute(0, 3, 1, 2).float(), (80, 20))
            assert lifted.mean((1, 2, 3)).numpy() == pytest.approx(mean, abs=3)
            assert lifted.std((1, 2, 3)).numpy() == pytest.approx(deviation, rel=0.15)
            torch.testing.assert_close(lifting(changed), plain(lifted.permute(0, 2, 3, 1).clone()))
            assert (lifting(changed) - plain(changed)).abs().max() > 1e-4
        assert torch.equal(lifting.train()(dark), plain.train()(dark)), "in training all are as they are"


@pytest.mark.parametrize("track", ["lake", "jungle"])
def test_the_shipped_network_steers_back_to_the_centre(track):
    """The side cameras see the road as a car does that is 0.8 m off: further right from the left, and vice versa."""
    network = load_model(SHIPPED_MODEL)
    views = (view(track, 0, s).astype(np.uint8) for s in np.linspace(0, Track(track).length, 60, endpoint=False))
    centre, left, right = np.array([[steer(network, frame) for frame in frames] for frames in views]).T
    assert (left > centre).all() and (right < centre).all()
    # Measured: 0.24 to 0.25. At 0.2 the car is back in the centre after about 7 m.
    assert 0.17 < np.mean(left - centre) < 0.3
    assert 0.17 < np.mean(centre - right) < 0.3
    assert np.mean(left) > 0.1 and np.mean(right) < -0.1, "to the centre, not only less away from it"
