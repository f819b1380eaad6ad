"""Answers leave in the order of their frames, whatever the order in which the models finish."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.answer_queue import AnswerQueue
from cable_rpc.wire.v1 import perception_pb2 as pb


def result(sequence: int) -> pb.StreamPerceptionResponse:
    return pb.StreamPerceptionResponse(result=pb.Result(sequence=sequence))


def flow() -> pb.StreamPerceptionResponse:
    return pb.StreamPerceptionResponse(flow_update=pb.FlowUpdate(max_in_flight=1))


@given(st.permutations(range(6)), st.sets(st.integers(0, 5)))
def test_order_is_that_of_the_places(finished: list[int], hints_after: set[int]) -> None:
    async def run() -> list[str]:
        queue = AnswerQueue()
        answers = []
        for sequence in range(6):
            answers.append(queue.open_answer())
            if sequence in hints_after:
                queue.send(flow())
        queue.end()
        told: list[str] = []

        async def read() -> None:
            while (response := await queue.next(1.0)) is not None:
                kind = response.WhichOneof("payload")
                told.append(str(response.result.sequence) if kind == "result" else "flow")

        reader = asyncio.create_task(read())
        for sequence in finished:
            answers[sequence].set_result(result(sequence))
            await asyncio.sleep(0)
        await reader
        return told

    expected = []
    for sequence in range(6):
        expected += [str(sequence), *(["flow"] if sequence in hints_after else [])]
    assert asyncio.run(run()) == expected


async def test_an_answer_counts_until_it_is_handed_out() -> None:
    """A client that takes nothing must not get credit for it: its answers would fill the memory."""
    queue = AnswerQueue()
    for sequence in range(2):
        queue.open_answer().set_result(result(sequence))
    await asyncio.sleep(0)
    assert queue.unanswered == 2
    await queue.next(1.0)
    assert queue.unanswered == 1


async def test_nothing_ready_in_time() -> None:
    queue = AnswerQueue()
    queue.open_answer()
    queue.send(flow())
    with pytest.raises(TimeoutError):
        await queue.next(0.01)
