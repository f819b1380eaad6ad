"""Edge and cloud together over a real socket: our client, our server, and what goes wrong between them."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cable_codecs import STILL_CODECS, CodecParameters, RegionTreatment, TreatedDecoder, available_codecs

from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.edge.capture import Capture
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.edge.frame_encoder import FrameEncoder
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.edge.strategy import FullFrame
from cable_rpc.edge.streamer import EdgeStreamer, StreamedFrame
from cable_rpc.errors import RemoteError, SourceError
from cable_rpc.study.run_record import read_frames
from cable_rpc.study.stream_run import StreamRun, StreamRunConfig
from cable_rpc.types import EgoMotion, Frame

from .conftest import BrightBoxDetector

FPS = 20.0


class MovingSquare:
    """A bright square that crosses a textured picture; any size."""

    name = "moving square"
    fps = FPS

    def __init__(self, count: int, size_wh: tuple[int, int] = (160, 96), fail_at: int | None = None) -> None:
        self.frame_count: int | None = count
        self.size_wh = size_wh
        self._fail_at = fail_at

    def __iter__(self) -> Iterator[Frame]:
        width, height = self.size_wh
        texture = np.random.default_rng(1).integers(60, 120, (height, width, 3), np.uint8)
        for index in range(self.frame_count or 0):
            if index == self._fail_at:
                raise SourceError(f"the camera went away at frame {index}")
            image = texture.copy()
            left = 20 + 2 * index
            image[height // 3 : height // 3 + 40, left : left + 50] = 255
            yield Frame(image, index, round(index * 1e9 / FPS), EgoMotion(10.0))


class RecordingDetector(BrightBoxDetector):
    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def one(self, image: np.ndarray) -> Any:
        self.seen.append(image.copy())
        return super().one(image)


class StallingDetector(BrightBoxDetector):
    def one(self, image: np.ndarray) -> Any:
        import time

        time.sleep(0.12)
        return super().one(image)


async def streamed(
    target: str,
    source: MovingSquare,
    codec: str,
    strategy: Any,
    *,
    realtime: bool = False,
    treatment: RegionTreatment | None = None,
) -> tuple[list[StreamedFrame], Capture]:
    width, height = source.size_wh
    capture = Capture(source, realtime=realtime)
    request = SessionRequest(codec, width, height, FPS, treatment=treatment)
    async with PerceptionClient(target, request, window=None if realtime else 1) as client:
        encoder = FrameEncoder(strategy, CodecParameters(codec, width, height, FPS), treatment)
        return [frame async for frame in EdgeStreamer(capture, encoder, client).run()], capture


async def stream_through(client: PerceptionClient, source: MovingSquare) -> None:
    async with client:
        encoder = FrameEncoder(FullFrame(), CodecParameters("jpeg", *source.size_wh, FPS))
        async for _ in EdgeStreamer(Capture(source, realtime=False), encoder, client).run():
            pass


TREATMENTS = {
    "default": None,
    "grey on a coarse grid": RegionTreatment(fill="grey", grid=16),
    "held": RegionTreatment(hold_frames=2),
    "half size": RegionTreatment(scale=0.5),
    "composed": RegionTreatment(compose=True),
    "soft": RegionTreatment(fill="keep", quantiser_offset=0.4),
}


@pytest.mark.parametrize(
    ("codec", "treatment"),
    [
        *((codec, "default") for codec in ("jpeg", "webp", "webp-lossless", "h264", "hevc", "av1", "vp9")),
        *(("h264", name) for name in TREATMENTS if name != "default"),
        ("jpeg", "half size"),
    ],
)
@pytest.mark.parametrize("size_wh", [(160, 96), (641, 479), (1225, 370)])
async def test_the_cloud_sees_exactly_what_the_edge_decodes(
    running_server: Any, codec: str, treatment: str, size_wh: tuple[int, int]
) -> None:
    if codec not in available_codecs():
        pytest.skip(f"this FFmpeg has no {codec}")
    detector = RecordingDetector()
    source = MovingSquare(4, size_wh)
    chosen = TREATMENTS[treatment]
    async with running_server(detector=detector) as target:
        frames, _ = await streamed(target, source, codec, RoiTracker(RoiConfig.paper()), treatment=chosen)
    assert [frame.answer.rejection for frame in frames] == [None] * 4
    used = chosen or RegionTreatment.default_for(stateless=codec in STILL_CODECS)
    with TreatedDecoder(CodecParameters(codec, *size_wh, FPS), used) as decoder:
        for frame, seen in zip(frames, detector.seen, strict=True):
            message, region = frame.prepared.message, frame.prepared.sent_region
            blocks = region.blocks if message.HasField("region") else None
            expected = decoder.decode(message.data, blocks, region.block_size, stamp=message.sequence)
            assert np.array_equal(seen, expected.image)
            inside = region.pixels()
            assert not (frame.prepared.proposal.roi.pixels() & ~inside).any()
            camera = frame.prepared.captured.frame.image
            assert np.abs(seen[inside].astype(int) - camera[inside]).mean() < 30
            if used.refills and used.refill == "constant" and not used.compose:
                assert (seen[~inside] == (128 if used.fill == "grey" else 0)).all()


async def test_the_mask_closes_the_loop(running_server: Any) -> None:
    async with running_server() as target:
        frames, _ = await streamed(target, MovingSquare(12), "h264", RoiTracker())
    assert [frame.prepared.index for frame in frames] == list(range(12))
    assert frames[0].prepared.proposal.keyframe
    later = [frame.prepared.proposal for frame in frames[2:]]
    assert all(proposal.staleness == 1 for proposal in later)
    assert all(proposal.roi.coverage < 0.9 for proposal in later if not proposal.keyframe)
    assert any(not proposal.keyframe for proposal in later)


async def test_clock_offset_on_one_machine_is_within_its_bound(running_server: Any) -> None:
    """Both ends read the same monotonic clock here, so the true offset is zero."""
    async with running_server() as target, PerceptionClient(target, SessionRequest("jpeg", 32, 32, FPS)) as client:
        offset = client.clock_offset
        assert offset is not None
        assert abs(offset.offset_ns) <= offset.error_ns


async def test_realtime_drops_before_the_encoder_and_keeps_the_newest(running_server: Any) -> None:
    async with running_server(detector=StallingDetector()) as target:
        frames, capture = await streamed(target, MovingSquare(30), "h264", FullFrame(), realtime=True)
    indices = [frame.prepared.index for frame in frames]
    assert capture.dropped
    assert sorted(indices + capture.dropped) == list(range(30))
    assert all(frame.answer.rejection is None for frame in frames), "a coded frame was lost"


async def test_nobody_there_is_said_at_once(unused_tcp_port: int) -> None:
    client = PerceptionClient(
        f"127.0.0.1:{unused_tcp_port}", SessionRequest("jpeg", 32, 32, FPS), connect_timeout_s=0.5
    )
    with pytest.raises(RemoteError, match="is `cable-rpc serve` running"):
        await client.__aenter__()


async def test_silent_server_counts_as_lost(running_server: Any) -> None:
    """Heartbeats are off and the model takes longer than the client's patience."""
    limits = SessionLimits(heartbeat_s=60.0, close_timeout_s=0.1)
    async with running_server(detector=StallingDetector(), limits=limits) as target:
        request = SessionRequest("jpeg", 160, 96, FPS)
        client = PerceptionClient(target, request, window=1, silence_timeout_s=0.05)
        with pytest.raises(RemoteError, match=r"silent for 0\.05 s"):
            await stream_through(client, MovingSquare(3))


