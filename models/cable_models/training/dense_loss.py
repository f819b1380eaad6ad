"""A training-only loss with many positives per object, beside the one-to-one matching of RT-DETR.

One query per object is a thin signal for a network that starts from nothing: small objects are matched by boxes
that hardly overlap them, and VariFocal weights such pairs down. As in Co-DETR (Zong et al., ICCV 2023) an extra
head, dropped after training, classifies every cell of the encoder's maps, and the encoder's own box head answers for
all cells near the middle of an object.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn import functional

CENTRE_SHARE = 0.25
"""Cells within this share of a box's width and height around its centre are positive."""
LEVEL_SIDES_PX = ((0.0, 64.0), (32.0, 160.0), (96.0, float("inf")))
"""Square root of the box area that each level answers for, pixels; neighbours overlap."""
FOCAL_ALPHA = 0.25
FOCAL_GAMMA = 2.0
BOX_WEIGHT = 5.0
GIOU_WEIGHT = 2.0
ANCHOR_MARGIN = 0.01
"""RT-DETR masks anchors whose centre lies closer to the border than this share."""


class DenseHead(nn.Module):
    """Class logits of every cell of the encoder's maps, by one 1x1 convolution per level."""

    def __init__(self, width: int, classes: int, levels: int, prior: float) -> None:
        super().__init__()
        self.levels = nn.ModuleList([nn.Conv2d(width, classes, 1) for _ in range(levels)])
        for layer in self.levels:
            nn.init.normal_(layer.get_parameter("weight"), std=0.01)
            nn.init.constant_(layer.get_parameter("bias"), float(torch.logit(torch.tensor(prior))))

    def forward(self, maps: Sequence[torch.Tensor]) -> torch.Tensor:
        """Maps [N, width, h, w] of all levels to logits [N, cells, classes], levels one after the other."""
        logits = [layer(features) for layer, features in zip(self.levels, maps, strict=True)]
        return torch.cat([level.flatten(2).transpose(1, 2) for level in logits], dim=1)


def dense_loss(
    class_logits: torch.Tensor,
    box_logits: torch.Tensor,
    shapes_hw: Sequence[tuple[int, int]],
    size_wh: tuple[int, int],
    targets: Sequence[dict[str, torch.Tensor]],
) -> torch.Tensor:
    """Focal loss of all cells, L1 and generalised IoU of the positive ones; a scalar per positive cell.

    Args:
        class_logits: float32 [N, cells, classes].
        box_logits: float32 [N, cells, 4], centre x, centre y, width, height before the sigmoid.
        shapes_hw: Height and width of each level's map.
        size_wh: Input size in pixels.
        targets: For each image ``class_labels`` int64 [M] and ``boxes`` float32 [M, 4] in 0..1.
    """
    centres, levels = (part.to(class_logits.device) for part in cell_centres(shapes_hw))
    wanted = torch.zeros_like(class_logits)
    predicted, boxes = [], []
    for index, target in enumerate(targets):
        cells, owners = positive_cells(centres, levels, shapes_hw, size_wh, target["boxes"])
        wanted[index, cells, target["class_labels"][owners]] = 1.0
        predicted.append(box_logits[index, cells].sigmoid())
        boxes.append(target["boxes"][owners])
    found, true = torch.cat(predicted), torch.cat(boxes)
    positives = max(1, len(true))
    loss = focal_loss(class_logits, wanted) / positives
    if len(true):
        loss = loss + BOX_WEIGHT * functional.l1_loss(found, true, reduction="sum") / positives
        loss = loss + GIOU_WEIGHT * (1 - paired_giou(found, true)).sum() / positives
    return loss


def cell_centres(shapes_hw: Sequence[tuple[int, int]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Centres of all cells, float32 [cells, 2] (x, y in 0..1), and their levels, int64 [cells]."""
    centres, levels = [], []
    for level, (height, width) in enumerate(shapes_hw):
        y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        centres.append(torch.stack([x / width, y / height], dim=-1).reshape(-1, 2))
        levels.append(torch.full((height * width,), level))
    return torch.cat(centres), torch.cat(levels)


def positive_cells(
    centres: torch.Tensor,
    levels: torch.Tensor,
    shapes_hw: Sequence[tuple[int, int]],
    size_wh: tuple[int, int],
    boxes: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cells near the middle of a box of their level's size, and the box of each; the smallest box wins.

    A box smaller than a cell still owns the cell its centre lies in.

    Returns:
        int64 [P] cell indices, int64 [P] box indices.
    """
    if not len(boxes):
        nothing = torch.zeros(0, dtype=torch.int64, device=boxes.device)
        return nothing, nothing
    cell_wh = torch.tensor([[1 / width, 1 / height] for height, width in shapes_hw], device=boxes.device)[levels]
    reach = torch.maximum(CENTRE_SHARE * boxes[None, :, 2:], 0.5 * cell_wh[:, None])
    near = ((centres[:, None] - boxes[None, :, :2]).abs() <= reach).all(dim=-1)
    side = (boxes[:, 2] * size_wh[0] * boxes[:, 3] * size_wh[1]).sqrt()
    limits = torch.tensor(LEVEL_SIDES_PX[: len(shapes_hw)], device=boxes.device)[levels]
    near &= (side[None] >= limits[:, :1]) & (side[None] <= limits[:, 1:])
    near &= ((centres > ANCHOR_MARGIN) & (centres < 1 - ANCHOR_MARGIN)).all(dim=-1, keepdim=True)
    area = (boxes[:, 2] * boxes[:, 3])[None].expand(len(centres), -1).masked_fill(~near, float("inf"))
    smallest, owner = area.min(dim=1)
    cells = torch.nonzero(torch.isfinite(smallest))[:, 0]
    return cells, owner[cells]


def focal_loss(logits: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Sum of the focal loss (Lin et al. 2017) over all entries."""
    probability = logits.sigmoid()
    agreement = probability * wanted + (1 - probability) * (1 - wanted)
    balance = FOCAL_ALPHA * wanted + (1 - FOCAL_ALPHA) * (1 - wanted)
    entropy = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    return (balance * (1 - agreement) ** FOCAL_GAMMA * entropy).sum()


def paired_giou(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Generalised IoU (Rezatofighi et al. 2019) of box i with box i, float32 [P]; centre and size in 0..1."""
    low_a, high_a = first[:, :2] - first[:, 2:] / 2, first[:, :2] + first[:, 2:] / 2
    low_b, high_b = second[:, :2] - second[:, 2:] / 2, second[:, :2] + second[:, 2:] / 2
    overlap = (torch.minimum(high_a, high_b) - torch.maximum(low_a, low_b)).clamp(min=0).prod(dim=1)
    union = first[:, 2:].prod(dim=1) + second[:, 2:].prod(dim=1) - overlap
    hull = (torch.maximum(high_a, high_b) - torch.minimum(low_a, low_b)).prod(dim=1)
    return overlap / union.clamp(min=1e-9) - (hull - union) / hull.clamp(min=1e-9)
