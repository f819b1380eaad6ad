"""Reading the structure of AV1 packets (AV1 bitstream specification, section 5) without decoding them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from cable_codecs.video_format import PacketSummary

SEQUENCE_HEADER = 1
FRAME_HEADER = 3
FRAME = 6
KEY_FRAME = 0
FORBIDDEN_BIT, EXTENSION_FLAG, HAS_SIZE_FIELD = 0x80, 0x04, 0x02
LONGEST_SIZE = 8
"""Bytes of a leb128 number at most."""


@dataclass(frozen=True, slots=True)
class OpenUnit:
    """Where one OBU lies in its packet."""

    kind: int
    """obu_type (section 6.2.2)."""
    payload: int
    """Position of the payload's first byte."""
    end: int
    """Position behind the payload."""


def walk_units(data: bytes) -> Iterator[OpenUnit]:
    """The OBUs of a packet in the low-overhead format (section 5.2), where each states its size.

    Ends silently where the data are cut or damaged, so the last ``end`` is short of the packet's.
    """
    position = 0
    while position < len(data):
        header = data[position]
        position += 2 if header & EXTENSION_FLAG else 1
        size, position = read_leb128(data, position)
        damaged = header & FORBIDDEN_BIT or not header & HAS_SIZE_FIELD or size < 0
        if damaged or position + size > len(data):
            return
        yield OpenUnit(header >> 3 & 15, position, position + size)
        position += size


def open_units(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The type and the first payload byte or none of each OBU; ends silently where the data are cut or damaged."""
    for unit in walk_units(data):
        yield unit.kind, data[unit.payload : min(unit.payload + 1, unit.end)]


def read_leb128(data: bytes, position: int) -> tuple[int, int]:
    """A number and the position behind it; -1 where it is cut or too long."""
    value = 0
    for index in range(LONGEST_SIZE):
        if position + index >= len(data):
            break
        byte = data[position + index]
        value |= (byte & 0x7F) << (7 * index)
        if not byte & 0x80:
            return value, position + index + 1
    return -1, position


def summarise_av1(data: bytes) -> PacketSummary:
    """What a temporal unit holds; keyframes are shown key frames.

    A packet that its OBUs don't fill to the last byte counts as one without pictures: dav1d would decode the whole
    ones, keep the rest and stumble over it in the next packet.
    """
    sequence_header = keyframe = headers_first = False
    reduced = False
    pictures = end = 0
    for unit in walk_units(data):
        end = unit.end
        if unit.payload == unit.end:
            continue
        first = data[unit.payload]
        if unit.kind == SEQUENCE_HEADER:
            sequence_header = True
            # seq_profile(3), still_picture(1), reduced_still_picture_header(1)
            reduced = bool(first & 0x08)
        elif unit.kind in (FRAME_HEADER, FRAME):
            # show_existing_frame(1), frame_type(2), show_frame(1); a reduced header has none of them.
            existing, frame_type, shown = first >> 7, first >> 5 & 3, first >> 4 & 1
            is_key = reduced or (not existing and frame_type == KEY_FRAME and bool(shown))
            if is_key and pictures == 0:
                keyframe, headers_first = True, sequence_header
            pictures += bool(reduced or existing or shown)
    if end != len(data):
        return PacketSummary(keyframe=False, has_headers=False, picture_count=0)
    return PacketSummary(keyframe, headers_first, pictures)
