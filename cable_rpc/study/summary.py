"""The figures of one run: frame records in, one summary out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from cable_rpc.study.language_summary import LanguageCost, language_cost
from cable_rpc.study.metrics import (
    MatchCounts,
    Scores,
    macro_frame,
    mean_or_none,
    percentiles,
    pixel_saving,
    scores_of,
)
from cable_rpc.study.run_record import SUMMARY_FILE, FrameRecord, RunInfo, write_json
from cable_rpc.study.transport_estimate import estimate_exchange

SCHEMA_VERSION = 1

STAGES = {
    "capture": "source (before capture time)",
    "roi": "ROI prediction",
    "fill": "background fill",
    "encode": "encode",
    "uplink": "uplink",
    "queue": "server wait",
    "decode": "decode",
    "detect": "detect",
    "segment": "segment",
    "segment_preprocess": "· image preparation",
    "segment_clip": "· CLIP",
    "segment_prefill": "· prefill",
    "segment_decode": "· token by token",
    "segment_sam_encoder": "· SAM encoder",
    "segment_mask_decoder": "· mask decoder",
    "segment_postprocess": "· enlarging masks",
    "server": "server in all",
    "downlink": "downlink",
    "apply": "apply mask",
    "end_to_end": "end to end",
}
"""Stages in the order of a frame's way, parts of a stage after it; each is the field ``<stage>_ns`` of a record."""

RECOGNITION_FIELDS = {
    0.05: "recognised",
    0.25: "recognised_25",
    0.50: "recognised_50",
    0.75: "recognised_75",
    0.95: "recognised_95",
}


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """What became of the captured frames."""

    captured: int
    answered: int
    rejected: int
    dropped: int
    lost: int

    @property
    def sent(self) -> int:
        """Frames that left the edge."""
        return self.captured - self.dropped


@dataclass(frozen=True, slots=True)
class LayerBytes:
    """One layer at which bytes are counted, the layers before it included; means are per frame sent."""

    layer: str
    uplink_bytes_per_frame: float | None
    uplink_kbps: float | None
    downlink_bytes_per_frame: float | None
    downlink_kbps: float | None
    full_frame_bytes_per_frame: float | None
    byte_saving: float | None
    """1 - uplink / full frame over the frames that have both; negative where the ROI stream costs more."""


@dataclass(frozen=True, slots=True)
class StageLatency:
    """Time that frames spent in one stage, in milliseconds."""

    stage: str
    label: str
    frames: int
    mean_ms: float
    p50_ms: float
    p95_ms: float
    p99_ms: float


@dataclass(frozen=True, slots=True)
class Quality:
    """What perception was worth; None where the run had nothing to score against."""

    truth_frames: int
    truth_count: int
    recognition: tuple[tuple[float, float], ...]
    """(overlap threshold, share of the objects), pooled over objects."""
    scored_frames: int
    """Frames whose detections were matched with truth."""
    micro: Scores | None
    macro_frame: Scores | None
    retention: float | None
    spurious_rate: float | None
    """Share of the ROI-only detections without a full-frame counterpart."""
    roi_psnr_db: float | None
    detections_per_frame: float | None
    mask_coverage: float | None
    mask_confidence: float | None


@dataclass(frozen=True, slots=True)
class RunSummary:
    """All figures of one run."""

    info: RunInfo
    frames: FrameCounts
    coverage_roi: float | None
    """Mean of R_k over the frames with a prior, keyframes included (the paper's table)."""
    coverage_tx: float | None
    """Mean share of pixels sent, keyframes and the first frame as 1."""
    keyframe_rate: float | None
    pixel_saving: float | None
    """1 - ``coverage_tx``; pixels, not bytes (the paper's figure is 1 - ``coverage_roi``)."""
    layers: tuple[LayerBytes, ...]
    latency: tuple[StageLatency, ...]
    staleness_mean_frames: float | None
    staleness_max_frames: int | None
    quality: Quality
    language: LanguageCost | None = None
    """None where the segmenter has no language model."""

    def layer(self, name: str) -> LayerBytes:
        """The layer of that name."""
        return next(layer for layer in self.layers if layer.layer == name)

    def stage(self, name: str) -> StageLatency | None:
        """The stage of that name, where it was measured."""
        return next((stage for stage in self.latency if stage.stage == name), None)


