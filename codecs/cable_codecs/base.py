"""What every frame codec takes, returns and promises."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from cable_codecs.errors import CodecError

Image = npt.NDArray[np.uint8]
BoolMask = npt.NDArray[np.bool_]

MAX_DIMENSION = 16384
"""Largest width or height accepted, in pixels (the limit of WebP, and beyond every camera)."""


@dataclass(frozen=True, slots=True)
class CodecParameters:
    """What a codec is opened with; a decoder needs the first three only.

    Raises:
        CodecError: A value is outside its range (the quality range is the codec's own and checked there).
    """

    name: str
    """Registered codec name: ``jpeg``, ``jpeg-ffmpeg``, ``webp``, ``webp-lossless``, ``h264``, ``hevc``, ``av1``
    or ``vp9``."""
    width: int
    """Pixels; odd values are fine."""
    height: int
    """Pixels; odd values are fine."""
    frame_rate: float = 10.0
    """Frames per second, 0.1..1000, used for time stamps and rate control only."""
    quality: int | None = None
    """JPEG and WebP: 1..100, more is better; video: CRF, less is better, 0..51 for H.264 and HEVC, 1..63 for AV1,
    0..63 for VP9; None: the codec's default (`registry.default_quality`). Not used where a bit rate is set."""
    keyframe_interval: int = 250
    """Frames from one keyframe to the next at most; image codecs ignore it."""
    threads: int = 1
    """Threads of the encoder, all working on one frame; decoders use one, so that no damage escapes them."""
    preset: str | None = None
    """Effort, in the encoder's own words: ``ultrafast`` ... for libx264 and libx265, 0..13 for libsvtav1, 0..8
    (cpu-used) for libvpx-vp9, 0..6 for WebP, ``fast`` or ``optimised`` Huffman tables for ``jpeg``; None: a value
    for live use. Hardware encoders have one setting and ignore it."""
    encoder: str | None = None
    """FFmpeg's name of a video encoder, ``auto-hardware`` for the first hardware encoder that works, None for the
    software encoder. What doesn't open is replaced by the software encoder (`Encoder.fallback_reason`)."""
    bitrate_kbps: float | None = None
    """Video: constant bit rate in kbit/s instead of constant quality."""
    ceiling_kbps: float | None = None
    """The most that `Encoder.set_bitrate` may ask for later, by default 4 times ``bitrate_kbps``. Without
    ``bitrate_kbps`` constant quality that stays below this rate; libx264, libx265 and libvpx-vp9 only."""
    buffer_seconds: float | None = None
    """Length of the rate controller's buffer (VBV) at the opening rate: how far the rate may stray for a moment.
    None: 1/3 s but at least 6 frames; shorter ones make x264 fall short of the rate."""
    background_offset: float = 0.0
    """Video: how much coarser pixels outside the region are quantised, 0..1 as a share of the quantiser scale, where
    `Encoder.encode` is given a region. Only libx264, libx265 and libvpx-vp9 can do so."""
    size_offset: float = 0.0
    """How much coarser a connected piece of the region is quantised for each doubling of its size, 0..0.5, up to
    ``background_offset`` (`cable_codecs.size_offset`)."""
    intra_refresh: bool = False
    """Only libx264: renew the picture column by column instead of by keyframes after the first, so that no packet is
    much larger than others. A decoder that lost a packet still needs a keyframe, made on demand."""

    def __post_init__(self) -> None:
        for label, value in (("width", self.width), ("height", self.height)):
            if not 1 <= value <= MAX_DIMENSION:
                raise CodecError(f"codec {label} must be 1..{MAX_DIMENSION} pixels, got {value}")
        if not (math.isfinite(self.frame_rate) and 0.1 <= self.frame_rate <= 1000):
            raise CodecError(f"codec frame_rate must be 0.1..1000 frames per second, got {self.frame_rate}")
        if self.keyframe_interval < 1:
            raise CodecError(f"codec keyframe_interval must be at least 1 frame, got {self.keyframe_interval}")
        if not 1 <= self.threads <= 64:
            raise CodecError(f"codec threads must be 1..64, got {self.threads}")
        for label, rate in (("bitrate_kbps", self.bitrate_kbps), ("ceiling_kbps", self.ceiling_kbps)):
            if rate is not None:
                check_rate(label, rate)
        if self.bitrate_kbps is not None and self.ceiling_kbps is not None and self.ceiling_kbps < self.bitrate_kbps:
            raise CodecError(
                f"codec ceiling_kbps {self.ceiling_kbps} is below bitrate_kbps {self.bitrate_kbps}; raise the ceiling"
            )
        if not 0 <= self.background_offset <= 1:
            raise CodecError(f"codec background_offset must be 0..1, got {self.background_offset}")
        if self.buffer_seconds is not None and not 0.01 <= self.buffer_seconds <= 60:
            raise CodecError(f"codec buffer_seconds must be 0.01..60, got {self.buffer_seconds}")

    def quality_within(self, low: int, high: int, default: int) -> int:
        """The quality in force.

        Raises:
            CodecError: The quality is outside low..high.
        """
        if self.quality is None:
            return default
        if not low <= self.quality <= high:
            raise CodecError(f"{self.name} quality must be {low}..{high}, got {self.quality}")
        return self.quality


def check_rate(label: str, kbps: float) -> None:
    """Check a bit rate in kbit/s.

    Raises:
        CodecError: Outside 1..1000000.
    """
    if not 1 <= kbps <= 1_000_000:
        raise CodecError(f"codec {label} must be 1..1000000 kbit/s, got {kbps}")


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """One coded picture."""

    data: bytes
    keyframe: bool
    """True exactly where a decoder can start: every still image, IRAP pictures of H.264 and HEVC, key frames of
    AV1 and VP9."""
    duration_ns: int
    """Time the encoder took, colour conversion included, monotonic clock."""


class Encoder(ABC):
    """Turns frames into packets, exactly one packet for each frame and without delay.

    Not safe for use by several threads at once.
    """

    implementation: str = ""
    """The library that does the work, as FFmpeg calls it (``libx264``, ``hevc_nvenc``), or ``opencv``."""
    fallback_reason: str | None = None
    """Why ``implementation`` isn't what ``parameters.encoder`` asked for; None where it is."""
    reopen_count: int = 0
    """How often a change of rate or quality could only be made by opening anew, each at the price of a keyframe."""

    def __init__(self, parameters: CodecParameters) -> None:
        self.parameters = parameters

    def set_bitrate(self, kbps: float) -> None:
        """Change the bit rate from the next frame on.

        Raises:
            CodecError: Not opened with ``bitrate_kbps``, above the ceiling, or a codec without rate control.
        """
        raise CodecError(f"{self.parameters.name} has no bit rate to set; set its quality instead")

    def set_quality(self, quality: int) -> None:
        """Change the quality from the next frame on.

        Raises:
            CodecError: Outside the codec's range, or the codec is opened at a constant bit rate.
        """
        raise CodecError(f"{self.parameters.name} has no quality to set, so {quality} can't be used")

    @abstractmethod
    def encode(self, image: Image, roi: BoolMask | None = None, *, keyframe: bool = False) -> EncodedFrame:
        """Encode the next frame.

        Args:
            image: uint8 [height, width, 3], BGR, of the size in ``parameters``.
            roi: bool [height, width], True inside the region of interest. Region-aware codecs spend their
                bits there; plain codecs check the shape and otherwise ignore it.
            keyframe: Make this frame one that a decoder can start at.

        Raises:
            CodecError: The arrays have the wrong shape or dtype, the encoder failed or is closed.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the codec; further calls of ``encode`` raise CodecError."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Decoder(ABC):
    """Turns packets back into frames, one frame for each packet and without delay.

    The same packets give bit-identical frames in every instance. Not safe for use by several threads at once.
    """

    implementation: str = ""
    """The library that does the work, as FFmpeg calls it, or ``opencv``."""

    def __init__(self, parameters: CodecParameters) -> None:
        self.parameters = parameters

    @abstractmethod
    def decode(self, data: bytes) -> Image:
        """Decode one packet.

        Returns:
            uint8 [height, width, 3], BGR, a new array of the size in ``parameters``.

        Raises:
            CodecError: The packet is damaged, empty, of another picture size, holds not exactly one picture,
                or can't be decoded without a keyframe before it.
        """

    @property
    @abstractmethod
    def needs_keyframe(self) -> bool:
        """True while only a keyframe can be decoded: at the start and after an error of a video codec."""

    @abstractmethod
    def close(self) -> None:
        """Release the codec; further calls of ``decode`` raise CodecError."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def check_frame(image: Image, roi: BoolMask | None, parameters: CodecParameters) -> None:
    """Check what a caller handed to an encoder.

    Raises:
        CodecError: Wrong shape or dtype of the image or the region of interest.
    """
    expected = (parameters.height, parameters.width)
    if image.dtype != np.uint8 or image.shape != (*expected, 3):
        raise CodecError(
            f"{parameters.name} encoder was opened for uint8 images [{expected[0]}, {expected[1]}, 3], "
            f"got {image.dtype} {list(image.shape)}; open another encoder for another size"
        )
    if roi is not None and (roi.dtype != np.bool_ or roi.shape != expected):
        raise CodecError(f"the region of interest must be bool {list(expected)}, got {roi.dtype} {list(roi.shape)}")
