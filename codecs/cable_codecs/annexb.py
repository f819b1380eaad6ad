"""Reading the structure of an H.264 byte stream (ITU-T H.264, Annex B) without decoding it."""

from __future__ import annotations

from dataclasses import dataclass

SLICE = 1
SLICE_PARTITION_A = 2
IDR_SLICE = 5
SEQUENCE_PARAMETERS = 7
PICTURE_PARAMETERS = 8

START_CODE = b"\x00\x00\x01"


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """What one packet holds."""

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


def parse_access_unit(data: bytes) -> AccessUnit:
    """List the NAL units of a packet by scanning its start codes.

    Args:
        data: Byte stream; anything is accepted, bytes before the first start code are skipped.
    """
    kinds: list[int] = []
    pictures = 0
    position = data.find(START_CODE)
    while position >= 0 and position + 3 < len(data):
        kind = data[position + 3] & 0x1F
        kinds.append(kind)
        # first_mb_in_slice is the slice header's first field, coded ue(v): zero is a single set bit.
        begins_picture = position + 4 < len(data) and data[position + 4] & 0x80
        if kind in (SLICE, SLICE_PARTITION_A, IDR_SLICE) and begins_picture:
            pictures += 1
        position = data.find(START_CODE, position + 3)
    return AccessUnit(tuple(kinds), pictures)