async def test_refused_session_carries_the_servers_reason(running_server: Any) -> None:
    async with running_server() as target:
        client = PerceptionClient(target, SessionRequest("jpeg", 60_000, 60_000, FPS))
        with pytest.raises(RemoteError, match="lower resolution"):
            await client.__aenter__()


async def test_vanished_server_ends_the_run_and_keeps_its_frames(running_server: Any, tmp_path: Path) -> None:
    context = running_server()
    target = await context.__aenter__()
    reached = asyncio.Event()

    def listen(_: str, record: Any) -> None:
        if record.index == 10:
            reached.set()

    run = StreamRun(MovingSquare(2000), StreamRunConfig(target, tmp_path, codec="jpeg"), listen)
    running = asyncio.create_task(run.run())
    await asyncio.wait_for(reached.wait(), 30)
    await context.__aexit__(None, None, None)
    with pytest.raises(RemoteError):
        await asyncio.wait_for(running, 30)
    records = read_frames(tmp_path / "frames.csv")
    assert [record.index for record in records[:11]] == list(range(11))
    assert (tmp_path / "summary.json").exists()
    assert not list(tmp_path.glob("*.part"))


async def test_failing_source_ends_the_run_and_keeps_its_frames(running_server: Any, tmp_path: Path) -> None:
    async with running_server() as target:
        config = StreamRunConfig(target, tmp_path, codec="jpeg")
        with pytest.raises(SourceError, match="went away at frame 5"):
            await StreamRun(MovingSquare(20, fail_at=5), config, lambda *_: None).run()
    assert len(read_frames(tmp_path / "frames.csv")) == 5


@pytest.mark.parametrize("codec", ["jpeg", "h264"])
async def test_a_run_measures_both_passes(running_server: Any, tmp_path: Path, codec: str) -> None:
    passes: list[str] = []
    async with running_server() as target:
        # The paper's mode, because its region of this scene is small for certain.
        config = StreamRunConfig(target, tmp_path, codec=codec, roi=RoiConfig.paper())
        run = StreamRun(MovingSquare(8), config, lambda name, _: passes.append(name))
        await run.run()
    assert passes == ["stream"] * 8 + ["evaluate"] * 8
    records = read_frames(tmp_path / "frames.csv")
    assert [record.outcome for record in records] == ["answered"] * 8
    for record in records:
        assert record.uplink_message_bytes > record.bitstream_bytes + record.roi_bytes > 0
        assert record.baseline_bitstream_bytes
        assert record.end_to_end_ns is not None
        assert record.server_ns is not None
        assert record.end_to_end_ns > record.server_ns > 0
        assert record.retained is not None
    sent, whole = sum(r.bitstream_bytes for r in records), sum(r.baseline_bitstream_bytes or 0 for r in records)
    assert sent < whole if codec == "jpeg" else sent <= whole
    assert (tmp_path / "annotated.mp4").exists()
    assert len(list((tmp_path / "stills").glob("*.jpg"))) >= 6


async def test_full_frame_strategy_costs_what_the_baseline_costs(running_server: Any, tmp_path: Path) -> None:
    """The same encoder on the same pixels: both passes must agree to the byte."""
    async with running_server() as target:
        config = StreamRunConfig(target, tmp_path, codec="h264", strategy="full-frame")
        await StreamRun(MovingSquare(6), config, lambda *_: None).run()
    for record in read_frames(tmp_path / "frames.csv"):
        assert record.bitstream_bytes == record.baseline_bitstream_bytes
        assert record.coverage == 1.0
