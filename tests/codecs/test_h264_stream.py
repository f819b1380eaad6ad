"""Structure of the H.264 stream, and what its decoder does with a broken one."""

from __future__ import annotations

import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from cable_codecs.annexb import AccessUnit, parse_access_unit
from codec_images import luma_psnr, moving_clip, natural_image

PARAMETERS = CodecParameters("h264", 128, 96)
START_CODE = b"\x00\x00\x01"


def nal_types(data: bytes) -> list[int]:
    """The literal definition: the low five bits behind each start code."""
    return [part[0] & 31 for part in data.split(START_CODE)[1:]]


def encode_clip(count, parameters=PARAMETERS, forced=()):
    encoder = create_encoder(parameters)
    return [encoder.encode(image, keyframe=index in forced) for index, image in enumerate(moving_clip(count))]


def test_forced_keyframe_is_an_idr_behind_its_parameter_sets_and_does_not_echo():
    packets = encode_clip(20, forced={7, 8, 15})
    keyframes = [index for index, packet in enumerate(packets) if packet.keyframe]
    assert keyframes == [0, 7, 8, 15]
    for index, packet in enumerate(packets):
        kinds = nal_types(packet.data)
        if index in keyframes:
            assert kinds[-1] == 5
            assert kinds.index(7) < kinds.index(8) < kinds.index(5)
        else:
            assert 5 not in kinds
            assert 1 in kinds
        assert parse_access_unit(packet.data).nal_types == tuple(kinds)


def test_keyframe_interval():
    packets = encode_clip(12, CodecParameters("h264", 128, 96, keyframe_interval=5))
    assert [packet.keyframe for packet in packets] == [index % 5 == 0 for index in range(12)]


def test_scene_cut_makes_no_keyframe():
    encoder = create_encoder(PARAMETERS)
    keyframes = [encoder.encode(natural_image(96, 128, seed)).keyframe for seed in range(8)]
    assert keyframes == [True] + [False] * 7


def test_reencoding_decoded_frames_does_not_copy_their_keyframes():
    decoder, second = create_decoder(PARAMETERS), create_encoder(PARAMETERS)
    again = [second.encode(decoder.decode(packet.data)) for packet in encode_clip(8, forced={4})]
    assert [packet.keyframe for packet in again] == [True] + [False] * 7


def test_threads_make_slices_of_one_picture():
    clip = [natural_image(256, 128, seed) for seed in range(3)]
    parameters = CodecParameters("h264", 128, 256, threads=4)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    for image in clip:
        encoded = encoder.encode(image)
        unit = parse_access_unit(encoded.data)
        assert unit.picture_count == 1
        assert len([kind for kind in unit.nal_types if kind in (1, 5)]) > 1
        assert luma_psnr(image, decoder.decode(encoded.data)) > 30


@pytest.mark.parametrize("lost", [-1, -2, -3])
@pytest.mark.parametrize("victim", [0, 1])
def test_lost_slice_is_an_error(lost, victim):
    parameters = CodecParameters("h264", 128, 256, threads=4)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    packets = [encoder.encode(natural_image(256, 128, seed)).data for seed in range(2)]
    for packet in packets[:victim]:
        decoder.decode(packet)
    parts = packets[victim].split(START_CODE)
    del parts[lost]
    with pytest.raises(CodecError):
        decoder.decode(START_CODE.join(parts))
    assert decoder.needs_keyframe


def test_decoder_joins_at_a_keyframe_only():
    packets = encode_clip(12, forced={8})
    decoder, whole = create_decoder(PARAMETERS), create_decoder(PARAMETERS)
    pictures = [whole.decode(packet.data) for packet in packets]
    assert decoder.needs_keyframe
    for packet in packets[3:8]:
        with pytest.raises(CodecError, match="keyframe"):
            decoder.decode(packet.data)
        assert decoder.needs_keyframe
    for index in range(8, 12):
        assert np.array_equal(decoder.decode(packets[index].data), pictures[index])
        assert not decoder.needs_keyframe


def broken_packets(data: bytes) -> dict[str, bytes]:
    flipped = bytearray(data)
    for position in range(len(data) // 2, len(data), 7):
        flipped[position] ^= 0x5A
    return {
        "empty": b"",
        "garbage": np.random.default_rng(1).bytes(2000),
        "cut": data[: len(data) // 2],
        "flipped": bytes(flipped),
        "twice": data + data,
        "start code only": START_CODE,
        "headers only": data[: data.rindex(START_CODE)],
    }


@pytest.mark.parametrize("kind", broken_packets(START_CODE + bytes(60)))
@pytest.mark.parametrize("victim", [0, 2])
def test_after_damage_only_a_keyframe_helps(kind, victim):
    packets = encode_clip(8, forced={6})
    whole = create_decoder(PARAMETERS)
    pictures = [whole.decode(packet.data) for packet in packets]
    decoder = create_decoder(PARAMETERS)
    for packet in packets[:victim]:
        decoder.decode(packet.data)
    with pytest.raises(CodecError):
        decoder.decode(broken_packets(packets[victim].data)[kind])
    assert decoder.needs_keyframe
    for packet in packets[3:6]:
        with pytest.raises(CodecError, match="needs a keyframe"):
            decoder.decode(packet.data)
    for index in (6, 7):
        assert np.array_equal(decoder.decode(packets[index].data), pictures[index])
    assert not decoder.needs_keyframe


def test_keyframe_without_parameter_sets_is_refused():
    data = encode_clip(1)[0].data
    with pytest.raises(CodecError, match="SPS and PPS"):
        create_decoder(PARAMETERS).decode(data[data.rindex(START_CODE) :])


@pytest.mark.parametrize(("width", "height"), [(130, 96), (128, 94), (64, 48), (1920, 1080)])
def test_other_picture_size_is_refused(width, height):
    data = create_encoder(CodecParameters("h264", width, height)).encode(natural_image(height, width)).data
    decoder = create_decoder(PARAMETERS)
    with pytest.raises(CodecError):
        decoder.decode(data)
    assert decoder.needs_keyframe
    decoder.decode(encode_clip(1)[0].data)
    assert not decoder.needs_keyframe


def test_access_unit_of_odd_input():
    assert parse_access_unit(b"") == AccessUnit((), 0)
    assert parse_access_unit(START_CODE) == AccessUnit((), 0)
    assert parse_access_unit(b"\x00" + START_CODE + b"\x65") == AccessUnit((5,), 0)
    assert parse_access_unit(START_CODE + b"\x67ab" + START_CODE + b"\x68c" + START_CODE + b"\x65\x88").is_idr
