"""Streams that survive: connections cut and silenced at any frame, a killed server, another server."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cable_codecs import CodecParameters, RegionTreatment, TreatedDecoder
from google.rpc import code_pb2, status_pb2
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cable_rpc.cloud.backends import FrameContext
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.cloud.tls import TlsFiles
from cable_rpc.edge import backoff
from cable_rpc.edge.capture import Capture
from cable_rpc.edge.channel import ClientSecurity
from cable_rpc.edge.client import SessionRequest
from cable_rpc.edge.frame_encoder import FrameEncoder
from cable_rpc.edge.resuming_client import ResumingClient
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.edge.streamer import EdgeStreamer, StreamedFrame
from cable_rpc.errors import RemoteError
from cable_rpc.study.run_record import read_frames
from cable_rpc.study.stream_run import StreamRun, StreamRunConfig
from cable_rpc.types import BoolMask, Image, Segmentation
from cable_rpc.wire.v1 import perception_pb2 as pb

from .certificates import Authority
from .secure_server import serving
from .tcp_relay import relayed
from .test_loop import FPS, MovingSquare

SIZE_WH = (160, 96)
PARAMETERS = CodecParameters("h264", *SIZE_WH, FPS)
CHATTY = SessionLimits(heartbeat_s=0.05, close_timeout_s=1.0)


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "FIRST_S", 0.02)


class Witness(BoxSegmenter):
    """Keeps every picture that it was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[int, Image] = {}
        self.streams: set[str] = set()
        self.forgotten: list[str] = []

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        self.seen[context.sequence] = image.copy()
        self.streams.add(context.stream)
        return super().segment(image, roi, prompt, context)

    def forget_stream(self, stream: str) -> None:
        self.forgotten.append(stream)


class Drive:
    """One streamed source, and what became of each of its frames."""

    def __init__(self, target: str, count: int, **settings: Any) -> None:
        self.said: list[str] = []
        self.frames: list[StreamedFrame] = []
        self.client = ResumingClient(target, SessionRequest("h264", *SIZE_WH, FPS), report=self.said.append, **settings)
        self.capture = Capture(MovingSquare(count, SIZE_WH), realtime=False)

    async def run(self, after: Any = None) -> None:
        async with self.client as client:
            streamer = EdgeStreamer(self.capture, FrameEncoder(RoiTracker(), PARAMETERS), client)
            async for frame in streamer.run():
                self.frames.append(frame)
                if after is not None:
                    await after(frame.prepared.index)

    @property
    def indices(self) -> list[int]:
        return [frame.prepared.index for frame in self.frames]

    @property
    def lost(self) -> list[int]:
        return [frame.prepared.index for frame in self.frames if frame.answer.is_lost]

    @property
    def idrs(self) -> list[int]:
        return [frame.prepared.index for frame in self.frames if frame.prepared.encoded.keyframe]

    def check_pictures(self, witness: Witness) -> None:
        """The cloud saw, bit by bit, what one decoder that never lost anything makes of the frames."""
        with TreatedDecoder(PARAMETERS, RegionTreatment.default_for(stateless=False)) as decoder:
            for frame in self.frames:
                message, region = frame.prepared.message, frame.prepared.sent_region
                blocks = region.blocks if message.HasField("region") else None
                expected = decoder.decode(message.data, blocks, region.block_size, stamp=message.sequence).image
                if frame.answer.rejection is None:
                    assert np.array_equal(witness.seen[message.sequence], expected)
                assert frame.answer.is_lost or not (frame.answer.rejection or "").startswith("UNDECODABLE")


async def test_cut_between_frames_costs_no_frame_and_no_keyframe() -> None:
    witness = Witness()
    async with serving(segmenter=witness) as server, relayed(f"127.0.0.1:{server.port}") as relay:
        drive = Drive(relay.target, 12, window=1)

        async def cut(index: int) -> None:
            if index in (3, 7):
                relay.reset()
                await asyncio.sleep(0.05)

        await drive.run(cut)
        assert drive.client.reconnects == 2
    assert drive.indices == list(range(12))
    assert (drive.lost, drive.idrs) == ([], [0])
    assert len(witness.streams) == 1
    drive.check_pictures(witness)
    assert sum("session kept, no keyframe needed" in line for line in drive.said) == 2
    assert sum(line.startswith("lost the server after ") for line in drive.said) == 2


