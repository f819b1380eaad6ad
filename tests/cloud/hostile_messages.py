"""Messages that no good client sends: bytes that were damaged, and valid messages of impossible values."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
from cable_codecs import encode_mask
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from hypothesis import strategies as st

from cable_rpc.wire.v1 import perception_pb2 as pb

from .test_protocol import HEIGHT, WIDTH, coded, frame, hello

CODECS = {pb.CODEC_JPEG: "jpeg", pb.CODEC_WEBP: "webp", pb.CODEC_H264: "h264", pb.CODEC_VP9: "vp9"}
DEEPEST = 3


def good_session(codec: Any) -> list[pb.StreamPerceptionRequest]:
    """Messages of a session as they should be, the Hello first."""
    blocks = np.zeros((HEIGHT // 8, WIDTH // 8), np.bool_)
    blocks[2:5, 1:7] = True
    region = pb.Region(block_size=8, columns=WIDTH // 8, rows=HEIGHT // 8, data=encode_mask(blocks))
    packets = coded(CODECS[codec], 3)
    return [
        hello(codec),
        *(frame(number, packet, region=region) for number, packet in enumerate(packets)),
        pb.StreamPerceptionRequest(codec_config=hello(codec).hello.codec_config),
        pb.StreamPerceptionRequest(task_config=pb.TaskConfig(prompt="cars", min_score=0.5)),
    ]


def damaged(data: bytes, source: random.Random) -> bytes:
    """Flipped bits, a cut, a doubled stretch, noise in the middle, or other bytes altogether."""
    body = bytearray(data)
    start = source.randrange(len(body))
    kind = source.randrange(5)
    if kind == 0:
        for _ in range(source.randint(1, 8)):
            body[source.randrange(len(body))] ^= 1 << source.randrange(8)
    elif kind == 1:
        del body[start:]
    elif kind == 2:
        body[start:start] = body[start : start + source.randint(1, 64)]
    elif kind == 3:
        body[start : start + 8] = source.randbytes(source.randint(0, 16))
    else:
        body = bytearray(source.randbytes(source.randint(0, 300)))
    return bytes(body)


def integers(bits: int, *, signed: bool) -> st.SearchStrategy[int]:
    """The whole range, and often its ends."""
    least, most = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    return st.sampled_from([0, 1, least, most]) | st.integers(least, most) | st.integers(0, 200)


VALUES: dict[int, st.SearchStrategy[Any]] = {
    FieldDescriptor.CPPTYPE_INT32: integers(32, signed=True),
    FieldDescriptor.CPPTYPE_INT64: integers(64, signed=True),
    FieldDescriptor.CPPTYPE_UINT32: integers(32, signed=False),
    FieldDescriptor.CPPTYPE_UINT64: integers(64, signed=False),
    FieldDescriptor.CPPTYPE_DOUBLE: st.floats(),
    FieldDescriptor.CPPTYPE_FLOAT: st.floats(width=32),
    FieldDescriptor.CPPTYPE_BOOL: st.booleans(),
    FieldDescriptor.CPPTYPE_ENUM: st.integers(-2, 9) | st.sampled_from([-(1 << 31), (1 << 31) - 1]),
    FieldDescriptor.CPPTYPE_STRING: st.text(max_size=40) | st.integers(0, 5000).map("x".__mul__),
}
OCTETS = st.binary(max_size=60) | st.binary(min_size=1, max_size=1).map(lambda byte: byte * 3000)


def values(field: FieldDescriptor, depth: int) -> st.SearchStrategy[Any]:
    """Values of a field, one each where it is repeated."""
    if field.message_type is not None:
        return messages(field.message_type, depth + 1)
    if field.type == FieldDescriptor.TYPE_BYTES:
        return OCTETS
    return VALUES[field.cpp_type]


@st.composite
def messages(draw: st.DrawFn, descriptor: Descriptor, depth: int = 0) -> Message:
    """Any message of a type, most fields left out."""
    fields = [field for field in descriptor.fields if depth < DEEPEST or field.message_type is None]
    chosen = draw(st.lists(st.sampled_from(fields), max_size=3, unique_by=lambda field: field.name)) if fields else []
    message = GetMessageClass(descriptor)()
    for field in chosen:
        if field.is_repeated:
            getattr(message, field.name).extend(draw(st.lists(values(field, depth), max_size=3)))
        elif field.message_type is not None:
            getattr(message, field.name).CopyFrom(draw(values(field, depth)))
        else:
            setattr(message, field.name, draw(values(field, depth)))
    return message


@st.composite
def sessions(draw: st.DrawFn, good: dict[Any, list[pb.StreamPerceptionRequest]]) -> list[bytes]:
    """A Hello, then requests; most of them good ones with a few fields put to something else."""
    first, *others = good[draw(st.sampled_from(sorted(good)))]
    requests = [first if draw(st.integers(0, 3)) else altered(draw, first)]
    requests += [altered(draw, other) for other in draw(st.lists(st.sampled_from(others), min_size=3, max_size=6))]
    for number, request in enumerate(requests):
        if request.WhichOneof("payload") == "frame" and request.frame.sequence < 3:
            request.frame.sequence = number
    return [request.SerializeToString() for request in requests]


def altered(draw: st.DrawFn, request: pb.StreamPerceptionRequest) -> pb.StreamPerceptionRequest:
    """A copy of a request with some of its fields, at any depth, put to something else."""
    copy = pb.StreamPerceptionRequest()
    copy.CopyFrom(request)
    payload = getattr(copy, copy.WhichOneof("payload") or "hello")
    payload.MergeFrom(draw(messages(payload.DESCRIPTOR)))
    return copy
