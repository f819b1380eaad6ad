"""From a camera image to the network's input."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast, get_args

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image as PilImage

from cable_models.detection import Image
from cable_models.errors import ModelError

FloatTensor = npt.NDArray[np.floating[Any]]
Resample = Literal["antialias", "linear"]


@dataclass(frozen=True, slots=True)
class InputRecipe:
    """What a checkpoint expects of its input: resize straight to ``size_wh`` (no letterbox), scale, normalise."""

    size_wh: tuple[int, int]
    """Width and height of the network's input."""
    resample: Resample = "antialias"
    """``antialias``: Pillow's bilinear filter, as the published processors resize, which widens when shrinking.
    ``linear``: OpenCV's two-tap filter, several times faster, which skips pixels when shrinking by more than 2."""
    rescale: float = 1 / 255
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """R, G, B, subtracted after ``rescale``."""
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """R, G, B, divided by last."""

    def __post_init__(self) -> None:
        """Refuses what can't work.

        Raises:
            ModelError: a side below 1, an unknown filter, a deviation of 0.
        """
        if min(self.size_wh) < 1 or self.resample not in get_args(Resample) or 0 in self.std or self.rescale <= 0:
            raise ModelError(f"unusable preprocessing {self}; sizes and deviations are positive, filters {RESAMPLES}")

    def describe(self) -> str:
        """One sentence for the metadata of an export."""
        width, height = self.size_wh
        kind = "antialiased bilinear (Pillow)" if self.resample == "antialias" else "plain bilinear (OpenCV)"
        plain = self.mean == (0.0, 0.0, 0.0) and self.std == (1.0, 1.0, 1.0)
        last = "no mean or deviation" if plain else f"minus mean {self.mean}, over deviation {self.std}"
        return f"BGR to RGB, {kind} resize straight to {width}x{height}, times {self.rescale:.6g}, {last}, NCHW"


RESAMPLES: tuple[Resample, ...] = get_args(Resample)


def as_resample(text: str) -> Resample:
    """A filter by its name.

    Raises:
        ModelError: unknown name; lists the known ones.
    """
    if text not in RESAMPLES:
        raise ModelError(f"resize filter '{text}' is unknown; use one of {', '.join(RESAMPLES)}")
    return text


def check_image(image: Image, position: int) -> None:
    """Refuses anything but a non-empty uint8 [H, W, 3] array.

    Raises:
        ModelError: wrong dtype or shape.
    """
    is_image = isinstance(image, np.ndarray) and image.dtype == np.uint8
    if not is_image or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ModelError(f"image {position} must be uint8 [height, width, 3] in BGR order, got {found}")


def fill_input(
    images: Sequence[Image], tensor: FloatTensor, recipe: InputRecipe | None = None, workers: Executor | None = None
) -> None:
    """Writes images into an RGB tensor.

    Args:
        images: uint8 [height, width, 3] BGR, any sizes.
        tensor: [N, 3, H, W]; its first ``len(images)`` rows are overwritten.
        recipe: What the network expects, for a tensor of its size; None = resized with antialiasing, 0..1.
        workers: Threads to spread several images over.
    """
    height, width = tensor.shape[2:]
    recipe = recipe or InputRecipe((width, height))
    spread = map if workers is None or len(images) == 1 else workers.map
    # resizing and arithmetic on arrays let other threads run; list() waits, and raises what a thread raised
    list(spread(partial(fill_row, recipe=recipe), images, tensor))


def fill_row(image: Image, row: FloatTensor, recipe: InputRecipe) -> None:
    """One image into its row [3, H, W]."""
    height, width = row.shape[1:]
    channels = reversed(cv2.split(resize(image, (width, height), recipe.resample)))
    for plane, channel, mean, std in zip(row, channels, recipe.mean, recipe.std, strict=True):
        np.multiply(channel, plane.dtype.type(recipe.rescale / std), out=plane)
        if mean:
            plane -= plane.dtype.type(mean / std)


def resize(image: Image, size_wh: tuple[int, int], resample: Resample) -> Image:
    """Resizes uint8 [height, width, 3]; the order of the channels doesn't matter."""
    if (image.shape[1], image.shape[0]) == size_wh:
        return image
    if resample == "linear":
        return cast(Image, cv2.resize(image, size_wh, interpolation=cv2.INTER_LINEAR))
    return np.asarray(PilImage.fromarray(image).resize(size_wh, PilImage.Resampling.BILINEAR))
