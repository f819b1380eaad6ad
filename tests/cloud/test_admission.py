"""Shares of identities and of the server: by arithmetic on a clock of our own, and over real sockets."""

from __future__ import annotations

import asyncio
import hashlib
import time
from pathlib import Path
from typing import Any

import grpc
import pytest
from google.rpc import code_pb2
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.admission import BURST_S, LONGEST_WAIT_S, AdmissionControl, TokenBucket
from cable_rpc.cloud.limits import Identity, IdentityLimits, ServerLimits
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.edge.channel import ClientSecurity
from cable_rpc.errors import CapacityError, ProtocolError, Refusal, RemoteError
from cable_rpc.wire.convert import retry_after_s
from cable_rpc.wire.v1 import perception_pb2 as pb

from .secure_server import LIMITS, client, one_frame, serving
from .test_protocol import HEIGHT, WIDTH, closing_of, coded, frame, hello, opened, read


class HandClock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@given(
    rate=st.floats(0.5, 1e6),
    steps=st.lists(st.tuples(st.floats(0, 5), st.floats(0, 10)), max_size=40),
)
def test_bucket_never_lets_more_through_than_rate_and_reserve(rate: float, steps: list[tuple[float, float]]) -> None:
    """Whoever waits as told has sent, at any time, at most the reserve and the rate since the beginning."""
    clock = HandClock()
    bucket = TokenBucket(rate, clock)
    began_s, sent = clock.now_s, 0.0
    for pause_s, amount_s in steps:
        clock.now_s += pause_s
        clock.now_s += bucket.take(amount_s * rate)
        sent += amount_s * rate
        assert sent <= rate * (BURST_S + clock.now_s - began_s) * (1 + 1e-9) + 1e-6


def test_streams_are_counted_by_identity_and_for_the_server() -> None:
    control = AdmissionControl(ServerLimits(streams=3, identity=IdentityLimits(streams=2)), HandClock())
    first, second = control.open_stream(Identity("a")), control.open_stream(Identity("a"))
    with pytest.raises(CapacityError, match="a has all of its 2 streams in use"):
        control.open_stream(Identity("a"))
    third = control.open_stream(Identity("b"))
    with pytest.raises(CapacityError, match="the server has all of its 3 streams"):
        control.open_stream(Identity("c"))
    first.release()
    first.release()
    control.open_stream(Identity("a", IdentityLimits(streams=2)))
    for share in (second, third):
        share.release()
    assert control.streams == 1


def test_announced_pixels_are_shared_out_and_given_back() -> None:
    control = AdmissionControl(ServerLimits(pixels_per_s=3000, identity=IdentityLimits(pixels_per_s=2000)), HandClock())
    first = control.open_stream(Identity("a"))
    first.announce(10, 10, 15)
    second = control.open_stream(Identity("a"))
    with pytest.raises(CapacityError, match=r"a has 0\.0 of 0\.0 left"):
        second.announce(10, 10, 6)
    second.announce(10, 10, 5)
    third = control.open_stream(Identity("b"))
    with pytest.raises(CapacityError, match="the server has"):
        third.announce(10, 10, 11)
    first.announce(10, 10, 14)
    third.announce(10, 10, 11)
    for share in (first, second, third):
        share.release()
    assert control.announced_pixels_per_s == pytest.approx(0)
    for rate in (float("nan"), float("inf"), -1.0, 1e9):
        with pytest.raises(ProtocolError, match="frame_rate"):
            control.open_stream(Identity("a")).announce(10, 10, rate)


def test_a_faster_stream_than_announced_waits_where_the_server_shares_pixels_out() -> None:
    clock = HandClock()
    control = AdmissionControl(ServerLimits(pixels_per_s=1e6), clock)
    share = control.open_stream()
    share.announce(10, 10, 10)
    waits = [share.take_frame(1000) for _ in range(30)]
    # 12.5 frames a second, two seconds of them in reserve.
    assert waits[:25] == [0.0] * 25
    assert waits[25:] == pytest.approx([n / 12.5 for n in range(1, 6)])
    free = AdmissionControl(ServerLimits(), clock).open_stream()
    free.announce(10, 10, 10)
    assert not any(free.take_frame(1 << 30) for _ in range(1000))