@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    faults=st.dictionaries(st.integers(0, 17), st.sampled_from(["reset", "fall_silent"]), max_size=3),
    window=st.integers(1, 3),
)
async def test_every_frame_has_its_answer_wherever_the_connection_breaks(faults: dict[int, str], window: int) -> None:
    witness = Witness()
    limits = SessionLimits(max_in_flight=window, heartbeat_s=0.05, close_timeout_s=1.0)
    async with (
        serving(segmenter=witness, limits=limits) as server,
        relayed(f"127.0.0.1:{server.port}") as relay,
    ):
        drive = Drive(relay.target, 20, silence_timeout_s=0.3)

        async def break_off(index: int) -> None:
            if index in faults:
                getattr(relay, faults[index])()

        await asyncio.wait_for(drive.run(break_off), 60)
    assert drive.indices == sorted(drive.indices)
    assert sorted(drive.indices + drive.capture.dropped) == list(range(20))
    assert len(drive.lost) == drive.client.lost_frames
    drive.check_pictures(witness)
    assert not drive.lost or faults


async def test_a_session_that_seems_alive_is_taken_over() -> None:
    """The server has not noticed that the connection is dead; its only place for streams is still taken."""
    witness = Witness()
    async with (
        serving(segmenter=witness, limits=CHATTY) as server,
        relayed(f"127.0.0.1:{server.port}") as relay,
    ):
        drive = Drive(relay.target, 8, window=1, silence_timeout_s=0.3)

        async def silence(index: int) -> None:
            if index == 3:
                relay.fall_silent()

        server._service._admission.limits = server._service._admission.limits.__class__(streams=1)
        await asyncio.wait_for(drive.run(silence), 20)
        assert server._service._admission.streams <= 1
    assert drive.indices == list(range(8))
    assert len(drive.lost) <= 1
    assert any("session kept" in line for line in drive.said)
    drive.check_pictures(witness)


async def test_server_that_stops_sends_its_clients_to_another() -> None:
    first_seen, second_seen = Witness(), Witness()
    async with serving(segmenter=second_seen) as second:
        elsewhere = f"127.0.0.1:{second.port}"
        context = serving(segmenter=first_seen, alternative_target=elsewhere)
        first = await context.__aenter__()
        stopping: list[asyncio.Task[Any]] = []
        drive = Drive(f"127.0.0.1:{first.port}", 12)

        async def stop(index: int) -> None:
            if index == 4:
                stopping.append(asyncio.create_task(context.__aexit__(None, None, None)))

        await asyncio.wait_for(drive.run(stop), 20)
        await stopping[0]
        assert drive.client.target == elsewhere
    assert sorted(drive.indices + drive.capture.dropped) == list(range(12))
    assert len(drive.lost) <= 2
    assert any(f"at {elsewhere} (new session)" in line for line in drive.said)
    assert second_seen.seen
    assert len(drive.idrs) == 2
    witness = Witness()
    witness.seen = first_seen.seen | second_seen.seen
    drive.check_pictures(witness)


async def test_resumes_over_tls_and_goes_to_no_server_that_it_does_not_trust(tmp_path: Path) -> None:
    for name in ("ours", "theirs"):
        (tmp_path / name).mkdir()
    ours, theirs = Authority(tmp_path / "ours"), Authority(tmp_path / "theirs")
    files, foreign = (TlsFiles(pair.certificate, pair.key) for pair in (ours.issue("a"), theirs.issue("b")))
    security = ClientSecurity(authorities=ours.root.certificate)
    witness = Witness()
    async with (
        serving(tls=foreign) as impostor,
        serving(segmenter=witness, tls=files) as server,
        relayed(f"127.0.0.1:{server.port}") as relay,
    ):
        drive = Drive(f"grpcs://{relay.target}", 12, window=1, security=security)

        async def disturb(index: int) -> None:
            if index == 3:
                relay.reset()
                await asyncio.sleep(0.05)
            if index == 7:
                (session,) = server._service._sessions
                status = status_pb2.Status(code=code_pb2.UNAVAILABLE, message="off to another")
                session.drain(status, pb.CLOSE_ACTION_MOVE, f"127.0.0.1:{impostor.port}")
                await asyncio.sleep(0.05)

        await asyncio.wait_for(drive.run(disturb), 20)
    assert sorted(drive.indices + drive.capture.dropped) == list(range(12))
    assert drive.client.reconnects == 2
    assert sum("session kept" in line for line in drive.said) == 2
    assert any(f"not going to 127.0.0.1:{impostor.port}" in line for line in drive.said)
    drive.check_pictures(witness)


