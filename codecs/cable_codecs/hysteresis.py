"""Keeping blocks in the region for some frames after they left it, so that its edge doesn't flicker."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask
from cable_codecs.errors import CodecError

NEVER = np.iinfo(np.int32).max
MAX_HOLD_FRAMES = 1000


class RegionHysteresis:
    """A block enters the region at once, and leaves it only after ``hold_frames`` frames outside.

    Not safe for use by several threads at once.
    """

    def __init__(self, hold_frames: int, *, most_share: float = 1.0) -> None:
        """Start with nothing held.

        Args:
            hold_frames: Frames for which a block stays after the last frame that wanted it, 0..1000; 0 holds none.
            most_share: Held blocks that would take the region beyond this share of the picture's blocks are
                let go, those longest outside first; wanted blocks stay, whatever their share.

        Raises:
            CodecError: A value is outside its range.
        """
        check_hysteresis(hold_frames, most_share)
        self.hold_frames = hold_frames
        self.most_share = most_share
        self.frames_outside: npt.NDArray[np.int32] | None = None

    def update(self, blocks: BoolMask) -> BoolMask:
        """The region of the next frame.

        Args:
            blocks: bool [rows, columns], what is wanted in it.

        Returns:
            bool [rows, columns], a superset; the argument itself where nothing is held.

        Raises:
            CodecError: Another number of rows or columns than before.
        """
        if self.hold_frames == 0:
            return blocks
        if self.frames_outside is None:
            self.frames_outside = np.full(blocks.shape, NEVER, np.int32)
        outside = self.frames_outside
        if blocks.shape != outside.shape:
            raise CodecError(
                f"the region had {list(outside.shape)} blocks, now {list(blocks.shape)}; reset before another size"
            )
        np.add(outside, 1, out=outside, where=outside <= self.hold_frames)
        outside[blocks] = 0
        return np.asarray(outside <= self.longest_held(outside))

    def longest_held(self, outside: npt.NDArray[np.int32]) -> int:
        """Frames outside up to which blocks are held in this frame, so that the region keeps to its share."""
        counts = np.bincount(outside[outside <= self.hold_frames], minlength=self.hold_frames + 1)
        fitting = np.cumsum(counts) <= self.most_share * outside.size
        fitting[0] = True
        return self.hold_frames if fitting.all() else int(np.argmin(fitting)) - 1

    def reset(self) -> None:
        """Forget what is held, as after a whole frame or a change of scene."""
        self.frames_outside = None


def check_hysteresis(hold_frames: int, most_share: float) -> None:
    """Check the settings of a hysteresis.

    Raises:
        CodecError: A value is outside its range.
    """
    if not 0 <= hold_frames <= MAX_HOLD_FRAMES:
        raise CodecError(f"hysteresis must hold blocks for 0..{MAX_HOLD_FRAMES} frames, got {hold_frames}")
    if not (math.isfinite(most_share) and 0 < most_share <= 1):
        raise CodecError(f"hysteresis' share of the picture must be above 0 and at most 1, got {most_share}")
