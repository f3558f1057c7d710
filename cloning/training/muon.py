"""The Muon optimizer, with which --robust learns more from as many images.

A layer's weights are a matrix, outputs by inputs. Muon moves it by an orthogonal matrix: the gradient, averaged over
the steps, with all its singular values made 1, so that the few directions that dominate a gradient do not slow the
others down (K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024). The weights also
decay. Biases, and the last layer's single row, are moved by Adam.

torch.optim.Muon does the same for matrices, in bfloat16 and not for the kernels of convolutions.
"""

from collections.abc import Iterable, Sequence

import torch
from torch import nn

from cloning.training.adam import Adam

# With this factor and the root of a matrix's longer side, weights move about as far as with Adam at the same learning
# rate (arXiv 2502.16982, section 2.2).
SIZE_OF_ADAMS_STEP = 0.2
NEWTON_SCHULZ_STEPS, COEFFICIENTS = 5, (3.4445, -4.7750, 2.0315)  # Jordan's: singular values end between 0.7 and 1.2


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
