"""Putting the background that was last received back around a region, where the pictures are looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask, Image
from cable_codecs.errors import CodecError
from cable_codecs.fill import copy_kept
from cable_codecs.region_grid import block_pixels, block_shape, check_blocks

NEVER_RECEIVED = -1


@dataclass(frozen=True, slots=True)
class ComposedFrame:
    """A picture whose parts may be of different age."""

    image: Image
    """uint8 [height, width, 3], BGR, a new array; black where nothing was ever received."""
    ages: npt.NDArray[np.int64]
    """int64 [rows, columns], what has passed since the pixels of each block were received, in the unit of the stamps
    (0: they are of this frame), ``NEVER_RECEIVED`` where they never were."""

    @property
    def oldest(self) -> int:
        """The largest age of a block that was received."""
        return max(0, int(self.ages.max(initial=0)))

    @property
    def received_share(self) -> float:
        """Share of the blocks that show something."""
        return float(np.mean(self.ages != NEVER_RECEIVED))


class BackgroundComposer:
    """Keeps the newest pixels received of every block: whole frames renew all, others their region.

    Not safe for use by several threads at once.
    """

    def __init__(self, height: int, width: int, block_size: int = 8) -> None:
        """Start with nothing received.

        Args:
            height: Pixels of the pictures.
            width: Pixels of the pictures.
            block_size: Side of a block of the regions in pixels.

        Raises:
            CodecError: A size below 1.
        """
        if min(height, width, block_size) < 1:
            raise CodecError(f"pictures to compose need positive sizes, got {width}x{height} in blocks of {block_size}")
        self.height, self.width, self.block_size = height, width, block_size
        self.reset()

    def reset(self) -> None:
        """Forget every pixel, as after a change of scene."""
        self.shown = np.zeros((self.height, self.width, 3), np.uint8)
        self.received_at = np.zeros(block_shape(self.height, self.width, self.block_size), np.int64)
        self.received = np.zeros(self.received_at.shape, np.bool_)
        self.stamp = -1

    def compose(self, image: Image, blocks: BoolMask | None, *, stamp: int | None = None) -> ComposedFrame:
        """Take in a decoded picture and show it with the background around it.

        Args:
            image: uint8 [height, width, 3], BGR; what it shows outside its region is not looked at.
            blocks: bool [ceil(height / block_size), ceil(width / block_size)], its region; None: it is whole.
            stamp: When it was captured, as a frame number or a time, at least the one before; None counts frames.

        Raises:
            CodecError: Arrays that don't fit, or a stamp that goes backwards.
        """
        if image.dtype != np.uint8 or image.shape != self.shown.shape:
            raise CodecError(
                f"the picture must be uint8 {list(self.shown.shape)}, got {image.dtype} {list(image.shape)}"
            )
        if blocks is not None:
            check_blocks(blocks, self.block_size, self.height, self.width)
        now = self.stamp + 1 if stamp is None else stamp
        if now < self.stamp:
            raise CodecError(f"the picture's stamp {now} is before the last one's, {self.stamp}; compose in order")
        self.stamp = now
        if blocks is None:
            self.shown[:] = image
            self.received[:] = True
            self.received_at[:] = now
        else:
            keep = block_pixels(blocks, self.block_size)[: self.height, : self.width]
            copy_kept(image, keep, self.shown)
            self.received |= blocks
            self.received_at[blocks] = now
        ages = np.where(self.received, now - self.received_at, NEVER_RECEIVED)
        return ComposedFrame(self.shown.copy(), ages)
