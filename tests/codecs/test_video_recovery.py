"""Lost, doubled, reordered and damaged packets: an error or a picture, and all is right from the next keyframe."""

from __future__ import annotations

import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from codec_images import VIDEOS, moving_clip
from hypothesis import given, settings
from hypothesis import strategies as st

COUNT, RESTART = 12, 9


def coded(name: str) -> tuple[list[bytes], list[np.ndarray]]:
    """Packets with a keyframe at 0 and RESTART, and the pictures of a decoder that sees them all."""
    encoder, decoder = create_encoder(CodecParameters(name, 128, 96)), create_decoder(CodecParameters(name, 128, 96))
    packets = [encoder.encode(image, keyframe=index == RESTART).data for index, image in enumerate(moving_clip(COUNT))]
    return packets, [decoder.decode(packet) for packet in packets]


STREAMS = {name: coded(name) for name in VIDEOS}


def feed(decoder, packets) -> int:
    """Decode what can be decoded; the number of errors."""
    errors = 0
    for packet in packets:
        try:
            assert decoder.decode(packet).shape == (96, 128, 3)
        except CodecError:
            assert decoder.needs_keyframe
            errors += 1
    return errors


def assert_recovers(name: str, decoder) -> None:
    """From the next keyframe on pictures are those of a fresh decoder, bit for bit."""
    packets, _ = STREAMS[name]
    fresh = create_decoder(CodecParameters(name, 128, 96))
    for packet in packets[RESTART:]:
        assert np.array_equal(decoder.decode(packet), fresh.decode(packet))
        assert not decoder.needs_keyframe


def broken(data: bytes) -> dict[str, bytes]:
    flipped = bytearray(data)
    for position in range(len(data) // 2, len(data), 7):
        flipped[position] ^= 0x5A
    return {
        "empty": b"",
        "one byte": data[:1],
        "garbage": np.random.default_rng(1).bytes(2000),
        "cut to half": data[: len(data) // 2],
        "last byte lost": data[:-1],
        "flipped": bytes(flipped),
        "twice in one": data + data,
        "zeros": bytes(len(data)),
        "zero tail": data[: len(data) // 3] + bytes(len(data) - len(data) // 3),
    }


@pytest.mark.parametrize("name", VIDEOS)
@pytest.mark.parametrize("kind", broken(bytes(60)))
@pytest.mark.parametrize("victim", [0, 3])
def test_damaged_packet(name, kind, victim):
    packets, _ = STREAMS[name]
    decoder = create_decoder(CodecParameters(name, 128, 96))
    feed(decoder, packets[:victim])
    errors = feed(decoder, [broken(packets[victim])[kind]])
    if kind in ("empty", "garbage", "zeros") or (kind, victim) == ("one byte", 0):
        assert errors == 1
    if errors:
        for packet in packets[victim + 1 : RESTART]:
            with pytest.raises(CodecError, match="needs a keyframe"):
                decoder.decode(packet)
    else:
        feed(decoder, packets[victim + 1 : RESTART])
    assert_recovers(name, decoder)


@pytest.mark.parametrize("name", VIDEOS)
@pytest.mark.parametrize(
    "order",
    {
        "lost": (0, 1, 3, 4, 5),
        "many lost": (0, 1, 7, 8),
        "doubled": (0, 1, 2, 2, 3, 4),
        "keyframe doubled": (0, 0, 1, 2),
        "swapped": (0, 1, 3, 2, 4, 5),
        "backwards": (5, 4, 3, 2, 1, 0),
        "keyframe late": (1, 2, 0, 3, 4),
        "old keyframe again": (0, 1, 2, 3, 0, 4, 5),
    }.items(),
    ids=lambda item: item[0],
)
def test_packets_in_the_wrong_order(name, order):
    packets, _ = STREAMS[name]
    decoder = create_decoder(CodecParameters(name, 128, 96))
    feed(decoder, [packets[index] for index in order[1]])
    assert_recovers(name, decoder)


@pytest.mark.parametrize("name", VIDEOS)
def test_a_doubled_keyframe_changes_nothing(name):
    packets, pictures = STREAMS[name]
    decoder = create_decoder(CodecParameters(name, 128, 96))
    for index in (0, 0, 1, 2, 0, 1, 2, 3):
        assert np.array_equal(decoder.decode(packets[index]), pictures[index])


@pytest.mark.parametrize("name", VIDEOS)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_bit_flips_anywhere_in_the_stream(name, data):
    packets, _ = STREAMS[name]
    decoder = create_decoder(CodecParameters(name, 128, 96))
    for packet in packets[:5]:
        hit = bytearray(packet)
        for _ in range(data.draw(st.integers(0, 4))):
            hit[data.draw(st.integers(0, len(hit) - 1))] ^= 1 << data.draw(st.integers(0, 7))
        feed(decoder, [bytes(hit)])
    assert_recovers(name, decoder)


@pytest.mark.parametrize("name", VIDEOS)
@pytest.mark.parametrize(("width", "height"), [(130, 96), (128, 94), (64, 64), (640, 480)])
def test_stream_of_another_size_is_refused(name, width, height):
    parameters = CodecParameters(name, width, height)
    other = create_encoder(parameters).encode(np.zeros((height, width, 3), np.uint8)).data
    decoder = create_decoder(CodecParameters(name, 128, 96))
    with pytest.raises(CodecError):
        decoder.decode(other)
    assert decoder.needs_keyframe
    assert_recovers(name, decoder)


@pytest.mark.parametrize("name", VIDEOS)
def test_stream_that_changes_size_midway_is_refused(name):
    packets, _ = STREAMS[name]
    decoder = create_decoder(CodecParameters(name, 128, 96))
    feed(decoder, packets[:3])
    larger = create_encoder(CodecParameters(name, 256, 192)).encode(np.zeros((192, 256, 3), np.uint8)).data
    assert feed(decoder, [larger]) == 1
    assert_recovers(name, decoder)
