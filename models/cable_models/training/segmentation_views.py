"""Random changes of training images that leave their instance masks true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_models.training.augment import jitter_colour, jpeg_recoded
from cable_models.training.segmentation_samples import CLASS_NAMES, SegmentedImage
from cable_models.training.upload_views import (
    BLOCK,
    CONSTANT_FILLS,
    CORRIDOR_SHARE,
    RegionFill,
    WeightedFill,
    corridor_blocks,
    draw_fill,
)

RARE_CLASSES = (2, 3)
WHOLE_ROWS_SHARE = 0.15
"""Share of the regions that are grown to whole rows."""


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """How often and how strongly images are changed."""

    flip: float = 0.5
    crop: float = 0.75
    min_crop: float = 0.35
    """Smallest crop as a share of the image's width and height."""
    rare_centre: float = 0.5
    """Share of crops laid around a pedestrian or cyclist."""
    colour: float = 0.7
    region_only: float = 0.5
    """Share of images of which only a region around the objects is kept, as an edge uploads them."""
    jpeg: float = 0.45


def changed_view(
    sample: SegmentedImage,
    size_wh: tuple[int, int],
    config: ViewConfig,
    rng: np.random.Generator,
    fills: Sequence[WeightedFill] = CONSTANT_FILLS,
) -> SegmentedImage:
    """A changed copy of ``size_wh`` pixels; what one of the fills hides is background."""
    view = random_crop(sample, size_wh, config, rng)
    if rng.random() < config.flip:
        view = SegmentedImage(
            np.ascontiguousarray(view.image[:, ::-1]), np.ascontiguousarray(view.instances[:, ::-1]), view.table
        )
    if rng.random() < config.colour:
        view = SegmentedImage(jitter_colour(view.image, rng), view.instances, view.table)
    if rng.random() < config.jpeg:
        view = SegmentedImage(jpeg_recoded(view.image, int(rng.integers(20, 91))), view.instances, view.table)
    # Last, since the service fills the background after decoding.
    if rng.random() < config.region_only:
        view = filled_outside(view, random_region(view, rng), draw_fill(fills, rng))
    return view


def random_crop(
    sample: SegmentedImage, size_wh: tuple[int, int], config: ViewConfig, rng: np.random.Generator
) -> SegmentedImage:
    """A random part of the image (or all that the wanted aspect ratio lets in) at the wanted size."""
    height, width = sample.image.shape[:2]
    aspect = size_wh[0] / size_wh[1] * rng.uniform(0.9, 1.11)
    crop_h = min(height, width / aspect)
    if rng.random() < config.crop:
        crop_h *= rng.uniform(config.min_crop, 1.0)
    crop_w = min(width, round(crop_h * aspect))
    crop_h = round(crop_h)
    x, y = int(rng.integers(0, width - crop_w + 1)), int(rng.integers(0, height - crop_h + 1))
    if rng.random() < config.rare_centre:
        x, y = around_rare_object(sample, (x, y), (crop_w, crop_h), rng)
    part = (slice(y, y + crop_h), slice(x, x + crop_w))
    enlarged = crop_w < size_wh[0]
    image = cv2.resize(sample.image[part], size_wh, interpolation=cv2.INTER_LINEAR if enlarged else cv2.INTER_AREA)
    instances = cv2.resize(sample.instances[part], size_wh, interpolation=cv2.INTER_NEAREST)
    return SegmentedImage(np.asarray(image, np.uint8), np.asarray(instances, np.uint16), sample.table)


def around_rare_object(
    sample: SegmentedImage, fallback: tuple[int, int], crop_wh: tuple[int, int], rng: np.random.Generator
) -> tuple[int, int]:
    """Corner (x, y) of a crop that holds a pixel of a random pedestrian or cyclist, or ``fallback`` without any."""
    rare = np.flatnonzero(np.isin(sample.table, RARE_CLASSES))
    if not len(rare):
        return fallback
    rows, columns = np.nonzero(sample.instances == rng.choice(rare))
    if not len(rows):
        return fallback
    pick = int(rng.integers(len(rows)))
    x = int(columns[pick] - rng.uniform(0.15, 0.85) * crop_wh[0])
    y = int(rows[pick] - rng.uniform(0.15, 0.85) * crop_wh[1])
    height, width = sample.instances.shape
    return min(max(x, 0), width - crop_wh[0]), min(max(y, 0), height - crop_wh[1])


def random_region(view: SegmentedImage, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """A region as an edge would keep it, bool [height, width]: most objects grown, a few missed, on 8x8 blocks."""
    height, width = view.instances.shape
    kept = rng.random(len(view.table)) < 0.92
    kept[0] = False
    region = (kept & (view.table > 0))[view.instances].astype(np.uint8)
    for _ in range(int(rng.integers(0, 4))):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        axes = (int(rng.integers(10, width // 4)), int(rng.integers(8, height // 4)))
        cv2.ellipse(region, (x, y), axes, 0, 0, 360, 1, -1)
    reach = int(rng.integers(2, 32))
    region = np.asarray(cv2.dilate(region, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)), np.uint8)
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    padded = np.zeros((rows * BLOCK, columns * BLOCK), np.uint8)
    padded[:height, :width] = region
    blocks = padded.reshape(rows, BLOCK, columns, BLOCK).max(axis=(1, 3)) > 0
    if rng.random() < CORRIDOR_SHARE and blocks.any():
        blocks = corridor_blocks(blocks)
    if rng.random() < WHOLE_ROWS_SHARE:
        # Image codecs send whole rows.
        blocks |= blocks.any(axis=1, keepdims=True)
    pixels: npt.NDArray[np.bool_] = blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[:height, :width]
    return pixels


def filled_outside(view: SegmentedImage, region: npt.NDArray[np.bool_], fill: RegionFill) -> SegmentedImage:
    """The image filled outside the region, where nothing counts as an object."""
    return SegmentedImage(fill(view.image, region), np.where(region, view.instances, np.uint16(0)), view.table)


def class_shares(view: SegmentedImage, grid_hw: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Share of each class in every cell of a coarse grid.

    Returns:
        float32 [1 + len(CLASS_NAMES), rows, columns], background first, sums to 1 over classes.
    """
    classes = view.classes
    size_wh = (grid_hw[1], grid_hw[0])
    planes = [np.where(classes == index, np.uint8(255), np.uint8(0)) for index in range(1, 1 + len(CLASS_NAMES))]
    objects = [cv2.resize(plane, size_wh, interpolation=cv2.INTER_AREA) for plane in planes]
    shares = np.stack(objects).astype(np.float32) / 255
    background = np.clip(1 - shares.sum(axis=0, keepdims=True), 0, 1)
    return np.concatenate([background, shares])
