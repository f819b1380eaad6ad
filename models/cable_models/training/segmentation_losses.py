"""Losses over mask cells whose truth is a share, not a yes or no."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

RARE_WEIGHT = 2.0
"""Weight of pedestrians and cyclists in the cross-entropy; they cover 1 % of the pixels."""


def dense_loss(logits: Tensor, shares: Tensor) -> Tensor:
    """Cross-entropy plus dice of class logits.

    Args:
        logits: [N, 4, rows, columns].
        shares: [N, 4, rows, columns], share of each class, all zero where nothing is taught.
    """
    weights = logits.new_tensor([1.0, 1.0, RARE_WEIGHT, RARE_WEIGHT])[:, None, None]
    logs = logits.log_softmax(1)
    taught = shares.sum(1, keepdim=True)
    entropy = -(weights * shares * logs).sum() / taught.sum()
    chances = logs.exp() * taught
    return entropy + dice((chances[:, 1:]).transpose(0, 1), shares[:, 1:].transpose(0, 1))


def mask_loss(logits: Tensor, target: Tensor, taught: Tensor) -> Tensor:
    """Binary cross-entropy plus dice of masks.

    Args:
        logits: [N, M, rows, columns], M masks per picture.
        target: [N, M, rows, columns], share of the wanted class in each cell.
        taught: [N, 1, rows, columns], 1 inside the picture.
    """
    entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    mean = (entropy * taught).sum() / (taught.sum() * logits.shape[1])
    return 2 * mean + dice((logits.sigmoid() * taught).transpose(0, 1), target.transpose(0, 1))


def dice(chances: Tensor, target: Tensor) -> Tensor:
    """Mean over the first axis of 1 - dice, pooled over a whole batch so that empty pictures count for little."""
    overlap = 2 * (chances * target).flatten(1).sum(1) + 1
    total = (chances + target).flatten(1).sum(1) + 1
    return torch.mean(1 - overlap / total)
