from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cable_rpc.errors import ProtocolError
from cable_rpc.types import Detections, RoiMask, Segmentation
from cable_rpc.wire.clock import ClockOffsetEstimator, ClockSample
from cable_rpc.wire.convert import (
    codec_name,
    detections_from_messages,
    detections_to_messages,
    mask_from_message,
    mask_to_message,
    region_from_message,
    region_to_message,
)
from cable_rpc.wire.v1 import perception_pb2 as pb


@given(
    hnp.arrays(np.bool_, st.tuples(st.integers(1, 70), st.integers(1, 70))),
    st.sampled_from([1, 2, 8, 16]),
)
def test_region_survives_the_wire_and_only_grows(mask: np.ndarray, block_size: int) -> None:
    height, width = mask.shape
    block_size = min(block_size, height, width)
    roi = RoiMask.from_pixels(mask, block_size)
    back = region_from_message(region_to_message(roi), height, width)
    assert np.array_equal(back.blocks, roi.blocks)
    pixels = back.pixels()
    assert pixels.shape == mask.shape
    for y in range(height):
        for x in range(width):
            top, left = y // block_size * block_size, x // block_size * block_size
            assert pixels[y, x] == mask[top : top + block_size, left : left + block_size].any()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"block_size": 0}, "block_size"),
        ({"block_size": 100_000}, "block_size"),
        ({"rows": 3}, "blocks of 8 px"),
        ({"data": b"\xff\x00rubbish"}, "damaged"),
        ({"data": b""}, "damaged"),
    ],
)
def test_unfit_region_is_refused(change: dict[str, object], said: str) -> None:
    message = region_to_message(RoiMask.full(40, 64))
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(ProtocolError, match=said):
        region_from_message(message, 40, 64)


def test_detections_survive_the_wire() -> None:
    detections = Detections(
        np.array([[0.5, 1.25, 30.0, 40.0], [3, 4, 5, 6]], np.float32),
        np.array([2, 0], np.int32),
        np.array([0.75, 0.5], np.float32),
    )
    back = detections_from_messages(detections_to_messages(detections))
    for name in ("boxes_xyxy", "class_ids", "scores"):
        assert np.array_equal(getattr(back, name), getattr(detections, name))
        assert getattr(back, name).dtype == getattr(detections, name).dtype
    assert len(detections_from_messages([])) == 0


def test_mask_survives_the_wire_and_a_foreign_size_is_refused() -> None:
    mask = np.zeros((37, 53), np.bool_)
    mask[5:20, 10:30] = True
    message = mask_to_message(Segmentation(mask, 0.5, 7, 256))
    back = mask_from_message(message, 37, 53)
    assert np.array_equal(back.mask, mask)
    assert (back.confidence, back.tokens_in, back.tokens_full) == (0.5, 7, 256)
    with pytest.raises(ProtocolError, match="53x37 mask for a 53x36 frame"):
        mask_from_message(message, 36, 53)


@pytest.mark.parametrize("number", [pb.CODEC_UNSPECIFIED, 999])
def test_unknown_codec_names_the_known_ones(number: int) -> None:
    with pytest.raises(ProtocolError, match="h264, hevc, av1, vp9, jpeg"):
        codec_name(number)  # type: ignore[arg-type]


@given(
    offset_ns=st.integers(-(10**15), 10**15),
    delays=st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 10**8)), min_size=1, max_size=20),
)
def test_clock_offset_lies_within_its_bound(offset_ns: int, delays: list[tuple[int, int]]) -> None:
    estimator = ClockOffsetEstimator()
    assert estimator.offset is None
    now = 0
    for up_ns, down_ns in delays:
        received = now + up_ns + offset_ns
        estimator.add(ClockSample(now, received, received + 5, now + up_ns + 5 + down_ns))
        now += 10**9
    offset = estimator.offset
    assert offset is not None
    assert abs(offset.offset_ns - offset_ns) <= offset.error_ns + 1
    assert offset.error_ns == min(up + down for up, down in delays) // 2


def test_clock_forgets_samples_older_than_its_window() -> None:
    estimator = ClockOffsetEstimator(window_ns=100)
    estimator.add(ClockSample(0, 1, 1, 2))
    estimator.add(ClockSample(200, 1205, 1205, 210))
    assert estimator.offset is not None
    assert estimator.offset.offset_ns == 1000
