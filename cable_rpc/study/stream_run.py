"""One measured run: stream a source through the loop, then judge it against the same frames sent whole."""

from __future__ import annotations

import asyncio
import logging
import platform
import shutil
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterable, Iterator
from contextlib import aclosing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cable_codecs import STILL_CODECS, CodecParameters, RegionTreatment, default_quality

import cable_rpc
from cable_rpc.data.source import FrameSource
from cable_rpc.edge.capture import Capture
from cable_rpc.edge.channel import PLAIN, ClientSecurity
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.edge.frame_encoder import FrameEncoder
from cable_rpc.edge.frame_trace import NOT_TRACED, EdgeTracing
from cable_rpc.edge.resuming_client import Report, ResumingClient
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.strategy import FullFrame
from cable_rpc.edge.streamer import EdgeStreamer, StreamedFrame
from cable_rpc.study.evaluation import FrameEvidence, RunEvaluator, UplinkSpool, record_of
from cable_rpc.study.run_record import (
    FRAMES_FILE,
    STILLS_FOLDER,
    FrameCsvWriter,
    FrameRecord,
    RunInfo,
    write_frames,
)
from cable_rpc.study.strategies import open_strategy
from cable_rpc.study.summary import RunSummary, summarise, write_summary
from cable_rpc.study.transport_counters import measure_link
from cable_rpc.study.transport_estimate import TransportBytes, estimate_exchanges
from cable_rpc.types import CameraIntrinsics, Frame
from cable_rpc.wire.address import Target

RecordListener = Callable[[str, FrameRecord], None]
"""Is told ("stream" | "evaluate", record) after each frame of each pass."""

log = logging.getLogger(__name__)

VERSIONED_PACKAGES = ("cable-rpc", "av", "grpcio", "numpy", "opencv-python-headless", "protobuf")


@dataclass(frozen=True, slots=True)
class StreamRunConfig:
    """How to run."""

    target: str
    out: Path
    codec: str = "h264"
    quality: int | None = None
    """JPEG/WebP 1..100, video codecs CRF; None = the codec's default."""
    bitrate_kbps: float | None = None
    """Constant rate instead of constant quality."""
    preset: str | None = None
    encoder: str | None = None
    """FFmpeg's name of the encoder, or ``auto-hardware``; None = software."""
    treatment: RegionTreatment | None = None
    """What becomes of regions before coding; None = what measured best for the codec."""
    strategy: str = "cable"
    """A name of `cable_rpc.study.strategies.STRATEGIES`."""
    realtime: bool = False
    """True: frames come at their own pace and are dropped when the loop is late. False: lock-step, one at a time."""
    block_size: int = 8
    prompt: str = ""
    min_score: float = 0.0
    client_id: str = ""
    connect_timeout_s: float = 10.0
    reconnect_s: float = 0.0
    """How long to look for a server that was lost; 0 = the run ends. The pass of whole frames always ends."""
    evaluate: bool = True
    """Second pass: the same frames whole, for their bytes and detections; quality; annotated video."""
    roi: RoiConfig = field(default_factory=RoiConfig)
    command_line: str = ""
    notes: tuple[str, ...] = ()
    security: ClientSecurity = PLAIN
    """TLS and token of the way to the server."""
    tracing: EdgeTracing = NOT_TRACED
    """Of the frames of the first pass."""


