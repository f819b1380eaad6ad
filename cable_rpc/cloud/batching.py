"""Dynamic batching: what waits when a model gets free runs together.

Every session has at most one place in a model's queue and goes to its end after each turn, so sessions take turns. A
place holds no picture: its frame is asked for when the batch is put together, and is then the newest of its session.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

from cable_rpc.cloud.model_runner import ModelRun
from cable_rpc.errors import ConfigurationError

Item = TypeVar("Item")
Answer = TypeVar("Answer")
T = TypeVar("T")

RUN_TIME_WEIGHT = 0.2
"""Of the latest batch in the running mean of what a frame takes."""


@dataclass(frozen=True, slots=True)
class BatchPolicy:
    """How large batches get and how long they wait."""

    max_batch: int = 1
    wait_s: float = 0.0
    """How long a free model waits for a batch to fill; 0 = it begins with what is there."""
    workers: int = 1
    """Batches that run at a time, each in a thread of its own; the model must allow it."""
    max_run_s: float = math.inf
    """Batches stay so small that they are likely to end within this time."""
    at_once_s: float = 0.0
    """A batch that is likely to take less than this runs in the event loop's thread: handing it over would take longer.

    Only for a model that needs nobody else to go on.
    """

    def __post_init__(self) -> None:
        if self.max_batch < 1 or self.workers < 1 or not 0.0 <= self.wait_s <= 10.0 or not self.max_run_s > 0.0:
            raise ConfigurationError(
                f"a batch takes at least 1 frame, 1 worker, 0 to 10 s of waiting and some time to run, got "
                f"{self.max_batch}, {self.workers}, {self.wait_s:g} s and {self.max_run_s:g} s"
            )


@dataclass(slots=True)
class _Place(Generic[Item, Answer]):
    """One session's place in the queue."""

    take: Callable[[], Item | None]
    answer: asyncio.Future[ModelRun[Answer] | None]
    queued_ns: int


@dataclass(frozen=True, slots=True)
class _Outcome(Generic[Answer]):
    """What a batch gave, each answer in its item's place."""

    answers: list[Answer | Exception]
    started_ns: int
    run_ns: int


