"""What a client is told of one frame: the models' result, or why there is none."""

from __future__ import annotations

import time

from cable_rpc.cloud.answer_queue import Answer, Response
from cable_rpc.cloud.perception import Perception
from cable_rpc.cloud.public_text import public_text
from cable_rpc.wire.convert import detections_to_messages, mask_to_message
from cable_rpc.wire.v1 import perception_pb2 as pb


def result_of(sequence: int, timing: pb.ServerTiming, perception: Perception) -> Response:
    """The answer to a frame that the models have seen; completes its times."""
    timing.stages.extend(
        pb.StageTiming(
            stage=run.stage,
            wait_ns=run.wait_ns,
            run_ns=run.run_ns,
            batch_size=run.batch_size,
            start_time_ns=run.start_time_ns,
        )
        for run in perception.stages
    )
    result = pb.Result(
        sequence=sequence,
        timing=timing,
        detections=detections_to_messages(perception.detections),
        mask=mask_to_message(perception.segmentation),
    )
    result.timing.send_time_ns = time.monotonic_ns()
    return Response(result=result)


def rejection_of(sequence: int, timing: pb.ServerTiming, reason: pb.RejectReason, message: str) -> Response:
    """The answer to a frame that no model has seen; completes its times."""
    timing.send_time_ns = time.monotonic_ns()
    rejected = pb.FrameRejected(sequence=sequence, reason=reason, message=public_text(message), timing=timing)
    return Response(frame_rejected=rejected)


def resolve(answer: Answer, response: Response) -> None:
    """Fills a frame's place; nothing where the session has ended meanwhile."""
    if not answer.done():
        answer.set_result(response)
