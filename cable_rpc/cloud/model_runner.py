"""Running a model off the event loop: one thread per model, so its calls queue instead of fighting for cores."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ModelRun(Generic[T]):
    """A model's answer and what it took."""

    value: T
    wait_ns: int
    run_ns: int
    batch_size: int


class ModelRunner(Protocol):
    """Hides whether a model runs in this process, in a batch with other sessions, or on another machine."""

    async def infer(self, call: Callable[[], T]) -> ModelRun[T]:
        """Runs ``call`` where the model lives; its exceptions come through."""
        ...


class ThreadModelRunner:
    """One worker thread in this process; calls run one at a time, in order."""

    def __init__(self, name: str) -> None:
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)

    async def infer(self, call: Callable[[], T]) -> ModelRun[T]:
        """See `ModelRunner`."""
        queued_ns = time.monotonic_ns()

        def timed() -> ModelRun[T]:
            started_ns = time.monotonic_ns()
            value = call()
            return ModelRun(value, started_ns - queued_ns, time.monotonic_ns() - started_ns, 1)

        return await asyncio.get_running_loop().run_in_executor(self._executor, timed)

    def close(self) -> None:
        """Ends the worker after its current call."""
        self._executor.shutdown(wait=False, cancel_futures=True)
