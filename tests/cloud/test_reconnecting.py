"""How the edge takes what a server says: when it comes back, when it does not, and limits that change."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import grpc
import pytest
from google.rpc import code_pb2, error_details_pb2, status_pb2
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.edge import backoff, client, credit, resuming_client
from cable_rpc.edge.backoff import Backoff
from cable_rpc.edge.channel import ClientSecurity
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.edge.credit import FramePacer
from cable_rpc.edge.resuming_client import ResumingClient
from cable_rpc.errors import ConnectionLost, RemoteError
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

REQUEST = SessionRequest("jpeg", 32, 32, 10.0)
Script = Callable[[int, Any, Any], Any]


def welcome(window: int = 1, **fields: Any) -> pb.StreamPerceptionResponse:
    flow = pb.FlowUpdate(max_in_flight=window, max_frame_bytes=1000)
    return pb.StreamPerceptionResponse(
        welcome=pb.Welcome(protocol_revision=1, flow=flow, resume_token=b"token", **fields)
    )


def result(sequence: int) -> pb.StreamPerceptionResponse:
    return pb.StreamPerceptionResponse(result=pb.Result(sequence=sequence))


def closing(
    code: int, action: pb.CloseAction, retry_s: float = 0.0, elsewhere: str = ""
) -> pb.StreamPerceptionResponse:
    status = status_pb2.Status(code=code, message="so it is")
    if retry_s:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromNanoseconds(round(retry_s * 1e9))
        status.details.add().Pack(retry)
    return pb.StreamPerceptionResponse(closing=pb.Closing(status=status, action=action, alternative_target=elsewhere))


class ScriptedService(pb_grpc.PerceptionServiceServicer):
    """Plays a script; it gets the number of the stream, its call and its context."""

    def __init__(self, script: Script) -> None:
        self.script = script
        self.hellos: list[pb.Hello] = []

    async def StreamPerception(self, requests: Any, context: Any) -> None:
        self.hellos.append((await anext(requests)).hello)
        await self.script(len(self.hellos), requests, context)

    async def GetServerInfo(self, request: Any, context: Any) -> pb.GetServerInfoResponse:
        return pb.GetServerInfoResponse(protocol_revision=1)

    async def SyncClock(self, request: Any, context: Any) -> pb.SyncClockResponse:
        return pb.SyncClockResponse(client_send_time_ns=request.client_send_time_ns)


@asynccontextmanager
async def scripted(script: Script) -> AsyncIterator[tuple[str, ScriptedService]]:
    service = ScriptedService(script)
    server = grpc.aio.server()
    pb_grpc.add_PerceptionServiceServicer_to_server(service, server)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        yield f"127.0.0.1:{port}", service
    finally:
        await server.stop(0)


async def answer_all(requests: Any, context: Any) -> None:
    async for request in requests:
        if request.WhichOneof("payload") == "frame":
            await context.write(result(request.frame.sequence))


async def send(session: ResumingClient | PerceptionClient, sequence: int) -> None:
    await asyncio.wait_for(session.acquire_credit(), 5)
    await session.send(pb.VideoFrame(sequence=sequence, data=b"x", keyframe=True))


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "FIRST_S", 0.02)


@pytest.mark.parametrize(
    "code",
    [
        grpc.StatusCode.UNAVAILABLE,
        grpc.StatusCode.INTERNAL,
        grpc.StatusCode.UNKNOWN,
        grpc.StatusCode.CANCELLED,
        "end",
        "resume",
        "nothing",
    ],
    ids=str,
)
async def test_comes_back_after(code: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two frames are unanswered when the stream ends; the next stream answers the third."""
    monkeypatch.setattr(client, "WELCOME_TIMEOUT_S", 0.2)

    async def play(number: int, requests: Any, context: Any) -> None:
        if number == 1:
            await context.write(welcome(3))
            await context.write(result((await anext(requests)).frame.sequence))
            for _ in range(2):
                await anext(requests)
            if code == "resume":
                await context.write(closing(code_pb2.UNAVAILABLE, pb.CLOSE_ACTION_RESUME))
                await anext(requests, None)
            elif isinstance(code, grpc.StatusCode):
                await context.abort(code, "gone")
        elif number == 2 and code == "nothing":
            await asyncio.sleep(1)
        else:
            await context.write(welcome(3, resumed=True, decoded_sequence=7))
            await answer_all(requests, context)

    said: list[str] = []
    async with scripted(play) as (target, service), ResumingClient(target, REQUEST, report=said.append) as session:
        answers = session.answers()
        connection = session.connection
        await send(session, 0)
        assert not (await anext(answers)).is_lost
        session.release_credit()
        await send(session, 1)
        await send(session, 2)
        lost = [await anext(answers), await anext(answers)]
        assert [(answer.sequence, answer.is_lost) for answer in lost] == [(1, True), (2, True)]
        later = asyncio.ensure_future(anext(answers))
        await send(session, 3)
        assert session.connection != connection
        answer = await asyncio.wait_for(later, 5)
        assert (answer.sequence, answer.is_lost) == (3, False)
        assert (session.resumed, session.decoded_sequence, session.lost_frames) == (True, 7, 2)
        await session.finish()
        assert [answer async for answer in answers] == []
    assert [hello.resume_token for hello in service.hellos[:2]] == [b"", b"token"]
    assert service.hellos[1].last_result_sequence == 0
    assert len(said) == 2


