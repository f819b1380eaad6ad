"""Colours survive: within our own codecs, and as other readers of the same bytes see them."""

from __future__ import annotations

import io

import av
import cv2
import numpy as np
import pytest
from cable_codecs import CodecParameters, create_decoder, create_encoder
from codec_images import BEST, CODECS, STILLS, natural_image
from PIL import Image


def blockwise_image() -> np.ndarray:
    """A picture constant over 2x2 blocks, so that chroma subsampling loses nothing."""
    return natural_image(120, 160, seed=7).repeat(2, axis=0).repeat(2, axis=1)


@pytest.mark.parametrize("name", CODECS)
def test_colour_is_unbiased_and_faithful(name):
    image = blockwise_image()
    parameters = CodecParameters(name, 320, 240, quality=BEST[name])
    decoded = create_decoder(parameters).decode(create_encoder(parameters).encode(image).data)
    difference = decoded.astype(np.float64) - image
    assert np.mean(difference**2) <= 255**2 / 10**4.5  # 45 dB
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.5


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 255, 0), (0, 0, 255), (40, 90, 200)])
def test_flat_colours(name, colour):
    image = np.full((48, 64, 3), colour, np.uint8)
    parameters = CodecParameters(name, 64, 48, quality=BEST[name])
    decoded = create_decoder(parameters).decode(create_encoder(parameters).encode(image).data)
    assert np.abs(decoded.astype(int) - colour).max() <= 4


@pytest.mark.parametrize("name", STILLS)
@pytest.mark.parametrize("size", [(240, 320), (119, 161)])
def test_other_readers_see_the_same_colours(name, size):
    image = natural_image(*size)
    parameters = CodecParameters(name, size[1], size[0], quality=None if name == "webp-lossless" else 90)
    data = create_encoder(parameters).encode(image).data
    ours = create_decoder(parameters).decode(data).astype(np.float64)
    by_opencv = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(np.float64)
    by_pillow = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))[..., ::-1].astype(np.float64)
    for other in (by_opencv, by_pillow):
        assert other.shape == ours.shape
        assert np.abs(ours - other).mean() < 1.0
        assert np.abs((ours - other).mean(axis=(0, 1))).max() < 0.5


def test_h264_is_tagged_bt601_limited():
    parameters = CodecParameters("h264", 64, 48)
    data = create_encoder(parameters).encode(natural_image(48, 64)).data
    frame = av.CodecContext.create("h264", "r").decode(av.Packet(data))[0]
    assert (frame.color_range, frame.colorspace, frame.color_primaries, frame.color_trc) == (1, 6, 6, 6)
    assert frame.format.name == "yuv420p"
