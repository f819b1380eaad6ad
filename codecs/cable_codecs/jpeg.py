"""JPEG: libjpeg-turbo, by OpenCV, encodes several times faster than FFmpeg; FFmpeg decodes.

OpenCV would decode in about three quarters of the time, but its libjpeg writes a line about each damaged image straight
to the process's standard error, where whoever sends images could fill a log.
"""

from __future__ import annotations

import time

import cv2
import numpy as np

from cable_codecs.base import BoolMask, CodecParameters, EncodedFrame, Encoder, Image, check_frame
from cable_codecs.errors import CodecError
from cable_codecs.ffmpeg import open_decoder
from cable_codecs.still import DEFAULT_QUALITY, JPEG, StillDecoder

PRESETS = ("fast", "optimised")
"""Huffman tables of the standard, or fitted to the image in a second pass."""


class JpegEncoder(Encoder):
    """Baseline JFIF, 4:2:0, every packet a keyframe.

    Fitted Huffman tables take twice the time and save 4-6 % of the bytes of full frames at quality 75, 14-24 % of
    frames with blank background and 28-37 % of those at quality 30, so by default they are used for frames that
    come with a region.
    """

    implementation = "opencv"

    def __init__(self, parameters: CodecParameters) -> None:
        super().__init__(parameters)
        self.quality = parameters.quality_within(1, 100, DEFAULT_QUALITY)
        if parameters.preset not in (None, *PRESETS):
            raise CodecError(f"{parameters.name} preset must be one of {', '.join(PRESETS)}, got {parameters.preset!r}")
        if not cv2.haveImageWriter(".jpg"):
            raise CodecError("this OpenCV was built without JPEG; choose another codec")
        self.closed = False

    def set_quality(self, quality: int) -> None:
        """Change the quality 1..100 from the next frame on."""
        if not 1 <= quality <= 100:
            raise CodecError(f"{self.parameters.name} quality must be 1..100, got {quality}")
        self.quality = quality

    def encode(self, image: Image, roi: BoolMask | None = None, *, keyframe: bool = False) -> EncodedFrame:
        """Encode one image; ``roi`` decides about the Huffman tables only, ``keyframe`` changes nothing."""
        started = time.monotonic_ns()
        name = self.parameters.name
        if self.closed:
            raise CodecError(f"{name} encoder is closed; open a new one")
        check_frame(image, roi, self.parameters)
        preset = self.parameters.preset
        optimise = preset == "optimised" or (preset is None and roi is not None)
        settings = [
            cv2.IMWRITE_JPEG_QUALITY, self.quality,
            cv2.IMWRITE_JPEG_OPTIMIZE, int(optimise),
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
        ]  # fmt: skip
        try:
            done, buffer = cv2.imencode(".jpg", np.ascontiguousarray(image), settings)
        except cv2.error as error:
            raise CodecError(f"{name} encoder failed: {error}") from error
        if not done:
            raise CodecError(f"{name} encoder failed on an image of {image.shape[1]}x{image.shape[0]}")
        return EncodedFrame(buffer.tobytes(), keyframe=True, duration_ns=time.monotonic_ns() - started)

    def close(self) -> None:
        """Release the codec."""
        self.closed = True


class JpegDecoder(StillDecoder):
    """Decodes sequential 4:2:0 files, those of `JpegEncoder` and others.

    Damage inside the scan is noticed only where it leaves no valid Huffman code, else it comes out as a wrong picture.
    The transport has to keep the bytes right.
    """

    def __init__(self, parameters: CodecParameters) -> None:
        super().__init__(parameters, JPEG)

    def decode(self, data: bytes) -> Image:
        """Decode one image file."""
        if self.context is not None:
            # FFmpeg keeps tables and what comments say from one image to the next; a fresh context costs about 2 ms at
            # 1280x720.
            self.context = open_decoder(self.still.decoder, self.parameters)
        return super().decode(data)