class StreamRun:
    """Runs one source once; `run` returns the summary and leaves all files in ``config.out``.

    Args:
        source: what is streamed.
        config: how.
        listener: is told each frame.
        report: is told, in a sentence, when the server is lost and found again.
    """

    def __init__(
        self, source: FrameSource, config: StreamRunConfig, listener: RecordListener, report: Report = log.warning
    ) -> None:
        self._source = source
        self._config = config
        self._listener = listener
        self._report = report
        width, height = source.size_wh
        self._parameters = CodecParameters(
            config.codec,
            width,
            height,
            source.fps,
            config.quality,
            preset=config.preset,
            encoder=config.encoder,
            bitrate_kbps=config.bitrate_kbps,
        )
        self._treatment = config.treatment or RegionTreatment.default_for(stateless=config.codec in STILL_CODECS)
        self._evidence: list[FrameEvidence] = []
        self._unsent: list[FrameRecord] = []
        self._measured_link: TransportBytes | None = None
        self._info = RunInfo(
            source=source.name,
            width=width,
            height=height,
            fps=source.fps,
            codec=config.codec,
            quality=self._quality_text(),
            strategy=config.strategy,
            mode=config.roi.mode,
            prompt=config.prompt,
            pace="real time" if config.realtime else "lock-step",
            server_target=config.target,
            started=datetime.now(UTC).isoformat(timespec="seconds"),
            command_line=config.command_line,
            versions=_versions(),
            notes=config.notes,
        )

    async def run(self) -> RunSummary:
        """Streams, evaluates, writes.

        A run that is interrupted or loses its server keeps what it had: frames.csv and summary.json are whole
        either way, and the error is raised after they are written.

        Raises:
            RemoteError, SourceError, CodecError: what ended the run early.
        """
        out = self._config.out
        out.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(out / STILLS_FOLDER, ignore_errors=True)
        with UplinkSpool() as spool:
            try:
                await self._stream(spool)
                if self._config.evaluate and self._evidence:
                    await self._evaluate(spool)
            finally:
                summary = self._write()
        return summary

    async def _stream(self, spool: UplinkSpool) -> None:
        config = self._config
        strategy = open_strategy(config.strategy, config.roi, config.block_size)
        capture = Capture(self._source, realtime=config.realtime)
        with FrameCsvWriter(config.out / FRAMES_FILE) as csv:
            async with self._lasting_session() as client:
                self._describe(client)
                encoder = FrameEncoder(strategy, self._parameters, self._treatment, config.tracing.every)
                if encoder.fallback_reason is not None:
                    self._note(f"Encoder: {encoder.fallback_reason}.")
                streamer = EdgeStreamer(capture, encoder, client)
                try:
                    async with aclosing(streamer.run()) as streamed_frames:
                        async for streamed in streamed_frames:
                            evidence = record_of(streamed, client.clock_offset)
                            config.tracing.frame_done(streamed, client.clock_offset)
                            spool.append(streamed.prepared.encoded.data)
                            self._evidence.append(evidence)
                            csv.write(evidence.record)
                            self._listener("stream", evidence.record)
                finally:
                    self._describe(client)
                    self._note_rate(encoder)
                    self._note_losses(client)
                    # The counters of connections that have gone went with them.
                    if not client.reconnects:
                        self._measured_link = measure_link(Target.parse(config.target).address)
                    self._unsent = [
                        *(FrameRecord(index, 0, "dropped") for index in capture.dropped),
                        *(FrameRecord(index, 0, "lost") for index in streamer.unanswered),
                    ]

    async def _evaluate(self, spool: UplinkSpool) -> None:
        evaluator = RunEvaluator(
            self._parameters, self._treatment, self._source.fps, self._config.out, spool, len(self._evidence)
        )
        with evaluator:
            async with aclosing(self._whole_frames()) as whole_frames:
                position = 0
                async for whole in whole_frames:
                    evidence = await _to_its_end(asyncio.to_thread(evaluator.judge, self._evidence[position], whole))
                    self._evidence[position] = evidence
                    position += 1
                    self._listener("evaluate", evidence.record)

    async def _whole_frames(self) -> AsyncGenerator[StreamedFrame, None]:
        """The same frames once more, whole, in lock-step: the baseline that savings are measured against."""
        indices = {evidence.record.index for evidence in self._evidence}
        capture = Capture(_only(self._source, indices), realtime=False)
        async with PerceptionClient(
            self._config.target,
            self._request(),
            security=self._config.security,
            window=1,
            connect_timeout_s=self._config.connect_timeout_s,
        ) as client:
            encoder = FrameEncoder(FullFrame(self._config.block_size), self._parameters, self._treatment)
            streamer = EdgeStreamer(capture, encoder, client)
            async with aclosing(streamer.run()) as streamed_frames:
                async for streamed in streamed_frames:
                    yield streamed

    def _lasting_session(self) -> ResumingClient:
        config = self._config
        return ResumingClient(
            config.target,
            self._request(),
            security=config.security,
            window=None if config.realtime else 1,
            connect_timeout_s=config.connect_timeout_s,
            reconnect_s=config.reconnect_s,
            report=self._report,
        )

    def _request(self) -> SessionRequest:
        config, parameters = self._config, self._parameters
        return SessionRequest(
            codec=config.codec,
            width=parameters.width,
            height=parameters.height,
            frame_rate=parameters.frame_rate,
            quality=config.quality or 0,
            client_id=config.client_id or platform.node(),
            prompt=config.prompt,
            min_score=config.min_score,
            intrinsics=_intrinsics(self._source),
            treatment=self._treatment,
        )

    def _describe(self, client: ResumingClient) -> None:
        offset = client.clock_offset
        models = [model.name for model in client.server_info.models]
        self._info = replace(
            self._info,
            detector=models[0] if models else "",
            segmenter=models[1] if len(models) > 1 else "",
            server_version=client.server_info.server_version,
            clock_offset_ns=offset.offset_ns if offset else None,
            clock_offset_error_ns=offset.error_ns if offset else None,
        )

    def _note(self, text: str) -> None:
        self._info = replace(self._info, notes=(*self._info.notes, text))

    def _note_rate(self, encoder: FrameEncoder) -> None:
        status = encoder.rate_status
        if status is None:
            return
        text = f"Image quality followed the rate: {status.mean_kbps:.0f} kbit/s, largest frame "
        text += f"{1 + status.largest_overshoot:.1f} times its share"
        if status.frames_at_floor or status.frames_at_ceiling:
            text += f"; out of reach on {status.frames_at_floor + status.frames_at_ceiling} frames"
        self._note(text + ".")

    def _note_losses(self, client: ResumingClient) -> None:
        if client.reconnects:
            times = "once" if client.reconnects == 1 else f"{client.reconnects} times"
            self._note(
                f"The server was lost and found again {times}; {client.lost_frames} frames were lost on the way."
            )

    def _write(self) -> RunSummary:
        records = [evidence.record for evidence in self._evidence] + self._unsent
        records.sort(key=lambda record: record.index)
        write_frames(self._config.out / FRAMES_FILE, records)
        summary = summarise(records, _with_transport(self._info, records, self._measured_link))
        write_summary(self._config.out, summary)
        return summary

    def _quality_text(self) -> str:
        config = self._config
        if config.bitrate_kbps is not None:
            return f"{config.bitrate_kbps:g} kbit/s"
        quality = default_quality(config.codec) if config.quality is None else config.quality
        if quality is None:
            return "lossless"
        return f"quality {quality}" if config.codec in STILL_CODECS else f"CRF {quality}"


def _with_transport(info: RunInfo, records: Iterable[FrameRecord], measured: TransportBytes | None) -> RunInfo:
    carried = measured or estimate_exchanges(
        (record.uplink_message_bytes, record.downlink_message_bytes) for record in records
    )
    return replace(
        info,
        transport_uplink_bytes=carried.uplink,
        transport_downlink_bytes=carried.downlink,
        transport_source="measured" if measured else "estimate",
    )


async def _to_its_end(work: Coroutine[Any, Any, FrameEvidence]) -> FrameEvidence:
    """Awaits a thread's work; a cancellation waits for it too, for the thread can't be stopped and holds the codecs."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait([task])
        raise


def _only(source: Iterable[Frame], indices: set[int]) -> Iterator[Frame]:
    last = max(indices)
    for frame in source:
        if frame.index in indices:
            yield frame
        if frame.index >= last:
            return


def _intrinsics(source: FrameSource) -> CameraIntrinsics | None:
    return getattr(source, "intrinsics", None)


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in VERSIONED_PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = cable_rpc.__version__ if package == "cable-rpc" else "?"
    return found
