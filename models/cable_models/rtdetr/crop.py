"""The part of a frame that is worth the network's pixels: a window around the region of interest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_models.errors import ModelError

BoolMask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class CropConfig:
    """How a region becomes a window. The window keeps the frame's aspect, so objects are distorted as ever."""

    margin: float = 0.05
    """Context added on each side of the region's box, as a share of the frame's side."""
    min_share: float = 0.35
    """Smallest side of a window, as a share of the frame's: the network has never seen objects much larger."""
    max_share: float = 0.9
    """A window beyond it isn't worth the cut; the whole frame is used."""

    def __post_init__(self) -> None:
        """Refuses shares outside 0..1.

        Raises:
            ModelError: which ones.
        """
        if not (0 <= self.margin <= 1 and 0 < self.min_share <= 1 and 0 < self.max_share <= 1):
            raise ModelError(f"crop shares must lie in 0..1 and window sizes above 0, got {self}")


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of whole pixels, right and bottom exclusive."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def offset_xyxy(self) -> npt.NDArray[np.float32]:
        """What to add to boxes inside the window, float32 [4]."""
        return np.array([self.left, self.top, self.left, self.top], np.float32)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


def crop_window(region: BoolMask, config: CropConfig) -> Window:
    """The window of the frame's aspect around a region.

    Args:
        region: bool [height, width].
        config: Context and limits.

    Returns:
        A window that holds the whole region; the whole frame where the region is empty or spreads over it.
    """
    height, width = region.shape
    whole = Window(0, 0, width, height)
    columns = np.flatnonzero(region.any(axis=0))
    if not len(columns):
        return whole
    rows = np.flatnonzero(region.any(axis=1))
    share = max(
        (columns[-1] + 1 - columns[0]) / width + 2 * config.margin,
        (rows[-1] + 1 - rows[0]) / height + 2 * config.margin,
        config.min_share,
    )
    if share > config.max_share:
        return whole
    left, right = centred_span(columns[0], columns[-1] + 1, share, width)
    top, bottom = centred_span(rows[0], rows[-1] + 1, share, height)
    return Window(left, top, right, bottom)


def centred_span(low: int, high: int, share: float, length: int) -> tuple[int, int]:
    """``share`` of 0..length around the middle of low..high, pushed inside."""
    size = min(int(np.ceil(share * length)), length)
    start = round((low + high - size) / 2)
    start = min(max(start, 0), length - size)
    return start, start + size
