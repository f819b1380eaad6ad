"""How much of the picture was sent: coverage of R_k, of what truly went up, and bytes at four layers."""

from __future__ import annotations

from dataclasses import dataclass

BYTE_LAYERS = ("bitstream", "with_roi", "message", "transport")
"""The layers at which bytes are counted, each with those before it; the fields of `ByteLayers`."""


@dataclass(frozen=True, slots=True)
class ByteLayers:
    """Bytes of one frame (or a sum of frames) in one direction; every layer includes those before it."""

    bitstream: int
    """The coded picture; on the way down, the coded mask and its uncertainty."""
    with_roi: int
    """And the region's own side information; on the way down as ``bitstream``."""
    message: int
    """The whole serialised protobuf message."""
    transport: int
    """IP packets with all headers, by `cable_rpc.study.transport_estimate` unless they were measured."""

    def __add__(self, other: ByteLayers) -> ByteLayers:
        return ByteLayers(
            self.bitstream + other.bitstream,
            self.with_roi + other.with_roi,
            self.message + other.message,
            self.transport + other.transport,
        )

    def of(self, layer: str) -> int:
        """Bytes at one of ``BYTE_LAYERS``."""
        return int(getattr(self, layer))


def pixel_saving(coverage: float) -> float:
    """Share of pixels not sent; says nothing about bytes."""
    return 1.0 - coverage


def sent_coverage(coverage: float, *, keyframe: bool, first: bool) -> float:
    """Share of a frame that counts as sent: keyframes and the first frame of a sequence as 1 (``coverage_tx``)."""
    return 1.0 if keyframe or first else coverage
