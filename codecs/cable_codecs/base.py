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
    """Everything that encoder and decoder must agree on.

    Raises:
        CodecError: A value is outside its range (the quality range is the codec's own and checked there).
    """

    name: str
    """Registered codec name: ``jpeg``, ``webp`` or ``h264``."""
    width: int
    """Pixels; odd values are fine."""
    height: int
    """Pixels; odd values are fine."""
    frame_rate: float = 10.0
    """Frames per second, 0.1..1000, used for time stamps and rate control only."""
    quality: int | None = None
    """JPEG and WebP: 1..100, more is better; H.264: CRF 0..51, less is better; None: 75, 75, CRF 28."""
    keyframe_interval: int = 250
    """Frames from one IDR to the next at most; image codecs ignore it."""
    threads: int = 1
    """Threads of the encoder, working on slices of one frame; decoders use one, so that no damage escapes them."""

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


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """One coded picture."""

    data: bytes
    keyframe: bool
    """True where a decoder can start here (every still image; in H.264 an IDR picture)."""
    duration_ns: int
    """Time the encoder took, colour conversion included, monotonic clock."""


class Encoder(ABC):
    """Turns frames into packets, exactly one packet for each frame and without delay.

    Not safe for use by several threads at once.
    """

    def __init__(self, parameters: CodecParameters) -> None:
        self.parameters = parameters

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
