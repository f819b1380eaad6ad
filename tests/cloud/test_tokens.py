"""Bearer tokens: the file, its changes, and calls over real sockets."""

from __future__ import annotations

import asyncio
import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import grpc
import pytest
from google.rpc import code_pb2
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.limits import IdentityLimits
from cable_rpc.cloud.tokens import parse_access_list
from cable_rpc.edge.channel import TOKEN_VARIABLE, ClientSecurity, SecureTarget, read_token
from cable_rpc.errors import ConfigurationError, RemoteError
from cable_rpc.wire.v1 import perception_pb2 as pb

from .secure_server import client, one_frame, serving
from .test_protocol import hello


def line(name: str, token: str, *limits: str) -> str:
    return " ".join([name, hashlib.sha256(token.encode()).hexdigest(), *limits]) + "\n"


def bringing(token: str) -> ClientSecurity:
    return ClientSecurity(token=token)


def bearer(token: str) -> tuple[tuple[str, str], ...]:
    return (("authorization", f"Bearer {token}"),)


@pytest.fixture
def tokens(tmp_path: Path) -> Path:
    path = tmp_path / "tokens"
    path.write_text(
        "# who may come\n\n" + line("car-7", "good", "streams=2", "bytes_per_s=2e6") + line("car-8", "eight")
    )
    return path


