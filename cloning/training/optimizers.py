"""The optimizers: Adam, computed by torch's function of that name, and Muon, with which --robust learns more.

torch.optim.Adam does the same, but its constructor imports torch's compiler, which nothing here uses: two seconds on
an idle machine, a twentieth of a training on one lap.

A layer's weights are a matrix, outputs by inputs. Muon moves it by an orthogonal matrix: the gradient, averaged over
the steps, with all its singular values made 1, so that the few directions that dominate a gradient do not slow the
others down (K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024). The weights also
decay. Biases, and the last layer's single row, are moved by Adam. torch.optim.Muon does the same for matrices, in
bfloat16 and not for the kernels of convolutions.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import nn
from torch.optim.adam import adam

from cloning.network.compute import Graphed

AVERAGES = ("step", "exp_avg", "exp_avg_sq")  # torch.optim's names: steps done, averages of gradient and its square

USUAL: dict[str, Any] = {"beta2": 0.999, "eps": 1e-8, "fused": True, "amsgrad": False, "maximize": False}
# With this factor and the root of a matrix's longer side, weights move about as far as with Adam at the same learning
# rate (arXiv 2502.16982, section 2.2).
SIZE_OF_ADAMS_STEP = 0.2
NEWTON_SCHULZ_STEPS, COEFFICIENTS = 5, (3.4445, -4.7750, 2.0315)  # Jordan's: singular values end between 0.7 and 1.2


class Adam:
    """Adam (arXiv 1412.6980); weights and state are those of torch.optim.Adam, bit for bit.

    state: the tensors named AVERAGES for each parameter, by its index; empty before the first step
    """

    def __init__(self, parameters: Iterable[nn.Parameter], momentum: float = 0.9, weight_decay: float = 0.0):
        """parameters: those to optimise, all on one device; each has a gradient when `step` is called.

        momentum, weight_decay: of torch's Adam, which calls the first one of the two betas.
        """
        self.parameters, self.momentum, self.weight_decay = list(parameters), momentum, weight_decay
        self.state: dict[int, dict[str, torch.Tensor]] = {}
        self.graphed = Graphed(self.update_by)

    def zeros(self, index: int) -> dict[str, torch.Tensor]:
        """Return a parameter's state before the first step: float32, on its device, in its order in memory."""
        parameter = self.parameters[index]
        count = torch.zeros((), device=parameter.device)
        return dict(zip(AVERAGES, (count, torch.zeros_like(parameter), torch.zeros_like(parameter)), strict=True))

    @torch.no_grad()
    def step(self, learning_rate: float) -> None:
        """Update the parameters by their gradients."""
        self.state = self.state or {index: self.zeros(index) for index in range(len(self.parameters))}
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        if gradients[0].device.type == "cuda":
            self.graphed(torch.full((), learning_rate, device=gradients[0].device), *gradients)
        else:
            self.update(range(len(self.parameters)), learning_rate)

    def update_by(self, learning_rate: torch.Tensor, *gradients: torch.Tensor) -> list[torch.Tensor]:
        """Update the parameters by these gradients, on a GPU; returns nothing."""
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        self.update(range(len(self.parameters)), learning_rate)
        return []

    def update(self, indices: Sequence[int], learning_rate: float | torch.Tensor) -> None:
        """Update the parameters with these indices, whose state is there, by their gradients."""
        parameters: list[torch.Tensor] = [self.parameters[index] for index in indices]
        steps, averages, squares = ([self.state[index][name] for index in indices] for name in AVERAGES)
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        own: dict[str, Any] = {"beta1": self.momentum, "lr": learning_rate, "weight_decay": self.weight_decay}
        adam(parameters, gradients, averages, squares, [], steps, **own, **USUAL)

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    def restore(self, state: dict[int, dict[str, torch.Tensor]]) -> None:
        """Copy a saved `state`, whose tensors have the right shapes, to the parameters' device."""
        self.state = {index: self.zeros(index) for index in state}
        for index, saved in state.items():
            for name, value in saved.items():
                self.state[index][name].copy_(value)


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """Return a matrix with the same singular vectors whose singular values are all about 1.

    matrix: float32 (m, n), as the result. Newton and Schulz's iteration X -> aX + b(XX')X + c(XX')²X, computed by the
    smaller Gram matrix XX' alone and applied to X once: in the largest layer this is a tenth of the work.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return orthogonal(matrix.T).T
    matrix = matrix / (matrix.norm() + 1e-7)
    gram = matrix @ matrix.T
    a, b, c = COEFFICIENTS
    whole = torch.eye(len(gram), device=gram.device)
    for _ in range(NEWTON_SCHULZ_STEPS):
        step = torch.addmm(gram, gram, gram, beta=b, alpha=c)  # b(XX') + c(XX')²
        step.diagonal().add_(a)
        whole, gram = step @ whole, step @ gram @ step
    return whole @ matrix


class Muon(Adam):
    """Muon for weights, Adam for all else; state: as Adam's, but a matrix's is its average gradient, "momentum"."""

    def __init__(self, parameters: Iterable[nn.Parameter], momentum: float = 0.95, weight_decay: float = 1.0):
        """parameters: see Adam, whose defaults are used for all that is no matrix.

        momentum: of the average gradient; weight_decay: of matrices, per step and unit of learning rate.
        """
        super().__init__(parameters)
        self.matrix_momentum, self.matrix_decay = momentum, weight_decay

    def is_matrix(self, index: int) -> bool:
        """Return whether a parameter is a layer's weights with several outputs."""
        parameter = self.parameters[index]
        return parameter.dim() > 1 and len(parameter) > 1

    def zeros(self, index: int) -> dict[str, torch.Tensor]:
        """Return a parameter's state before the first step, as Adam's."""
        if not self.is_matrix(index):
            return super().zeros(index)
        return {"momentum": torch.zeros_like(self.parameters[index])}

    def update(self, indices: Sequence[int], learning_rate: float | torch.Tensor) -> None:
        """Update the parameters with these indices, as Adam's."""
        super().update([index for index in indices if not self.is_matrix(index)], learning_rate)
        for index in filter(self.is_matrix, indices):
            parameter, average = self.parameters[index], self.state[index]["momentum"]
            assert parameter.grad is not None
            average.lerp_(parameter.grad, 1 - self.matrix_momentum)
            ahead = parameter.grad.lerp(average, self.matrix_momentum).flatten(1)  # Nesterov's
            far = SIZE_OF_ADAMS_STEP * max(ahead.shape) ** 0.5
            parameter.mul_(1 - learning_rate * self.matrix_decay)
            parameter.sub_(orthogonal(ahead).reshape(parameter.shape) * (learning_rate * far))


OPTIMIZERS = {"adam": Adam, "muon": Muon}