def summarise(records: Sequence[FrameRecord], info: RunInfo) -> RunSummary:
    """Aggregate the records of a run.

    Bytes count every frame, keyframes included. Coverage, keyframe rate and bytes per frame are over frames
    that left the edge; rates in kbit/s are over all captured frames at the source's frame rate.
    """
    sent = [record for record in records if record.outcome != "dropped"]
    coverage_tx = mean_or_none(record.coverage for record in sent)
    staleness = [record.staleness_frames for record in sent if record.staleness_frames is not None]
    return RunSummary(
        info=info,
        frames=count_frames(records),
        coverage_roi=mean_or_none(record.roi_coverage for record in sent),
        coverage_tx=coverage_tx,
        keyframe_rate=mean_or_none(float(record.keyframe) for record in sent),
        pixel_saving=None if coverage_tx is None else pixel_saving(coverage_tx),
        layers=byte_layers(records, info),
        latency=stage_latencies(records),
        staleness_mean_frames=mean_or_none(staleness),
        staleness_max_frames=max(staleness, default=None),
        quality=quality_of(records),
        language=language_cost([record for record in records if record.outcome == "answered"]),
    )


def count_frames(records: Sequence[FrameRecord]) -> FrameCounts:
    """Frames by outcome."""
    outcomes = [record.outcome for record in records]
    return FrameCounts(
        captured=len(outcomes),
        answered=outcomes.count("answered"),
        rejected=outcomes.count("rejected"),
        dropped=outcomes.count("dropped"),
        lost=outcomes.count("lost"),
    )


def byte_layers(records: Sequence[FrameRecord], info: RunInfo) -> tuple[LayerBytes, ...]:
    """Bytes at the four layers: bitstream, with ROI side information, message, transport.

    Transport is as ``info`` states it. An estimate is set against the full frame by the same formula (its answer
    taken to be as large as ours); a measured figure has no full frame, as only this run's connections were read.
    """
    sent = [record for record in records if record.outcome != "dropped"]
    captured = len(records)

    def per_frame(total: int | None) -> float | None:
        return total / len(sent) if total is not None and sent else None

    def kbps(total: int | None) -> float | None:
        return total * 8.0 * info.fps / captured / 1e3 if total is not None and captured and info.fps else None

    def layer(name: str, up: int | None, down: int | None, pairs: Iterable[tuple[int, int | None]]) -> LayerBytes:
        both = [(ours, full) for ours, full in pairs if full is not None]
        full_total = sum(full for _, full in both)
        saving = 1.0 - sum(ours for ours, _ in both) / full_total if full_total else None
        full_mean = full_total / len(both) if both else None
        return LayerBytes(name, per_frame(up), kbps(up), per_frame(down), kbps(down), full_mean, saving)

    return (
        layer(
            "bitstream",
            sum(record.bitstream_bytes for record in sent),
            sum(record.mask_bytes for record in sent),
            ((record.bitstream_bytes, record.baseline_bitstream_bytes) for record in sent),
        ),
        layer(
            "with_roi",
            sum(record.bitstream_bytes + record.roi_bytes for record in sent),
            None,
            ((record.bitstream_bytes + record.roi_bytes, record.baseline_bitstream_bytes) for record in sent),
        ),
        layer(
            "message",
            sum(record.uplink_message_bytes for record in sent),
            sum(record.downlink_message_bytes for record in sent),
            ((record.uplink_message_bytes, record.baseline_message_bytes) for record in sent),
        ),
        layer(
            "transport",
            info.transport_uplink_bytes,
            info.transport_downlink_bytes,
            map(estimated_uplinks, sent) if info.transport_source == "estimate" else (),
        ),
    )


def estimated_uplinks(record: FrameRecord) -> tuple[int, int | None]:
    """Uplink packets in bytes of a frame and of the same frame sent whole, by estimate."""
    answer, whole = record.downlink_message_bytes, record.baseline_message_bytes
    ours = estimate_exchange(record.uplink_message_bytes, answer).uplink
    return ours, None if whole is None else estimate_exchange(whole, answer).uplink


def stage_latencies(records: Sequence[FrameRecord]) -> tuple[StageLatency, ...]:
    """Latency of each stage that was measured on at least one frame."""
    stages = []
    for stage, label in STAGES.items():
        sample = [value / 1e6 for record in records if (value := getattr(record, f"{stage}_ns")) is not None]
        tails = percentiles(sample)
        if tails is not None:
            mean = sum(sample) / len(sample)
            stages.append(StageLatency(stage, label, len(sample), mean, tails.p50, tails.p95, tails.p99))
    return tuple(stages)


