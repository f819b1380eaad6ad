"""Running a model off the event loop, for all sessions of a server."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

Item = TypeVar("Item", contravariant=True)
Answer = TypeVar("Answer", covariant=True)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ModelRun(Generic[Answer]):
    """A model's answer and what it took."""

    value: Answer
    wait_ns: int
    """In the model's queue."""
    run_ns: int
    """Of the whole batch."""
    batch_size: int
    start_time_ns: int = 0
    """When the run began, on this machine's monotonic clock; 0 = not told."""


class ModelRunner(Protocol[Item, Answer]):
    """Hides whether a model runs in this process, in a batch with other sessions, or on another machine."""

    async def infer(self, take: Callable[[], Item | None]) -> ModelRun[Answer] | None:
        """Queues for the model; ``take`` is called when the turn has come, so that it can give the newest frame.

        Returns None where ``take`` had nothing to give. The model's exceptions come through. Cancelling it before its
        turn leaves the queue.
        """
        ...

    def backlog_s(self) -> float:
        """How long another frame is likely to be on its way through, as far as it is known."""
        ...

    async def call(self, function: Callable[[], T]) -> T:
        """Runs something where the model runs, between its batches."""
        ...

    def close(self) -> None:
        """Ends it after the batch that runs."""
        ...
