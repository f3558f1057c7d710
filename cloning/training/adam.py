"""The Adam optimizer, computed by torch's function of that name.

torch.optim.Adam does the same, but its constructor imports torch's compiler, which nothing here uses: two seconds on
an idle machine, a twentieth of a training on one lap.
"""

from collections.abc import Iterable, Sequence

import torch
from torch import nn
from torch.optim.adam import adam

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

    def zeros(self, number: int) -> dict[str, torch.Tensor]:
        """Return a parameter's state before the first step: float32, on its device, in its order in memory."""
        parameter = self.parameters[number]
        count = torch.zeros((), device=parameter.device)
        return dict(zip(AVERAGES, (count, torch.zeros_like(parameter), torch.zeros_like(parameter)), strict=True))

    @torch.no_grad()
    def step(self, learning_rate: float) -> None:
        """Update the parameters by their gradients."""
        numbers = range(len(self.parameters))
        self.state = self.state or {number: self.zeros(number) for number in numbers}
        self.update(numbers, learning_rate)

    def update(self, numbers: Sequence[int], learning_rate: float) -> None:
        """Update some parameters, whose state is there, by their gradients; numbers: of the parameters."""
        parameters: list[torch.Tensor] = [self.parameters[number] for number in numbers]
        steps, averages, squares = ([self.state[number][name] for number in numbers] for name in AVERAGES)
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
        self.state = {number: self.zeros(number) for number in state}
        for number, saved in state.items():
            for name, value in saved.items():
                self.state[number][name].copy_(value)
