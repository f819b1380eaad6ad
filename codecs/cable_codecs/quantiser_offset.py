"""Coarser quantisation outside the region of interest, the whole picture kept ("soft" region of interest).

FFmpeg carries quantiser offsets as side data of a frame (AV_FRAME_DATA_REGIONS_OF_INTEREST): rectangles, of
which the first that contains a macroblock of 16x16 pixels decides. Here the region's rectangles come first, with
offset 0, and the whole picture last, with the background's offset, so that where rectangles must be joined the
region only grows. libx264, libx265 and libvpx-vp9 heed them, the first two only with adaptive quantisation, which
x264's preset ``ultrafast`` switches off; encoders that don't heed them say nothing. `require_offsets` finds out.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cache
from typing import cast

import av
import numpy as np
from av.filter import Graph
from av.sidedata.sidedata import SideData, SideDataContainer
from av.video.codeccontext import VideoCodecContext
from av.video.format import VideoFormat
from av.video.frame import VideoFrame

from cable_codecs.base import BoolMask
from cable_codecs.errors import CodecError
from cable_codecs.region_grid import grow_to_grid
from cable_codecs.region_rectangles import Rectangle, covering_rectangles
from cable_codecs.size_offset import check_size_offset, sized_rectangles

MACROBLOCK = 16
"""Side in pixels of the squares that x264 gives one offset each."""
DEFAULT_RECTANGLES = 48
"""Enough for one rectangle per row of macroblocks of a 720p picture; each costs a node in a filter graph."""
OFFSET_STEPS = 1000
RECORD = struct.Struct("<Iiiiiii")
"""AVRegionOfInterest: self_size, top, bottom, left, right, and the offset's numerator and denominator."""

Regions = Sequence[tuple[Rectangle, float]]


def check_offset(offset: float) -> None:
    """Check a quantiser offset.

    Raises:
        CodecError: Outside 0..1, the background would be coded better than the region or beyond the coarsest step.
    """
    if not (math.isfinite(offset) and 0 <= offset <= 1):
        raise CodecError(f"the background's quantiser offset must be 0..1 (a share of the 51 QP steps), got {offset}")


def region_rectangles(roi: BoolMask, most: int = DEFAULT_RECTANGLES) -> tuple[Rectangle, ...]:
    """Pixel rectangles on the 16 px grid that cover a region, exactly its macroblocks where ``most`` allows.

    Args:
        roi: bool [height, width], True inside.
        most: Rectangles at most.
    """
    height, width = roi.shape
    macroblocks = grow_to_grid(roi, 1, MACROBLOCK, height, width)
    return tuple(one.scaled(MACROBLOCK, height, width) for one in covering_rectangles(macroblocks, most))


def regions_of(rectangles: Sequence[Rectangle], offset: float, height: int, width: int) -> Regions:
    """What is attached to a frame: the rectangles with offset 0, then the whole picture with the offset."""
    return [*((one, 0.0) for one in rectangles), (Rectangle(0, height, 0, width), offset)]


def attach(frame: VideoFrame, rectangles: Sequence[Rectangle], offset: float) -> VideoFrame:
    """A frame with the quantiser offset everywhere but in rectangles; builds a filter graph each time, 1-3 ms.

    Args:
        frame: Any frame; the result shares its pixels.
        rectangles: In pixels.
        offset: 0..1, as a share of the encoder's quantiser scale: 0.4 is about +20 QP in 8-bit H.264.

    Raises:
        CodecError: The offset is outside 0..1, or FFmpeg's filter refuses.
    """
    check_offset(offset)
    graph = build_graph(
        frame.width, frame.height, frame.format.name, regions_of(rectangles, offset, frame.height, frame.width)
    )
    return through(graph, frame)


def build_graph(width: int, height: int, pixel_format: str, regions: Regions) -> Graph:
    """A filter graph that attaches regions to the frames that pass.

    Raises:
        CodecError: This FFmpeg has no ``addroi`` filter, or it refuses the regions.
    """
    try:
        graph = Graph()
        # Nothing here has work for a pool of threads, and starting one takes longer than all the rest.
        graph.threads = 1
        nodes = [
            graph.add_buffer(
                width=width, height=height, format=VideoFormat(pixel_format), time_base=Fraction(1, OFFSET_STEPS)
            )
        ]
        nodes += [
            graph.add(
                "addroi",
                f"x={one.left}:y={one.top}:w={one.right - one.left}:h={one.bottom - one.top}"
                f":qoffset={round(offset * OFFSET_STEPS)}/{OFFSET_STEPS}",
            )
            for one, offset in regions
        ]
        nodes.append(graph.add("buffersink"))
        graph.link_nodes(*nodes).configure()
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(
            f"quantiser offsets can't be attached: {error}; they need FFmpeg's addroi filter, and rectangles "
            f"within {width}x{height} pixels"
        ) from error
    return graph


