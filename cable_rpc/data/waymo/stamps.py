"""Time stamp and pose of a serialized ``Frame``, without parsing the megabytes behind them."""

from __future__ import annotations

import mmap
from dataclasses import dataclass

from cable_rpc.errors import SourceError

VARINT, FIXED64, DELIMITED, FIXED32 = 0, 1, 2, 5
FIXED_BYTES = {FIXED64: 8, FIXED32: 4}
VARINT_BYTES = 10

TIMESTAMP_FIELD, POSE_FIELD = 2, 3
"""Field numbers of Frame in dataset.proto."""


@dataclass(frozen=True, slots=True)
class FrameStamp:
    """What a frame's motion is told from."""

    time_micros: int
    pose: bytes
    """A serialized Transform; empty where there is none."""


def frame_stamp(data: bytes | mmap.mmap, start: int, end: int, place: str) -> FrameStamp:
    """Walk over a message's outermost fields until both are found.

    Wire format: https://protobuf.dev/programming-guides/encoding/

    Args:
        data: a file's bytes.
        start: where the message begins in it.
        end: and ends.
        place: for error texts.

    Raises:
        SourceError: the bytes are no message, or there is no time stamp.
    """
    time_micros: int | None = None
    pose = b""
    position = start
    while position < end and not (time_micros is not None and pose):
        key, position = varint(data, position, end, place)
        number, kind = key >> 3, key & 7
        if kind == VARINT:
            value, position = varint(data, position, end, place)
            time_micros = value if number == TIMESTAMP_FIELD else time_micros
            continue
        if kind == DELIMITED:
            length, position = varint(data, position, end, place)
        elif kind in FIXED_BYTES:
            length = FIXED_BYTES[kind]
        else:
            raise SourceError(f"{place} is no Waymo Frame: a field of wire type {kind}")
        if position + length > end:
            raise SourceError(f"{place} is no Waymo Frame: field {number} is longer than the record")
        if number == POSE_FIELD and kind == DELIMITED:
            pose = data[position : position + length]
        position += length
    if time_micros is None:
        raise SourceError(f"{place} is no Waymo Frame: it has no time stamp")
    return FrameStamp(time_micros, pose)


def varint(data: bytes | mmap.mmap, position: int, end: int, place: str) -> tuple[int, int]:
    """A whole number and where the next value begins.

    Raises:
        SourceError: it has no end.
    """
    value = 0
    for shift, place_of_octet in enumerate(range(position, min(position + VARINT_BYTES, end))):
        octet = data[place_of_octet]
        value |= (octet & 0x7F) << (7 * shift)
        if octet < 0x80:
            return value, place_of_octet + 1
    raise SourceError(f"{place} is no Waymo Frame: a number in it has no end")
