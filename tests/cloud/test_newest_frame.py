"""The mailbox of one: what is taken, what is told of the others, and when."""

from __future__ import annotations

import asyncio
import time

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.answer_queue import Answer
from cable_rpc.cloud.newest_frame import NewestFrame, WaitingFrame
from cable_rpc.cloud.stream_decoder import DecodedFrame
from cable_rpc.wire.v1 import perception_pb2 as pb

PICTURE = DecodedFrame(np.zeros((2, 2, 3), np.uint8), None)


def waiting(sequence: int, *, age_ms: float = 0.0, deadline_ms: float = 0.0) -> WaitingFrame:
    timing = pb.ServerTiming(receive_time_ns=time.monotonic_ns() - round(age_ms * 1e6))
    answer: Answer = asyncio.get_running_loop().create_future()
    return WaitingFrame(sequence, PICTURE, timing, answer, round(deadline_ms * 1e6))


def reason_of(frame: WaitingFrame) -> str:
    rejected = frame.answer.result().frame_rejected
    assert rejected.sequence == frame.sequence
    return pb.RejectReason.Name(rejected.reason).removeprefix("REJECT_REASON_")


@given(st.lists(st.booleans(), max_size=12))
def test_takes_are_the_newest_and_everything_else_is_superseded(steps: list[bool]) -> None:
    """True = a frame comes, False = a model takes."""

    async def run() -> None:
        mailbox = NewestFrame()
        there: list[WaitingFrame] = []
        for sequence, comes in enumerate(steps):
            if comes:
                there.append(waiting(sequence))
                mailbox.offer(there[-1])
                assert not any(frame.answer.done() for frame in there)  # answered only when a model turns to them
            else:
                taken = mailbox.take()
                assert taken is (there[-1] if there else None)
                assert [reason_of(frame) for frame in there[:-1]] == ["SUPERSEDED"] * len(there[:-1])
                assert taken is None or not taken.answer.done()
                there = []

    asyncio.run(run())


async def test_late_frames_are_shed_by_whose_limit_was_passed() -> None:
    for bound_s, frame, reason in (
        (0.0, waiting(1, age_ms=500.0), None),
        (0.1, waiting(2, age_ms=50.0), None),
        (0.1, waiting(3, age_ms=500.0), "OVERLOADED"),
        (0.0, waiting(4, age_ms=50.0, deadline_ms=20.0), "DEADLINE"),
        (0.1, waiting(5, age_ms=500.0, deadline_ms=20.0), "DEADLINE"),
        (0.1, waiting(6, age_ms=500.0, deadline_ms=900.0), "OVERLOADED"),
    ):
        mailbox = NewestFrame(bound_s)
        mailbox.offer(frame)
        taken = mailbox.take()
        if reason is None:
            assert taken is frame
        else:
            assert taken is None
            assert reason_of(frame) == reason


async def test_waiting_ends_with_a_frame_and_begins_again_when_it_is_taken() -> None:
    mailbox = NewestFrame()
    waiter = asyncio.create_task(mailbox.wait())
    await asyncio.sleep(0)
    assert not waiter.done()
    mailbox.offer(waiting(0))
    await asyncio.wait_for(waiter, 1)
    mailbox.take()
    again = asyncio.create_task(mailbox.wait())
    await asyncio.sleep(0)
    assert not again.done()
    again.cancel()
