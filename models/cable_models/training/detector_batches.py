"""Batches of the detector's training: pixels and targets as transformers wants them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cable_models.rtdetr.compact import CompactRtDetrConfig
from cable_models.rtdetr.labels import coco_index_table
from cable_models.rtdetr.preprocess import fill_input
from cable_models.training.augment import AugmentConfig, augment
from cable_models.training.samples import LabelledImage, learnable
from cable_models.training.sampling import BalancedSampler
from cable_models.training.upload_views import CONSTANT_FILLS, WeightedFill

STRIDE = 32
"""Sides of every view are multiples of the coarsest stride."""


@dataclass(frozen=True, slots=True)
class View:
    """One way of showing images: how large a share of the picture at how large a share of the input size.

    Whole frames teach what the detector will see; small crops around an actor show several times as many
    actors in the same computing time. Both are mixed from the first step on: the network masks anchors near the
    border by their share of the width, so a size that comes late brings cells that were never trained.
    """

    weight: float
    """How often this view is drawn, relative to the others."""
    input_share: float
    """Sides of the batch as a share of the network's input size."""
    images: float
    """Batch size, as a multiple of the configured one."""
    augment: AugmentConfig


VIEWS = (
    View(0.5, 1.0, 1.0, AugmentConfig(crop=0.6, crop_shares=(0.5, 1.0))),
    View(0.5, 0.625, 2.0, AugmentConfig(crop=1.0, crop_shares=(0.35, 0.85))),
)

CLOSING_VIEWS = (View(1.0, 1.0, 1.0, AugmentConfig(crop=0.0, colour=0.5, region_only=0.35)),)
"""What the end of a training shows: whole frames, as the detector will see them."""


@dataclass(frozen=True, slots=True)
class Batch:
    """One step's images."""

    pixels: torch.Tensor
    """float32 [N, 3, height, width], RGB in 0..1."""
    targets: list[dict[str, torch.Tensor]]
    """For each image ``class_labels`` int64 [M] and ``boxes`` float32 [M, 4], centre and size in 0..1."""


def view_size(size_wh: tuple[int, int], share: float) -> tuple[int, int]:
    """The share of the input size, rounded to whole strides."""
    width, height = (max(1, round(share * side / STRIDE)) * STRIDE for side in size_wh)
    return width, height


def next_batch(
    sampler: BalancedSampler,
    network: CompactRtDetrConfig,
    images: int,
    min_height_px: float,
    min_visibility: float,
    rng: np.random.Generator,
    views: Sequence[View] = VIEWS,
    fills: Sequence[WeightedFill] = CONSTANT_FILLS,
) -> Batch:
    """Draws a view and fills it.

    Args:
        sampler: Source of images.
        network: Gives input size and classes.
        images: Images of a whole-frame batch.
        min_height_px: Smallest object taught, in pixels of the network's input.
        min_visibility: Smallest visible share of an object taught.
        rng: Source of all draws.
        views: Ways of showing images.
        fills: What may stand outside a kept region.
    """
    weights = np.array([view.weight for view in views])
    view = views[int(rng.choice(len(views), p=weights / weights.sum()))]
    size_wh = view_size(network.input_size_wh, view.input_share)
    changed = []
    for _ in range(max(1, round(view.images * images))):
        focus = sampler.draw(rng)
        changed.append(augment(focus.sample, size_wh, view.augment, rng, focus.row, fills))
    tensor = np.empty((len(changed), 3, size_wh[1], size_wh[0]), np.float32)
    fill_input([sample.image for sample in changed], tensor)
    targets = [target_of(sample, network.labels, size_wh, min_height_px, min_visibility) for sample in changed]
    return Batch(torch.from_numpy(tensor), targets)


def target_of(
    sample: LabelledImage,
    labels: Sequence[str],
    size_wh: tuple[int, int],
    min_height_px: float,
    min_visibility: float,
) -> dict[str, torch.Tensor]:
    """The taught objects of one image in the network's own classes and box coordinates."""
    class_of = {int(coco): index for index, coco in enumerate(coco_index_table(dict(enumerate(labels))))}
    taught = learnable(sample.boxes_xyxy, sample.visibility, size_wh[1], min_height_px / size_wh[1], min_visibility)
    taught &= np.isin(sample.class_ids, list(class_of))
    corners = sample.boxes_xyxy[taught] / np.array([*size_wh, *size_wh], np.float32)
    low, high = corners[:, :2], corners[:, 2:]
    centre_size = np.concatenate([(low + high) / 2, high - low], axis=1)
    return {
        "class_labels": torch.tensor([class_of[int(i)] for i in sample.class_ids[taught]], dtype=torch.int64),
        "boxes": torch.from_numpy(centre_size.astype(np.float32)),
    }