class BatchingRunner(Generic[Item, Answer]):
    """A `ModelRunner` in this process; belongs to one event loop at a time.

    Args:
        name: of its threads.
        run_batch: the model: one answer for each item, in their order; runs in a worker thread.
        policy: sizes and times.

    Attributes:
        batch_done: is told the size of each batch and the nanoseconds that it ran; called on the event loop.
    """

    def __init__(
        self, name: str, run_batch: Callable[[Sequence[Item]], list[Answer]], policy: BatchPolicy | None = None
    ) -> None:
        self.policy = policy or BatchPolicy()
        self._run_batch = run_batch
        self._executor = ThreadPoolExecutor(self.policy.workers, thread_name_prefix=name)
        self._queue: deque[_Place[Item, Answer]] = deque()
        self._running: dict[Future[_Outcome[Answer]], int] = {}
        self._alarm: asyncio.TimerHandle | None = None
        self._alarm_loop: asyncio.AbstractEventLoop | None = None
        self._loop: asyncio.AbstractEventLoop
        self._item_run_s = 0.0
        self._calls: set[Future[Any]] = set()
        self.batch_done: Callable[[int, int], None] = lambda size, run_ns: None

    async def infer(self, take: Callable[[], Item | None]) -> ModelRun[Answer] | None:
        """See `ModelRunner`."""
        self._loop = asyncio.get_running_loop()
        answer: asyncio.Future[ModelRun[Answer] | None] = self._loop.create_future()
        self._queue.append(_Place(take, answer, time.monotonic_ns()))
        self._schedule()
        return await answer

    def backlog_s(self) -> float:
        """See `ModelRunner`."""
        frames = len(self._queue) + sum(self._running.values()) + 1
        return frames * self._item_run_s / self.policy.workers

    async def call(self, function: Callable[[], T]) -> T:
        """See `ModelRunner`."""
        call = self._executor.submit(function)
        self._calls.add(call)
        call.add_done_callback(self._calls.discard)
        return await asyncio.wrap_future(call)

    def close(self) -> None:
        """See `ModelRunner`."""
        if self._alarm is not None:
            self._alarm.cancel()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _schedule(self) -> None:
        """Begins batches while there are frames and free workers, or sets the alarm for the one to wait for."""
        while self._queue and (free := self._free_workers()) > 0:
            first = self._queue[0]
            due_ns = first.queued_ns + round(self.policy.wait_s * 1e9) - time.monotonic_ns()
            if due_ns > 0 and len(self._queue) < self.policy.max_batch and not first.answer.done():
                self._set_alarm(due_ns / 1e9)
                return
            share = -(-len(self._queue) // free)
            self._begin(min(share, self._largest_batch()))

    def _largest_batch(self) -> int:
        if not self._item_run_s or math.isinf(self.policy.max_run_s):
            return self.policy.max_batch
        return min(self.policy.max_batch, max(1, int(self.policy.max_run_s / self._item_run_s)))

    def _set_alarm(self, delay_s: float) -> None:
        # An alarm of a loop that has ended never rings.
        if self._alarm is None or self._alarm_loop is not self._loop:
            self._alarm, self._alarm_loop = self._loop.call_later(delay_s, self._alarmed), self._loop

    def _alarmed(self) -> None:
        self._alarm = None
        self._schedule()

    def _free_workers(self) -> int:
        # A batch whose event loop is gone reports to nobody, so its end is looked at here.
        self._running = {batch: size for batch, size in self._running.items() if not batch.done()}
        return self.policy.workers - len(self._running)

    def _begin(self, size: int) -> None:
        places: list[_Place[Item, Answer]] = []
        items: list[Item] = []
        while self._queue and len(items) < size:
            place = self._queue.popleft()
            if place.answer.done():
                continue
            try:
                item = place.take()
            except Exception as error:
                place.answer.set_exception(error)
                continue
            if item is None:
                place.answer.set_result(None)
            else:
                places.append(place)
                items.append(item)
        if items and self._is_short(len(items)):
            self._settle(places, self._run(items))
        elif items:
            batch = self._executor.submit(self._run, items)
            self._running[batch] = len(items)
            batch.add_done_callback(partial(self._report, places))

    def _is_short(self, size: int) -> bool:
        """True for a batch to be run at once; never while something else runs where the model does."""
        return 0.0 < self._item_run_s * size < self.policy.at_once_s and not self._running and not self._calls

    def _report(self, places: list[_Place[Item, Answer]], batch: Future[_Outcome[Answer]]) -> None:
        """In the worker thread, when its batch counts as done."""
        try:
            if not batch.cancelled():
                places[0].answer.get_loop().call_soon_threadsafe(self._finish, places, batch.result())
        except RuntimeError:
            # The loop has ended; what waits belongs to the next one, if there is one already.
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._schedule)

    def _run(self, items: list[Item]) -> _Outcome[Answer]:
        started_ns = time.monotonic_ns()
        answers: list[Answer | Exception]
        try:
            answers = list(self._run_batch(items))
            if len(answers) != len(items):
                answers = [RuntimeError(f"the model gave {len(answers)} answers to {len(items)} items")] * len(items)
        except Exception as error:
            # One bad picture must not fail those that happened to run beside it.
            answers = [error] if len(items) == 1 else [self._run([item]).answers[0] for item in items]
        return _Outcome(answers, started_ns, time.monotonic_ns() - started_ns)

    def _finish(self, places: list[_Place[Item, Answer]], outcome: _Outcome[Answer]) -> None:
        self._settle(places, outcome)
        self._schedule()

    def _settle(self, places: list[_Place[Item, Answer]], outcome: _Outcome[Answer]) -> None:
        self.batch_done(len(places), outcome.run_ns)
        latest_s = outcome.run_ns / 1e9 / len(places)
        self._item_run_s += (latest_s - self._item_run_s) * (RUN_TIME_WEIGHT if self._item_run_s else 1.0)
        for place, answer in zip(places, outcome.answers, strict=True):
            if place.answer.done():
                continue
            if isinstance(answer, Exception):
                place.answer.set_exception(answer)
            else:
                wait_ns = outcome.started_ns - place.queued_ns
                place.answer.set_result(ModelRun(answer, wait_ns, outcome.run_ns, len(places), outcome.started_ns))
