"""What decides which part of a frame is sent: the tracker, or the full-frame baseline."""

from __future__ import annotations

from typing import Protocol

from cable_rpc.edge.roi_tracker import RoiProposal
from cable_rpc.types import BoolMask, Frame, RoiMask, StageTimings


class RoiStrategy(Protocol):
    """The interface that `RoiTracker` and every baseline share."""

    def propose(self, frame: Frame) -> RoiProposal:
        """The region to send of a frame."""
        ...

    def update(self, index: int, mask: BoolMask) -> None:
        """The cloud's mask, bool [H, W], of the frame with this index."""
        ...

    def request_keyframe(self) -> None:
        """Make the next proposal whole."""
        ...


class FullFrame:
    """Sends every frame whole: the baseline that every saving is measured against."""

    def __init__(self, block_size: int = 8) -> None:
        self._block_size = block_size

    def propose(self, frame: Frame) -> RoiProposal:
        """The whole frame."""
        roi = RoiMask.full(*frame.size_hw, self._block_size)
        return RoiProposal(
            roi=roi,
            keyframe=True,
            coverage=1.0,
            prior_index=None,
            staleness=None,
            dilation_px=0.0,
            shift_px=0.0,
            raw_coverage=1.0,
            timings=StageTimings(),
        )

    def update(self, index: int, mask: BoolMask) -> None:
        """Nothing to learn."""

    def request_keyframe(self) -> None:
        """Every frame is whole already."""
