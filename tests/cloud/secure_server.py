"""A real server with the settings of a test, and sessions of our own client with it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from cable_codecs import CodecParameters, create_encoder

from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.service import PerceptionServer, ServerConfig
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import BrightBoxDetector
from .test_protocol import HEIGHT, WIDTH, picture

LIMITS = SessionLimits(close_timeout_s=1.0)


@asynccontextmanager
async def serving(*, detector: Any = None, segmenter: Any = None, **settings: Any) -> AsyncIterator[PerceptionServer]:
    """A listening server; ``settings`` are fields of ServerConfig."""
    models = PerceptionModels.in_process(detector or BrightBoxDetector(), segmenter or BoxSegmenter())
    fields = {"address": "127.0.0.1:0", "limits": LIMITS, "drain_s": 1.0} | settings
    async with PerceptionServer(models, ServerConfig(**fields)) as server:
        yield server
    models.close()


def client(target: str, frame_rate: float = 10.0, **settings: Any) -> PerceptionClient:
    return PerceptionClient(target, SessionRequest("jpeg", WIDTH, HEIGHT, frame_rate), **settings)


async def one_frame(session: PerceptionClient, sequence: int = 0) -> FrameAnswer:
    """Sends a frame and waits for its answer."""
    with create_encoder(CodecParameters("jpeg", WIDTH, HEIGHT)) as encoder:
        data = encoder.encode(picture()).data
    await session.acquire_credit()
    await session.send(pb.VideoFrame(sequence=sequence, data=data, keyframe=True))
    answer = await anext(session.answers())
    session.release_credit()
    return answer
