"""The parts of PyAV that all frame codecs share: opening contexts, pushing frames, pulling pictures."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Literal

import av
import cv2
import numpy as np
from av.codec.context import ThreadType
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.plane import VideoPlane

from cable_codecs.base import CodecParameters
from cable_codecs.colour import Plane, picture_planes
from cable_codecs.errors import CodecError

MPEG_RANGE, JPEG_RANGE = 1, 2
"""AVCOL_RANGE_*: limited and full range."""
BT470BG, SMPTE170M = 5, 6
"""AVCOL_SPC_*: both have the BT.601 matrix; JFIF streams carry the first, ours the second."""
EDGE_PIXELS = 256
"""Room for the edges and the alignment that FFmpeg adds to a picture before it checks the limit."""


def open_encoder(
    library: str,
    parameters: CodecParameters,
    *,
    size: tuple[int, int],
    full_range: bool,
    options: Mapping[str, str],
    interval: int | None = None,
    bit_rate: int | None = None,
    pixel_format: str | None = None,
) -> VideoCodecContext:
    """Open an encoder for 4:2:0 pictures tagged BT.601.

    Args:
        library: FFmpeg's name of the encoder.
        parameters: What the caller asked for.
        size: (height, width) of the coded picture.
        full_range: Tag as full range (JFIF) instead of limited range.
        options: Private options of the encoder.
        interval: Frames between keyframes at most, None for image codecs.
        bit_rate: Bits per second, None for constant quality.
        pixel_format: Of the frames; None for I420 of the range given.

    Raises:
        CodecError: The encoder isn't in this FFmpeg or refuses the settings.
    """
    try:
        context = create_context(library, "w")
        context.height, context.width = size
        context.pix_fmt = pixel_format or ("yuvj420p" if full_range else "yuv420p")
        rate = Fraction(parameters.frame_rate).limit_denominator(1001)
        context.framerate, context.time_base = rate, 1 / rate
        context.color_range = JPEG_RANGE if full_range else MPEG_RANGE
        context.colorspace = context.color_primaries = context.color_trc = SMPTE170M
        context.thread_count = parameters.threads
        context.thread_type = ThreadType.SLICE
        if interval is not None:
            context.gop_size, context.max_b_frames = interval, 0
        if bit_rate is not None:
            context.bit_rate = bit_rate
        context.options = dict(options)
        context.open()
    except (av.FFmpegError, ValueError) as error:
        detail = error.strerror if isinstance(error, av.FFmpegError) else "this FFmpeg was built without it"
        raise CodecError(
            f"{library} can't be opened for {parameters.width}x{parameters.height}: {detail}; "
            "check the size, the quality and the preset, or choose another codec"
        ) from error
    return context


def open_decoder(library: str, parameters: CodecParameters) -> VideoCodecContext:
    """Open a decoder that refuses damaged streams and pictures much larger than expected.

    Raises:
        CodecError: The decoder isn't in this FFmpeg.
    """
    most_pixels = (parameters.width + EDGE_PIXELS) * (parameters.height + EDGE_PIXELS)
    try:
        context = create_context(library, "r")
        # Several slice threads would switch off the detection of lost slices, frame threads would add delay.
        context.thread_count = 1
        context.options = {"err_detect": "explode", "flags": "low_delay", "max_pixels": str(most_pixels)}
        context.open()
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(f"{library} decoder can't be opened: {error}; choose another codec") from error
    return context


def create_context(library: str, mode: Literal["r", "w"]) -> VideoCodecContext:
    """An unopened context.

    Raises:
        ValueError: No such video codec in this FFmpeg (PyAV's own error for unknown names is one as well).
    """
    context = av.CodecContext.create(library, mode)
    if not isinstance(context, VideoCodecContext):
        raise ValueError(f"{library} is no video codec")
    return context


def frame_of_picture(picture: Plane, height: int, width: int, pixel_format: str) -> VideoFrame:
    """A frame of the given size from an I420 picture up to one row and column larger.

    Shares the picture's memory where it can, so that must stay alive and unchanged until it is encoded.
    """
    # PyAV takes the height of a shared buffer as rows // 6 * 4, which cuts heights not a multiple of 4.
    if height % 4 == 0 and width % 2 == 0:
        return VideoFrame.from_numpy_buffer(picture, format=pixel_format)
    frame = VideoFrame(width, height, pixel_format)
    for plane, source in zip(frame.planes, picture_planes(picture), strict=True):
        plane_view(plane)[:] = source[: plane.height, : plane.width]
    return frame


def nv12_frame_of_picture(picture: Plane) -> VideoFrame:
    """A frame with interleaved chroma, as most hardware encoders take it, from an I420 picture."""
    luma, blue, red = picture_planes(picture)
    height, width = luma.shape
    frame = VideoFrame(width, height, "nv12")
    for plane, source in zip(frame.planes, (luma, cv2.merge([blue, red]).reshape(-1, width)), strict=True):
        rows = np.frombuffer(memoryview(plane), np.uint8)[: len(source) * plane.line_size]
        rows.reshape(len(source), plane.line_size)[:, :width] = source
    return frame


def plane_view(plane: VideoPlane) -> Plane:
    """uint8 [height, width] over the memory of a plane."""
    rows = np.frombuffer(memoryview(plane), np.uint8)[: plane.height * plane.line_size]
    return rows.reshape(plane.height, plane.line_size)[:, : plane.width]


def encode_single(context: VideoCodecContext, frame: VideoFrame, name: str) -> bytes:
    """Encode a frame into its packet.

    Raises:
        CodecError: The encoder failed or didn't return exactly one packet.
    """
    try:
        packets = context.encode(frame)
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(f"{name} encoder failed on frame {frame.pts}: {error}; open a new encoder") from error
    if len(packets) != 1:
        raise CodecError(
            f"{name} encoder returned {len(packets)} packets for frame {frame.pts}, expected exactly one; "
            "open a new encoder"
        )
    return bytes(packets[0])


def decode_single(context: VideoCodecContext, data: bytes, parameters: CodecParameters) -> VideoFrame:
    """Decode a packet into its picture.

    Raises:
        CodecError: The packet is empty, damaged, or doesn't hold exactly one picture.
    """
    if not data:
        raise CodecError(f"{parameters.name} packet is empty; send the packet as the encoder made it")
    try:
        frames = context.decode(av.Packet(data))
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(
            f"{parameters.name} packet of {len(data)} bytes can't be decoded: {error}; "
            "it is damaged or isn't of this codec and size"
        ) from error
    if len(frames) != 1:
        raise CodecError(
            f"{parameters.name} packet of {len(data)} bytes holds {len(frames)} pictures, expected one; "
            "send one whole encoded frame per packet"
        )
    frame = frames[0]
    if frame.is_corrupt:
        raise CodecError(f"{parameters.name} packet of {len(data)} bytes is damaged; request a keyframe")
    return frame


def read_picture(frame: VideoFrame, out: Plane, size: tuple[int, int], formats: tuple[str, ...], name: str) -> Plane:
    """Copy a decoded frame into an I420 picture after checking what it is.

    Args:
        frame: What the decoder returned.
        out: I420 picture to fill, padded to even sides.
        size: (height, width) that the coded picture must have.
        formats: Pixel formats that are acceptable.
        name: Codec name for the error text.

    Raises:
        CodecError: Another picture size or pixel format.
    """
    if (frame.height, frame.width) != size:
        raise CodecError(
            f"{name} picture is {frame.width}x{frame.height}, expected {size[1]}x{size[0]}; "
            "open the decoder with the size of the encoder"
        )
    if frame.format.name not in formats:
        raise CodecError(
            f"{name} picture has pixel format {frame.format.name}, expected {' or '.join(formats)}; "
            "encode with chroma subsampled 4:2:0 and without alpha"
        )
    for plane, target in zip(frame.planes, picture_planes(out), strict=True):
        target[: plane.height, : plane.width] = plane_view(plane)
    return out
