"""What the edge hears from the cloud, as plain data."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from cable_rpc.types import Detections, Segmentation
from cable_rpc.wire.convert import detections_from_messages, mask_from_message
from cable_rpc.wire.v1 import perception_pb2 as pb


@dataclass(frozen=True, slots=True)
class ServerTimes:
    """Where a frame's time went at the server; stamps on the server's monotonic clock."""

    receive_time_ns: int = 0
    send_time_ns: int = 0
    decode_ns: int = 0
    queue_ns: int = 0
    """All waiting for threads and models."""
    run_ns: Mapping[str, int] = field(default_factory=dict)
    """Model stages ("detect", "segment") to their durations, and the parts of a stage ("segment.clip")."""

    @classmethod
    def from_message(cls, timing: pb.ServerTiming) -> ServerTimes:
        """From the wire."""
        return cls(
            timing.receive_time_ns,
            timing.send_time_ns,
            timing.decode_ns,
            timing.decode_wait_ns + _model_wait_ns(timing),
            {stage.stage: stage.run_ns for stage in timing.stages},
        )

    def parts_of(self, stage: str) -> dict[str, int]:
        """The named parts of a model's stage to their durations; empty where it tells none."""
        prefix = f"{stage}."
        return {name.removeprefix(prefix): took for name, took in self.run_ns.items() if name.startswith(prefix)}


@dataclass(frozen=True, slots=True)
class FrameAnswer:
    """The cloud's answer to one frame."""

    sequence: int
    receive_time_ns: int
    """When it reached the edge, on the edge's monotonic clock."""
    message_bytes: int
    """Size of the whole serialised response."""
    times: ServerTimes
    detections: Detections
    segmentation: Segmentation | None
    mask_data: bytes
    """The mask as coded on the wire."""
    uncertainty_data: bytes = b""
    """The mask's uncertainty as coded on the wire; empty = not told."""
    rejection: str | None = None
    """Why the frame was not processed; None = it was."""
    is_lost: bool = False
    """True: no answer came, and none will."""

    @classmethod
    def from_result(
        cls, result: pb.Result, height: int, width: int, *, receive_time_ns: int, message_bytes: int
    ) -> FrameAnswer:
        """From the wire.

        Raises:
            ProtocolError: if the mask does not belong to a frame of this size, or is damaged.
        """
        has_mask = result.HasField("mask")
        times = ServerTimes.from_message(result.timing)
        segmentation = None
        if has_mask:
            segmentation = replace(mask_from_message(result.mask, height, width), stages_ns=times.parts_of("segment"))
        return cls(
            result.sequence,
            receive_time_ns,
            message_bytes,
            times,
            detections_from_messages(result.detections),
            segmentation,
            result.mask.data if has_mask else b"",
            result.mask.uncertainty if has_mask else b"",
        )

    @classmethod
    def from_rejection(cls, rejected: pb.FrameRejected, *, receive_time_ns: int, message_bytes: int) -> FrameAnswer:
        """From the wire."""
        reason = pb.RejectReason.Name(rejected.reason).removeprefix("REJECT_REASON_")
        return cls(
            rejected.sequence,
            receive_time_ns,
            message_bytes,
            ServerTimes.from_message(rejected.timing),
            Detections.empty(),
            None,
            b"",
            rejection=f"{reason}: {rejected.message}",
        )

    @classmethod
    def lost(cls, sequence: int, reason: str) -> FrameAnswer:
        """What stands for the answer to a frame whose connection broke; received now, without any figures."""
        nothing = Detections.empty()
        now_ns = time.monotonic_ns()
        return cls(sequence, now_ns, 0, ServerTimes(), nothing, None, b"", rejection=f"LOST: {reason}", is_lost=True)


def _model_wait_ns(timing: pb.ServerTiming) -> int:
    """Waiting for the models; while one of them runs, a frame does not wait for another."""
    stages = sorted((stage for stage in timing.stages if stage.start_time_ns), key=lambda stage: stage.start_time_ns)
    if not stages:
        return sum(stage.wait_ns for stage in timing.stages)
    waited_ns, busy_until_ns = 0, stages[0].start_time_ns - stages[0].wait_ns
    for stage in stages:
        waited_ns += max(0, stage.start_time_ns - busy_until_ns)
        busy_until_ns = max(busy_until_ns, stage.start_time_ns + stage.run_ns)
    return waited_ns
