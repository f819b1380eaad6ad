"""Prometheus metrics of one server. Needs the cloud extra.

Labels come from fixed sets: nothing that a client chooses becomes one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping

from google.rpc import code_pb2
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

import cable_rpc
from cable_rpc.cloud.telemetry import Telemetry
from cable_rpc.wire.v1 import perception_pb2 as pb

SECONDS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
BATCH_SIZES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
STAGES = ("decode_wait", "decode", "detect_wait", "detect", "segment_wait", "segment", "server")
"""Of an answered frame; ``server`` is all of its time here."""
OUTCOMES = {number: name.removeprefix("REJECT_REASON_").lower() for name, number in pb.RejectReason.items()}


class ServerMetrics(Telemetry):
    """Counts into a registry of its own, so that several servers can live in one process."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        self._streams = Gauge("cable_streams", "Open streams", registry=registry)
        sessions = Counter(
            "cable_sessions",
            "Sessions welcomed: new, or resumed from an earlier connection",
            ["kind"],
            registry=registry,
        )
        self._new, self._resumed = sessions.labels("new"), sessions.labels("resumed")
        self._closings = Counter(
            "cable_closings", "Sessions that the server ended, by google.rpc.Code", ["code"], registry=registry
        )
        frames = Counter("cable_frames", "Frames answered: result, or why not", ["outcome"], registry=registry)
        self._results = frames.labels("result")
        self._rejections = {number: frames.labels(name) for number, name in OUTCOMES.items() if number}
        self._received = Counter("cable_frames_received", "Frames accepted", registry=registry)
        up = Counter("cable_uplink_bytes", "Bytes of accepted frames", ["layer"], registry=registry)
        self._up_video, self._up_region, self._up_rest = (up.labels(layer) for layer in ("video", "region", "rest"))
        down = Counter("cable_downlink_bytes", "Bytes of messages sent", ["layer"], registry=registry)
        self._down_mask, self._down_rest = (down.labels(layer) for layer in ("mask", "rest"))
        stages = Histogram(
            "cable_stage_seconds", "Time of an answered frame", ["stage"], buckets=SECONDS, registry=registry
        )
        self._stages = {stage: stages.labels(stage) for stage in STAGES}
        self._batches = Histogram(
            "cable_batch_frames", "Frames in one run of a model", ["model"], buckets=BATCH_SIZES, registry=registry
        )
        self._runs = Histogram(
            "cable_batch_seconds", "Time of one run of a model", ["model"], buckets=SECONDS, registry=registry
        )
        self._keyframe_requests = Counter(
            "cable_keyframe_requests", "Times a decoder asked for a keyframe", registry=registry
        )
        self._authentication_failures = Counter(
            "cable_authentication_failures", "Calls without a valid token or certificate", registry=registry
        )
        build = Gauge("cable_build_info", "Always 1; the version of the program", ["version"], registry=registry)
        build.labels(cable_rpc.__version__).set(1)
        registry.register(MemoryCollector())

    def stream_opened(self) -> None:
        """See `Telemetry`."""
        self._streams.inc()

    def stream_closed(self) -> None:
        """See `Telemetry`."""
        self._streams.dec()

    def frame_received(self, frame: pb.VideoFrame) -> None:
        """See `Telemetry`."""
        self._received.inc()
        video, region = len(frame.data), frame.region.ByteSize() if frame.HasField("region") else 0
        self._up_video.inc(video)
        self._up_region.inc(region)
        self._up_rest.inc(frame.ByteSize() - video - region)

    def response_sent(self, response: pb.StreamPerceptionResponse) -> None:
        """See `Telemetry`."""
        kind, mask_bytes = response.WhichOneof("payload"), 0
        if kind == "result":
            result = response.result
            self._results.inc()
            self._observe(result.timing)
            mask_bytes = len(result.mask.data) + len(result.mask.uncertainty)
            self._down_mask.inc(mask_bytes)
        elif kind == "frame_rejected":
            self._rejections[response.frame_rejected.reason].inc()
        elif kind == "welcome":
            (self._resumed if response.welcome.resumed else self._new).inc()
        elif kind == "closing":
            self._closings.labels(code_pb2.Code.Name(response.closing.status.code).lower()).inc()
        elif kind == "keyframe_request":
            self._keyframe_requests.inc()
        self._down_rest.inc(response.ByteSize() - mask_bytes)

    def batch_done(self, model: str, size: int, run_ns: int) -> None:
        """See `Telemetry`."""
        self._batches.labels(model).observe(size)
        self._runs.labels(model).observe(run_ns / 1e9)

    def authentication_failed(self) -> None:
        """See `Telemetry`."""
        self._authentication_failures.inc()

    def _observe(self, timing: pb.ServerTiming) -> None:
        took: dict[str, int] = {
            "decode_wait": timing.decode_wait_ns,
            "decode": timing.decode_ns,
            "server": timing.send_time_ns - timing.receive_time_ns,
        }
        for stage in timing.stages:
            if stage.stage in self._stages:
                took[stage.stage] = stage.run_ns
                took[f"{stage.stage}_wait"] = stage.wait_ns
        for name, took_ns in took.items():
            self._stages[name].observe(took_ns / 1e9)


class MemoryCollector(Collector):
    """Memory with the models in it, looked up at each scrape."""

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """See `prometheus_client.registry.Collector`."""
        family = GaugeMetricFamily(
            "cable_memory_bytes", "Memory with the models in it: resident, and of each GPU", labels=["kind"]
        )
        for kind, size in memory_bytes().items():
            family.add_metric([kind], size)
        yield family


def memory_bytes() -> Mapping[str, int]:
    """Resident memory of this process and what torch holds on each GPU; a platform that doesn't tell is left out."""
    sizes = {}
    try:
        with open("/proc/self/statm") as statm:
            sizes["resident"] = int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        pass
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        for index in range(torch.cuda.device_count()):
            sizes[f"cuda{index}"] = torch.cuda.memory_allocated(index)
    return sizes
