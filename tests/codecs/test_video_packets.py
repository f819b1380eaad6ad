"""Packet headers read by hand agree with what decoders can do and with literal bit layouts."""

from __future__ import annotations

import av
import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from cable_codecs.annexb import summarise_h264, summarise_hevc
from cable_codecs.obu import open_units, read_leb128, summarise_av1
from cable_codecs.registry import VIDEO_FORMATS
from cable_codecs.video_format import PacketSummary
from cable_codecs.vp9_header import split_superframe, summarise_vp9
from codec_images import VIDEOS, moving_clip, natural_image
from hypothesis import given, settings
from hypothesis import strategies as st


def encode_clip(name, count, forced=(), **settings_):
    encoder = create_encoder(CodecParameters(name, 128, 96, **settings_))
    return [encoder.encode(image, keyframe=index in forced) for index, image in enumerate(moving_clip(count))]


def raw_decoder_starts_at(name: str, data: bytes) -> bool:
    """Whether a decoder without any of our checks makes a sound picture from nothing but this packet."""
    context = av.CodecContext.create(VIDEO_FORMATS[name].decoder, "r")
    context.options = {"flags": "low_delay", "err_detect": "explode"}
    context.thread_count = 1
    try:
        frames = context.decode(av.Packet(data))
    except av.FFmpegError:
        return False
    return len(frames) == 1 and not frames[0].is_corrupt


@pytest.mark.parametrize("name", VIDEOS)
def test_keyframe_says_exactly_where_a_decoder_can_start(name):
    packets = encode_clip(name, 20, forced={7, 8, 15})
    assert [index for index, packet in enumerate(packets) if packet.keyframe] == [0, 7, 8, 15]
    for packet in packets:
        assert raw_decoder_starts_at(name, packet.data) == packet.keyframe
        summary = VIDEO_FORMATS[name].summarise(packet.data)
        assert summary.picture_count == 1
        assert summary.keyframe == packet.keyframe
        assert summary.has_headers or not packet.keyframe


@pytest.mark.parametrize("name", VIDEOS)
def test_interval_is_kept_and_scene_cuts_make_no_keyframe(name):
    packets = encode_clip(name, 12, keyframe_interval=5)
    assert [packet.keyframe for packet in packets] == [index % 5 == 0 for index in range(12)]
    encoder = create_encoder(CodecParameters(name, 128, 96))
    keyframes = [encoder.encode(natural_image(96, 128, seed)).keyframe for seed in range(8)]
    assert keyframes == [True] + [False] * 7


def test_intra_refresh_has_one_keyframe_and_recovers_nowhere_else_by_name():
    packets = encode_clip("h264", 40, intra_refresh=True, keyframe_interval=10)
    assert [packet.keyframe for packet in packets] == [True] + [False] * 39
    forced = encode_clip("h264", 12, forced={6}, intra_refresh=True)
    assert [index for index, packet in enumerate(forced) if packet.keyframe] == [0, 6]
    with pytest.raises(CodecError, match="intra_refresh"):
        create_encoder(CodecParameters("vp9", 128, 96, intra_refresh=True))


def test_intra_refresh_spreads_the_cost_of_keyframes():
    sizes = [[len(packet.data) for packet in encode_clip("h264", 60, keyframe_interval=20, intra_refresh=on)]
             for on in (True, False)]  # fmt: skip
    assert max(sizes[0][1:]) < max(sizes[1][1:])


@pytest.mark.parametrize("name", ["h264", "hevc", "av1"])
def test_keyframe_without_its_headers_is_refused(name):
    data = encode_clip(name, 1)[0].data
    if name == "av1":
        # Temporal delimiter (2 bytes), then the sequence header with its one-byte size.
        assert data[:2] == b"\x12\x00"
        assert data[2] == 0x0A
        bare = data[:2] + data[4 + data[3] :]
    else:
        start = b"\x00\x00\x01"
        bare = data[data.rindex(start) :]
    assert VIDEO_FORMATS[name].summarise(bare) == PacketSummary(True, False, 1)
    with pytest.raises(CodecError, match="in band"):
        create_decoder(CodecParameters(name, 128, 96)).decode(bare)


@pytest.mark.parametrize("name", VIDEOS)
def test_two_packets_joined_are_refused(name):
    packets = encode_clip(name, 2)
    joined = packets[0].data + packets[1].data
    if name == "vp9":
        # Without a superframe index the second would be taken for padding of the first.
        sizes = [len(packet.data) for packet in packets]
        marker = bytes([0b110_11_000 | 1])
        joined += marker + b"".join(size.to_bytes(4, "little") for size in sizes) + marker
    decoder = create_decoder(CodecParameters(name, 128, 96))
    with pytest.raises(CodecError, match="holds 2 pictures"):
        decoder.decode(joined)


