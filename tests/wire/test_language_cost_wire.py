"""Tokens, prefill, answer and stages of a language model on the wire; both ends may be older."""

from __future__ import annotations

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.model_runner import ModelRun
from cable_rpc.cloud.perception import StageRun
from cable_rpc.types import PrefillCost, Segmentation
from cable_rpc.wire.answers import FrameAnswer, ServerTimes
from cable_rpc.wire.convert import mask_from_message, mask_to_message
from cable_rpc.wire.v1 import perception_pb2 as pb

HEIGHT, WIDTH = 21, 34
counts = st.integers(0, 2**32 - 1)
nanoseconds = st.integers(0, 2**62)
factors = st.floats(1.0, 1e6)
prefills = st.builds(PrefillCost, counts, factors, factors, nanoseconds, nanoseconds)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=40)


def told(**parts: object) -> Segmentation:
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[3:9, 5:30] = True
    return Segmentation(mask, 0.5, 60, 256, **parts)  # type: ignore[arg-type]


def over_the_wire(segmentation: Segmentation) -> Segmentation:
    message = pb.Mask.FromString(mask_to_message(segmentation).SerializeToString())
    return mask_from_message(message, HEIGHT, WIDTH)


@given(st.none() | prefills, texts, texts)
def test_what_the_language_model_said_and_cost_survives_the_wire(
    prefill: PrefillCost | None, answer: str, decoding: str
) -> None:
    back = over_the_wire(told(prefill=prefill, answer=answer, decoding=decoding))
    assert (back.prefill, back.answer, back.decoding) == (prefill, answer, decoding)
    assert (back.tokens_in, back.tokens_full) == (60, 256)


def test_the_clock_speaks_only_where_a_whole_frame_was_timed() -> None:
    assert PrefillCost(94, 5.2, 2.3, 4_000, 10_000).speedup_measured == 2.5
    assert PrefillCost(94, 5.2, 2.3, 4_000).speedup_measured is None
    assert PrefillCost(94, 5.2, 2.3, 0, 10_000).speedup_measured is None


def test_parts_of_the_segmenter_s_time_reach_the_edge_and_count_once() -> None:
    stages_ns = {"clip": 3, "prefill": 40, "sam_encoder": 500}
    run = ModelRun(told(stages_ns=stages_ns), wait_ns=7, run_ns=600, batch_size=2)
    stages = (StageRun("detect", 5, 90, 1), StageRun.of("segment", run), *StageRun.parts("segment", run))
    timing = pb.ServerTiming(
        stages=[
            pb.StageTiming(stage=s.stage, wait_ns=s.wait_ns, run_ns=s.run_ns, batch_size=s.batch_size) for s in stages
        ]
    )
    result = pb.Result(sequence=1, timing=timing, mask=mask_to_message(run.value))
    answer = FrameAnswer.from_result(result, HEIGHT, WIDTH, receive_time_ns=1, message_bytes=result.ByteSize())
    assert answer.segmentation is not None
    assert answer.segmentation.stages_ns == stages_ns
    assert answer.times.run_ns["segment"] == 600
    assert answer.times.run_ns["segment.prefill"] == 40
    assert answer.times.queue_ns == 5 + 7
    assert {stage.batch_size for stage in stages[2:]} == {2}


def test_a_model_without_parts_has_none() -> None:
    times = ServerTimes(run_ns={"detect": 1, "segment": 2, "segments.clip": 3})
    assert times.parts_of("segment") == {}
    assert over_the_wire(told()).stages_ns == {}


def former_mask_class() -> type:
    """Mask as it was before it had these fields, from a descriptor of its own."""
    file = descriptor_pb2.FileDescriptorProto(name="former_language.proto", package="former_language", syntax="proto3")
    message = file.message_type.add(name="Mask")
    kind = descriptor_pb2.FieldDescriptorProto
    rows = {
        "width": (1, kind.TYPE_UINT32),
        "height": (2, kind.TYPE_UINT32),
        "data": (3, kind.TYPE_BYTES),
        "confidence": (4, kind.TYPE_FLOAT),
        "tokens_in": (5, kind.TYPE_UINT32),
        "tokens_full": (6, kind.TYPE_UINT32),
        "uncertainty": (7, kind.TYPE_BYTES),
    }
    for name, (number, field_type) in rows.items():
        message.field.add(name=name, number=number, type=field_type, label=kind.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    return message_factory.GetMessageClass(pool.Add(file).message_types_by_name["Mask"])


def test_an_older_client_skips_what_it_does_not_know() -> None:
    message = mask_to_message(told(prefill=PrefillCost(94, 5.2, 2.3, 4_000), answer="Sure, [SEG].", decoding="forced"))
    former = former_mask_class().FromString(message.SerializeToString())  # type: ignore[attr-defined]
    assert (former.tokens_in, former.tokens_full, former.confidence) == (60, 256, 0.5)
    assert former.data == message.data


def test_an_older_server_tells_nothing() -> None:
    former = former_mask_class()(  # type: ignore[call-arg]
        width=WIDTH, height=HEIGHT, data=mask_to_message(told()).data, tokens_in=60, tokens_full=256
    )
    back = mask_from_message(pb.Mask.FromString(former.SerializeToString()), HEIGHT, WIDTH)
    assert (back.prefill, back.answer, back.decoding) == (None, "", "")
    assert (back.tokens_in, back.tokens_full) == (60, 256)
