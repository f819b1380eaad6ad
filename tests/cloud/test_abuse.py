"""What hostile clients send, over real sockets: memory is bounded, nothing of the inside shows, others are served."""

from __future__ import annotations

import asyncio
import re
import socket
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from cable_codecs import CodecParameters, EncodedFrame, available_codecs, create_encoder
from google.protobuf.message import DecodeError
from google.rpc import code_pb2
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.public_text import MOST_CHARACTERS, log_text, public_text
from cable_rpc.cloud.request_bounds import leading_frame_bytes, parse_request
from cable_rpc.errors import ModelError, ProtocolError
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import BrightBoxDetector
from .secure_server import serving
from .test_protocol import HEIGHT, WIDTH, closing_of, coded, frame, hello, opened, read, serves_a_frame

STREAM = "/cable.v1.PerceptionService/StreamPerception"


def memory_mb(what: str) -> float:
    found = re.search(rf"{what}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


@contextmanager
def memory_stays_within(most_mb: float) -> Iterator[None]:
    """The peak of this process, server and client, above what it had."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pytest.skip("needs Linux's peak of resident memory")
    before_mb = memory_mb("VmRSS")
    yield
    grown_mb = memory_mb("VmHWM") - before_mb
    assert grown_mb < most_mb, f"memory grew by {grown_mb:.0f} MB"


def jpeg_of_stated_size(width: int, height: int) -> bytes:
    """A small file whose header states another size."""
    data = coded("jpeg", 1)[0].data
    start = data.index(b"\xff\xc0")
    return data[: start + 5] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[start + 9 :]


def jpeg_with_second_picture() -> bytes:
    """The header that is checked first is true; another one stands behind the first scan."""
    good, huge = coded("jpeg", 1)[0].data, jpeg_of_stated_size(65_500, 65_500)
    return good[:-2] + huge[huge.index(b"\xff\xdb") :]


def webp_of_stated_size(lossless: bool) -> bytes:
    data = bytearray(coded("webp-lossless" if lossless else "webp", 1)[0].data)
    if lossless:
        data[21:25] = (0x3FFF | 0x3FFF << 14).to_bytes(4, "little")
    else:
        start = data.index(b"\x9d\x01\x2a") + 3
        data[start : start + 4] = b"\xff\x3f\xff\x3f"
    return bytes(data)


def huge_video(codec: str) -> bytes:
    """A whole, valid picture of 8192 x 8192 pixels in a few kilobytes."""
    side = 8192
    with create_encoder(CodecParameters(codec, side, side)) as encoder:
        return encoder.encode(np.zeros((side, side, 3), np.uint8)).data


@pytest.mark.skipif("h264" not in available_codecs(), reason="needs libx264")
async def test_pictures_larger_than_announced_take_no_memory(stub_for: Any) -> None:
    bombs = [
        (pb.CODEC_JPEG, jpeg_of_stated_size(65_500, 65_500)),
        (pb.CODEC_JPEG, jpeg_with_second_picture()),
        (pb.CODEC_WEBP, webp_of_stated_size(lossless=False)),
        (pb.CODEC_WEBP_LOSSLESS, webp_of_stated_size(lossless=True)),
        (pb.CODEC_H264, huge_video("h264")),
    ]
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        await serves_a_frame(stub)
        with memory_stays_within(40):
            for codec, data in bombs:
                assert len(data) < 300_000
                call = await opened(stub, hello(codec))
                await call.write(frame(0, EncodedFrame(data, True, 0)))
                rejected = (await read(call)).frame_rejected
                assert rejected.reason == pb.REJECT_REASON_UNDECODABLE, pb.Codec.Name(codec)
                call.cancel()
        await serves_a_frame(stub)


async def test_regions_that_inflate_take_no_memory(stub_for: Any) -> None:
    compressor = zlib.compressobj(9, wbits=-15)
    bomb = compressor.compress(bytes(400 << 20)) + compressor.flush()
    assert len(bomb) < 500_000
    packet = coded("jpeg", 1)[0]
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        await serves_a_frame(stub)
        with memory_stays_within(20):
            call = await opened(stub)
            for sequence, tag in enumerate((2, 3, 4, 5)):
                region = pb.Region(block_size=1, columns=WIDTH, rows=HEIGHT, data=bytes([tag]) + bomb)
                await call.write(frame(sequence, packet, region=region))
                assert (await read(call)).frame_rejected.reason == pb.REJECT_REASON_INVALID_REGION
            for rows, columns in ((1 << 31, 1 << 31), (1, 0)):
                sequence += 1
                region = pb.Region(block_size=1, columns=columns, rows=rows, data=b"\1")
                await call.write(frame(sequence, packet, region=region))
                assert (await read(call)).frame_rejected.reason == pb.REJECT_REASON_INVALID_REGION
            call.cancel()


def varint(number: int) -> bytes:
    return bytes([number]) if number < 128 else bytes([number & 127 | 128]) + varint(number >> 7)


def field(number: int, body: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(body)) + body


async def test_lists_that_grow_when_parsed_take_no_memory(stub_for: Any) -> None:
    """Millions of empty texts in a Hello, alone and behind a frame."""
    texts = b"\x5a\x00" * 7_000_000
    whole = [field(1, texts), field(2, b"") + field(1, texts)]
    async with serving() as server, grpc.aio.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        for data in whole:
            with memory_stays_within(80):
                call = channel.stream_stream(STREAM, response_deserializer=pb.StreamPerceptionResponse.FromString)()
                await call.write(data)
                closing = (await read(call)).closing
                assert "bytes that are no frame" in closing.status.message
                assert closing.status.code == code_pb2.FAILED_PRECONDITION
                await call.done_writing()


@given(st.binary(max_size=300))
def test_requests_are_parsed_like_protobuf_does(data: bytes) -> None:
    try:
        expected = pb.StreamPerceptionRequest.FromString(data)
    except DecodeError:
        with pytest.raises(ProtocolError):
            parse_request(data)
    else:
        assert parse_request(data) == expected


@given(st.binary(max_size=3000), st.binary(max_size=50))
def test_size_of_the_leading_frame(body: bytes, rest: bytes) -> None:
    message = field(2, body)
    assert leading_frame_bytes(message + rest) == len(message)
    assert leading_frame_bytes(message[:-1]) <= len(message)
    assert leading_frame_bytes(field(1, body)) == 0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"task_config": pb.TaskConfig(prompt="x" * 2001)}, "TaskConfig.prompt has a length of 2001"),
        ({"task_config": pb.TaskConfig(min_score=float("nan"))}, "min_score is nan"),
        ({"client_id": "x" * 129}, "Hello.client_id has a length of 129"),
        ({"features": ["x"] * 65}, "Hello.features"),
        ({"resume_token": bytes(1025)}, "Hello.resume_token"),
        ({"codec_config": pb.CodecConfig(codec=pb.CODEC_JPEG, width=1, height=1, frame_rate=float("inf"))}, "inf"),
        ({"codec_config": pb.CodecConfig(codec=pb.CODEC_JPEG, width=1 << 20, height=9)}, "1..16384"),
    ],
)
async def test_too_long_and_impossible_settings_are_refused(stub_for: Any, fields: dict[str, Any], said: str) -> None:
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        request = hello()
        for name, value in fields.items():
            request.hello.ClearField(name)
            getattr(request.hello, name).extend(value) if isinstance(value, list) else request.hello.MergeFrom(
                pb.Hello(**{name: value})
            )
        closing = await closing_of(stub, request)
        assert said in closing.status.message
        closing = await closing_of(
            stub, hello(), pb.StreamPerceptionRequest(task_config=pb.TaskConfig(prompt="x" * 2001))
        )
        assert "TaskConfig.prompt" in closing.status.message


class PathDetector(BrightBoxDetector):
    name = "onnx:/srv/models/secret/detector.onnx"

    def detect(self, images: Any) -> Any:
        raise ModelError("can't read /srv/models/secret/detector.onnx, line 3")


async def test_paths_of_the_server_are_not_told(stub_for: Any, caplog: pytest.LogCaptureFixture) -> None:
    async with serving(detector=PathDetector()) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        info = await stub.GetServerInfo(pb.GetServerInfoRequest())
        assert info.models[0].name == "onnx:detector.onnx"
        call = await opened(stub)
        await call.write(frame(0, coded("jpeg", 1)[0]))
        assert (await read(call)).frame_rejected.message == "frame 0: can't read detector.onnx, line 3"
        assert "/srv/models/secret" in caplog.text
        call.cancel()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("no such file: '/srv/a b/c.bin'", "no such file: 'a b/c.bin'"),
        ("OpenCV(5.0) /io/opencv/modules/src/load.cpp:12: error", "OpenCV(5.0) load.cpp:12: error"),
        ("lisa:~/weights/x?a=b", "lisa:x?a=b"),
        (r"C:\Users\me\model.onnx", "model.onnx"),
        ("use kbit/s; 0x64; JPEG/WebP; a/b; 1..5", "use kbit/s; 0x64; JPEG/WebP; a/b; 1..5"),
        ("rtdetr:PekingU/rtdetr_r50vd", "rtdetr:PekingU/rtdetr_r50vd"),
        ("line\nline\x1b[31m", "line line [31m"),
    ],
)
def test_public_text(text: str, shown: str) -> None:
    assert public_text(text) == shown


@given(st.text())
def test_texts_are_one_bounded_line(text: str) -> None:
    for shown in (public_text(text), log_text(text)):
        assert len(shown) <= MOST_CHARACTERS
        assert shown.isprintable()


class WordyDetector(BrightBoxDetector):
    """Its name alone fills what the transport takes before a reader reads."""

    revision = "x" * (12 << 20)


async def test_client_that_takes_no_answers_is_cut_off(stub_for: Any) -> None:
    async with (
        serving(detector=WordyDetector(), write_timeout_s=0.3) as server,
        grpc.aio.insecure_channel(f"127.0.0.1:{server.port}") as channel,
    ):
        call = channel.stream_stream(STREAM, request_serializer=pb.StreamPerceptionRequest.SerializeToString)()
        await call.write(hello())
        await asyncio.sleep(0.2)
        assert len(server._service._sessions) == 1
        await asyncio.wait_for(server._service._idle.wait(), 5)
        assert server._service._admission.streams == 0
        call.cancel()


async def test_client_that_ignores_its_credit_and_reads_nothing_holds_little(stub_for: Any) -> None:
    packet = coded("jpeg", 1)[0]
    async with serving() as server:
        target = f"127.0.0.1:{server.port}"
        with memory_stays_within(60):
            async with grpc.aio.insecure_channel(target) as channel, stub_for(target) as other:
                call = channel.stream_stream(STREAM, request_serializer=pb.StreamPerceptionRequest.SerializeToString)()
                await call.write(hello())
                with pytest.raises((asyncio.InvalidStateError, grpc.aio.AioRpcError, TimeoutError)):
                    async with asyncio.timeout(10):
                        for sequence in range(200_000):
                            await call.write(frame(sequence, packet))
                await serves_a_frame(other)
                call.cancel()
                await asyncio.wait_for(server._service._idle.wait(), 10)


async def test_half_open_connections_do_not_hinder_others(stub_for: Any) -> None:
    """Sockets that say nothing, half a greeting, or noise."""
    openings = [b"", b"PRI * HTTP/2.0\r\n", b"GET / HTTP/1.1\r\n\r\n", bytes(range(256)) * 8, b"\x16\x03\x01\x02\x00"]
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        sockets = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(60)]
        for number, half_open in enumerate(sockets):
            half_open.sendall(openings[number % len(openings)])
        await serves_a_frame(stub)
        for half_open in sockets:
            half_open.close()
        await serves_a_frame(stub)