def test_reconnecting_does_not_renew_the_reserve() -> None:
    clock = HandClock()
    control = AdmissionControl(ServerLimits(identity=IdentityLimits(frames_per_s=10)), clock)
    for _ in range(2):
        share = control.open_stream(Identity("a"))
        assert [share.take_frame(1) for _ in range(10)] == [0.0] * 10
        share.release()
    share = control.open_stream(Identity("a"))
    assert share.take_frame(1) == pytest.approx(0.1)
    share.release()
    clock.now_s += 60
    control.open_stream(Identity("b"))
    assert list(control._accounts) == ["b"]


def test_new_limits_hold_for_open_streams() -> None:
    control = AdmissionControl(ServerLimits(), HandClock())
    share = control.open_stream(Identity("a", IdentityLimits(streams=5)))
    again = control.open_stream(Identity("a", IdentityLimits(streams=5, frames_per_s=1)))
    assert share.frame_rate_advice == 1
    share.release()
    again.release()
    assert control.open_stream(Identity("a")).account.streams == 1


def test_far_too_much_ends_the_stream() -> None:
    control = AdmissionControl(ServerLimits(identity=IdentityLimits(bytes_per_s=1000)), HandClock())
    share = control.open_stream(Identity("a"))
    with pytest.raises(CapacityError, match="ahead of its bytes per second") as caught:
        share.take_frame(int(1000 * (BURST_S + LONGEST_WAIT_S)) + 100)
    assert caught.value.retry_after_s == pytest.approx(LONGEST_WAIT_S + 0.1)


async def test_full_server_says_so_in_band_and_when_to_come_back(stub_for: Any) -> None:
    async with (
        serving(shares=ServerLimits(streams=1)) as server,
        stub_for(f"127.0.0.1:{server.port}") as stub,
        client(f"127.0.0.1:{server.port}") as session,
    ):
        closing = await closing_of(stub, hello())
        assert (closing.status.code, closing.action) == (code_pb2.RESOURCE_EXHAUSTED, pb.CLOSE_ACTION_RESUME)
        assert retry_after_s(closing.status) == 5.0
        with pytest.raises(RemoteError, match=r"RESOURCE_EXHAUSTED: the server has all of its 1 streams.*again in 5 s"):
            async with client(f"127.0.0.1:{server.port}"):
                pass
        assert (await one_frame(session)).rejection is None


async def test_many_more_calls_than_places_are_refused_by_the_transport(stub_for: Any) -> None:
    """Refused streams that do not half-close hold no more than the spare places."""
    async with (
        serving(shares=ServerLimits(streams=2), limits=SessionLimits(close_timeout_s=30)) as server,
        stub_for(f"127.0.0.1:{server.port}") as stub,
    ):
        calls = [stub.StreamPerception() for _ in range(40)]
        codes = []
        for call in calls:
            try:
                await call.write(hello())
                codes.append((await read(call)).WhichOneof("payload"))
            except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
                codes.append(await call.code())
        assert codes.count("welcome") == 2
        assert codes.count("closing") == 16
        refused = [code for code in codes if isinstance(code, grpc.StatusCode)]
        assert len(refused) == 22
        # A call that is refused while the client writes can report INTERNAL in place of its status (grpc #36066).
        assert set(refused) <= {grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.INTERNAL}
        assert grpc.StatusCode.RESOURCE_EXHAUSTED in refused
        assert len(server._service._sessions) == 18
        for call in calls:
            call.cancel()


async def test_place_is_free_again_when_a_client_has_gone(stub_for: Any) -> None:
    async with serving(shares=ServerLimits(streams=1)) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        for _ in range(5):
            call = await opened(stub)
            call.cancel()
            await asyncio.wait_for(server._service._idle.wait(), 5)
        assert server._service._admission.streams == 0


