"""The inputs of CLIP and SAM made on the model's device, bit for bit those of `images`.

On a GPU the frame is uploaded as it is, and PIL's two resizes, tens of milliseconds of one processor core a frame,
become a few integer products there. PIL's resize of 8-bit images is integer arithmetic: weights of 22 fractional bits,
one pass along the rows, rounding to 8 bits, one pass along the columns (Pillow, ``src/libImaging/Resample.c``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import torch

from cable_models.errors import ModelError
from cable_models.lisa.images import CLIP_MEAN, CLIP_STD, SAM_MEAN, SAM_STD, ClipGeometry, Size, sam_size

PRECISION_BITS = 22
"""Fractional bits of PIL's weights."""

Filter = Callable[[float], float]


def bilinear(distance: float) -> float:
    """PIL's triangle, of support 1."""
    return max(0.0, 1.0 - abs(distance))


def bicubic(distance: float) -> float:
    """PIL's cubic with a = -0.5, of support 2."""
    x, a = abs(distance), -0.5
    if x < 1.0:
        return ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0
    return (((x - 5.0) * x + 8.0) * x - 4.0) * a if x < 2.0 else 0.0


SUPPORT: dict[Filter, float] = {bilinear: 1.0, bicubic: 2.0}


@lru_cache(maxsize=64)
def resize_taps(length: int, resized: int, kernel: Filter, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """What each sample of a resized line is made of.

    Args:
        length: Samples of the line.
        resized: Samples afterwards.
        kernel: Filter.
        device: Where the tables lie.

    Returns:
        int64 [resized, taps], numbers of the samples, and int32 [resized, taps], their weights.
    """
    scale = length / resized
    stretch = max(scale, 1.0)
    reach = SUPPORT[kernel] * stretch
    taps = math.ceil(reach) * 2 + 1
    numbers, weights = np.zeros((resized, taps), np.int64), np.zeros((resized, taps), np.int32)
    for sample in range(resized):
        # In the order, and with the roundings, of the original's double precision.
        centre = (sample + 0.5) * scale
        first = max(int(centre - reach + 0.5), 0)
        last = min(int(centre + reach + 0.5), length)
        values = [kernel((x - centre + 0.5) * (1.0 / stretch)) for x in range(first, last)]
        total = sum(values)
        scaled = [value / total * (1 << PRECISION_BITS) for value in values]
        weights[sample, : len(values)] = [int(value - 0.5 if value < 0 else value + 0.5) for value in scaled]
        numbers[sample, : len(values)] = range(first, last)
    return torch.from_numpy(numbers).to(device), torch.from_numpy(weights).to(device)


def resize_rows(planes: torch.Tensor, resized: int, kernel: Filter, part: slice = slice(None)) -> torch.Tensor:
    """One pass of PIL's resize, along the last axis.

    Args:
        planes: uint8 [..., W].
        resized: Width w of the whole result.
        kernel: Filter.
        part: The columns of the result that are wanted.

    Returns:
        uint8 [..., columns of ``part``].
    """
    if planes.shape[-1] == resized:
        return planes[..., part]
    numbers, weights = resize_taps(planes.shape[-1], resized, kernel, planes.device)
    numbers, weights = numbers[part], weights[part]
    total = (planes[..., numbers] * weights).sum(-1, dtype=torch.int32)
    return ((total + (1 << (PRECISION_BITS - 1))) >> PRECISION_BITS).clamp_(0, 255).to(torch.uint8)


def resize(
    planes: torch.Tensor, size: Size, kernel: Filter, rows: slice = slice(None), columns: slice = slice(None)
) -> torch.Tensor:
    """PIL's resize, of which only ``rows`` and ``columns`` are wanted: uint8 [C, H, W] to uint8 [C, h, w]."""
    narrow = resize_rows(planes, size[1], kernel, columns)
    return resize_rows(narrow.mT, size[0], kernel, rows).mT


def normalise(
    planes: torch.Tensor, levels: Sequence[float], mean: Sequence[float], std: Sequence[float]
) -> torch.Tensor:
    """``(levels[grey] - mean) / std`` of each channel through a table: uint8 [3, h, w] to float32 [3, h, w]."""
    grey = np.asarray(levels, np.float32)
    tables = [(grey - np.float32(m)) / np.float32(s) for m, s in zip(mean, std, strict=True)]
    on_device = torch.from_numpy(np.stack(tables)).to(planes.device)
    return torch.stack([table[plane.int()] for table, plane in zip(on_device, planes, strict=True)])


def rgb_planes(image: torch.Tensor) -> torch.Tensor:
    """uint8 [H, W, 3] BGR to uint8 [3, H, W] RGB.

    Raises:
        ModelError: another shape or number format.
    """
    if image.dtype != torch.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.numel():
        raise ModelError(f"a frame must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}")
    return image.permute(2, 0, 1).flip(0)


def clip_input_on_device(
    image: torch.Tensor,
    geometry: ClipGeometry,
    mean: Sequence[float] = CLIP_MEAN,
    std: Sequence[float] = CLIP_STD,
) -> torch.Tensor:
    """`images.clip_input` on the image's device.

    Args:
        image: uint8 [H, W, 3] BGR, of the size ``geometry`` was made for.
        geometry: Mapping of the frame onto CLIP's square.
        mean: RGB, of values 0..1; also the colour of the padding.
        std: RGB, of values 0..1.

    Returns:
        float32 [3, S, S], RGB.

    Raises:
        ModelError: the image isn't uint8 [H, W, 3] or has another size.
    """
    planes = rgb_planes(image)
    if tuple(image.shape[:2]) != geometry.frame:
        raise ModelError(f"image {list(image.shape[:2])} doesn't have the size {geometry.frame} of its CLIP geometry")
    if geometry.canvas != geometry.frame:
        colours = torch.tensor([int(value * 255) for value in mean], dtype=torch.uint8, device=image.device)
        canvas = colours[:, None, None].repeat(1, *geometry.canvas)
        (top, left), (height, width) = geometry.padding, geometry.frame
        canvas[:, top : top + height, left : left + width] = planes
        planes = canvas
    rows, columns = (slice(first, first + geometry.size) for first in geometry.crop)
    seen = resize(planes, geometry.resized, bicubic, rows, columns)
    return normalise(seen, np.arange(256) * (1 / 255), mean, std)  # type: ignore[arg-type]


def sam_input_on_device(image: torch.Tensor, size: int) -> tuple[torch.Tensor, Size]:
    """`images.sam_input` on the image's device.

    Args:
        image: uint8 [H, W, 3] BGR.
        size: Side S of SAM's square input.

    Returns:
        float32 [3, S, S] RGB, and the (h, w) of its top-left part that holds the picture.

    Raises:
        ModelError: the image isn't uint8 [H, W, 3], or is too narrow.
    """
    planes = rgb_planes(image)
    height, width = sam_size((image.shape[0], image.shape[1]), size)
    square = torch.zeros(3, size, size, device=image.device)
    square[:, :height, :width] = normalise(resize(planes, (height, width), bilinear), range(256), SAM_MEAN, SAM_STD)
    return square, (height, width)
