"""What a run's frames cost and bought: the measurements of the stream, and its judgement against whole frames."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from cable_codecs import CodecError, CodecParameters, RegionTreatment, TreatedDecoder, decode_mask, roi_psnr

from cable_rpc.edge.streamer import StreamedFrame
from cable_rpc.study.annotate import AnnotatedVideoWriter, annotate, status_line
from cable_rpc.study.language_record import language_columns, segment_parts, whole_prefill
from cable_rpc.study.metrics import match_detections, recognition_curve, retained, visible_truth
from cable_rpc.study.run_record import STILLS_FOLDER, VIDEO_FILE, FrameRecord, Outcome
from cable_rpc.types import BoolMask, Detections, Frame, Image, RoiMask
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.clock import ClockOffset

STILL_COUNT = 4


@dataclass(frozen=True, slots=True)
class FrameEvidence:
    """A frame's record, and what the second pass needs to judge it."""

    record: FrameRecord
    roi: RoiMask
    detections: Detections
    mask_data: bytes
    """The cloud's mask as coded on the wire; empty without one."""


class UplinkSpool:
    """The coded frames of a run in order, on disk, so that memory does not grow with the run."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._sizes: list[int] = []
        self._read = 0

    def __enter__(self) -> UplinkSpool:
        self._file = tempfile.TemporaryFile(prefix="cable-rpc-uplink-")
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._file is not None:
            self._file.close()

    def append(self, data: bytes) -> None:
        """Adds the next frame."""
        self._open.write(data)
        self._sizes.append(len(data))

    def read_next(self) -> bytes:
        """The frames again, from the first on."""
        if self._read == 0:
            self._open.seek(0)
        size = self._sizes[self._read]
        self._read += 1
        return self._open.read(size)

    @property
    def _open(self) -> IO[bytes]:
        if self._file is None:
            raise ValueError("UplinkSpool is used outside its with block")
        return self._file


def record_of(streamed: StreamedFrame, clock_offset: ClockOffset | None) -> FrameEvidence:
    """Measurements of one streamed frame, without any judgement of quality."""
    prepared, answer = streamed.prepared, streamed.answer
    proposal, message, times = prepared.proposal, prepared.message, answer.times
    segmentation = answer.segmentation
    heard = not answer.is_lost
    uplink_ns = downlink_ns = None
    if clock_offset is not None and times.receive_time_ns:
        uplink_ns = clock_offset.to_client(times.receive_time_ns) - message.send_time_ns
        downlink_ns = answer.receive_time_ns - clock_offset.to_client(times.send_time_ns)
    record = FrameRecord(
        index=prepared.index,
        capture_time_ns=prepared.captured.frame.capture_time_ns,
        outcome=outcome_of(answer),
        keyframe=proposal.keyframe,
        keyframe_reason=proposal.keyframe_reason or "",
        idr=prepared.encoded.keyframe,
        coverage=prepared.sent_region.coverage,
        roi_coverage=proposal.coverage if proposal.prior_index is not None else None,
        staleness_frames=proposal.staleness,
        bitstream_bytes=len(prepared.encoded.data),
        roi_bytes=len(message.region.data),
        uplink_message_bytes=prepared.uplink_message_bytes,
        downlink_message_bytes=answer.message_bytes,
        mask_bytes=len(answer.mask_data) + len(answer.uncertainty_data),
        capture_ns=prepared.captured.capture_ns,
        roi_ns=prepared.roi_ns,
        fill_ns=prepared.fill_ns,
        encode_ns=prepared.encoded.duration_ns,
        uplink_ns=uplink_ns,
        queue_ns=times.queue_ns if heard else None,
        decode_ns=times.decode_ns if heard else None,
        detect_ns=times.run_ns.get("detect"),
        segment_ns=times.run_ns.get("segment"),
        **segment_parts(times.parts_of("segment")),
        server_ns=times.send_time_ns - times.receive_time_ns if heard else None,
        downlink_ns=downlink_ns,
        apply_ns=streamed.apply_ns if heard else None,
        end_to_end_ns=streamed.applied_time_ns - prepared.captured.available_time_ns if heard else None,
        detection_count=len(answer.detections) if heard else None,
        mask_coverage=float(segmentation.mask.mean()) if segmentation else None,
        mask_confidence=segmentation.confidence if segmentation else None,
        **language_columns(segmentation),
    )
    return FrameEvidence(record, prepared.sent_region, answer.detections, answer.mask_data)


def outcome_of(answer: FrameAnswer) -> Outcome:
    """What became of a frame that was sent."""
    if answer.is_lost:
        return "lost"
    return "answered" if answer.rejection is None else "rejected"


class RunEvaluator:
    """Judges a run's frames in order; writes the annotated video and a few stills as it goes."""

    def __init__(
        self,
        parameters: CodecParameters,
        treatment: RegionTreatment,
        fps: float,
        out: Path,
        spool: UplinkSpool,
        frame_count: int,
    ) -> None:
        self._spool = spool
        self._decoder = TreatedDecoder(parameters, treatment)
        self._video = AnnotatedVideoWriter(out / VIDEO_FILE, fps)
        self._stills = out / STILLS_FOLDER
        self._still_positions = {round((i + 0.5) * frame_count / STILL_COUNT) for i in range(STILL_COUNT)}
        self._position = 0

    def __enter__(self) -> RunEvaluator:
        self._video.__enter__()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._video.close()
        self._decoder.close()

    def judge(self, evidence: FrameEvidence, whole: StreamedFrame) -> FrameEvidence:
        """Adds quality and baseline to one frame's record.

        Args:
            evidence: the next frame of the run.
            whole: the same frame, sent whole.
        """
        frame = whole.prepared.captured.frame
        roi = evidence.roi.pixels()
        received = self._received(evidence)
        quality = _truth_quality(frame, roi, evidence.detections)
        retention = retained(whole.answer.detections, evidence.detections)
        psnr = roi_psnr(frame.image, received, roi) if received is not None and roi.any() else None
        record = replace(
            evidence.record,
            **quality,
            reference_count=retention.reference_count,
            retained=retention.retained,
            spurious=retention.spurious,
            roi_psnr_db=psnr if psnr is not None and np.isfinite(psnr) else None,
            baseline_bitstream_bytes=len(whole.prepared.encoded.data),
            baseline_message_bytes=whole.prepared.uplink_message_bytes,
            **whole_prefill(whole.answer.segmentation),
        )
        judged = replace(evidence, record=record)
        self._draw(frame, judged, received)
        self._position += 1
        return judged

    def _received(self, evidence: FrameEvidence) -> Image | None:
        """What the cloud's models saw of the next frame; None where it could not be decoded."""
        data, region = self._spool.read_next(), evidence.roi
        whole = evidence.record.roi_bytes == 0
        try:
            restored = self._decoder.decode(
                data, None if whole else region.blocks, region.block_size, stamp=evidence.record.index
            )
        except CodecError:
            return None
        return restored.image

    def _draw(self, frame: Frame, evidence: FrameEvidence, received: Image | None) -> None:
        record = evidence.record
        mask = decode_mask(evidence.mask_data, *frame.size_hw) if evidence.mask_data else None
        status = status_line(
            record.index,
            coverage=record.coverage,
            message_bytes=record.uplink_message_bytes,
            staleness_frames=record.staleness_frames,
            end_to_end_ns=record.end_to_end_ns,
            outcome=record.outcome,
        )
        drawn = annotate(
            frame.image,
            roi=evidence.roi.pixels(),
            mask=mask,
            detections=evidence.detections,
            truth=frame.truth,
            status=status,
            keyframe=record.keyframe,
        )
        shown = received if received is not None else np.zeros_like(frame.image)
        self._video.write(drawn, shown)
        if self._position in self._still_positions:
            self._stills.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(self._stills / f"{record.index:06d}_camera.jpg"), drawn)
            cv2.imwrite(str(self._stills / f"{record.index:06d}_received.jpg"), shown)


def _truth_quality(frame: Frame, roi: BoolMask, detections: Detections) -> dict[str, Any]:
    truth = frame.truth
    if truth is None:
        return {}
    asked = visible_truth(truth)
    counts = match_detections(
        detections, truth.boxes_xyxy, truth.class_ids, counted=asked, ignored_boxes=truth.ignored_boxes_xyxy
    )
    curve = recognition_curve(truth.boxes_xyxy[asked], roi).tolist()
    names = ("recognised", "recognised_25", "recognised_50", "recognised_75", "recognised_95")
    return {
        "truth_count": int(asked.sum()),
        **dict(zip(names, curve, strict=True)),
        "true_positives": counts.true_positives,
        "false_positives": counts.false_positives,
        "false_negatives": counts.false_negatives,
    }
