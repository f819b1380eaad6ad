"""Offset between the monotonic clocks of edge and cloud, from round trips (Cristian's method, minimum-RTT filter)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ClockSample:
    """The four readings of one round trip, each on its own end's monotonic clock."""

    client_send_ns: int
    server_receive_ns: int
    server_send_ns: int
    client_receive_ns: int

    @property
    def round_trip_ns(self) -> int:
        """Time on the way, without the server's own."""
        return (self.client_receive_ns - self.client_send_ns) - (self.server_send_ns - self.server_receive_ns)

    @property
    def offset_ns(self) -> int:
        """Server clock minus client clock, if both directions took equally long."""
        return ((self.server_receive_ns - self.client_send_ns) + (self.server_send_ns - self.client_receive_ns)) // 2


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Server clock = client clock + ``offset_ns``, known to within ``error_ns`` whatever the asymmetry."""

    offset_ns: int
    error_ns: int

    def to_client(self, server_time_ns: int) -> int:
        """A server reading on the client's clock."""
        return server_time_ns - self.offset_ns


class ClockOffsetEstimator:
    """Keeps the samples of a sliding window and trusts the one with the shortest round trip."""

    def __init__(self, window_ns: int = 60_000_000_000) -> None:
        self._window_ns = window_ns
        self._samples: deque[ClockSample] = deque()

    def add(self, sample: ClockSample) -> None:
        """Adds a sample; older ones than the window fall out."""
        self._samples.append(sample)
        oldest = sample.client_receive_ns - self._window_ns
        while self._samples[0].client_receive_ns < oldest:
            self._samples.popleft()

    @property
    def offset(self) -> ClockOffset | None:
        """Best estimate; None before the first sample. The error is half the round trip."""
        if not self._samples:
            return None
        best = min(self._samples, key=lambda sample: sample.round_trip_ns)
        return ClockOffset(best.offset_ns, max(best.round_trip_ns, 0) // 2)
