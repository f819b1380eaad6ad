"""How long the stages of a model take: CUDA events on a GPU, the monotonic clock elsewhere."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class StageTimer:
    """Collects durations of named stages; a stage entered twice is added up."""

    def __init__(self, device: torch.device) -> None:
        self._cuda = device.type == "cuda"
        self._spans_ns: dict[str, int] = defaultdict(int)
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times what runs inside; on a GPU without waiting for it."""
        if self._cuda:
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
            start.record()
            try:
                yield
            finally:
                end.record()
                self._events.append((name, start, end))
            return
        began_ns = time.perf_counter_ns()
        try:
            yield
        finally:
            self._spans_ns[name] += time.perf_counter_ns() - began_ns

    def durations_ns(self) -> dict[str, int]:
        """Nanoseconds of each stage so far; waits for the GPU."""
        if self._events:
            torch.cuda.synchronize()
            for name, start, end in self._events:
                self._spans_ns[name] += round(start.elapsed_time(end) * 1e6)
            self._events.clear()
        return dict(self._spans_ns)
