"""The batch scheduler against a model whose runs are let through one by one."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.batching import BatchingRunner, BatchPolicy
from cable_rpc.cloud.model_runner import ModelRun
from cable_rpc.errors import ConfigurationError


@dataclass
class GatedModel:
    """Answers ten times the item; each run waits until the test lets it through."""

    batches: list[list[int]] = field(default_factory=list)
    fails_on: frozenset[int] = frozenset()
    gate: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    begun: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    def run(self, items: Sequence[int]) -> list[int]:
        self.batches.append(list(items))
        self.begun.release()
        assert self.gate.acquire(timeout=10)
        if self.fails_on & set(items):
            raise ValueError(f"can't do {sorted(self.fails_on & set(items))}")
        return [10 * item for item in items]

    async def has_begun(self) -> None:
        """Returns when one more run has begun."""
        assert await asyncio.to_thread(self.begun.acquire, timeout=10)

    def let_through(self, runs: int = 1) -> None:
        self.gate.release(runs)


@asynccontextmanager
async def running(model: GatedModel, policy: BatchPolicy) -> AsyncIterator[BatchingRunner[int, int]]:
    runner = BatchingRunner("test", model.run, policy)
    try:
        yield runner
    finally:
        model.let_through(1000)
        runner.close()


def asks(runner: BatchingRunner[int, int], item: int | None) -> asyncio.Task[ModelRun[int] | None]:
    return asyncio.create_task(runner.infer(lambda: item))


async def settled() -> None:
    """Lets all tasks that can go on do so."""
    for _ in range(5):
        await asyncio.sleep(0)


async def test_what_waits_when_the_model_gets_free_runs_together() -> None:
    model = GatedModel()
    async with running(model, BatchPolicy(max_batch=3)) as runner:
        first = asks(runner, 0)
        await settled()
        await model.has_begun()
        others = [asks(runner, item) for item in range(1, 6)]
        await settled()
        model.let_through(3)
        runs = [await task for task in (first, *others)]
        assert [run.value for run in runs if run] == [0, 10, 20, 30, 40, 50]
        assert model.batches == [[0], [1, 2, 3], [4, 5]]
        assert [run.batch_size for run in runs if run] == [1, 3, 3, 3, 2, 2]


async def test_time_in_the_queue_and_in_the_model_are_told_apart() -> None:
    model = GatedModel()
    async with running(model, BatchPolicy()) as runner:
        first = asks(runner, 1)
        await settled()
        await model.has_begun()
        second = asks(runner, 2)
        await asyncio.sleep(0.05)
        model.let_through(2)
        one, two = await first, await second
        assert one is not None
        assert two is not None
        assert min(one.run_ns, two.wait_ns) >= 50_000_000
        assert two.start_time_ns >= one.start_time_ns + one.run_ns


async def test_the_frame_is_chosen_when_its_turn_comes() -> None:
    model = GatedModel()
    newest = [1]
    async with running(model, BatchPolicy(max_batch=4)) as runner:
        first = asks(runner, 0)
        await settled()
        await model.has_begun()
        second = asyncio.create_task(runner.infer(lambda: newest[0]))
        await settled()
        newest[0] = 7
        model.let_through(2)
        assert (await first, await second)[1] is not None
        assert model.batches == [[0], [7]]


async def test_a_place_with_nothing_to_give_takes_no_room_in_the_batch() -> None:
    model = GatedModel()
    async with running(model, BatchPolicy(max_batch=2)) as runner:
        first = asks(runner, 0)
        await settled()
        await model.has_begun()
        others = [asks(runner, item) for item in (1, None, 2)]
        await settled()
        model.let_through(2)
        await first
        assert [run and run.value for run in [await task for task in others]] == [10, None, 20]
        assert model.batches == [[0], [1, 2]]


async def test_a_cancelled_session_leaves_the_queue() -> None:
    model = GatedModel()
    async with running(model, BatchPolicy(max_batch=4)) as runner:
        first = asks(runner, 0)
        await settled()
        await model.has_begun()
        taken: list[int] = []
        gone = asyncio.create_task(runner.infer(lambda: taken.append(1) or 1))  # type: ignore[func-returns-value]
        stays = asks(runner, 2)
        await settled()
        gone.cancel()
        model.let_through(2)
        assert await first
        assert await stays
        assert model.batches == [[0], [2]]
        assert not taken


async def test_a_bad_picture_fails_alone() -> None:
    model = GatedModel(fails_on=frozenset({2}))
    async with running(model, BatchPolicy(max_batch=4)) as runner:
        first = asks(runner, 0)
        await settled()
        await model.has_begun()
        tasks = [asks(runner, item) for item in (1, 2, 3)]
        await settled()
        model.let_through(10)
        await first
        answers = await asyncio.gather(*tasks, return_exceptions=True)
        assert isinstance(answers[1], ValueError)
        assert [run.value for run in answers if isinstance(run, ModelRun)] == [10, 30]


async def test_a_picture_that_can_not_be_taken_fails_alone() -> None:
    def broken() -> int:
        raise LookupError("gone")

    model = GatedModel()
    async with running(model, BatchPolicy(max_batch=4)) as runner:
        first, bad, good = asks(runner, 0), asyncio.create_task(runner.infer(broken)), asks(runner, 1)
        model.let_through(5)
        await first
        with pytest.raises(LookupError):
            await bad
        assert (await good) is not None


async def test_a_model_that_forgets_an_answer_fails_and_does_not_hang() -> None:
    runner: BatchingRunner[int, int] = BatchingRunner("test", lambda items: [], BatchPolicy())
    with pytest.raises(RuntimeError, match="0 answers to 1 items"):
        await runner.infer(lambda: 1)
    runner.close()


async def test_a_free_model_waits_for_its_batch_but_not_for_ever() -> None:
    model = GatedModel()
    model.let_through(10)
    async with running(model, BatchPolicy(max_batch=3, wait_s=0.05)) as runner:
        pair = [asks(runner, item) for item in (1, 2)]
        await asyncio.gather(*pair)
        await asyncio.gather(*(asks(runner, item) for item in (3, 4, 5)))
        assert model.batches == [[1, 2], [3, 4, 5]]


async def test_two_workers_share_what_waits() -> None:
    model = GatedModel()
    async with running(model, BatchPolicy(max_batch=4, workers=2)) as runner:
        begun = [asks(runner, item) for item in (0, 1)]
        await settled()
        await model.has_begun()
        await model.has_begun()
        others = [asks(runner, item) for item in (2, 3, 4, 5)]
        await settled()
        model.let_through(10)
        await asyncio.gather(*begun, *others)
        assert sorted(chain.from_iterable(model.batches)) == [0, 1, 2, 3, 4, 5]
        assert len(model.batches[0]) == len(model.batches[1]) == 1


async def test_batches_shrink_to_what_fits_the_time() -> None:
    """A model that takes 10 ms a frame and may run for 25 ms takes two frames at a time."""
    sizes = []

    def slow(items: Sequence[int]) -> list[int]:
        sizes.append(len(items))
        threading.Event().wait(0.01 * len(items))
        return list(items)

    runner = BatchingRunner("test", slow, BatchPolicy(max_batch=8, max_run_s=0.025))
    await runner.infer(lambda: 0)
    await asyncio.gather(*(runner.infer(lambda: 1) for _ in range(6)))
    assert max(sizes[1:]) <= 2
    runner.close()


def test_a_model_outlives_the_event_loop_of_its_sessions() -> None:
    """A study runs one event loop after another over the same models; some end in the middle of a batch."""
    model = GatedModel()
    runner = BatchingRunner("test", model.run, BatchPolicy(max_batch=2, wait_s=0.01))

    async def abandoned() -> None:
        task = asks(runner, 1)
        await model.has_begun()
        asks(runner, 2)
        await settled()
        task.cancel()

    asyncio.run(abandoned())
    model.let_through(10)

    async def again() -> int:
        run = await asyncio.wait_for(runner.infer(lambda: 3), 10)
        assert run is not None
        return run.value

    assert asyncio.run(again()) == 30
    runner.close()


@pytest.mark.parametrize(
    "make",
    [
        lambda: BatchPolicy(max_batch=0),
        lambda: BatchPolicy(workers=0),
        lambda: BatchPolicy(wait_s=-1.0),
        lambda: BatchPolicy(max_run_s=0.0),
        lambda: BatchPolicy(wait_s=float("nan")),
    ],
)
def test_impossible_policies_are_refused(make: Callable[[], BatchPolicy]) -> None:
    with pytest.raises(ConfigurationError, match="at least 1 frame"):
        make()


@given(st.integers(1, 6), st.integers(1, 4), st.integers(1, 5))
def test_streams_take_turns(streams: int, frames: int, max_batch: int) -> None:
    batches: list[list[tuple[int, int]]] = []

    def record(items: Sequence[tuple[int, int]]) -> list[None]:
        batches.append(list(items))
        return [None] * len(items)

    async def run() -> None:
        runner: BatchingRunner[tuple[int, int], None] = BatchingRunner("test", record, BatchPolicy(max_batch=max_batch))

        async def stream(number: int) -> None:
            for frame in range(frames):
                await runner.infer(lambda item=(number, frame): item)

        await asyncio.gather(*(stream(number) for number in range(streams)))
        runner.close()

    asyncio.run(run())
    assert sorted(chain.from_iterable(batches)) == [
        (stream, frame) for stream in range(streams) for frame in range(frames)
    ]
    assert max(len(batch) for batch in batches) <= max_batch
    # No stream is two turns ahead of one that has work left.
    done = dict.fromkeys(range(streams), 0)
    for batch in batches:
        assert len({stream for stream, _ in batch}) == len(batch)
        for stream, _ in batch:
            done[stream] += 1
        assert max(done.values()) - min(done.values()) <= 1
