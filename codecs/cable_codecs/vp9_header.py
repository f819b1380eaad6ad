"""Reading the structure of VP9 packets (VP9 bitstream specification, annex B and section 6.2) without decoding."""

from __future__ import annotations

from cable_codecs.video_format import PacketSummary

FRAME_MARKER = 2
SYNC_CODE = b"\x49\x83\x42"


def split_superframe(data: bytes) -> list[bytes]:
    """The frames of a packet; a packet without a (valid) superframe index is one frame."""
    if not data or data[-1] >> 5 != 0b110:
        return [data]
    size_bytes, count = (data[-1] >> 3 & 3) + 1, (data[-1] & 7) + 1
    index_size = 2 + size_bytes * count
    if len(data) < index_size or data[-index_size] != data[-1]:
        return [data]
    frames = []
    position = 0
    for number in range(count):
        start = len(data) - index_size + 1 + number * size_bytes
        size = int.from_bytes(data[start : start + size_bytes], "little")
        if position + size > len(data) - index_size:
            return [data]
        frames.append(data[position : position + size])
        position += size
    return frames


def frame_flags(frame: bytes) -> tuple[bool, bool]:
    """(key frame, shown) from a frame's uncompressed header; both False where it is no 8-bit 4:2:0 VP9 frame."""
    if not frame or frame[0] >> 4 != FRAME_MARKER << 2:
        return False, False
    # frame_marker(2), profile(2, here 0), show_existing_frame(1), frame_type(1), show_frame(1), error_resilient(1)
    existing, is_inter, shown = frame[0] >> 3 & 1, frame[0] >> 2 & 1, frame[0] >> 1 & 1
    if existing:
        return False, True
    return not is_inter and frame[1:4] == SYNC_CODE, bool(shown)


def summarise_vp9(data: bytes) -> PacketSummary:
    """What a packet holds; keyframes are shown key frames, which carry all that a decoder needs."""
    flags = [frame_flags(frame) for frame in split_superframe(data)]
    keyframe = flags[0] == (True, True)
    return PacketSummary(keyframe, has_headers=True, picture_count=sum(shown for _, shown in flags))
