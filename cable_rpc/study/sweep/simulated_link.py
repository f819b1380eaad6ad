"""A link in simulated time: when each frame's answer is back, and which frames find no room.

Deterministic, unlike a real link: bytes are true, times follow from them. The uplink serves frames in order at a
constant rate or along a trace of delivery opportunities; loss is not modelled, since a reliable transport turns it into
delay that depends on its congestion control.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cable_rpc.errors import ConfigurationError

MS = 1_000_000
TRACE_PACKET_BYTES = 1500
"""One line of a Mahimahi trace is an opportunity to deliver so many bytes."""


@dataclass(frozen=True, slots=True)
class SimulatedLink:
    """What lies between edge and cloud, and how long each of them works.

    Raises:
        ConfigurationError: a value is outside its range.
    """

    name: str
    """For people."""
    uplink_kbps: float | None = None
    """Constant rate; None where a trace tells it."""
    trace_ms: tuple[int, ...] = ()
    """Milliseconds at which `TRACE_PACKET_BYTES` can leave, rising, repeated from the last one on (Mahimahi)."""
    downlink_kbps: float = 10_000.0
    delay_ms: float = 20.0
    """Propagation, each way."""
    edge_ms: float = 15.0
    """From capture to the first byte: region and encoder."""
    cloud_ms: float = 50.0
    """From the last byte to the answer's first: decoder and models."""
    window: int = 2
    """Unanswered frames at most; a frame that finds as many is dropped."""

    def __post_init__(self) -> None:
        where = f"link '{self.name}'"
        if (self.uplink_kbps is None) == (not self.trace_ms):
            raise ConfigurationError(f"{where} needs uplink_kbps or a trace, and not both")
        if (self.uplink_kbps is not None and self.uplink_kbps <= 0) or self.downlink_kbps <= 0:
            raise ConfigurationError(f"{where}: rates must be above 0 kbit/s")
        if min(self.delay_ms, self.edge_ms, self.cloud_ms) < 0:
            raise ConfigurationError(f"{where}: times must be at least 0 ms")
        if self.window < 1:
            raise ConfigurationError(f"{where}: window must be at least 1 frame")
        steps = np.diff(self.trace_ms)
        if self.trace_ms and (self.trace_ms[0] < 0 or self.trace_ms[-1] == 0 or bool((steps < 0).any())):
            raise ConfigurationError(f"{where}: a trace holds rising times in ms, the last of them above 0")


class LinkClock:
    """One session's way over a link, frame after frame."""

    def __init__(self, link: SimulatedLink) -> None:
        self._link = link
        self._uplink_free_ns = 0
        self._next_opportunity = 0
        self._downlink_free_ns = 0
        self._cloud_free_ns = 0
        self._answers_ns: list[int] = []

    def has_room(self, capture_ns: int) -> bool:
        """Whether a frame captured now may be sent."""
        self._answers_ns = [answer for answer in self._answers_ns if answer > capture_ns]
        return len(self._answers_ns) < self._link.window

    def send(self, capture_ns: int, bytes_up: int, bytes_down: int) -> int:
        """Sends a frame and has it answered.

        Args:
            capture_ns: of the frame, later than that of every frame before.
            bytes_up: on the uplink.
            bytes_down: of the answer.

        Returns:
            When the answer is there, in ns on the clock of ``capture_ns``.
        """
        link = self._link
        sent = self._uplink(capture_ns + round(link.edge_ms * MS), bytes_up)
        arrived = sent + round(link.delay_ms * MS)
        self._cloud_free_ns = max(arrived, self._cloud_free_ns) + round(link.cloud_ms * MS)
        start = max(self._cloud_free_ns, self._downlink_free_ns)
        self._downlink_free_ns = start + round(bytes_down * 8 * MS / link.downlink_kbps)
        answered = self._downlink_free_ns + round(link.delay_ms * MS)
        self._answers_ns.append(answered)
        return answered

    def _uplink(self, ready_ns: int, size: int) -> int:
        """When the last byte has left."""
        start = max(ready_ns, self._uplink_free_ns)
        if self._link.uplink_kbps is not None:
            self._uplink_free_ns = start + round(size * 8 * MS / self._link.uplink_kbps)
        else:
            first = max(self._next_opportunity, self._first_opportunity(start))
            self._next_opportunity = first + -(-size // TRACE_PACKET_BYTES)
            self._uplink_free_ns = max(start, self._opportunity_ns(self._next_opportunity - 1))
        return self._uplink_free_ns

    def _opportunity_ns(self, index: int) -> int:
        """Time of an opportunity, counted from the session's start over all repetitions."""
        times = self._link.trace_ms
        round_trip, place = divmod(index, len(times))
        return (round_trip * times[-1] + times[place]) * MS

    def _first_opportunity(self, time_ns: int) -> int:
        """The first opportunity at or after a time."""
        times = self._link.trace_ms
        wanted_ms = -(-time_ns // MS)
        # The last one of a repetition comes at the moment with which the next begins.
        repetition = max(0, -(-wanted_ms // times[-1]) - 1)
        place = int(np.searchsorted(times, wanted_ms - repetition * times[-1], side="left"))
        return repetition * len(times) + place
