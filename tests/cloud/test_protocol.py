"""The session rules R1-R7 of the wire contract, over real sockets, with a client that breaks them on purpose."""

from __future__ import annotations

import asyncio
from typing import Any

import grpc
import numpy as np
import pytest
from cable_codecs import CodecParameters, EncodedFrame, available_codecs, create_encoder, encode_mask
from google.rpc import code_pb2

from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import BrightBoxDetector, FailingSegmenter

WIDTH, HEIGHT = 96, 64


def picture(left: int = 30, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    image = np.full((height, width, 3), 40, np.uint8)
    image[20:40, left : left + 24] = 255
    return image


def coded(codec: str, count: int, width: int = WIDTH, height: int = HEIGHT) -> list[EncodedFrame]:
    with create_encoder(CodecParameters(codec, width, height)) as encoder:
        return [encoder.encode(picture(30 + i, width, height)) for i in range(count)]


def hello(codec: Any = pb.CODEC_JPEG, width: int = WIDTH, height: int = HEIGHT) -> pb.StreamPerceptionRequest:
    return pb.StreamPerceptionRequest(
        hello=pb.Hello(
            protocol_revision=1,
            codec_config=pb.CodecConfig(codec=codec, width=width, height=height, frame_rate=10),
        )
    )


def frame(sequence: int, packet: EncodedFrame, **fields: Any) -> pb.StreamPerceptionRequest:
    message = pb.VideoFrame(sequence=sequence, data=packet.data, keyframe=packet.keyframe, **fields)
    return pb.StreamPerceptionRequest(frame=message)


async def read(call: Any) -> pb.StreamPerceptionResponse:
    return await asyncio.wait_for(call.read(), 10)


async def opened(stub: Any, request: pb.StreamPerceptionRequest | None = None) -> Any:
    call = stub.StreamPerception()
    await call.write(request or hello())
    assert (await read(call)).WhichOneof("payload") == "welcome"
    return call


async def closing_of(stub: Any, *requests: pb.StreamPerceptionRequest) -> pb.Closing:
    """Sends everything, reads to Closing, half-closes and checks that the call then ends with OK."""
    call = stub.StreamPerception()
    for request in requests:
        await call.write(request)
    while (response := await read(call)) is not grpc.aio.EOF:
        if response.WhichOneof("payload") == "closing":
            await call.done_writing()
            assert await read(call) is grpc.aio.EOF
            assert await call.code() == grpc.StatusCode.OK
            return response.closing
    raise AssertionError("the stream ended without Closing")


async def serves_a_frame(stub: Any) -> None:
    call = await opened(stub)
    await call.write(frame(0, coded("jpeg", 1)[0]))
    result = (await read(call)).result
    assert len(result.detections) == 1
    await call.done_writing()
    assert await read(call) is grpc.aio.EOF


async def test_a_frame_is_decoded_detected_and_masked(running_server: Any, stub_for: Any) -> None:
    async with running_server() as target, stub_for(target) as stub:
        call = await opened(stub)
        await call.write(frame(5, coded("jpeg", 1)[0]))
        result = (await read(call)).result
        assert result.sequence == 5
        box = result.detections[0]
        assert (box.x_min, box.y_min, box.x_max, box.y_max) == pytest.approx((30, 20, 54, 40), abs=2)
        assert (result.mask.width, result.mask.height) == (WIDTH, HEIGHT)
        assert result.timing.send_time_ns >= result.timing.receive_time_ns > 0
        assert [stage.stage for stage in result.timing.stages] == ["detect", "segment"]
        call.cancel()


async def test_the_region_is_applied_again_after_decoding(running_server: Any, stub_for: Any) -> None:
    """The bright square straddles the region's edge; only its part inside may be seen."""
    blocks = np.zeros((HEIGHT // 8, WIDTH // 8), np.bool_)
    blocks[:, :5] = True
    region = pb.Region(block_size=8, columns=WIDTH // 8, rows=HEIGHT // 8, data=encode_mask(blocks))
    async with running_server() as target, stub_for(target) as stub:
        call = await opened(stub)
        await call.write(frame(0, coded("jpeg", 1)[0], region=region))
        assert (await read(call)).result.detections[0].x_max == 40
        call.cancel()


@pytest.mark.parametrize(
    ("requests", "code", "said"),
    [
        ([frame(0, EncodedFrame(b"x", True, 0))], code_pb2.FAILED_PRECONDITION, "first message must be Hello"),
        ([pb.StreamPerceptionRequest()], code_pb2.FAILED_PRECONDITION, "first message must be Hello"),
        ([hello(codec=999)], code_pb2.FAILED_PRECONDITION, "does not decode; use one of h264, hevc, av1, vp9, jpeg"),
        ([hello(width=0)], code_pb2.FAILED_PRECONDITION, "0x64"),
        ([hello(width=60_000, height=60_000)], code_pb2.FAILED_PRECONDITION, "lower resolution"),
        ([hello(), hello()], code_pb2.FAILED_PRECONDITION, "unexpected message"),
        (
            [pb.StreamPerceptionRequest(hello=pb.Hello(protocol_revision=7))],
            code_pb2.FAILED_PRECONDITION,
            "protocol revision 7",
        ),
    ],
    ids=["frame-first", "empty", "codec-999", "size-0", "size-huge", "hello-twice", "revision"],
)
async def test_a_broken_rule_closes_that_stream_in_band(
    running_server: Any, stub_for: Any, requests: list[pb.StreamPerceptionRequest], code: int, said: str
) -> None:
    async with running_server() as target, stub_for(target) as stub, stub_for(target) as other:
        bystander = await opened(other)
        closing = await closing_of(stub, *requests)
        assert closing.status.code == code
        assert said in closing.status.message
        assert closing.action == pb.CLOSE_ACTION_STOP
        await bystander.write(frame(0, coded("jpeg", 1)[0]))
        assert (await read(bystander)).result.sequence == 0
        bystander.cancel()


async def test_sequence_must_rise(running_server: Any, stub_for: Any) -> None:
    packet = coded("jpeg", 1)[0]
    async with running_server() as target, stub_for(target) as stub:
        closing = await closing_of(stub, hello(), frame(4, packet), frame(4, packet))
        assert "sequence must rise: 4 came after 4" in closing.status.message


class SlowDetector(BrightBoxDetector):
    def one(self, image: np.ndarray) -> Any:
        import time

        time.sleep(0.3)
        return super().one(image)


async def test_frames_over_the_credit_end_the_session_after_the_pending_answers(
    running_server: Any, stub_for: Any
) -> None:
    packets = coded("jpeg", 3)
    async with running_server(detector=SlowDetector()) as target, stub_for(target) as stub:
        call = await opened(stub)
        for sequence, packet in enumerate(packets):
            await call.write(frame(sequence, packet))
        assert (await read(call)).result.sequence == 0
        assert (await read(call)).result.sequence == 1
        closing = (await read(call)).closing
        assert "credit of 2" in closing.status.message
        await call.done_writing()
        assert await read(call) is grpc.aio.EOF


async def test_wider_credit_lets_newer_frames_overtake_and_keeps_the_order(running_server: Any, stub_for: Any) -> None:
    limits = SessionLimits(max_in_flight=4, close_timeout_s=1.0)
    async with running_server(detector=SlowDetector(), limits=limits) as target, stub_for(target) as stub:
        call = await opened(stub)
        for sequence, packet in enumerate(coded("jpeg", 4)):
            await call.write(frame(sequence, packet))
        answers = [await read(call) for _ in range(4)]
        kinds = [answer.WhichOneof("payload") for answer in answers]
        sequences = [getattr(answer, kind).sequence for answer, kind in zip(answers, kinds, strict=True)]
        assert sequences == [0, 1, 2, 3]
        assert kinds[0] == kinds[3] == "result"
        assert "frame_rejected" in kinds
        rejected = next(answer.frame_rejected for answer in answers if answer.WhichOneof("payload") == "frame_rejected")
        assert rejected.reason == pb.REJECT_REASON_SUPERSEDED
        call.cancel()


@pytest.mark.parametrize("codec", ["jpeg", "webp", "h264"])
async def test_damaged_bitstreams_fail_their_frame_only(running_server: Any, stub_for: Any, codec: str) -> None:
    number = {"jpeg": pb.CODEC_JPEG, "webp": pb.CODEC_WEBP, "h264": pb.CODEC_H264}[codec]
    good = coded(codec, 1)[0]
    foreign = coded(codec, 1, width=64, height=48)[0]
    damaged = {
        "truncated": good.data[: len(good.data) // 2],
        "empty": b"",
        "garbage": bytes(range(256)),
        "wrong size": foreign.data,
    }
    async with running_server() as target, stub_for(target) as stub, stub_for(target) as other:
        call = await opened(stub, hello(number))
        sequence = 0
        for name, data in damaged.items():
            await call.write(frame(sequence, EncodedFrame(data, True, 0)))
            answer = await read(call)
            while answer.WhichOneof("payload") == "keyframe_request":
                answer = await read(call)
            rejected = answer.frame_rejected
            assert rejected.reason == pb.REJECT_REASON_UNDECODABLE, (name, answer)
            assert f"frame {sequence} can't be decoded" in rejected.message
            sequence += 1
        await call.write(frame(sequence, good))
        answer = await read(call)
        while answer.WhichOneof("payload") == "keyframe_request":
            answer = await read(call)
        assert answer.result.sequence == sequence
        await serves_a_frame(other)
        call.cancel()


async def test_a_lost_video_frame_brings_one_keyframe_request(running_server: Any, stub_for: Any) -> None:
    packets = coded("h264", 5)
    async with running_server() as target, stub_for(target) as stub:
        call = await opened(stub, hello(pb.CODEC_H264))
        await call.write(frame(0, packets[0]))
        assert (await read(call)).result.sequence == 0
        await call.write(frame(2, packets[2], reference_sequence=1))
        assert (await read(call)).frame_rejected.reason == pb.REJECT_REASON_UNDECODABLE
        assert (await read(call)).keyframe_request.last_good_sequence == 0
        await call.write(frame(3, packets[3], reference_sequence=2))
        assert (await read(call)).frame_rejected.sequence == 3
        idr = coded("h264", 1)[0]
        await call.write(frame(4, idr))
        assert (await read(call)).result.sequence == 4
        call.cancel()


async def test_region_that_does_not_fit_is_rejected(running_server: Any, stub_for: Any) -> None:
    region = pb.Region(block_size=8, columns=3, rows=3, data=b"\x01")
    async with running_server() as target, stub_for(target) as stub:
        call = await opened(stub)
        await call.write(frame(0, coded("jpeg", 1)[0], region=region))
        rejected = (await read(call)).frame_rejected
        assert rejected.reason == pb.REJECT_REASON_INVALID_REGION
        assert "3x3 blocks" in rejected.message
        call.cancel()


async def test_frame_over_the_frame_limit_is_rejected(running_server: Any, stub_for: Any) -> None:
    limits = SessionLimits(max_frame_bytes=2000, close_timeout_s=1.0)
    async with running_server(limits=limits) as target, stub_for(target) as stub:
        call = await opened(stub)
        await call.write(frame(0, EncodedFrame(bytes(2001), True, 0)))
        rejected = (await read(call)).frame_rejected
        assert rejected.reason == pb.REJECT_REASON_TOO_LARGE
        assert "2001 bytes, the limit is 2000" in rejected.message
        call.cancel()


async def test_message_over_the_transport_limit_ends_that_stream_with_a_status(
    running_server: Any, stub_for: Any
) -> None:
    async with running_server() as target, stub_for(target) as stub, stub_for(target) as other:
        call = await opened(stub)
        await call.write(frame(0, EncodedFrame(bytes(17 << 20), True, 0)))
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await read(call)
        assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        await serves_a_frame(other)


async def test_a_failing_model_fails_that_frame_and_tells_no_secrets(running_server: Any, stub_for: Any) -> None:
    packets = coded("jpeg", 3)
    async with running_server(segmenter=FailingSegmenter()) as target, stub_for(target) as stub:
        call = await opened(stub)
        for sequence, packet in enumerate(packets):
            await call.write(frame(sequence, packet))
            answer = await read(call)
            if sequence % 2:
                assert answer.frame_rejected.reason == pb.REJECT_REASON_MODEL_FAILED
                assert "secret" not in answer.frame_rejected.message
            else:
                assert answer.result.sequence == sequence
        call.cancel()


async def test_deadline_rejects_a_frame_that_waited_too_long(running_server: Any, stub_for: Any) -> None:
    packets = coded("jpeg", 2)
    async with running_server(detector=SlowDetector()) as target, stub_for(target) as stub:
        call = await opened(stub)
        await call.write(frame(0, packets[0]))
        await call.write(frame(1, packets[1], deadline_ns=1_000_000))
        assert (await read(call)).result.sequence == 0
        rejected = (await read(call)).frame_rejected
        assert (rejected.sequence, rejected.reason) == (1, pb.REJECT_REASON_DEADLINE)
        call.cancel()


async def test_silence_is_broken_by_heartbeats(running_server: Any, stub_for: Any) -> None:
    limits = SessionLimits(heartbeat_s=0.05, close_timeout_s=1.0)
    async with running_server(limits=limits) as target, stub_for(target) as stub:
        call = await opened(stub)
        assert (await read(call)).flow_update.max_in_flight == 2
        assert (await read(call)).WhichOneof("payload") == "flow_update"
        call.cancel()


async def test_clients_that_vanish_mid_frame_leave_the_server_whole(running_server: Any, stub_for: Any) -> None:
    """Each cancels while its frame is being decoded or perceived."""
    packet = coded("h264", 1, 640, 480)[0]
    async with running_server() as target, stub_for(target) as stub:
        for wait_s in (0.0, 0.001, 0.003, 0.01) * 5:
            call = await opened(stub, hello(pb.CODEC_H264, 640, 480))
            await call.write(frame(0, packet))
            await asyncio.sleep(wait_s)
            call.cancel()
        await serves_a_frame(stub)


async def test_client_that_says_nothing_is_sent_away(running_server: Any, stub_for: Any) -> None:
    limits = SessionLimits(hello_timeout_s=0.1, close_timeout_s=1.0)
    async with running_server(limits=limits) as target, stub_for(target) as stub:
        closing = await closing_of(stub)
        assert "no Hello within 0.1 s" in closing.status.message


async def test_shutdown_answers_what_is_in_flight_and_says_goodbye(running_server: Any, stub_for: Any) -> None:
    context = running_server(detector=SlowDetector())
    target = await context.__aenter__()
    async with stub_for(target) as stub:
        call = await opened(stub)
        await call.write(frame(0, coded("jpeg", 1)[0]))
        await asyncio.sleep(0.1)
        stopping = asyncio.create_task(context.__aexit__(None, None, None))
        assert (await read(call)).result.sequence == 0
        closing = (await read(call)).closing
        assert closing.action == pb.CLOSE_ACTION_RESUME
        assert closing.status.code == code_pb2.UNAVAILABLE
        await call.done_writing()
        await asyncio.wait_for(stopping, 10)


async def test_server_info_and_clock(running_server: Any, stub_for: Any) -> None:
    async with running_server() as target, stub_for(target) as stub:
        info = await stub.GetServerInfo(pb.GetServerInfoRequest())
        assert [model.name for model in info.models] == ["bright", "boxes"]
        assert {pb.CODEC_JPEG, pb.CODEC_WEBP, pb.CODEC_WEBP_LOSSLESS} <= set(info.codecs)
        assert (pb.CODEC_H264 in info.codecs) == ("h264" in available_codecs())
        sample = await stub.SyncClock(pb.SyncClockRequest(client_send_time_ns=7))
        assert sample.client_send_time_ns == 7
        assert sample.server_send_time_ns >= sample.server_receive_time_ns > 0
