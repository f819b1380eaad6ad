"""Sessions in Ray Serve replicas: the `PerceptionSession` of every server, behind Serve's gRPC ingress."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from concurrent.futures import ThreadPoolExecutor
from contextlib import aclosing
from typing import Any

import grpc
from google.rpc import code_pb2, status_pb2
from ray.serve.grpc_util import RayServegRPCContext, gRPCInputStream

from cable_rpc.cloud.admission import AdmissionControl
from cable_rpc.cloud.authentication import Authenticator, tokens_of
from cable_rpc.cloud.batching import BatchingRunner
from cable_rpc.cloud.cluster.remote_models import ModelFace, RemoteRunner
from cable_rpc.cloud.cluster.settings import ClusterSettings
from cable_rpc.cloud.limits import Identity
from cable_rpc.cloud.model_batches import detect_batch, segment_batch
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.server_info import clock_sample, server_info
from cable_rpc.cloud.session import PerceptionSession
from cable_rpc.cloud.session_store import SessionStore, StoreLimits
from cable_rpc.cloud.tokens import AccessFile
from cable_rpc.errors import AuthenticationError
from cable_rpc.wire.v1 import perception_pb2 as pb


class PerceptionIngress:
    """cable.v1.PerceptionService as a deployment; the methods are named as on the wire.

    Args:
        settings: of the application.
        detector: handle of the detector's deployment; None = it is loaded here.
        segmenter: likewise.
    """

    def __init__(self, settings: ClusterSettings, detector: Any = None, segmenter: Any = None) -> None:
        self._settings = settings
        self._detector_handle, self._segmenter_handle = detector, segmenter
        self._models: PerceptionModels | None = None
        self._decode_executor = ThreadPoolExecutor(max(1, int(settings.ingress.cpus)), thread_name_prefix="decode")
        self._admission = AdmissionControl(settings.shares)
        tokens = settings.tokens_path
        self._authenticator = Authenticator(None if tokens is None else AccessFile(tokens))
        if detector is None and segmenter is None:
            self._models = settings.models.load()
        self._store = SessionStore(StoreLimits(window_s=settings.resume_window_s), self._forget)
        self._loading = asyncio.Lock()

    async def StreamPerception(  # noqa: N802 - the wire name
        self, request_stream: gRPCInputStream[pb.StreamPerceptionRequest], grpc_context: RayServegRPCContext
    ) -> AsyncGenerator[pb.StreamPerceptionResponse, None]:
        """One camera's session."""
        try:
            identity = self._identify(grpc_context)
        except AuthenticationError as error:
            status = status_pb2.Status(code=code_pb2.UNAUTHENTICATED, message=str(error))
            yield pb.StreamPerceptionResponse(closing=pb.Closing(status=status, action=pb.CLOSE_ACTION_STOP))
            return
        session = PerceptionSession(
            await self._hosted(),
            self._settings.limits,
            self._decode_executor,
            admission=self._admission,
            identity=identity,
            store=self._store,
        )
        async with aclosing(session.run(request_stream)) as responses:
            async for response in responses:
                yield response

    async def GetServerInfo(  # noqa: N802
        self, request: pb.GetServerInfoRequest, grpc_context: RayServegRPCContext
    ) -> pb.GetServerInfoResponse:
        """What this server is."""
        if not self._lets_in(grpc_context):
            return pb.GetServerInfoResponse()
        return server_info(await self._hosted(), self._settings.limits)

    async def SyncClock(  # noqa: N802
        self, request: pb.SyncClockRequest, grpc_context: RayServegRPCContext
    ) -> pb.SyncClockResponse:
        """One clock sample: of this replica's machine, and so of no use where the stream is on another one."""
        return clock_sample(request) if self._lets_in(grpc_context) else pb.SyncClockResponse()

    def _forget(self, stream: str) -> None:
        if self._models is not None:
            self._models.forget_stream(stream)

    def _identify(self, context: RayServegRPCContext) -> Identity:
        return self._authenticator.identify(tokens_of(context.invocation_metadata()), None)

    def _lets_in(self, context: RayServegRPCContext) -> bool:
        try:
            self._identify(context)
        except AuthenticationError as error:
            context.set_code(grpc.StatusCode.UNAUTHENTICATED)
            context.set_details(str(error))
            return False
        return True

    async def _hosted(self) -> PerceptionModels:
        """The models; those elsewhere are asked who they are when the first client comes."""
        async with self._loading:
            if self._models is None:
                self._models = await self._assembled()
        return self._models

    async def _assembled(self) -> PerceptionModels:
        settings = self._settings.models
        detector: Any
        segmenter: Any
        if self._detector_handle is None:
            detector = await asyncio.to_thread(settings.load_detector)
            detector_runner: Any = BatchingRunner(
                "detector", lambda requests: detect_batch(detector, requests), settings.detector_policy(detector.device)
            )
        else:
            detector = ModelFace(**await self._detector_handle.face.remote())
            detector_runner = RemoteRunner(self._detector_handle)
        if self._segmenter_handle is None:
            segmenter = await asyncio.to_thread(settings.load_segmenter)
            segmenter_runner: Any = BatchingRunner(
                "segmenter",
                lambda requests: segment_batch(segmenter, requests),
                settings.segmenter_policy(segmenter.device),
            )
        else:
            segmenter = ModelFace(**await self._segmenter_handle.face.remote())
            segmenter_runner = RemoteRunner(self._segmenter_handle)
        return PerceptionModels(detector, segmenter, detector_runner, segmenter_runner)
