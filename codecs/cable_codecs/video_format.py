"""What sets one video codec, and one encoder of it, apart from another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from cable_codecs.base import CodecParameters
from cable_codecs.colour import even

CEILING_FACTOR = 4
"""How far the bit rate may rise later where no ceiling is given."""
BUFFER_SECONDS = 1 / 3
BUFFER_FRAMES = 6
"""Measured on 540p drives at 600 kbit/s: x264 stays within 8 % of the rate over any 2 s from 4 frames of buffer
on; with 1.3 frames it falls 30 % short. Six leave room to double the rate without opening anew."""


@dataclass(frozen=True, slots=True)
class PacketSummary:
    """What a packet's headers say, found without decoding it."""

    keyframe: bool
    """True where a decoder can start here."""
    has_headers: bool
    """True where the parameter sets that a keyframe needs stand before it (VP9 has none: always True)."""
    picture_count: int
    """Pictures that the packet shows."""


@dataclass(frozen=True, slots=True)
class Rate:
    """The bit rate that an encoder is opened at, in bit/s and bits."""

    target: int | None
    """Constant bit rate, None for constant quality."""
    ceiling: int | None
    """The most the encoder may use; None leaves constant quality without a limit."""
    buffer: int
    """Bits that the decoder's model buffer (VBV) holds; 0 without a rate."""


@dataclass(frozen=True, slots=True)
class EncoderSpec:
    """How to open one encoder of FFmpeg for live video."""

    library: str
    """FFmpeg's name."""
    options: Callable[[CodecParameters, int, Rate], Mapping[str, str]]
    """Private options from parameters, CRF and rate."""
    hardware: bool = False
    live_bitrate: bool = False
    """A new bit rate takes effect without opening anew."""
    caps_quality: bool = False
    """Constant quality can be held under a ceiling."""
    constant_quality: bool = True
    """Works without a bit rate."""
    pixel_format: Literal["yuv420p", "nv12"] = "yuv420p"
    needs: str | None = None
    """What is usually missing where it doesn't open."""


@dataclass(frozen=True, slots=True)
class VideoFormat:
    """One video codec."""

    name: str
    decoder: str
    """FFmpeg's name."""
    software: EncoderSpec
    hardware: tuple[EncoderSpec, ...]
    """In the order in which ``auto-hardware`` tries them."""
    quality_range: tuple[int, int]
    """CRF, least to most compression."""
    default_quality: int
    summarise: Callable[[bytes], PacketSummary]
    headers: str
    """What the keyframe's headers are called."""
    smallest: int = 2
    """Least width and height that the encoder takes; smaller pictures are padded."""

    def coded_size(self, parameters: CodecParameters) -> tuple[int, int]:
        """(height, width) of the coded picture: even, because chroma is halved, and not too small."""
        return max(even(parameters.height), self.smallest), max(even(parameters.width), self.smallest)

    def find_encoder(self, library: str) -> EncoderSpec | None:
        """The encoder of FFmpeg's name, None where this codec has no such encoder."""
        return next((spec for spec in (self.software, *self.hardware) if spec.library == library), None)


def opening_rate(parameters: CodecParameters, target_kbps: float | None) -> Rate:
    """The rate for opening an encoder.

    Args:
        parameters: The caller's parameters.
        target_kbps: The bit rate now in force, None for constant quality.
    """
    base = target_kbps if target_kbps is not None else parameters.ceiling_kbps
    if base is None:
        return Rate(None, None, 0)
    seconds = parameters.buffer_seconds
    if seconds is None:
        seconds = max(BUFFER_SECONDS, BUFFER_FRAMES / parameters.frame_rate)
    ceiling = highest_kbps(parameters, base)
    target = None if target_kbps is None else round(target_kbps * 1000)
    return Rate(target, round(ceiling * 1000), round(base * 1000 * seconds))


def highest_kbps(parameters: CodecParameters, target_kbps: float) -> float:
    """The bit rate that may be asked for later, at least the one in force."""
    if parameters.ceiling_kbps is not None:
        return parameters.ceiling_kbps
    opening = parameters.bitrate_kbps if parameters.bitrate_kbps is not None else target_kbps
    return opening * CEILING_FACTOR
