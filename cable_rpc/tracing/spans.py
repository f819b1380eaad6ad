"""Spans as plain data, made after a frame is done from the times that were recorded on its way."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from cable_rpc.tracing.context import SpanContext

Attributes = Mapping[str, str | int | float | bool]


class SpanKind(Enum):
    """A span's place in a call from one process to another."""

    INTERNAL = "internal"
    CLIENT = "client"
    SERVER = "server"


@dataclass(frozen=True, slots=True)
class Span:
    """Something that took time."""

    name: str
    context: SpanContext
    parent_id: str
    """Span id within the same trace; empty = the trace begins here."""
    start_time_ns: int
    """Since 1970-01-01 UTC, on the wall clock of the machine that tells it."""
    end_time_ns: int
    attributes: Attributes = field(default_factory=dict)
    kind: SpanKind = SpanKind.INTERNAL
    error: str = ""
    """Why it failed; empty = it did not."""


class SpanSink(Protocol):
    """Takes spans away; returns at once."""

    def export(self, spans: Sequence[Span]) -> None:
        """Takes spans, or drops them where it has too many."""
        ...


def wall_offset_ns() -> int:
    """Wall clock minus monotonic clock of this machine, from the closest of a few readings."""
    readings = []
    for _ in range(3):
        before_ns = time.monotonic_ns()
        wall_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


@dataclass(frozen=True, slots=True)
class SpanFamily:
    """Makes the children of one span."""

    parent: SpanContext
    wall_offset_ns: int

    def child(self, name: str, start_ns: int, end_ns: int, attributes: Attributes | None = None) -> Span:
        """A child between two readings of this machine's monotonic clock; never ends before it starts."""
        return Span(
            name,
            self.parent.sibling(),
            self.parent.span_id,
            start_ns + self.wall_offset_ns,
            max(start_ns, end_ns) + self.wall_offset_ns,
            attributes or {},
        )
