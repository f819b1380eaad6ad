"""The uncertainty map on the wire: doubt may grow on the way, but never gets lost."""

from __future__ import annotations

import math

import numpy as np
import pytest
from cable_codecs import encode_mask
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cable_rpc.errors import ProtocolError
from cable_rpc.types import Segmentation
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.convert import mask_from_message, mask_to_message
from cable_rpc.wire.uncertainty import decode_uncertainty, encode_uncertainty
from cable_rpc.wire.v1 import perception_pb2 as pb

HEIGHT, WIDTH = 37, 53
sizes = st.tuples(st.integers(1, 41), st.integers(1, 41))
maps = hnp.arrays(np.uint8, sizes, elements=st.sampled_from([0, 1, 84, 85, 86, 170, 171, 254, 255]))


def doubtful() -> Segmentation:
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[5:20, 10:30] = True
    uncertainty = np.zeros((HEIGHT, WIDTH), np.uint8)
    uncertainty[3:8, 9:31] = 120
    uncertainty[30:, 50:] = 255
    return Segmentation(mask, 0.5, 7, 256, uncertainty)


@given(maps)
@example(np.zeros((8, 8), np.uint8))
@example(np.full((9, 17), 255, np.uint8))
@example(np.tile(np.arange(256, dtype=np.uint8), (40, 1)))
def test_each_block_comes_back_as_its_largest_value_rounded_up(uncertainty: np.ndarray) -> None:
    height, width = uncertainty.shape
    back = decode_uncertainty(encode_uncertainty(uncertainty), height, width)
    assert back.shape == uncertainty.shape
    assert back.dtype == np.uint8
    assert np.all(back >= uncertainty)
    for top in range(0, height, 8):
        for left in range(0, width, 8):
            block = np.s_[top : top + 8, left : left + 8]
            assert set(np.unique(back[block])) == {85 * math.ceil(int(uncertainty[block].max()) / 85)}
    again = decode_uncertainty(encode_uncertainty(back), height, width)
    assert np.array_equal(again, back), "a second trip must change nothing"


def test_the_bitmap_is_the_documented_one() -> None:
    """Levels 0, 1 / 2, 3 of four blocks: high bits 00 / 11 above low bits 01 / 01."""
    uncertainty = np.zeros((16, 16), np.uint8)
    uncertainty[:8, 8:], uncertainty[8:, :8], uncertainty[8:, 8:] = 85, 170, 255
    bitmap = np.array([[0, 0], [1, 1], [0, 1], [0, 1]], np.bool_)
    assert encode_uncertainty(uncertainty) == encode_mask(bitmap)
    assert np.array_equal(decode_uncertainty(encode_mask(bitmap), 16, 16), uncertainty)


def test_being_sure_everywhere_costs_a_byte_and_is_not_silence() -> None:
    sure = Segmentation(np.ones((HEIGHT, WIDTH), np.bool_), 1.0, uncertainty=np.zeros((HEIGHT, WIDTH), np.uint8))
    message = mask_to_message(sure)
    assert len(message.uncertainty) == 1
    back = mask_from_message(message, HEIGHT, WIDTH).uncertainty
    assert back is not None
    assert not back.any()


@given(st.data())
def test_damaged_bytes_are_refused_or_harmless(data: st.DataObject) -> None:
    """Whatever comes, the answer is a map of the frame's size or a ProtocolError."""
    good = mask_to_message(doubtful()).uncertainty
    place = data.draw(st.integers(0, len(good)))
    damaged = data.draw(
        st.one_of(
            st.binary(min_size=1, max_size=40),
            st.just(good[: max(place, 1)]),
            st.binary(min_size=1, max_size=3).map(lambda extra: good[:place] + extra + good[place + len(extra) :]),
        )
    )
    try:
        back = decode_uncertainty(damaged, HEIGHT, WIDTH)
    except ProtocolError:
        return
    assert back.shape == (HEIGHT, WIDTH)
    assert set(np.unique(back)) <= {0, 85, 170, 255}


@pytest.mark.parametrize(
    "data",
    [
        b"\x07",
        b"\x00\x00",
        encode_uncertainty(np.eye(400, dtype=np.uint8) * 255),
        encode_uncertainty(np.eye(HEIGHT, WIDTH + 8, dtype=np.uint8) * 255),
        mask_to_message(doubtful()).uncertainty[:-1],
        mask_to_message(doubtful()).uncertainty + b"\x00",
    ],
    ids=["unknown tag", "payload too many", "larger frame", "wider frame", "cut short", "rubbish behind"],
)
def test_a_map_that_does_not_fit_ends_like_a_damaged_mask(data: bytes) -> None:
    result = pb.Result(sequence=3, mask=mask_to_message(doubtful()))
    result.mask.uncertainty = data
    with pytest.raises(ProtocolError, match=r"Mask\.uncertainty is damaged"):
        FrameAnswer.from_result(result, HEIGHT, WIDTH, receive_time_ns=0, message_bytes=0)


def test_the_answer_keeps_what_the_map_cost() -> None:
    result = pb.Result(sequence=3, mask=mask_to_message(doubtful()))
    answer = FrameAnswer.from_result(result, HEIGHT, WIDTH, receive_time_ns=0, message_bytes=result.ByteSize())
    assert answer.uncertainty_data == result.mask.uncertainty
    assert answer.mask_data == result.mask.data
    assert answer.segmentation is not None
    assert answer.segmentation.uncertainty is not None
    assert answer.segmentation.uncertainty[36, 52] == 255
    assert answer.segmentation.uncertainty[0, 8] == 170
    assert answer.segmentation.uncertainty[0, 0] == 0


def former_mask_class() -> type:
    """Mask as it was before it had the field, from a descriptor of its own."""
    file = descriptor_pb2.FileDescriptorProto(name="former.proto", package="former", syntax="proto3")
    message = file.message_type.add(name="Mask")
    kind = descriptor_pb2.FieldDescriptorProto
    for number, (name, field_type) in enumerate(
        [
            ("width", kind.TYPE_UINT32),
            ("height", kind.TYPE_UINT32),
            ("data", kind.TYPE_BYTES),
            ("confidence", kind.TYPE_FLOAT),
            ("tokens_in", kind.TYPE_UINT32),
            ("tokens_full", kind.TYPE_UINT32),
        ],
        start=1,
    ):
        message.field.add(name=name, number=number, type=field_type, label=kind.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("former.Mask"))


def test_a_former_client_reads_all_it_knows() -> None:
    new = mask_to_message(doubtful())
    former = former_mask_class().FromString(new.SerializeToString())  # type: ignore[attr-defined]
    for name in ("width", "height", "data", "confidence", "tokens_in", "tokens_full"):
        assert getattr(former, name) == getattr(new, name)


def test_a_former_server_tells_no_uncertainty() -> None:
    new = mask_to_message(doubtful())
    names = ("width", "height", "data", "confidence", "tokens_in", "tokens_full")
    former = former_mask_class()(**{name: getattr(new, name) for name in names})
    back = mask_from_message(pb.Mask.FromString(former.SerializeToString()), HEIGHT, WIDTH)
    assert back.uncertainty is None
    assert np.array_equal(back.mask, doubtful().mask)
    assert (back.confidence, back.tokens_in, back.tokens_full) == (0.5, 7, 256)