def through(graph: Graph, frame: VideoFrame) -> VideoFrame:
    """Send one frame through a graph.

    Raises:
        CodecError: The filter failed.
    """
    try:
        graph.vpush(frame)
        return graph.vpull()
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(f"quantiser offsets can't be attached to frame {frame.pts}: {error}") from error


def records(regions: Regions) -> bytes:
    """The regions as FFmpeg lays them out in memory."""
    return b"".join(
        RECORD.pack(RECORD.size, one.top, one.bottom, one.left, one.right, round(offset * OFFSET_STEPS), OFFSET_STEPS)
        for one, offset in regions
    )


def side_data(frame: VideoFrame) -> SideData:
    """The regions attached to a frame.

    Raises:
        CodecError: There are none.
    """
    try:
        # PyAV's stub names another class than the container that it returns.
        return cast(SideDataContainer, frame.side_data)["REGIONS_OF_INTEREST"]
    except KeyError as error:
        raise CodecError("the frame carries no regions of interest; FFmpeg's addroi filter attached none") from error


class OffsetAttacher:
    """Attaches a region's quantiser offset to frames of one size, 0.1 ms where rectangles change every frame.

    The filter graph is built once, with as many nodes as there may be rectangles; the records that it attaches are
    then overwritten in place. They lie in a buffer that the graph's last node made for this very frame and nobody
    else holds. Whether FFmpeg lays them out as expected is checked when the attacher is made, on known rectangles;
    where it doesn't, and for every frame with ``in_place=False``, the graph is rebuilt for each new set instead.
    """

    def __init__(
        self,
        height: int,
        width: int,
        offset: float,
        *,
        pixel_format: str = "yuv420p",
        most_rectangles: int = DEFAULT_RECTANGLES,
        in_place: bool = True,
        size_offset: float = 0.0,
    ) -> None:
        """Prepare for one picture size.

        Args:
            height: Of the coded picture, padding included.
            width: Of the coded picture, padding included.
            offset: 0..1, the background's, as a share of the quantiser scale.
            pixel_format: Of the frames.
            most_rectangles: Beyond these a region is covered by fewer, larger ones.
            in_place: Overwrite records where that is found safe.
            size_offset: How much coarser a piece of the region is quantised for each doubling of its side
                (`cable_codecs.size_offset`).

        Raises:
            CodecError: A value outside its range, or this FFmpeg has no ``addroi`` filter.
        """
        check_offset(offset)
        check_size_offset(size_offset, offset)
        if most_rectangles < 1:
            raise CodecError(f"most_rectangles must be at least 1, got {most_rectangles}")
        self.height, self.width = height, width
        self.offset = offset
        self.size_offset = size_offset
        self.pixel_format = pixel_format
        self.most_rectangles = most_rectangles
        self.in_place = in_place and records_lie_as_expected()
        whole = Rectangle(0, height, 0, width)
        self.regions: Regions = [(whole, 0.0)] * (most_rectangles + 1) if self.in_place else []
        self.graph = build_graph(width, height, pixel_format, self.regions)

    def attach(self, frame: VideoFrame, roi: BoolMask) -> VideoFrame:
        """A frame whose background carries the offset; shares the pixels of the argument.

        Args:
            frame: Of the size and pixel format given at the start.
            roi: bool [height or less, width or less], True inside; padding beyond it is background.

        Raises:
            CodecError: The frame has another size or format, or the filter failed.
        """
        if (frame.height, frame.width, frame.format.name) != (self.height, self.width, self.pixel_format):
            raise CodecError(
                f"offsets were prepared for {self.pixel_format} frames of {self.width}x{self.height}, "
                f"got {frame.format.name} of {frame.width}x{frame.height}"
            )
        if roi.dtype != np.bool_ or roi.ndim != 2 or roi.shape[0] > self.height or roi.shape[1] > self.width:
            raise CodecError(
                f"the region must be bool and at most [{self.height}, {self.width}], got {roi.dtype} {list(roi.shape)}"
            )
        regions = self.regions_of(roi)
        if not self.in_place:
            if regions != self.regions:
                self.graph = build_graph(self.width, self.height, self.pixel_format, regions)
                self.regions = regions
            return through(self.graph, frame)
        attached = through(self.graph, frame)
        # Behind the whole picture a record decides nothing; the number of records can't change.
        spare = [regions[-1]] * (self.most_rectangles + 1 - len(regions))
        overwrite(attached, records([*regions, *spare]))
        return attached

    def regions_of(self, roi: BoolMask) -> Regions:
        """The region's rectangles with their offsets, then the whole picture."""
        if not self.size_offset:
            rectangles = region_rectangles(roi, self.most_rectangles)
            return regions_of(rectangles, self.offset, self.height, self.width)
        pieces = sized_rectangles(roi, self.size_offset, self.offset, self.most_rectangles, MACROBLOCK)
        return [*pieces, (Rectangle(0, self.height, 0, self.width), self.offset)]


