"""Training images as the models meet them in the loop: a region as an edge keeps it, and what stands around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_models.detection import Float32Array, Image

BoolMask = npt.NDArray[np.bool_]

BLOCK = 8
"""Regions travel in blocks of so many pixels."""
SEEN_OBJECTS = 0.92
"""Share of the objects that the edge knew of."""
CORRIDOR_SHARE = 0.6
"""Share of the regions that are joined into a band."""
TOP_MARGIN, BOTTOM_MARGIN = 0.10, 0.15
"""A band's growth, as a share of the distance to the upper and lower border."""

RegionFill = Callable[[Image, BoolMask], Image]
"""From an image, uint8 [height, width, 3] BGR, and the region, bool [height, width], to what a model sees."""


@dataclass(frozen=True, slots=True)
class WeightedFill:
    """A way to fill the background."""

    fill: RegionFill
    weight: float
    """How often it is drawn, relative to the others."""


def black(image: Image, region: BoolMask) -> Image:
    """Black outside the region."""
    return np.where(region[..., None], image, np.uint8(0))


def grey(image: Image, region: BoolMask) -> Image:
    """Level 128 outside the region."""
    return np.where(region[..., None], image, np.uint8(128))


def mean_colour(image: Image, region: BoolMask) -> Image:
    """The image's mean colour outside the region."""
    return np.where(region[..., None], image, image.reshape(-1, 3).mean(axis=0).astype(np.uint8))


CONSTANT_FILLS = (WeightedFill(black, 0.6), WeightedFill(grey, 0.25), WeightedFill(mean_colour, 0.15))


def draw_fill(fills: Sequence[WeightedFill], rng: np.random.Generator) -> RegionFill:
    """One of the fills, by their weights."""
    weights = np.array([one.weight for one in fills])
    return fills[int(rng.choice(len(fills), p=weights / weights.sum()))].fill


def upload_region(boxes_xyxy: Float32Array, size_hw: tuple[int, int], rng: np.random.Generator) -> BoolMask:
    """A region that holds most of the objects, with a random margin, in blocks, often joined into a band.

    Args:
        boxes_xyxy: float32 [N, 4], the objects' boxes in pixels.
        size_hw: (height, width) of the image.
        rng: source of all draws.

    Returns:
        bool [height, width].
    """
    height, width = size_hw
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    blocks = np.zeros((rows, columns), np.bool_)
    margin = rng.uniform(2, 40)
    seen = rng.random(len(boxes_xyxy)) < SEEN_OBJECTS
    for x0, y0, x1, y1 in grown_blocks(boxes_xyxy[seen], margin):
        blocks[y0:y1, x0:x1] = True
    if rng.random() < CORRIDOR_SHARE and blocks.any():
        blocks = corridor_blocks(blocks)
    region: BoolMask = blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[:height, :width]
    return region


def grown_blocks(boxes_xyxy: Float32Array, margin: float) -> list[list[int]]:
    """Boxes grown by ``margin`` pixels, in whole blocks, as x0, y0, x1, y1."""
    low = np.maximum(np.floor((boxes_xyxy[:, :2] - margin) / BLOCK), 0)
    high = np.ceil((boxes_xyxy[:, 2:] + margin) / BLOCK)
    grown: list[list[int]] = np.concatenate([low, high], axis=1).astype(int).tolist()
    return grown


def corridor_blocks(blocks: BoolMask) -> BoolMask:
    """The region joined into one band from its first to its last column, with the method's margins.

    Args:
        blocks: bool [rows, columns], not empty.
    """
    rows = len(blocks)
    occupied = np.flatnonzero(blocks.any(axis=0))
    span = np.arange(occupied[0], occupied[-1] + 1)
    first = blocks[:, occupied].argmax(axis=0)
    last = rows - 1 - blocks[::-1, occupied].argmax(axis=0)
    top = np.interp(span, occupied, first) * (1 - TOP_MARGIN)
    bottom = np.interp(span, occupied, last)
    bottom += BOTTOM_MARGIN * (rows - bottom)
    row = np.arange(rows)[:, None]
    band = blocks.copy()
    band[:, span] |= (row >= np.floor(top)) & (row <= np.ceil(bottom))
    return band
