"""Who gets a kept session back, for how long, and how many are kept."""

from __future__ import annotations

import asyncio
import hashlib
from pathlib import Path
from typing import Any

import grpc
import pytest
from cable_codecs import CodecParameters, EncodedFrame, create_encoder
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.cloud.limits import Identity
from cable_rpc.cloud.service import PerceptionServer
from cable_rpc.cloud.session_store import SessionState, SessionStore, StoreLimits
from cable_rpc.wire.v1 import perception_pb2 as pb

from .secure_server import serving
from .test_protocol import HEIGHT, WIDTH, coded, frame, hello, picture, read


def resuming(token: bytes, codec: Any = pb.CODEC_H264, **size: int) -> pb.StreamPerceptionRequest:
    request = hello(codec, **size)
    request.hello.resume_token = token
    return request


async def stream(stub: Any, request: pb.StreamPerceptionRequest, who: str = "") -> tuple[Any, pb.Welcome]:
    call = stub.StreamPerception(metadata=(("authorization", f"Bearer {who}"),) if who else ())
    await call.write(request)
    response = await read(call)
    assert response.WhichOneof("payload") == "welcome", response
    return call, response.welcome


async def answered(call: Any, request: pb.StreamPerceptionRequest) -> pb.StreamPerceptionResponse:
    await call.write(request)
    return await read(call)


async def kept_in(server: PerceptionServer) -> None:
    """Returns when the server has noticed that a stream has ended."""
    for _ in range(500):
        if len(server._service._store):
            return
        await asyncio.sleep(0.01)
    raise AssertionError("the session was not kept")


def packets(count: int) -> list[EncodedFrame]:
    """A keyframe and the pictures after it."""
    return coded("h264", count)


async def test_goodbye_keeps_a_session_and_its_decoder_goes_on(stub_for: Any) -> None:
    first, second, third = packets(3)
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call, welcome = await stream(stub, hello(pb.CODEC_H264))
        assert not welcome.resumed
        assert not welcome.HasField("decoded_sequence")
        assert len(welcome.resume_token) >= 16
        assert welcome.resume_window_s == 30
        assert (await answered(call, frame(0, first))).result.sequence == 0
        await call.write(frame(1, second, reference_sequence=0))
        await call.write(pb.StreamPerceptionRequest(goodbye=pb.Goodbye(keep_session=True)))
        await call.done_writing()
        while await read(call) is not grpc.aio.EOF:
            pass
        call, again = await stream(stub, resuming(welcome.resume_token))
        assert (again.resumed, again.decoded_sequence) == (True, 1)
        assert (again.session_id, again.resume_token) == (welcome.session_id, welcome.resume_token)
        assert (await answered(call, frame(2, third, reference_sequence=1))).result.sequence == 2
        call.cancel()


async def test_goodbye_ends_a_session(stub_for: Any) -> None:
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call, welcome = await stream(stub, hello(pb.CODEC_H264))
        await call.write(pb.StreamPerceptionRequest(goodbye=pb.Goodbye()))
        assert await read(call) is grpc.aio.EOF
        call, again = await stream(stub, resuming(welcome.resume_token))
        assert not again.resumed
        assert again.resume_token != welcome.resume_token
        call.cancel()


async def test_broken_rule_ends_a_session(stub_for: Any) -> None:
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call, welcome = await stream(stub, hello(pb.CODEC_H264))
        assert (await answered(call, hello(pb.CODEC_H264))).closing.action == pb.CLOSE_ACTION_STOP
        await call.done_writing()
        assert await read(call) is grpc.aio.EOF
        call, again = await stream(stub, resuming(welcome.resume_token))
        assert not again.resumed
        call.cancel()


async def test_what_was_damaged_or_is_coded_otherwise_begins_with_a_keyframe(stub_for: Any) -> None:
    first, second = packets(2)
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call, welcome = await stream(stub, hello(pb.CODEC_H264))
        await answered(call, frame(0, first))
        # What it refers to never came: the decoder is out of step from here on.
        assert (await answered(call, frame(2, second, reference_sequence=1))).HasField("frame_rejected")
        call, again = await stream(stub, resuming(welcome.resume_token))
        assert again.resumed
        assert not again.HasField("decoded_sequence")
        assert (await answered(call, frame(3, first))).result.sequence == 3
        call, other = await stream(stub, resuming(welcome.resume_token, width=WIDTH + 16))
        assert other.resumed
        assert not other.HasField("decoded_sequence")
        with create_encoder(CodecParameters("h264", WIDTH + 16, HEIGHT)) as encoder:
            wider = encoder.encode(picture(width=WIDTH + 16))
        assert (await answered(call, frame(4, wider))).result.mask.width == WIDTH + 16
        call.cancel()


