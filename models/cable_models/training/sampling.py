"""Which training images are shown, at which size, and around which object they are cropped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cable_models.errors import ModelError
from cable_models.training.samples import LabelledImage, SampleEntry, read_entries

DRAWS_BEFORE_REREAD = 400

CLASS_SHARES: Mapping[int, float] = {0: 0.34, 1: 0.26, 2: 0.16, 5: 0.11, 7: 0.13}
"""How often each COCO class is what an image is picked and cropped for."""

MIN_FOCUS_VISIBILITY = 0.4
MIN_FOCUS_HEIGHT_PX = 12.0
"""Smallest object worth cropping to, in pixels of the stored image."""


@dataclass(frozen=True, slots=True)
class Focus:
    """A training image and the object it was picked for."""

    sample: LabelledImage
    row: int | None
    """Row of the object, None where the image holds none."""


@dataclass(slots=True)
class BalancedSampler:
    """Draws a class, then an image that holds it, then one object of it; takes up new images as they appear.

    Its draws come from the generator it is given, so a stored generator state is all that a resumed run needs.
    """

    folder: Path
    entries: list[SampleEntry] = field(default_factory=list)
    holders: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    draws: int = 0

    def draw(self, rng: np.random.Generator) -> Focus:
        """The next image.

        Raises:
            ModelError: the folder holds no samples.
        """
        if self.draws % DRAWS_BEFORE_REREAD == 0:
            self.reread()
        self.draws += 1
        present = [index for index in CLASS_SHARES if self.holders.get(index)]
        if not present:
            return Focus(self.entries[int(rng.integers(len(self.entries)))].load(), None)
        shares = np.array([CLASS_SHARES[index] for index in present])
        chosen = present[int(rng.choice(len(present), p=shares / shares.sum()))]
        entry, row = self.holders[chosen][int(rng.integers(len(self.holders[chosen])))]
        return Focus(self.entries[entry].load(), row)

    def reread(self) -> None:
        """Reads the label file again.

        Raises:
            ModelError: the folder holds no samples.
        """
        self.entries = read_entries(self.folder)
        if not self.entries:
            raise ModelError(f"{self.folder} holds no samples; render a training set into it first")
        self.holders = holders_by_class(self.entries)


def holders_by_class(entries: Sequence[SampleEntry]) -> dict[int, list[tuple[int, int]]]:
    """For each class the (entry, row) of every object large and free enough to be the focus of a crop."""
    holders: dict[int, list[tuple[int, int]]] = {}
    for index, entry in enumerate(entries):
        heights = entry.boxes_xyxy[:, 3] - entry.boxes_xyxy[:, 1]
        clear = (entry.visibility >= MIN_FOCUS_VISIBILITY) & (heights >= MIN_FOCUS_HEIGHT_PX)
        for row in np.flatnonzero(clear).tolist():
            holders.setdefault(int(entry.class_ids[row]), []).append((index, row))
    return holders
