"""Quantisers by object size: closed values, the cover, and bytes that a large object no longer costs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, RegionTreatment, TreatedDecoder, TreatedEncoder, roi_psnr
from cable_codecs.region_grid import grow_to_grid
from cable_codecs.size_offset import SMALL_SIDE_SHARE, sized_rectangles
from hypothesis import given, settings
from hypothesis import strategies as st

SMALL_PX = SMALL_SIDE_SHARE * math.sqrt(416 * 416)


def square(side: int, at: tuple[int, int] = (32, 32)) -> np.ndarray:
    region = np.zeros((416, 416), np.bool_)
    region[at[0] : at[0] + side, at[1] : at[1] + side] = True
    return region


@pytest.mark.parametrize(("side", "doublings"), [(16, 0.0), (32, 1.0), (64, 2.0), (128, 3.0)])
def test_each_doubling_of_the_side_adds_one_step(side: int, doublings: float) -> None:
    assert pytest.approx(16.0) == SMALL_PX
    ((rectangle, offset),) = sized_rectangles(square(side), 0.1, 0.9, 48, 16)
    assert (rectangle.top, rectangle.bottom, rectangle.left, rectangle.right) == (32, 32 + side, 32, 32 + side)
    assert offset == pytest.approx(0.1 * doublings)


def test_no_piece_is_coarser_than_the_background_and_the_finest_comes_first() -> None:
    region = square(256, (0, 0)) | square(16, (352, 352)) | square(64, (320, 0))
    offsets = [offset for _, offset in sized_rectangles(region, 0.1, 0.3, 48, 16)]
    assert offsets == pytest.approx([0.0, 0.2, 0.3])


def test_more_pieces_than_rectangles_are_covered_without_offsets() -> None:
    region = np.zeros((416, 416), np.bool_)
    region[::32, ::32] = True
    found = sized_rectangles(region, 0.1, 0.4, 8, 16)
    assert len(found) <= 8
    assert all(offset == 0 for _, offset in found)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.01, 0.6), most=st.integers(1, 48))
def test_the_whole_region_is_covered_whatever_its_shape(seed: int, share: float, most: int) -> None:
    region = np.kron(np.random.default_rng(seed).random((6, 8)) < share, np.ones((24, 24))).astype(np.bool_)
    found = sized_rectangles(region, 0.1, 0.4, most, 16)
    covered = np.zeros(region.shape, np.bool_)
    for one, _ in found:
        covered[one.top : one.bottom, one.left : one.right] = True
    assert len(found) <= most
    assert not (region & ~covered).any()
    if most == 48:
        grown = np.kron(grow_to_grid(region, 1, 16, *region.shape), np.ones((16, 16)))[:144, :192]
        assert covered.sum() >= grown.sum()


def test_a_large_object_costs_less_and_a_small_one_keeps_its_quality() -> None:
    random = np.random.default_rng(3)
    texture = np.repeat(random.integers(0, 256, (104, 104, 1)).astype(np.uint8), 3, axis=2)
    image = np.kron(texture, np.ones((4, 4, 1))).astype(np.uint8)
    small, large = square(16, (368, 368)), square(256)
    coded = {}
    for size_offset in (0.0, 0.1):
        treatment = RegionTreatment(fill="keep", grid=16, quantiser_offset=0.6, size_offset=size_offset)
        parameters = CodecParameters("h264", 416, 416, quality=26)
        with TreatedEncoder(parameters, treatment) as encoder, TreatedDecoder(parameters, treatment) as decoder:
            packet = encoder.encode(image, small | large)
            shown = decoder.decode(packet.encoded.data, packet.blocks, packet.block_size).image
        coded[size_offset] = len(packet.encoded.data), roi_psnr(image, shown, small), roi_psnr(image, shown, large)
    assert coded[0.1][0] < 0.6 * coded[0.0][0]
    assert coded[0.1][1] >= coded[0.0][1] - 1.0
    assert coded[0.1][2] < coded[0.0][2] - 3


@pytest.mark.parametrize(
    "switches", [{"size_offset": 0.1}, {"size_offset": -0.1}, {"size_offset": 0.6, "quantiser_offset": 0.4}]
)
def test_impossible_offsets_are_refused(switches: dict[str, float]) -> None:
    with pytest.raises(CodecError, match="quantiser"):
        RegionTreatment(fill="keep", **switches)
