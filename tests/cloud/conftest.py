from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import grpc
import numpy as np
import pytest

from cable_rpc.cloud.backends import FrameContext
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.service import PerceptionServer, ServerConfig
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.types import BoolMask, Detections, Image, Segmentation
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc


class BrightBoxDetector:
    """Finds the bounding box of bright pixels: an answer that depends on the decoded picture."""

    name = "bright"
    revision = "test"
    device = "cpu"

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        return [self.one(image) for image in images]

    def one(self, image: Image) -> Detections:
        rows, columns = np.nonzero(image.max(axis=2) > 200)
        if len(rows) == 0:
            return Detections.empty()
        box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        return Detections(np.array([box], np.float32), np.array([2], np.int32), np.array([0.9], np.float32))


class FailingSegmenter(BoxSegmenter):
    """Fails on every picture whose frame number is odd."""

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        if context.sequence % 2:
            raise RuntimeError("secret path /etc/weights is broken")
        return super().segment(image, roi, prompt, context)


ServerFactory = Callable[..., AbstractAsyncContextManager[str]]


@pytest.fixture
def running_server() -> ServerFactory:
    """A real server on a real loopback socket; yields HOST:PORT."""

    @asynccontextmanager
    async def start(
        *, segmenter: Any = None, limits: SessionLimits | None = None, detector: Any = None
    ) -> AsyncIterator[str]:
        models = PerceptionModels.in_process(detector or BrightBoxDetector(), segmenter or BoxSegmenter())
        config = ServerConfig("127.0.0.1:0", limits or SessionLimits(close_timeout_s=1.0), drain_s=1.0)
        async with PerceptionServer(models, config) as server:
            yield f"127.0.0.1:{server.port}"
        models.close()

    return start


@pytest.fixture
def stub_for() -> Callable[[str], AbstractAsyncContextManager[pb_grpc.PerceptionServiceStub]]:
    """A bare gRPC client without any of our client's manners."""

    @asynccontextmanager
    async def connect(target: str) -> AsyncIterator[pb_grpc.PerceptionServiceStub]:
        async with grpc.aio.insecure_channel(target, options=[("grpc.max_send_message_length", 64 << 20)]) as channel:
            yield pb_grpc.PerceptionServiceStub(channel)

    return connect
