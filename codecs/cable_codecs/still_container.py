"""Checking JPEG and WebP files before they are decoded: decoders pad cut images with grey instead of complaining."""

from __future__ import annotations

from collections.abc import Iterator

from cable_codecs.errors import CodecError

START_OF_IMAGE = b"\xff\xd8"
END_OF_IMAGE = b"\xff\xd9"
START_OF_SCAN = 0xDA
HUFFMAN_TABLES = 0xC4
QUANTISER_TABLES = 0xDB
SEQUENTIAL_FRAMES = (0xC0, 0xC1)
"""SOF0 and SOF1: baseline and extended sequential, Huffman coded."""
AC_CLASS = 0x10
"""Table class bit of Huffman tables for AC values."""
OTHER_FRAMES = frozenset({0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF})
SUBSAMPLED_420 = (3, 0x22, 0x11, 0x11)
"""Number of components, then the sampling factors of each."""


def check_jpeg(data: bytes, size: tuple[int, int], name: str) -> None:
    """Check that a file is one whole JPEG of a size: sequential, 8 bits, 4:2:0 (ITU-T T.81, annex B).

    It must bring the tables that its first scan needs, since FFmpeg would put others in their place. Damage inside
    the scan stays unseen.

    Args:
        data: The file.
        size: (height, width) that it must have.
        name: Codec name for the error text.

    Raises:
        CodecError: Cut, trailing bytes, another size or pixel format, or not a JPEG.
    """
    position = 2
    needed: set[tuple[int, int]] = set()
    tables: set[tuple[int, int]] = set()
    if data[:2] != START_OF_IMAGE:
        raise not_whole(data, name)
    while True:
        if position + 4 > len(data) or data[position] != 0xFF:
            raise not_whole(data, name)
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        segment = data[position + 4 : position + 2 + length]
        position += 2 + length
        if length < 2 or position > len(data):
            raise not_whole(data, name)
        if marker in OTHER_FRAMES:
            raise CodecError(f"{name} file is progressive or arithmetic coded; encode it as baseline")
        if marker in SEQUENTIAL_FRAMES:
            check_jpeg_frame(segment, size, name)
            needed = {(QUANTISER_TABLES, index) for index in segment[8::3]}
        if marker in (HUFFMAN_TABLES, QUANTISER_TABLES):
            tables |= {(marker, index) for index in table_indices(marker, segment)}
        if marker == START_OF_SCAN:
            break
    if not needed or data.find(END_OF_IMAGE, position) != len(data) - 2:
        raise not_whole(data, name)
    # Of each component in the scan: its identifier, then four bits for its DC and four for its AC table.
    for both in segment[2 : 2 + 2 * segment[0] : 2] if segment else b"":
        needed |= {(HUFFMAN_TABLES, both >> 4), (HUFFMAN_TABLES, AC_CLASS | both & 15)}
    if not needed <= tables:
        raise CodecError(f"{name} file of {len(data)} bytes lacks some of its tables; send the whole file")


def table_indices(marker: int, segment: bytes) -> Iterator[int]:
    """The destination identifiers of the tables in a segment, with `AC_CLASS` for the Huffman codes of AC values."""
    position = 0
    while position < len(segment):
        head = segment[position]
        if marker == QUANTISER_TABLES:
            yield head & 15
            # 64 values of 8 or 16 bits.
            position += 1 + 64 * (1 + (head >> 4))
        else:
            yield head
            position += 17 + sum(segment[position + 1 : position + 17])


def check_jpeg_frame(segment: bytes, size: tuple[int, int], name: str) -> None:
    """Check a JPEG's frame header.

    Raises:
        CodecError: Another size or pixel format.
    """
    components = (segment[5:6] or b"\0")[0]
    form = (components, *segment[7::3])
    if len(segment) != 6 + 3 * components or segment[0] != 8 or form != SUBSAMPLED_420:
        raise CodecError(
            f"{name} picture has another pixel format than 8 bits in three components subsampled 4:2:0; encode it so"
        )
    height, width = int.from_bytes(segment[1:3], "big"), int.from_bytes(segment[3:5], "big")
    check_size((height, width), size, name)


def check_webp(data: bytes, name: str) -> bytes:
    """Check that a file has the length that its RIFF header states.

    Returns:
        The four letters of its first chunk: ``VP8 ``, ``VP8L`` or ``VP8X``.

    Raises:
        CodecError: The file is cut, has trailing bytes or isn't a WebP.
    """
    stated = int.from_bytes(data[4:8], "little") + 8
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or stated != len(data):
        raise not_whole(data, name)
    return data[12:16]


def check_lossless_webp(data: bytes, size: tuple[int, int], name: str) -> None:
    """Check that a file is one whole lossless WebP of a size without transparency.

    Raises:
        CodecError: Cut, trailing bytes, another size or pixel format, or not a WebP.
    """
    kind = check_webp(data, name)
    # Signature byte, width - 1 and height - 1 in 14 bits each, alpha_is_used.
    fields = int.from_bytes(data[21:25], "little")
    if kind != b"VP8L" or data[20:21] != b"\x2f" or fields >> 28 & 1:
        raise CodecError(
            f"{name} picture has another pixel format than lossless RGB without transparency; encode it so"
        )
    check_size(((fields >> 14 & 0x3FFF) + 1, (fields & 0x3FFF) + 1), size, name)


def check_size(found: tuple[int, int], expected: tuple[int, int], name: str) -> None:
    """Compare (height, width).

    Raises:
        CodecError: They differ.
    """
    if found != expected:
        raise CodecError(
            f"{name} picture is {found[1]}x{found[0]}, expected {expected[1]}x{expected[0]}; "
            "open the decoder with the size of the encoder"
        )


def not_whole(data: bytes, name: str) -> CodecError:
    """The error of a file that is no whole image."""
    return CodecError(f"packet of {len(data)} bytes isn't one whole {name} file; it is cut, joined or of another codec")
