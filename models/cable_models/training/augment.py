"""Random changes of training images that leave their labels true."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cable_models.detection import Float32Array, Image
from cable_models.training.samples import LabelledImage
from cable_models.training.upload_views import CONSTANT_FILLS, RegionFill, WeightedFill, draw_fill, upload_region

MIN_KEPT_AREA = 0.4


@dataclass(frozen=True, slots=True)
class AugmentConfig:
    """How often and how strongly images are changed."""

    flip: float = 0.5
    crop: float = 0.6
    crop_shares: tuple[float, float] = (0.55, 1.0)
    """Smallest and largest crop as a share of the image's width and height."""
    colour: float = 0.8
    region_only: float = 0.5
    """Share of images of which only a region around the objects is kept, as an edge uploads them."""
    jpeg: float = 0.4


def augment(
    sample: LabelledImage,
    size_wh: tuple[int, int],
    config: AugmentConfig,
    rng: np.random.Generator,
    focus: int | None = None,
    fills: Sequence[WeightedFill] = CONSTANT_FILLS,
) -> LabelledImage:
    """A changed copy, resized to ``size_wh`` pixels; objects mostly lost to a crop or a fill are dropped.

    Args:
        sample: Image and labels.
        size_wh: Width and height of the result.
        config: How often and how strongly.
        rng: Source of all draws.
        focus: Row of an object that a crop keeps, whole where the crop is large enough.
        fills: What may stand outside a kept region.
    """
    sample = random_crop(sample, size_wh, config, rng, focus)
    if rng.random() < config.flip:
        sample = mirrored(sample)
    image = sample.image
    if rng.random() < config.colour:
        image = jitter_colour(image, rng)
    if rng.random() < config.jpeg:
        image = jpeg_recoded(image, int(rng.integers(20, 90)))
    sample = LabelledImage(image, sample.boxes_xyxy, sample.class_ids, sample.visibility)
    # Last, since the service fills the background after decoding.
    return keep_region(sample, draw_fill(fills, rng), rng) if rng.random() < config.region_only else sample


def random_crop(
    sample: LabelledImage,
    size_wh: tuple[int, int],
    config: AugmentConfig,
    rng: np.random.Generator,
    focus: int | None = None,
) -> LabelledImage:
    """A random part of the image (or all of it) at the wanted size, aspect ratio jittered by up to 15 %."""
    height, width = sample.image.shape[:2]
    crop_h, crop_w = height, width
    if rng.random() < config.crop:
        share = rng.uniform(*config.crop_shares)
        crop_h = int(height * min(1.0, share * rng.uniform(0.85, 1.15)))
        crop_w = int(width * share)
    kept_box = np.array([0, 0, width, height]) if focus is None else sample.boxes_xyxy[focus]
    x = crop_start(width, crop_w, float(kept_box[0]), float(kept_box[2]), rng)
    y = crop_start(height, crop_h, float(kept_box[1]), float(kept_box[3]), rng)
    part = sample.image[y : y + crop_h, x : x + crop_w]
    image = cv2.resize(part, size_wh, interpolation=cv2.INTER_LINEAR)
    scale = np.array([size_wh[0] / crop_w, size_wh[1] / crop_h] * 2, np.float32)
    moved = (sample.boxes_xyxy - np.array([x, y, x, y], np.float32)) * scale
    clipped = np.clip(moved, 0, np.array([*size_wh, *size_wh], np.float32))
    kept = area(clipped) >= MIN_KEPT_AREA * np.maximum(area(moved), 1e-6)
    return LabelledImage(np.asarray(image, np.uint8), clipped[kept], sample.class_ids[kept], sample.visibility[kept])


def crop_start(side: int, crop: int, low: float, high: float, rng: np.random.Generator) -> int:
    """A random start of a crop along one side that keeps the span from ``low`` to ``high`` inside, where it fits."""
    first = min(max(0, math.ceil(high) - crop), side - crop)
    last = max(min(math.floor(low), side - crop), 0)
    if high - low > crop:
        first, last = min(first, last), max(first, last)
    return int(rng.integers(first, max(first, last) + 1))


def mirrored(sample: LabelledImage) -> LabelledImage:
    """Left and right exchanged."""
    width = sample.image.shape[1]
    boxes = sample.boxes_xyxy.copy()
    boxes[:, [0, 2]] = width - sample.boxes_xyxy[:, [2, 0]]
    return LabelledImage(np.ascontiguousarray(sample.image[:, ::-1]), boxes, sample.class_ids, sample.visibility)


def jitter_colour(image: Image, rng: np.random.Generator) -> Image:
    """Random brightness, contrast, gamma, white balance and saturation."""
    grey_level = np.linspace(0, 1, 256, dtype=np.float32)
    curve = grey_level ** rng.uniform(0.7, 1.5)
    curve = (curve - 0.5) * rng.uniform(0.7, 1.3) + 0.5 + rng.uniform(-0.15, 0.15)
    table = curve[:, None] * rng.uniform(0.92, 1.08, 3)
    table8 = np.clip(table * 255, 0, 255).astype(np.uint8)[None]
    toned = cv2.LUT(image, table8)
    grey = cv2.cvtColor(cv2.cvtColor(toned, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    saturation = rng.uniform(0.4, 1.4)
    return np.asarray(cv2.addWeighted(toned, saturation, grey, 1 - saturation, 0), np.uint8)


def keep_region(sample: LabelledImage, fill: RegionFill, rng: np.random.Generator) -> LabelledImage:
    """Replaces all but a region around most of the objects, as the upload of an edge looks."""
    region = upload_region(sample.boxes_xyxy, sample.image.shape[:2], rng)
    kept = covered_share(sample.boxes_xyxy, region) >= MIN_KEPT_AREA
    return LabelledImage(
        fill(sample.image, region), sample.boxes_xyxy[kept], sample.class_ids[kept], sample.visibility[kept]
    )


def covered_share(boxes_xyxy: Float32Array, pixels: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> Float32Array:
    """Share of each box's pixels inside a mask, by its integral image, float32 [N]."""
    height, width = pixels.shape
    integral = cv2.integral(pixels.astype(np.uint8))
    x0, y0, x1, y1 = np.clip(np.round(boxes_xyxy).astype(int), 0, [width, height, width, height]).T
    inside = integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]
    return np.asarray(inside / np.maximum((x1 - x0) * (y1 - y0), 1), np.float32)


def jpeg_recoded(image: Image, quality: int) -> Image:
    """The image after JPEG at the given quality."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def area(boxes_xyxy: Float32Array) -> Float32Array:
    """Area of each box in square pixels, float32 [N]."""
    return np.asarray(np.clip(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], 0, None).prod(axis=1), np.float32)
