"""The table of the network's layers that the student's recipe prints, with the columns and names of the report's."""

import torch
from torch import nn

from cloning.base.frame import FRAME
from cloning.network.network import Network


def layer_table(network: Network) -> str:
    """Return a line for each layer: its name and type, its output's shape, its parameters, and the layer before it.

    Of a network with a `forward` of its own, which alone knows that order, it has torch's description.
    """
    total = f"Total params: {_parameters(network):,}"
    if type(network).forward is not Network.forward:  # its layers need not be applied one after the other
        return f"{network}\n{total}"
    top, bottom = network.crop
    layers: list[tuple[str, str, nn.Module]] = [
        ("lambda_1", "Lambda", nn.Identity()),
        ("cropping2d_1", "Cropping2D", nn.ZeroPad2d((0, 0, -top, -bottom))),
        *((f"convolution2d_{i}", "Convolution2D", layer) for i, layer in enumerate(network.convolutions, 1)),
        ("flatten_1", "Flatten", nn.Flatten()),
        ("dropout_1", "Dropout", nn.Identity()),
        *((f"dense_{i}", "Dense", layer) for i, layer in enumerate(network.dense, 1)),
    ]
    device = next(network.parameters()).device
    rows, previous, x = list[str](), "lambda_input_1", torch.zeros(1, FRAME[2], *FRAME[:2], device=device)
    with torch.no_grad():
        for name, keras_type, layer in layers:
            x = layer(x)
            shape = str((None, *x.shape[2:], x.shape[1]))
            rows.append(f"{f'{name} ({keras_type})':32} {shape:22} {_parameters(layer):<11} {previous}[0][0]")
            previous = name
    title = f"{'Layer (type)':32} {'Output Shape':22} {'Param #':11} Connected to"
    return "\n".join(["_" * 90, title, "=" * 90, *rows, "=" * 90, total])


def _parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