def test_list_is_read(tokens: Path) -> None:
    access = parse_access_list(tokens.read_text() + "pole-1 certificate\n", "tokens")
    assert sorted(access.identities) == ["car-7", "car-8", "pole-1"]
    seven = access.of_token("good")
    assert seven is not None
    assert (seven.name, seven.limits) == ("car-7", IdentityLimits(streams=2, bytes_per_s=2e6))
    for bad in ("", "goo", "good ", "GOOD", "x" * 5000, "\udcff"):
        assert access.of_token(bad) is None
    assert access.of_subject("car-7") is None
    pole = access.of_subject("pole-1")
    assert pole is not None
    assert pole.limits is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "names nobody"),
        ("car-7", "line 1: write NAME SHA256_OF_TOKEN"),
        ("\n\ncar;7 certificate", "line 3: write NAME"),
        ("car-7 good", r"line 1: the second word must be the SHA-256 .* sha256sum"),
        (line("car-7", "a", "speed=3"), "'speed=3' is no limit; use streams=N, frames_per_s=N"),
        (line("car-7", "a", "streams=many"), "needs a number, e.g. streams=30"),
        (line("car-7", "a", "streams=0"), "limit streams is 0; it must be positive"),
        (line("car-7", "a", "streams=nan"), "must be positive"),
        (line("car-7", "a") + line("car-8", "a"), "line 2: car-8 has the token of somebody further up"),
        (line("car-7", "a") + line("car-7", "b", "streams=2"), "line 2: car-7 has other limits further up"),
    ],
)
def test_wrong_lines_are_named(text: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        parse_access_list(text, "tokens")


@given(st.text(max_size=200))
def test_any_text_is_a_list_or_an_error(text: str) -> None:
    with suppress(ConfigurationError):
        parse_access_list(text, "tokens")


async def test_only_known_tokens_come_in(tokens: Path) -> None:
    async with serving(tokens=tokens) as server:
        target = f"127.0.0.1:{server.port}"
        async with client(target, security=bringing("good")) as session:
            assert (await one_frame(session)).rejection is None
            (hosted,) = server._service._sessions
            assert hosted.identity.name == "car-7"
        for security, said in (
            (bringing("bad"), "not known here"),
            (ClientSecurity(), "a token is needed"),
        ):
            with pytest.raises(RemoteError, match=f"does not let us in: .*{said}"):
                async with client(target, security=security):
                    pass
        assert not server._service._sessions


async def test_every_method_but_health_is_guarded(tokens: Path) -> None:
    async with serving(tokens=tokens) as server, grpc.aio.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        service = "/cable.v1.PerceptionService/"
        for method in ("GetServerInfo", "SyncClock"):
            for metadata in (
                (),
                bearer("bad"),
                (("authorization", "Basic Z29vZA=="),),
                bearer("good") + bearer("good"),
            ):
                with pytest.raises(grpc.aio.AioRpcError) as caught:
                    await channel.unary_unary(service + method)(b"", metadata=metadata)
                assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED
            await channel.unary_unary(service + method)(b"", metadata=bearer("good"))
        await channel.unary_unary("/grpc.health.v1.Health/Check")(b"")


async def test_a_stream_without_a_token_ends_before_any_session(tokens: Path, stub_for: Any) -> None:
    async with serving(tokens=tokens) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        for _ in range(20):
            call = stub.StreamPerception()
            await call.write(hello())
            with pytest.raises(grpc.aio.AioRpcError) as caught:
                await asyncio.wait_for(call.read(), 10)
                raise AssertionError("it was answered")
            assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED
            assert not server._service._sessions


async def test_changes_of_the_file_take_hold(tokens: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with serving(tokens=tokens, access_check_s=0.02) as server:
        target = f"127.0.0.1:{server.port}"
        seven, eight = (client(target, security=bringing(token)) for token in ("good", "eight"))
        async with seven, eight:
            tokens.write_text("nonsense")
            await asyncio.sleep(0.2)
            assert "the old one stays" in caplog.text
            assert (await one_frame(seven)).rejection is None
            tokens.write_text(line("car-8", "eight", "frames_per_s=100") + line("car-9", "nine"))
            with pytest.raises(RemoteError, match="UNAUTHENTICATED: the token is not known here any more"):
                async for _ in seven.answers():
                    pass
            assert (await one_frame(eight)).rejection is None
        async with client(target, security=bringing("nine")) as session:
            await one_frame(session)
        os.unlink(tokens)
        await asyncio.sleep(0.1)
        async with client(target, security=bringing("nine")) as session:
            await one_frame(session)


def test_token_never_travels_in_plain_text_beyond_this_machine() -> None:
    security = bringing("good")
    for target in ("gpu-box:50051", "grpc://192.0.2.7:1", "[2001:db8::1]:1"):
        with pytest.raises(ConfigurationError, match="plain text, where anybody on the way can take it"):
            SecureTarget(target, security)
    for target in ("127.0.0.1:1", "localhost:1", "[::1]:1", "grpcs://gpu-box:1"):
        assert SecureTarget(target, security).metadata == (("authorization", "Bearer good"),)
    assert "good" not in repr(security)


def test_token_comes_from_a_file_or_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    assert read_token(None) == ""
    monkeypatch.setenv(TOKEN_VARIABLE, "from-environment")
    assert read_token(None) == "from-environment"
    path = tmp_path / "token"
    path.write_text("from-file\n")
    assert read_token(path) == "from-file"
    for text in ("", "two words", "line\nline", "tökén", "x" * 5000):
        path.write_text(text)
        with pytest.raises(ConfigurationError, match="must hold one token"):
            read_token(path)
    with pytest.raises(ConfigurationError, match=r"--token-file .* can't be read"):
        read_token(tmp_path / "absent")


async def test_closing_of_a_revoked_stream_travels_in_band(tokens: Path, stub_for: Any) -> None:
    async with serving(tokens=tokens, access_check_s=0.02) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call = stub.StreamPerception(metadata=bearer("good"))
        await call.write(hello())
        assert (await call.read()).WhichOneof("payload") == "welcome"
        tokens.write_text(line("car-8", "eight"))
        closing = (await asyncio.wait_for(call.read(), 10)).closing
        assert (closing.status.code, closing.action) == (code_pb2.UNAUTHENTICATED, pb.CLOSE_ACTION_STOP)
        await call.done_writing()
        assert await call.read() is grpc.aio.EOF
        assert await call.code() == grpc.StatusCode.OK
