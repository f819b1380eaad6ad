"""What one session may use."""

from __future__ import annotations

from dataclasses import dataclass

from cable_rpc.wire.v1 import perception_pb2 as pb


@dataclass(frozen=True, slots=True)
class SessionLimits:
    """What one session may use."""

    max_in_flight: int = 2
    """Unanswered frames; 2 keeps a link busy without queueing stale video."""
    max_frame_bytes: int = 2 << 20
    max_pixels: int = 4096 * 2304
    default_min_score: float = 0.4
    hello_timeout_s: float = 10.0
    heartbeat_s: float = 5.0
    close_timeout_s: float = 5.0
    idle_timeout_s: float = 300.0
    """A client that has nothing unanswered and sends nothing for so long is sent away."""
    latency_bound_s: float = 0.0
    """A frame that no model could begin with for so long after it came is shed; 0 = no bound."""

    def flow(self) -> pb.FlowUpdate:
        """The limits as the client is told them."""
        return pb.FlowUpdate(max_in_flight=self.max_in_flight, max_frame_bytes=self.max_frame_bytes)
