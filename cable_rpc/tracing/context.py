"""Which trace a frame belongs to: W3C Trace Context, level 1, as it travels in VideoFrame.traceparent."""

from __future__ import annotations

import re
import secrets
from dataclasses import dataclass, replace

TRACEPARENT = re.compile(r"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?")
UNUSED_VERSION = "ff"
SAMPLED = 1
LONGEST_TRACEPARENT = 255


@dataclass(frozen=True, slots=True)
class SpanContext:
    """A span of a trace."""

    trace_id: str
    """32 hexadecimal digits, not all zero."""
    span_id: str
    """16 hexadecimal digits, not all zero."""

    @classmethod
    def new_trace(cls) -> SpanContext:
        """A span of a trace that nothing else belongs to yet."""
        return cls(secrets.token_hex(16), new_span_id())

    def sibling(self) -> SpanContext:
        """Another span of the same trace."""
        return replace(self, span_id=new_span_id())

    def to_traceparent(self) -> str:
        """As it travels; says that the trace is wanted."""
        return f"00-{self.trace_id}-{self.span_id}-{SAMPLED:02x}"

    @classmethod
    def from_traceparent(cls, text: str) -> SpanContext | None:
        """Reads what travelled; None where it is not valid, or the trace is not wanted.

        Versions after 00 are read as far as 00 goes, as the standard asks for.
        """
        found = TRACEPARENT.fullmatch(text) if len(text) <= LONGEST_TRACEPARENT else None
        if found is None:
            return None
        version, trace_id, span_id, flags, rest = found.groups()
        if version == UNUSED_VERSION or (version == "00" and rest) or not (int(trace_id, 16) and int(span_id, 16)):
            return None
        return cls(trace_id, span_id) if int(flags, 16) & SAMPLED else None


def new_span_id() -> str:
    """16 random hexadecimal digits."""
    return secrets.token_hex(8)
