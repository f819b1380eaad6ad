"""Mask quality on held-out images: intersection over union, pooled over all pixels of all images."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from cable_models.detection import Image
from cable_models.lisa.images import sam_input
from cable_models.training.segmentation_samples import SegmentedImage
from cable_models.training.segmentation_vision import CONCEPTS, VisionTrainee
from cable_models.training.upload_views import BLOCK, RegionFill

BoolMask = npt.NDArray[np.bool_]

Segment = Callable[[Image, BoolMask | None], BoolMask]
"""Masks of all concepts, bool [len(CONCEPTS), H, W], of an image uint8 [H, W, 3] BGR and the region kept of it."""

REGION_MARGIN = 12
"""Pixels by which true objects are grown into the region that is kept of a masked image."""


@dataclass(frozen=True, slots=True)
class MaskFigures:
    """Quality of masks on one set of images."""

    iou: tuple[float, ...]
    """Pooled, in the order of `CONCEPTS`."""
    images: int

    def as_dict(self) -> dict[str, float]:
        """IoU by concept."""
        return {name: round(value, 4) for (name, _), value in zip(CONCEPTS, self.iou, strict=True)}

    def as_json(self) -> str:
        """One line."""
        return json.dumps(self.as_dict())


@torch.no_grad()
def evaluate_masks(segment: Segment, samples: Sequence[SegmentedImage], fill: RegionFill | None = None) -> MaskFigures:
    """Pooled IoU per concept.

    Args:
        segment: The model.
        samples: Images with truth.
        fill: Fills all but a region around the true objects first, and the model is told that region; None shows
            it whole images.
    """
    overlap = np.zeros(len(CONCEPTS))
    union = np.zeros(len(CONCEPTS))
    for sample in samples:
        image, region = sample.image, None
        if fill is not None:
            region = object_region(sample)
            image = fill(image, region)
        found = segment(image, region)
        classes = sample.classes
        for index, (_, covered) in enumerate(CONCEPTS):
            truth = np.isin(classes, covered)
            overlap[index] += np.count_nonzero(found[index] & truth)
            union[index] += np.count_nonzero(found[index] | truth)
    return MaskFigures(tuple((overlap / np.maximum(union, 1)).tolist()), len(samples))


def object_region(sample: SegmentedImage) -> BoolMask:
    """True objects grown by `REGION_MARGIN` pixels and to 8x8 blocks, bool [H, W]."""
    height, width = sample.instances.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    side = 2 * REGION_MARGIN + 1
    padded = np.zeros((rows * BLOCK, columns * BLOCK), np.uint8)
    padded[:height, :width] = cv2.dilate((sample.classes > 0).astype(np.uint8), np.ones((side, side), np.uint8))
    blocks = padded.reshape(rows, BLOCK, columns, BLOCK).max(axis=(1, 3)) > 0
    pixels: BoolMask = blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[:height, :width]
    return pixels


def dense_segmenter(trainee: VisionTrainee) -> Segment:
    """The encoder with its dense head."""

    def segment(image: Image, region: BoolMask | None) -> BoolMask:
        logits = functional.log_softmax(trainee.dense_head(trainee.features(padded_pixels(trainee, image))), dim=1)
        best = full_size(logits, image).argmax(0)
        return np.stack([np.isin(best, covered) for _, covered in CONCEPTS])

    return segment


def token_segmenter(trainee: VisionTrainee) -> Segment:
    """Encoder and mask decoder with the learned concept tokens."""

    def segment(image: Image, region: BoolMask | None) -> BoolMask:
        logits = trainee.masks(trainee.features(padded_pixels(trainee, image)), trainee.concept_tokens)
        found: BoolMask = full_size(logits, image) > 0
        return found

    return segment


def padded_pixels(trainee: VisionTrainee, image: Image) -> torch.Tensor:
    """SAM's input without the rows of windows that hold padding only, float32 [1, 3, height, image_size]."""
    sizes = trainee.config
    pixels, (height, _) = sam_input(image, sizes.image_size)
    window = sizes.window * sizes.patch_size
    kept = min(-(-height // window) * window, sizes.image_size)
    return torch.from_numpy(pixels[None, :, :kept])


def full_size(logits: torch.Tensor, image: Image) -> npt.NDArray[np.float32]:
    """Low-resolution logits [1, M, 4 rows, 4 columns] of a padded square's upper part at the image's size."""
    height, width = image.shape[:2]
    cells = logits.shape[-1]
    scale = cells / max(height, width)
    large = functional.interpolate(logits, scale_factor=4, mode="bilinear", align_corners=False)
    picture = large[..., : round(4 * height * scale), : round(4 * width * scale)]
    out: npt.NDArray[np.float32] = functional.interpolate(
        picture, size=(height, width), mode="bilinear", align_corners=False
    )[0].numpy()
    return out
