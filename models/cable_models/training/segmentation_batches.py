"""Batches for SAM's image encoder: pictures in the top-left corner of a padded square, of which only rows are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cable_models.detection import Image
from cable_models.errors import ModelError
from cable_models.training.segmentation_encoder import CELLS_PER_TOKEN
from cable_models.training.segmentation_samples import CLASS_NAMES, SegmentedEntry, SegmentedImage, read_segmented
from cable_models.training.segmentation_views import ViewConfig, changed_view, class_shares
from cable_models.training.upload_views import CONSTANT_FILLS, WeightedFill

PIXEL_MEAN = np.array((123.675, 116.28, 103.53), np.float32)
PIXEL_STD = np.array((58.395, 57.12, 57.375), np.float32)

REREAD_EVERY = 50
"""Batches after which a folder is looked through for new images."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How one batch fills the square, in shares of its side."""

    picture: float
    """Height of the picture, whose width is the side."""
    kept: float
    """Height that is encoded; what lies between the two is zero."""
    weight: float
    """How often the layout is drawn."""


LAYOUTS = (
    Layout(picture=2 / 3, kept=2 / 3, weight=0.5),
    Layout(picture=9 / 16, kept=2 / 3, weight=0.35),
    Layout(picture=9 / 16, kept=1.0, weight=0.1),
    Layout(picture=3 / 4, kept=1.0, weight=0.05),
)
"""3:2 for the most picture per token; 16:9 without its windows of padding and with them; 4:3."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Pictures and what their cells show."""

    pixels: Tensor
    """float32 [N, 3, rows * patch, image_size], normalised RGB, zero outside the picture."""
    shares: Tensor
    """float32 [N, 4, 4 * rows, 4 * columns], share of each class in a cell; all zero outside the picture."""


class BatchMaker:
    """Draws batches from a sample folder; new files are taken up as they appear."""

    def __init__(
        self,
        folder: Path,
        image_size: int,
        patch_size: int,
        batch: int,
        views: ViewConfig,
        fills: Sequence[WeightedFill] = CONSTANT_FILLS,
    ) -> None:
        self.folder = folder
        self.image_size = image_size
        self.patch_size = patch_size
        self.batch = batch
        self.views = views
        self.fills = fills
        self.drawn = 0
        self.entries: Sequence[SegmentedEntry] = ()

    def samples(self, rng: np.random.Generator) -> list[SegmentedImage]:
        """As many random images as a batch holds.

        Raises:
            ModelError: the folder holds none.
        """
        if self.drawn % REREAD_EVERY == 0:
            self.entries = read_segmented(self.folder)
        if not self.entries:
            raise ModelError(f"{self.folder} holds no samples; render a training set into it first")
        self.drawn += 1
        return [self.entries[int(index)].load() for index in rng.integers(len(self.entries), size=self.batch)]

    def next(self, rng: np.random.Generator) -> Batch:
        """The next batch.

        Raises:
            ModelError: the folder holds no samples.
        """
        weights = np.array([layout.weight for layout in LAYOUTS])
        layout = LAYOUTS[int(rng.choice(len(LAYOUTS), p=weights / weights.sum()))]
        size = self.image_size
        picture_hw = (round(size * layout.picture), size)
        rows = round(size * layout.kept / self.patch_size)
        pixels = np.zeros((self.batch, 3, rows * self.patch_size, size), np.float32)
        cells = CELLS_PER_TOKEN * size // self.patch_size
        shares = np.zeros((self.batch, 1 + len(CLASS_NAMES), CELLS_PER_TOKEN * rows, cells), np.float32)
        filled = round(picture_hw[0] * cells / size)
        for row, sample in enumerate(self.samples(rng)):
            view = changed_view(sample, (picture_hw[1], picture_hw[0]), self.views, rng, self.fills)
            pixels[row, :, : picture_hw[0]] = normalised(view.image)
            shares[row, :, :filled] = class_shares(view, (filled, cells))
        return Batch(torch.from_numpy(pixels), torch.from_numpy(shares))


def normalised(image: Image) -> npt.NDArray[np.float32]:
    """SAM's input of a BGR picture, float32 [3, H, W] RGB."""
    scaled: npt.NDArray[np.float32] = (image[..., ::-1].astype(np.float32) - PIXEL_MEAN) / PIXEL_STD
    return scaled.transpose(2, 0, 1)
