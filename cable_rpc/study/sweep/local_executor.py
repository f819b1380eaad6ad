"""Calls in processes of this machine."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from typing import Any, Self

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.closed_loop.failure import told
from cable_rpc.study.sweep.executors import WORKER_DIED, Call, Outcome, answer
from cable_rpc.study.worker_pool import worker_pool


class LocalExecutor:
    """An `Executor` over spawned processes, one of them too: a crash costs a cell, never the sweep.

    A process that dies takes the pool along, and nothing tells which call it was that killed it. Those that were on the
    way are therefore repeated alone, and the one that kills its process again has failed.

    Args:
        workers: processes, each of one computing thread besides its models'.

    Raises:
        ConfigurationError: there is to be no worker.
    """

    def __init__(self, workers: int = 1) -> None:
        if workers < 1:
            raise ConfigurationError(f"workers is {workers}; give at least 1")
        self.workers = workers
        self._waiting: deque[Call] = deque()
        self._running: dict[Future[tuple[Any, str]], Call] = {}
        self._suspects: deque[Call] = deque()
        self._stack = ExitStack()
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: Any) -> None:
        self._pool = None
        self._stack.__exit__(*exc_info)

    def submit(self, function: Callable[[Any], Any], argument: Any) -> None:
        """Hand in a call."""
        self._waiting.append(Call(function, argument))

    def completed(self) -> Iterator[Outcome]:
        """Runs what was handed in; each outcome as it becomes ready."""
        while self._waiting or self._running or self._suspects:
            if not self._suspects:
                self.start_some()
            if not self._running:
                self.close_pool()
                while self._suspects:
                    yield self.alone(self._suspects.popleft())
                continue
            ready, _ = wait(self._running, return_when=FIRST_COMPLETED)
            for future in ready:
                call = self._running.pop(future)
                try:
                    result, error = future.result()
                except BrokenProcessPool:
                    self._suspects.append(call)
                    continue
                except Exception as failure:
                    result, error = None, f"can't reach its worker process: {told(failure)}"
                yield Outcome(call.argument, result, error)

    def start_some(self) -> None:
        """Keeps one call more than there are workers on the way."""
        if self._pool is None and self._waiting:
            self._pool = self._stack.enter_context(worker_pool(self.workers))
        while self._pool is not None and self._waiting and len(self._running) <= self.workers:
            try:
                future = self._pool.submit(answer, self._waiting[0])
            except BrokenProcessPool:
                if not self._running:
                    self.close_pool()
                return
            self._running[future] = self._waiting.popleft()

    def alone(self, call: Call) -> Outcome:
        """The outcome of a call in a process of its own."""
        with worker_pool(1) as pool:
            try:
                result, error = pool.submit(answer, call).result()
            except BrokenProcessPool:
                return Outcome(call.argument, None, WORKER_DIED)
        return Outcome(call.argument, result, error)

    def close_pool(self) -> None:
        """Its processes end once they are idle."""
        self._pool = None
        self._stack.close()