@pytest.mark.parametrize(
    ("response", "said"),
    [
        (closing(code_pb2.UNAVAILABLE, pb.CLOSE_ACTION_STOP), "so it is"),
        (closing(code_pb2.UNAUTHENTICATED, pb.CLOSE_ACTION_STOP), "UNAUTHENTICATED"),
        (grpc.StatusCode.UNAUTHENTICATED, "does not let us in"),
        (grpc.StatusCode.FAILED_PRECONDITION, "FAILED_PRECONDITION"),
        (grpc.StatusCode.INVALID_ARGUMENT, "INVALID_ARGUMENT"),
    ],
    ids=["stop", "stop-unauthenticated", "unauthenticated", "failed-precondition", "invalid-argument"],
)
async def test_does_not_come_back_after(response: Any, said: str) -> None:
    async def play(number: int, requests: Any, context: Any) -> None:
        await context.write(welcome())
        if isinstance(response, grpc.StatusCode):
            await context.abort(response, "no")
        await context.write(response)
        await anext(requests, None)

    async with scripted(play) as (target, service), ResumingClient(target, REQUEST) as session:
        with pytest.raises(RemoteError, match=said) as caught:
            await anext(session.answers())
        assert not isinstance(caught.value, ConnectionLost)
    assert len(service.hellos) == 1


async def test_waits_as_long_as_the_server_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float | None] = []

    class Patient(Backoff):
        def next_s(self, retry_after_s: float | None = None) -> float:
            asked.append(retry_after_s)
            return 0.0

    async def play(number: int, requests: Any, context: Any) -> None:
        if number in (1, 3):
            await context.write(welcome())
        if number < 3:
            await context.write(closing(code_pb2.RESOURCE_EXHAUSTED, pb.CLOSE_ACTION_RESUME, 7.0 * number))
            await anext(requests, None)
        else:
            await answer_all(requests, context)

    monkeypatch.setattr(resuming_client, "Backoff", Patient)
    async with scripted(play) as (target, _), ResumingClient(target, REQUEST, report=lambda _: None) as session:
        answers = session.answers()
        await send(session, 0)
        assert (await anext(answers)).is_lost
        answer = asyncio.ensure_future(anext(answers))
        await send(session, 1)
        assert not (await asyncio.wait_for(answer, 5)).is_lost
    assert asked == [7.0, 14.0]


async def test_moves_only_under_the_same_security() -> None:
    said: list[str] = []
    secure = ResumingClient("grpcs://127.0.0.1:1", REQUEST, report=said.append)
    assert secure._targets(ConnectionLost("x", alternative_target="grpc://127.0.0.1:2")) == ["grpcs://127.0.0.1:1"]
    assert "not going to grpc://127.0.0.1:2" in said[0]
    assert secure._targets(ConnectionLost("x", alternative_target="127.0.0.1:2"))[0] == "127.0.0.1:2"
    assert secure._client_for("127.0.0.1:2")._way.tls
    security = ClientSecurity(token="t")  # noqa: S106
    with_token = ResumingClient("127.0.0.1:1", REQUEST, security=security, report=said.append)
    assert with_token._targets(ConnectionLost("x", alternative_target="192.0.2.1:2")) == ["127.0.0.1:1"]
    assert "plain text" in said[1]


async def test_credit_follows_the_server_but_never_beyond_its_welcome() -> None:
    proceed = asyncio.Event()
    flows = [pb.FlowUpdate(max_in_flight=number) for number in (1, 9, 0)]

    async def play(number: int, requests: Any, context: Any) -> None:
        await context.write(welcome(3))
        for flow in flows:
            await context.write(pb.StreamPerceptionResponse(flow_update=flow))
            # An answer behind it tells when the client has taken note.
            await context.write(result((await anext(requests)).frame.sequence))
            await proceed.wait()
            proceed.clear()
        await answer_all(requests, context)

    async with scripted(play) as (target, _), PerceptionClient(target, REQUEST, window=2) as session:
        answers = session.answers()
        windows = []
        for sequence in range(len(flows)):
            await send(session, sequence)
            assert (await anext(answers)).sequence == sequence
            session.release_credit()
            windows.append(await free_places(session))
            proceed.set()
    assert windows == [1, 2, 2]


async def free_places(session: PerceptionClient) -> int:
    """How many places can be taken at once; gives them back."""
    taken = 0
    while True:
        try:
            await asyncio.wait_for(session.acquire_credit(), 0.02)
        except TimeoutError:
            break
        taken += 1
    for _ in range(taken):
        session.release_credit()
    return taken


@settings(max_examples=40)
@given(gaps=st.lists(st.floats(0, 1), min_size=2, max_size=40), rate=st.floats(1, 30))
async def test_pacer_keeps_to_the_rate_with_one_frame_of_slack(gaps: list[float], rate: float) -> None:
    """Over any stretch of time no more frames are taken than the rate allows, and one that came late."""
    now_s = 100.0
    taken: list[float] = []

    class Clock:
        @staticmethod
        def monotonic() -> float:
            return now_s

    async def sleep(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(credit, "time", Clock)
        patch.setattr(credit.asyncio, "sleep", sleep)
        pacer = FramePacer()
        for gap in gaps:
            now_s += gap
            await pacer.wait(rate)
            taken.append(now_s)
    for first in range(len(taken)):
        for last in range(first + 1, len(taken)):
            frames = last - first
            assert frames <= (taken[last] - taken[first]) * rate + 1 + 1e-6


@given(asked=st.none() | st.floats(0, 100), attempts=st.integers(1, 60))
def test_backoff_grows_to_its_bound_and_honours_the_server(asked: float | None, attempts: int) -> None:
    waits = Backoff()
    for attempt in range(attempts):
        wait_s = waits.next_s(asked) - (asked or 0)
        exponential = backoff.FIRST_S * 2.0 ** (attempt - 1)
        highest = backoff.FIRST_S if attempt == 0 else min(backoff.LONGEST_S, exponential) * 1.25
        lowest = 0 if attempt == 0 else min(backoff.LONGEST_S, exponential) * 0.75
        assert lowest - 1e-9 <= wait_s <= highest + 1e-9