def test_hevc_headers_by_hand():
    start = b"\x00\x00\x01"
    sets = b"".join(start + bytes([kind << 1, 1]) for kind in (32, 33, 34))
    assert summarise_hevc(sets + start + b"\x26\x01\x80") == PacketSummary(True, True, 1)
    assert summarise_hevc(start + b"\x26\x01\x80" + sets) == PacketSummary(True, False, 1)
    assert summarise_hevc(start + b"\x02\x01\x80" + start + b"\x02\x01\x00") == PacketSummary(False, False, 1)
    for kind in (16, 19, 20, 21):
        assert summarise_hevc(start + bytes([kind << 1, 1, 0x80])).keyframe
    for kind in (0, 1, 9, 39):
        assert not summarise_hevc(start + bytes([kind << 1, 1, 0x80])).keyframe


def test_av1_headers_by_hand():
    delimiter, sequence = b"\x12\x00", b"\x0a\x01\x00"
    key, inter, hidden_key, existing = (b"\x32\x01" + bytes([bits]) for bits in (0x10, 0x30, 0x00, 0x80))
    assert summarise_av1(delimiter + sequence + key) == PacketSummary(True, True, 1)
    assert summarise_av1(delimiter + key + sequence) == PacketSummary(True, False, 1)
    assert summarise_av1(delimiter + inter) == PacketSummary(False, False, 1)
    assert summarise_av1(delimiter + sequence + hidden_key) == PacketSummary(False, False, 0)
    assert summarise_av1(delimiter + existing) == PacketSummary(False, False, 1)
    assert summarise_av1(delimiter + inter + key).picture_count == 2
    # reduced_still_picture_header: every picture is a key frame
    assert summarise_av1(b"\x0a\x01\x18" + b"\x32\x01\x00") == PacketSummary(True, True, 1)
    assert list(open_units(b"\x12\x00\x32\x05\x10")) == [(2, b"")]
    assert read_leb128(b"\x80\x01", 0) == (128, 2)
    assert read_leb128(b"\xff" * 9, 0) == (-1, 0)
    assert read_leb128(b"\x80", 0) == (-1, 0)


def test_vp9_headers_by_hand():
    sync = b"\x49\x83\x42"
    assert summarise_vp9(b"\x82" + sync) == PacketSummary(True, True, 1)
    assert summarise_vp9(b"\x82" + b"\x00\x00\x00") == PacketSummary(False, True, 1)
    assert summarise_vp9(b"\x80" + sync) == PacketSummary(False, True, 0)
    assert summarise_vp9(b"\x86") == PacketSummary(False, True, 1)
    assert summarise_vp9(b"\x88") == PacketSummary(False, True, 1)
    assert summarise_vp9(b"") == PacketSummary(False, True, 0)
    hidden, shown = b"\x84xx", b"\x86y"
    index = b"\xc1" + bytes([len(hidden), len(shown)]) + b"\xc1"
    assert split_superframe(hidden + shown + index) == [hidden, shown]
    assert summarise_vp9(hidden + shown + index).picture_count == 1
    broken = hidden + shown + b"\xc1\x60\x60\xc1"
    assert split_superframe(broken) == [broken]


@pytest.mark.parametrize("summarise", [summarise_h264, summarise_hevc, summarise_av1, summarise_vp9])
@settings(max_examples=150, deadline=None)
@given(data=st.binary(max_size=80))
def test_any_bytes_are_read_without_failing(summarise, data):
    assert summarise(data).picture_count >= 0


@pytest.mark.parametrize("name", VIDEOS)
def test_predicted_packets_alone_are_refused(name):
    packets = encode_clip(name, 12, forced={8})
    decoder, whole = create_decoder(CodecParameters(name, 128, 96)), create_decoder(CodecParameters(name, 128, 96))
    pictures = [whole.decode(packet.data) for packet in packets]
    for packet in packets[3:8]:
        with pytest.raises(CodecError, match="keyframe"):
            decoder.decode(packet.data)
        assert decoder.needs_keyframe
    for index in range(8, 12):
        assert np.array_equal(decoder.decode(packets[index].data), pictures[index])
    assert not decoder.needs_keyframe
