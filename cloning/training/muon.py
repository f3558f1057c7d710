"""The Muon optimizer, with which --robust learns more from as many images.

A layer's weights are a matrix, outputs by inputs. Muon moves it by an orthogonal matrix: the gradient, averaged over
the steps, with all its singular values made 1, so that the few directions that dominate a gradient do not slow the
others down (K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024). The weights also
decay. Biases, and the last layer's single row, are moved by Adam.

torch.optim.Muon does the same for matrices, in bfloat16 and not for the kernels of convolutions.
"""

from collections.abc import Sequence

import torch

from cloning.training.adam import Adam

MOMENTUM = 0.95
# With this factor and the root of a matrix's longer side, weights move about as far as with Adam at the same learning
# rate (arXiv 2502.16982, section 2.2).
SIZE_OF_ADAMS_STEP = 0.2
# Per step and unit of learning rate. Each step adds a matrix of full rank, so without it the weights keep growing: at
# 4e-3 the largest layer's spectral norm was 0.7 at first, 4.8 after 10,000 images and 13 after 60,000, and a training
# on 72 recordings broke down after 120,000. With it, the norm stays at 4.
WEIGHT_DECAY = 1.0
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
    """Muon for weights, Adam for all else.

    state: as Adam's, but a matrix's is its average gradient alone, "momentum"
    """

    def is_matrix(self, number: int) -> bool:
        """Return whether a parameter, by its number, is a layer's weights with several outputs."""
        parameter = self.parameters[number]
        return parameter.dim() > 1 and len(parameter) > 1

    def zeros(self, number: int) -> dict[str, torch.Tensor]:
        """Return a parameter's state before the first step: float32, on its device, in its order in memory."""
        if not self.is_matrix(number):
            return super().zeros(number)
        return {"momentum": torch.zeros_like(self.parameters[number])}

    def update(self, numbers: Sequence[int], learning_rate: float) -> None:
        """Update some parameters, whose state is there, by their gradients; numbers: of the parameters."""
        super().update([number for number in numbers if not self.is_matrix(number)], learning_rate)
        for number in filter(self.is_matrix, numbers):
            parameter, average = self.parameters[number], self.state[number]["momentum"]
            assert parameter.grad is not None
            average.lerp_(parameter.grad, 1 - MOMENTUM)
            ahead = parameter.grad.lerp(average, MOMENTUM).flatten(1)  # Nesterov's
            far = SIZE_OF_ADAMS_STEP * max(ahead.shape) ** 0.5
            parameter.mul_(1 - learning_rate * WEIGHT_DECAY)
            parameter.sub_(orthogonal(ahead).reshape(parameter.shape), alpha=learning_rate * far)


OPTIMIZERS = {"adam": Adam, "muon": Muon}
