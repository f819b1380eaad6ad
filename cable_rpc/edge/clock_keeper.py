"""Keeps the offset between our clock and a server's known, on a connection of its own."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from typing import Any

import grpc

from cable_rpc.edge.channel import Metadata
from cable_rpc.wire.clock import ClockOffset, ClockOffsetEstimator, ClockSample
from cable_rpc.wire.v1 import perception_pb2 as pb
from cable_rpc.wire.v1 import perception_pb2_grpc as pb_grpc

SAMPLES_AT_START = 8
INTERVAL_S = 5.0


class ClockKeeper:
    """Samples one server's clock.

    Args:
        stub: over a channel not shared with video frames, behind which a sample would wait.
        metadata: of each call.
    """

    def __init__(self, stub: pb_grpc.PerceptionServiceStub, metadata: Metadata) -> None:
        self._stub: Any = stub
        self._metadata = metadata
        self._estimator = ClockOffsetEstimator()

    @property
    def offset(self) -> ClockOffset | None:
        """Server clock against ours; None before the first sample."""
        return self._estimator.offset

    async def begin(self) -> None:
        """Takes the first samples.

        Raises:
            grpc.aio.AioRpcError: the server can't be asked.
        """
        for _ in range(SAMPLES_AT_START):
            await self._sample()

    async def run(self) -> None:
        """Goes on for ever; the stream itself reports a lost server."""
        while True:
            with suppress(grpc.aio.AioRpcError):
                await (self.begin() if self.offset is None else self._sample())
            await asyncio.sleep(INTERVAL_S)

    async def _sample(self) -> None:
        sent_ns = time.monotonic_ns()
        response = await self._stub.SyncClock(pb.SyncClockRequest(client_send_time_ns=sent_ns), metadata=self._metadata)
        self._estimator.add(
            ClockSample(sent_ns, response.server_receive_time_ns, response.server_send_time_ns, time.monotonic_ns())
        )
