"""What decides which part of a frame is sent: the interface, and the baseline that sends everything."""

from __future__ import annotations

from typing import Protocol

from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.types import BoolMask, Frame, RoiMask, UncertaintyMap


class RoiStrategy(Protocol):
    """The interface that the tracker and every baseline share. One object serves one stream, from one thread."""

    def propose(self, frame: Frame) -> RoiProposal:
        """The region to send of a frame."""
        ...

    def update(
        self, index: int, mask: BoolMask, *, confidence: float = 1.0, uncertainty: UncertaintyMap | None = None
    ) -> None:
        """The cloud's answer to the frame with this index.

        Args:
            index: the frame.
            mask: bool [height, width].
            confidence: 0..1, of the mask as a whole.
            uncertainty: uint8 [height, width], of each pixel, where the cloud tells it.
        """
        ...

    def sent(self, index: int, byte_count: int) -> None:
        """A proposed frame was really sent, in so many bytes; told before its answer."""
        ...

    def request_keyframe(self) -> None:
        """Make the next proposal whole."""
        ...


class WithoutFeedback:
    """Base of strategies that learn nothing from the cloud."""

    def update(
        self, index: int, mask: BoolMask, *, confidence: float = 1.0, uncertainty: UncertaintyMap | None = None
    ) -> None:
        """Nothing to learn."""

    def sent(self, index: int, byte_count: int) -> None:
        """Nothing to learn."""


class FullFrame(WithoutFeedback):
    """Sends every frame whole: the baseline that every saving is measured against."""

    def __init__(self, block_size: int = 8) -> None:
        self._block_size = block_size

    def propose(self, frame: Frame) -> RoiProposal:
        """The whole frame."""
        return RoiProposal(RoiMask.full(*frame.size_hw, self._block_size), True, 1.0, keyframe_reason="strategy")

    def request_keyframe(self) -> None:
        """Every frame is whole already."""
