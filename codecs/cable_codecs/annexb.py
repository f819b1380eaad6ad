"""Reading the structure of H.264 and HEVC byte streams (ITU-T H.264 and H.265, Annex B) without decoding them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from cable_codecs.video_format import PacketSummary

START_CODE = b"\x00\x00\x01"

SLICE = 1
SLICE_PARTITION_A = 2
IDR_SLICE = 5
SEQUENCE_PARAMETERS = 7
PICTURE_PARAMETERS = 8

HEVC_LAST_SLICE = 31
HEVC_RANDOM_ACCESS = range(16, 24)
"""Intra random access point pictures: BLA, IDR, CRA and two reserved types (H.265, table 7-1)."""
HEVC_PARAMETER_SETS = frozenset({32, 33, 34})
"""VPS, SPS and PPS."""


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """What one H.264 packet holds."""

    nal_types: tuple[int, ...]
    """nal_unit_type of each NAL unit in order (table 7-1)."""
    picture_count: int
    """Slices with first_mb_in_slice = 0, that is pictures begun."""

    @property
    def is_idr(self) -> bool:
        """True where the packet holds an IDR picture, the only place where a decoder can start cleanly."""
        return IDR_SLICE in self.nal_types

    @property
    def has_parameter_sets(self) -> bool:
        """True where sequence and picture parameter sets stand before the first slice."""
        head = self.nal_types[: self.first_slice]
        return SEQUENCE_PARAMETERS in head and PICTURE_PARAMETERS in head

    @property
    def first_slice(self) -> int:
        """Index of the first slice in ``nal_types``, their number where there is none."""
        for index, kind in enumerate(self.nal_types):
            if kind in (SLICE, SLICE_PARTITION_A, IDR_SLICE):
                return index
        return len(self.nal_types)


def nal_positions(data: bytes) -> Iterator[int]:
    """Where the NAL units of a byte stream begin, behind their start codes; bytes before the first are skipped."""
    position = data.find(START_CODE)
    while position >= 0 and position + 3 < len(data):
        yield position + 3
        position = data.find(START_CODE, position + 3)


def parse_access_unit(data: bytes) -> AccessUnit:
    """List the NAL units of an H.264 packet by scanning its start codes.

    Args:
        data: Byte stream; anything is accepted, bytes before the first start code are skipped.
    """
    kinds: list[int] = []
    pictures = 0
    for position in nal_positions(data):
        kind = data[position] & 0x1F
        kinds.append(kind)
        # first_mb_in_slice is the slice header's first field, coded ue(v): zero is a single set bit.
        begins_picture = position + 1 < len(data) and data[position + 1] & 0x80
        if kind in (SLICE, SLICE_PARTITION_A, IDR_SLICE) and begins_picture:
            pictures += 1
    return AccessUnit(tuple(kinds), pictures)


def summarise_h264(data: bytes) -> PacketSummary:
    """What an H.264 packet holds; keyframes are IDR pictures."""
    unit = parse_access_unit(data)
    return PacketSummary(unit.is_idr, unit.has_parameter_sets, unit.picture_count)


def summarise_hevc(data: bytes) -> PacketSummary:
    """What an HEVC packet holds; keyframes are intra random access point pictures."""
    before_slices: set[int] = set()
    keyframe = False
    pictures = 0
    for position in nal_positions(data):
        kind = (data[position] >> 1) & 0x3F
        if kind > HEVC_LAST_SLICE:
            if pictures == 0:
                before_slices.add(kind)
            continue
        keyframe = keyframe or kind in HEVC_RANDOM_ACCESS
        # first_slice_segment_in_pic_flag is the slice header's first bit, behind the NAL header of two bytes.
        if position + 2 < len(data) and data[position + 2] & 0x80:
            pictures += 1
    return PacketSummary(keyframe, before_slices >= HEVC_PARAMETER_SETS, pictures)
