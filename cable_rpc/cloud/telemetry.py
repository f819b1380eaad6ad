"""What a server tells of its work, to whoever counts it: metrics, traces, or nobody."""

from __future__ import annotations

from cable_rpc.wire.v1 import perception_pb2 as pb


class Telemetry:
    """Is told what happens; does nothing. Every method returns at once, since sessions call it between frames."""

    def stream_opened(self) -> None:
        """A client has begun a stream."""

    def stream_closed(self) -> None:
        """A stream has ended, however."""

    def frame_received(self, frame: pb.VideoFrame) -> None:
        """A frame was accepted."""

    def response_sent(self, response: pb.StreamPerceptionResponse) -> None:
        """A message of a session is on its way, complete with its times."""

    def batch_done(self, model: str, size: int, run_ns: int) -> None:
        """A model ("detect" or "segment") has run over so many frames."""

    def authentication_failed(self) -> None:
        """A call brought no valid proof of who makes it."""


NOBODY = Telemetry()
"""Counts nothing."""