async def test_token_of_an_open_stream_ends_that_stream(stub_for: Any) -> None:
    first, second = packets(2)
    async with serving() as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        old, welcome = await stream(stub, hello(pb.CODEC_H264))
        await answered(old, frame(0, first))
        new, again = await stream(stub, resuming(welcome.resume_token))
        assert (again.resumed, again.decoded_sequence) == (True, 0)
        assert await read(old) is grpc.aio.EOF
        assert (await answered(new, frame(1, second, reference_sequence=0))).result.sequence == 1
        assert server._service._admission.streams == 1
        new.cancel()


async def test_foreign_token_gets_nothing_and_takes_nothing(stub_for: Any, tmp_path: Path) -> None:
    first, second, third = packets(3)
    tokens = tmp_path / "tokens"
    tokens.write_text("".join(f"{name} {hashlib.sha256(name.encode()).hexdigest()}\n" for name in ("alice", "bob")))
    async with serving(tokens=tokens) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call, welcome = await stream(stub, hello(pb.CODEC_H264), "alice")
        await answered(call, frame(0, first))
        for kept in (False, True):
            if kept:
                call.cancel()
                await kept_in(server)
            foreign, again = await stream(stub, resuming(welcome.resume_token), "bob")
            assert not again.resumed
            assert not again.HasField("decoded_sequence")
            assert again.session_id != welcome.session_id
            assert again.resume_token != welcome.resume_token
            rejected = await answered(foreign, frame(1, second, reference_sequence=0))
            assert rejected.frame_rejected.reason == pb.REJECT_REASON_UNDECODABLE
            foreign.cancel()
            if not kept:
                assert (await answered(call, frame(1, second, reference_sequence=0))).result.sequence == 1
        call, own = await stream(stub, resuming(welcome.resume_token), "alice")
        assert (own.resumed, own.decoded_sequence) == (True, 1)
        assert (await answered(call, frame(2, third, reference_sequence=1))).result.sequence == 2
        call.cancel()


@pytest.mark.parametrize("window_s", [0.0, 0.05])
async def test_session_is_gone_after_its_window(stub_for: Any, window_s: float) -> None:
    async with (
        serving(resume=StoreLimits(window_s)) as server,
        stub_for(f"127.0.0.1:{server.port}") as stub,
    ):
        call, welcome = await stream(stub, hello(pb.CODEC_H264))
        assert bool(welcome.resume_token) == (window_s > 0)
        call.cancel()
        await asyncio.sleep(0.3)
        assert len(server._service._store) == 0
        call, again = await stream(stub, resuming(welcome.resume_token or b"x" * 24))
        assert not again.resumed
        call.cancel()


@settings(max_examples=40)
@given(
    arrivals=st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 40)), max_size=25),
    limits=st.builds(StoreLimits, st.just(60.0), st.integers(1, 6), st.integers(1, 4), st.integers(10, 120)),
)
async def test_store_stays_within_its_bounds_and_drops_the_oldest(
    arrivals: list[tuple[str, int]], limits: StoreLimits
) -> None:
    forgotten: list[str] = []
    store = SessionStore(limits, forgotten.append)
    tokens = {}
    expected: list[tuple[str, str, int]] = []
    for number, (name, pixels) in enumerate(arrivals):
        state = SessionState(str(number), pb.CodecConfig(width=pixels, height=1))
        tokens[str(number)] = token = b"%d" % number
        await store.leave(token, Identity(name), state, keep=True)
        if pixels > limits.pixels:
            continue
        own = [entry for entry in expected if entry[1] == name]
        if len(own) == limits.identity_sessions:
            expected.remove(own[0])
        while len(expected) == limits.sessions or sum(e[2] for e in expected) + pixels > limits.pixels:
            del expected[0]
        expected.append((str(number), name, pixels))
        assert len(store) <= limits.sessions
        assert store.pixels <= limits.pixels
    kept = {session for session, _, _ in expected}
    assert kept | set(forgotten) == set(tokens)
    assert not kept & set(forgotten)
    for session, name, _ in expected:
        assert store.take(tokens[session], Identity("mallory")) is None
        state = store.take(tokens[session], Identity(name))
        assert state is not None
        assert state.session_id == session
        assert store.take(tokens[session], Identity(name)) is None
    await store.close()


async def test_sessions_of_the_unknown_are_dropped() -> None:
    store = SessionStore(StoreLimits(), lambda _: None)
    for name in "ab":
        await store.leave(name.encode(), Identity(name), SessionState(name), keep=True)
    store.keep_only(lambda identity: identity.name == "b")
    assert store.take(b"a", Identity("a")) is None
    assert store.take(b"b", Identity("b")) is not None
    await store.close()