async def test_shares_of_a_token_hold_over_the_socket(tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    digests = {name: hashlib.sha256(name.encode()).hexdigest() for name in ("a", "b", "c")}
    pixels = WIDTH * HEIGHT * 10
    tokens.write_text(
        f"a {digests['a']} streams=1 frames_per_s=20\nb {digests['b']} pixels_per_s={pixels}\n"
        f"c {digests['c']} bytes_per_s=10\n"
    )
    async with serving(tokens=tokens) as server:
        target = f"127.0.0.1:{server.port}"
        a, b, c = (ClientSecurity(token=name) for name in "abc")
        async with client(target, security=a) as session:
            with pytest.raises(RemoteError, match="a has all of its 1 streams"):
                async with client(target, security=a):
                    pass
            started_s = time.monotonic()
            for sequence in range(50):
                assert (await one_frame(session, sequence)).rejection is None
            # 40 are in reserve, ten more take half a second.
            assert time.monotonic() - started_s >= 0.4
        async with client(target, security=b):
            with pytest.raises(RemoteError, match="Mpixel/s, and b has"):
                async with client(target, security=b, frame_rate=1):
                    pass
        with pytest.raises(RemoteError, match=r"RESOURCE_EXHAUSTED: c is .* s ahead of its bytes per second"):
            async with client(target, security=c) as session:
                await one_frame(session)


async def test_shutdown_lets_nobody_in_and_names_the_other_server(stub_for: Any) -> None:
    context = serving(alternative_target="other:1")
    server = await context.__aenter__()
    async with stub_for(f"127.0.0.1:{server.port}") as stub, stub_for(f"127.0.0.1:{server.port}") as late:
        await late.GetServerInfo(pb.GetServerInfoRequest())
        call = await opened(stub)
        started_s = time.monotonic()
        stopping = asyncio.create_task(context.__aexit__(None, None, None))
        closing = (await read(call)).closing
        assert (closing.action, closing.alternative_target) == (pb.CLOSE_ACTION_MOVE, "other:1")
        refused = late.StreamPerception()
        await refused.write(hello())
        answer = (await read(refused)).closing
        assert answer.status.code == code_pb2.UNAVAILABLE
        assert "shutting down" in answer.status.message
        # Neither half-closes: the end comes all the same.
        await stopping
        assert time.monotonic() - started_s < 10


async def test_heartbeats_stop_after_closing_and_the_silent_are_sent_away(stub_for: Any) -> None:
    limits = SessionLimits(heartbeat_s=0.05, idle_timeout_s=0.3, close_timeout_s=0.3)
    async with serving(limits=limits) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call = await opened(stub)
        kinds = []
        while (response := await read(call)) is not grpc.aio.EOF:
            kinds.append(response.WhichOneof("payload"))
        assert kinds[-1] == "closing"
        assert set(kinds[:-1]) == {"flow_update"}
        assert not server._service._sessions


async def test_working_client_is_not_called_silent(stub_for: Any) -> None:
    """A model that takes longer than the idle time: the client has nothing to say meanwhile."""

    class Slow:
        name, revision, device = "slow", "1", "cpu"

        def detect(self, images: Any) -> Any:
            from cable_rpc.types import Detections

            time.sleep(0.4)
            return [Detections.empty() for _ in images]

    limits = SessionLimits(heartbeat_s=0.05, idle_timeout_s=0.2, close_timeout_s=0.3)
    async with serving(detector=Slow(), limits=limits) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call = await opened(stub)
        await call.write(frame(0, coded("jpeg", 1)[0]))
        kinds = [(await read(call)).WhichOneof("payload")]
        while kinds[-1] == "flow_update":
            kinds.append((await read(call)).WhichOneof("payload"))
        assert kinds[-1] == "result"
        call.cancel()


def test_closed_control_refuses() -> None:
    control = AdmissionControl()
    control.close(Refusal("going", 3.0))
    with pytest.raises(Refusal, match="going"):
        control.open_stream()
    assert LIMITS.idle_timeout_s == 300
