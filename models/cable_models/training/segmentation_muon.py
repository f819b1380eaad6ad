"""Muon: momentum whose matrices are made orthogonal, in float32.

Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks", 2024; the scale to AdamW's rates is
of Liu et al., arXiv 2502.16982. PyTorch's own Muon works in bfloat16, twenty times slower on processors without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5


class Muon(torch.optim.Optimizer):
    """Muon with Nesterov momentum for two-dimensional parameters.

    Args:
        params: Matrices, or parameter groups of them.
        lr: Rate in AdamW's scale: an update's root mean square is 0.2 times it.
        momentum: Share of the old direction kept.
        weight_decay: Decoupled decay.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1e-3,
        momentum: float = 0.95,
        weight_decay: float = 0.0,
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Moves every matrix that has a gradient."""
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                state = self.state[matrix]
                if not state:
                    state["momentum"] = torch.zeros_like(matrix)
                state["momentum"].lerp_(matrix.grad, 1 - group["momentum"])
                direction = matrix.grad.lerp(state["momentum"], group["momentum"])
                scale = 0.2 * max(matrix.shape) ** 0.5
                matrix.mul_(1 - group["lr"] * group["weight_decay"])
                matrix.add_(orthogonal(direction), alpha=-group["lr"] * scale)


def orthogonal(matrix: Tensor) -> Tensor:
    """The nearest matrix with all singular values near 1 (0.7 .. 1.2), by a Newton-Schulz iteration.

    Args:
        matrix: float32 [rows, columns].
    """
    a, b, c = COEFFICIENTS
    wide = matrix.shape[0] <= matrix.shape[1]
    turned = matrix if wide else matrix.T
    turned = turned / (turned.norm() + 1e-7)
    for _ in range(ITERATIONS):
        gram = turned @ turned.T
        turned = a * turned + (b * gram + c * gram @ gram) @ turned
    return turned if wide else turned.T
