"""Whatever bytes arrive, a decoder returns a picture of its size or raises CodecError, and works on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from codec_images import CODECS, STILLS, luma_psnr, natural_image
from hypothesis import given, settings
from hypothesis import strategies as st

IMAGE = natural_image(48, 64)
PACKETS = {name: create_encoder(CodecParameters(name, 64, 48)).encode(IMAGE).data for name in CODECS}


def decode_or_refuse(decoder, data):
    try:
        picture = decoder.decode(data)
    except CodecError:
        return
    assert picture.shape == (48, 64, 3)


@pytest.mark.parametrize("name", CODECS)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_flipped_and_cut_packets(name, data):
    packet = bytearray(PACKETS[name])
    for position in data.draw(st.lists(st.integers(0, len(packet) - 1), max_size=8)):
        packet[position] ^= data.draw(st.integers(1, 255))
    decoder = create_decoder(CodecParameters(name, 64, 48))
    decode_or_refuse(decoder, bytes(packet[: data.draw(st.integers(0, len(packet)))]))
    assert luma_psnr(IMAGE, decoder.decode(PACKETS[name])) > 30


@pytest.mark.parametrize("name", CODECS)
@settings(max_examples=40, deadline=None)
@given(garbage=st.binary(max_size=300), head=st.integers(0, 40))
def test_garbage(name, garbage, head):
    decoder = create_decoder(CodecParameters(name, 64, 48))
    decode_or_refuse(decoder, PACKETS[name][:head] + garbage)
    assert luma_psnr(IMAGE, decoder.decode(PACKETS[name])) > 30


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("other", CODECS)
def test_packets_of_another_codec(name, other):
    if name.split("-ffmpeg")[0] == other.split("-ffmpeg")[0]:
        return
    with pytest.raises(CodecError):
        create_decoder(CodecParameters(name, 64, 48)).decode(PACKETS[other])


@pytest.mark.parametrize("name", STILLS)
@pytest.mark.parametrize("change", [lambda b: b"", lambda b: b[:-1], lambda b: b[: len(b) // 2], lambda b: b + b])
def test_still_images_must_be_whole(name, change):
    with pytest.raises(CodecError, match=r"cut|joined"):
        create_decoder(CodecParameters(name, 64, 48)).decode(change(PACKETS[name]))


@pytest.mark.parametrize("name", STILLS)
@pytest.mark.parametrize(("width", "height"), [(66, 48), (64, 47), (16, 16), (1500, 1000)])
def test_still_images_of_another_size(name, width, height):
    data = create_encoder(CodecParameters(name, width, height)).encode(natural_image(height, width)).data
    with pytest.raises(CodecError):
        create_decoder(CodecParameters(name, 64, 48)).decode(data)


def test_other_kinds_of_the_same_format_are_refused():
    grey = cv2.imencode(".jpg", IMAGE[..., 0])[1].tobytes()
    full_chroma = cv2.imencode(".jpg", IMAGE, [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444])[
        1
    ].tobytes()
    lossless = cv2.imencode(".webp", IMAGE, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    with_alpha = cv2.imencode(".webp", np.dstack([IMAGE, IMAGE[..., 0]]), [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
    for name, data in (("jpeg", grey), ("jpeg", full_chroma), ("webp", lossless), ("webp", with_alpha)):
        with pytest.raises(CodecError, match="pixel format"):
            create_decoder(CodecParameters(name, 64, 48)).decode(data)


@pytest.mark.parametrize(("name", "suffix"), [("jpeg", ".jpg"), ("webp", ".webp")])
def test_files_of_other_encoders_decode(name, suffix):
    data = cv2.imencode(suffix, IMAGE, [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_WEBP_QUALITY, 90])[1].tobytes()
    assert luma_psnr(IMAGE, create_decoder(CodecParameters(name, 64, 48)).decode(data)) > 33
