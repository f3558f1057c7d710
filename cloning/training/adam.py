"""The Adam optimizer, computed by torch's function of that name.

torch.optim.Adam does the same, but its constructor imports torch's compiler, which nothing here uses: two seconds on
an idle machine, a twentieth of a training on one lap.
"""

from collections.abc import Iterable, Sequence

import torch
from torch import nn
from torch.optim.adam import adam

from cloning.network.compute import Graphed

AVERAGES = ("step", "exp_avg", "exp_avg_sq")  # torch.optim's names: steps done, averages of gradient and its square


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
        adam(
            parameters,
            [parameter.grad for parameter in parameters if parameter.grad is not None],
            averages,
            squares,
            [],
            steps,
            fused=True,
            amsgrad=False,
            beta1=self.momentum,
            beta2=0.999,
            lr=learning_rate,
            weight_decay=self.weight_decay,
            eps=1e-8,
            maximize=False,
        )

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