def overwrite(frame: VideoFrame, content: bytes) -> None:
    """Replace the records attached to a frame by as many others.

    Raises:
        CodecError: The frame carries another number of records.
    """
    data = side_data(frame)
    if data.buffer_size != len(content):
        raise CodecError(f"the frame carries {data.buffer_size} bytes of regions, expected {len(content)}")
    ctypes.memmove(data.buffer_ptr, content, len(content))


@cache
def records_lie_as_expected() -> bool:
    """Whether FFmpeg lays out records as `records` does, and takes them in order, found by attaching known ones."""
    regions = [(Rectangle(16, 48, 32, 112), 0.125), (Rectangle(0, 64, 0, 128), 0.5)]
    frame = through(build_graph(128, 64, "yuv420p", regions), VideoFrame(128, 64, "yuv420p"))
    content = bytes(side_data(frame))
    if len(content) != len(regions) * RECORD.size:
        return False
    for number, (one, offset) in enumerate(regions):
        size, top, bottom, left, right, numerator, denominator = RECORD.unpack_from(content, number * RECORD.size)
        placed = (size, top, bottom, left, right) == (RECORD.size, one.top, one.bottom, one.left, one.right)
        if not placed or denominator <= 0 or Fraction(numerator, denominator) != Fraction(offset):
            return False
    return True


def honours_offsets(encoder_name: str, options: Mapping[str, str]) -> bool:
    """Whether an encoder makes other bytes where a frame asks for coarser quantisation, found by trying.

    Other, not fewer: under a fixed bit rate the bytes saved in the background go to the region.

    Args:
        encoder_name: FFmpeg's name, for example ``libx264``.
        options: Its private options, exactly those of the stream.

    Raises:
        CodecError: The encoder can't be opened.
    """
    return cached_honours_offsets(encoder_name, tuple(sorted(options.items())))


@cache
def cached_honours_offsets(encoder_name: str, options: tuple[tuple[str, str], ...]) -> bool:
    """`honours_offsets` with arguments that can be remembered."""
    plain = trial_stream(encoder_name, dict(options), 0.0)
    return trial_stream(encoder_name, dict(options), 0.4) != plain


def require_offsets(encoder_name: str, options: Mapping[str, str]) -> None:
    """Refuse an encoder that ignores quantiser offsets.

    Raises:
        CodecError: It ignores them with these options, or can't be opened.
    """
    if not honours_offsets(encoder_name, options):
        preset = f" with preset {options['preset']}" if "preset" in options else ""
        raise CodecError(
            f"{encoder_name}{preset} ignores quantiser offsets: trial pictures gave the same bytes with as without; "
            "switch adaptive quantisation on (aq-mode=1) or choose libx264, libx265 or libvpx-vp9"
        )


TRIAL_SIZE = 128


def trial_stream(encoder_name: str, options: dict[str, str], offset: float) -> bytes:
    """Three coded frames of noise, the background of which carries the offset.

    Raises:
        CodecError: The encoder can't be opened.
    """
    noise = np.random.default_rng(0).integers(0, 256, (TRIAL_SIZE * 3 // 2, TRIAL_SIZE), np.uint8)
    middle = Rectangle(MACROBLOCK, 3 * MACROBLOCK, MACROBLOCK, 3 * MACROBLOCK)
    try:
        context = av.CodecContext.create(encoder_name, "w")
        if not isinstance(context, VideoCodecContext):
            raise CodecError(f"{encoder_name} is no video encoder")
        context.width = context.height = TRIAL_SIZE
        context.pix_fmt = "yuv420p"
        context.framerate, context.time_base = Fraction(25), Fraction(1, 25)
        context.thread_count = 1
        context.options = options
        context.open()
        packets = []
        for number in range(3):
            frame = VideoFrame.from_numpy_buffer(np.roll(noise, number, axis=1), format="yuv420p")
            frame.pts = number
            packets += context.encode(attach(frame, [middle], offset))
        packets += context.encode(None)
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(
            f"{encoder_name} can't be opened to see whether it heeds quantiser offsets: {error}"
        ) from error
    return b"".join(bytes(packet) for packet in packets)
