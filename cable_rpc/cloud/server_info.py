"""Answers that need no session."""

from __future__ import annotations

import time

from cable_codecs import available_codecs

import cable_rpc
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.public_text import public_text
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.wire.convert import CODEC_NAMES, PROTOCOL_REVISION
from cable_rpc.wire.v1 import perception_pb2 as pb


def model_infos(models: PerceptionModels) -> list[pb.ModelInfo]:
    """The hosted models as the client is told them."""
    kinds = ((models.detector, pb.RESULT_KIND_DETECTION), (models.segmenter, pb.RESULT_KIND_SEGMENTATION))
    return [
        pb.ModelInfo(name=public_text(model.name), revision=model.revision, device=model.device, result_kind=kind)
        for model, kind in kinds
    ]


def server_info(models: PerceptionModels, limits: SessionLimits) -> pb.GetServerInfoResponse:
    """What a server is, and what it grants."""
    return pb.GetServerInfoResponse(
        protocol_revision=PROTOCOL_REVISION,
        server_version=f"cable-rpc/{cable_rpc.__version__}",
        codecs=[number for number, name in CODEC_NAMES.items() if name in available_codecs()],
        models=model_infos(models),
        flow=limits.flow(),
        max_pixels=limits.max_pixels,
    )


def clock_sample(request: pb.SyncClockRequest) -> pb.SyncClockResponse:
    """One clock sample; call it at once when the request comes."""
    received_ns = time.monotonic_ns()
    return pb.SyncClockResponse(
        client_send_time_ns=request.client_send_time_ns,
        server_receive_time_ns=received_ns,
        server_send_time_ns=time.monotonic_ns(),
    )