def quality_of(records: Sequence[FrameRecord]) -> Quality:
    """Recognition, precision, recall, retention and picture quality over the frames that carry them."""
    with_truth = [record for record in records if record.truth_count is not None]
    matches = [
        MatchCounts(record.true_positives, record.false_positives, record.false_negatives)
        for record in records
        if record.true_positives is not None
        and record.false_positives is not None
        and record.false_negatives is not None
    ]
    pooled = sum(matches, MatchCounts(0, 0, 0))
    held = [record for record in records if record.retained is not None and record.spurious is not None]
    kept = sum(record.retained or 0 for record in held)
    spurious = sum(record.spurious or 0 for record in held)
    return Quality(
        truth_frames=len(with_truth),
        truth_count=sum(record.truth_count or 0 for record in with_truth),
        recognition=recognition_shares(with_truth),
        scored_frames=len(matches),
        micro=scores_of(pooled) if matches else None,
        macro_frame=macro_frame(matches) if matches else None,
        retention=share(kept, sum(record.reference_count or 0 for record in held)),
        spurious_rate=share(spurious, kept + spurious),
        roi_psnr_db=mean_or_none(record.roi_psnr_db for record in records),
        detections_per_frame=mean_or_none(record.detection_count for record in records),
        mask_coverage=mean_or_none(record.mask_coverage for record in records),
        mask_confidence=mean_or_none(record.mask_confidence for record in records),
    )


def recognition_shares(records: Sequence[FrameRecord]) -> tuple[tuple[float, float], ...]:
    """Recognised share of the objects at each threshold that the run recorded."""
    curve = []
    for threshold, name in RECOGNITION_FIELDS.items():
        pairs = [(found, record.truth_count or 0) for record in records if (found := getattr(record, name)) is not None]
        ratio = share(sum(found for found, _ in pairs), sum(total for _, total in pairs))
        if ratio is not None:
            curve.append((threshold, ratio))
    return tuple(curve)


def share(part: int, whole: int) -> float | None:
    """``part / whole``; None where the whole is empty."""
    return part / whole if whole else None


def honesty_notes(summary: RunSummary) -> tuple[str, ...]:
    """What a reader must know before quoting the figures of this run."""
    info = summary.info
    notes = ["Pixel saving counts pixels that were not sent; it is no measure of bytes."]
    if summary.layer("message").byte_saving is None:
        notes.append("No full-frame pass was made, so there is no byte saving to state.")
    else:
        notes.append(
            "Byte saving compares the uplink with a full-frame pass of the same clip at the same codec and "
            "quality setting; equal setting is not equal task quality, for which a rate sweep is needed."
        )
    if info.clock_offset_error_ns is not None:
        notes.append(
            "Uplink and downlink are one-way delays between two clocks, "
            f"good to ± {info.clock_offset_error_ns / 1e6:.2f} ms."
        )
    elif summary.stage("uplink") is not None:
        notes.append("Uplink and downlink are one-way delays between two clocks whose offset was not bounded.")
    if info.transport_source == "estimate":
        notes.append(
            "Transport bytes are an estimate, not a measurement: gRPC, HTTP/2, TCP and IPv4 headers and "
            "acknowledgements as on Ethernet, without connection set-up, retransmissions and TLS."
        )
    elif info.transport_source == "measured":
        notes.append(
            "Transport bytes were counted by the kernel on this run's TCP connections, handshake and clock samples "
            "included; the full-frame pass was not counted."
        )
    if "oracle" in info.segmenter.lower():
        notes.append(
            "The segmenter is the oracle: it reads the ground truth, so the figures are an upper bound of "
            "what a real model reaches."
        )
    if summary.language is not None and summary.language.of_run is not None:
        notes.append(
            "Prefill: the paper's column takes all work for attention, which is a few percent of a language model's "
            "work at these lengths; the operations and the clock say what is gained. The prefill is one part of the "
            "segmenter's time."
        )
    if summary.quality.truth_frames == 0:
        notes.append("The source has no truth: recognition, precision and recall can't be stated.")
    return (*notes, *info.notes)


def write_summary(run_dir: Path, summary: RunSummary) -> Path:
    """Write ``summary.json`` into the run's folder and return its path."""
    content = asdict(summary)
    run = content.pop("info")
    path = run_dir / SUMMARY_FILE
    write_json(path, {"schema_version": SCHEMA_VERSION, "run": run, "summary": content})
    return path