SERVER = """
import asyncio, sys
from cable_rpc.cloud.perception import PerceptionModels
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.service import ServerConfig, serve_until_signal
from tests.cloud.conftest import BrightBoxDetector
models = PerceptionModels.in_process(BrightBoxDetector(), BoxSegmenter())
config = ServerConfig("127.0.0.1:" + sys.argv[1], drain_s=0.5)
asyncio.run(serve_until_signal(models, config, lambda line: print(line, flush=True)))
"""


def started_server(repository: Path, port: int) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", SERVER, str(port)]
    process = subprocess.Popen(command, cwd=repository, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("listening on ")
    return process


async def test_killed_server_that_comes_back_is_found_again(
    repository: Path, unused_tcp_port: int, tmp_path: Path
) -> None:
    servers = [started_server(repository, unused_tcp_port)]
    reached = asyncio.Event()
    said: list[str] = []

    def listen(_: str, record: Any) -> None:
        if record.index == 6:
            reached.set()

    config = StreamRunConfig(
        f"127.0.0.1:{unused_tcp_port}", tmp_path, realtime=True, reconnect_s=30.0, evaluate=False, strategy="full-frame"
    )
    try:
        run = asyncio.create_task(StreamRun(MovingSquare(64, SIZE_WH), config, listen, said.append).run())
        await asyncio.wait_for(reached.wait(), 20)
        servers[0].kill()
        servers[0].wait()
        servers.append(await asyncio.to_thread(started_server, repository, unused_tcp_port))
        summary = await asyncio.wait_for(run, 60)
    finally:
        for server in servers:
            server.send_signal(signal.SIGKILL)
            server.wait()
            assert server.stdout is not None
            server.stdout.close()
    assert len(said) >= 2
    assert said[-1].startswith("resumed after ")
    assert "new session" in said[-1]
    records = read_frames(tmp_path / "frames.csv")
    assert [record.index for record in records] == list(range(64))
    assert summary.frames.lost == sum(record.outcome == "lost" for record in records) <= 2
    answered = [record.index for record in records if record.outcome == "answered"]
    assert max(answered) > max((r.index for r in records if r.outcome == "lost"), default=7)
    assert any("lost and found again once" in note for note in summary.info.notes)


async def test_a_run_with_lost_frames_is_judged_whole(tmp_path: Path) -> None:
    """Each answer to a frame number that ends in 4 is lost, and yet the decoder has the frame."""
    loop = asyncio.get_running_loop()

    class Breaking(Witness):
        def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
            if context.sequence % 10 == 4 and context.sequence not in self.seen:
                loop.call_soon_threadsafe(relay.reset)
                time.sleep(0.05)
            return super().segment(image, roi, prompt, context)

    async with serving(segmenter=Breaking()) as server, relayed(f"127.0.0.1:{server.port}") as relay:
        config = StreamRunConfig(relay.target, tmp_path, strategy="full-frame", reconnect_s=20.0)
        summary = await StreamRun(MovingSquare(16, SIZE_WH), config, lambda *_: None, lambda _: None).run()
    records = read_frames(tmp_path / "frames.csv")
    assert [record.index for record in records] == list(range(16))
    assert [record.index for record in records if record.outcome == "lost"] == [4, 14]
    assert [record.index for record in records if record.idr] == [0]
    assert (summary.frames.lost, summary.frames.answered) == (2, 14)
    for record in records:
        # What was lost has cost its bytes.
        assert record.bitstream_bytes == record.baseline_bitstream_bytes
        assert record.roi_psnr_db is not None
        assert (record.end_to_end_ns is None) == (record.outcome == "lost")


async def test_gives_up_in_time_and_says_why(unused_tcp_port: int) -> None:
    context = serving()
    server = await context.__aenter__()
    drive = Drive(f"127.0.0.1:{server.port}", 2000, reconnect_s=0.3, connect_timeout_s=0.2)

    async def stop(index: int) -> None:
        if index == 2:
            await context.__aexit__(None, None, None)

    with pytest.raises(RemoteError, match=r"no server for .*, gave up"):
        await asyncio.wait_for(drive.run(stop), 20)
