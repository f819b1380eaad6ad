"""One frame under one strategy as the metrics take it: what went up, what came back, what the whole frame gave."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.study.closed_loop.lane import Passage
from cable_rpc.study.metrics import ByteLayers, mask_overlap, roi_overlap, sent_coverage
from cable_rpc.study.sequence_metrics import MeasuredFrame, frame_prefill
from cable_rpc.study.transport_estimate import TransportBytes, estimate_exchange
from cable_rpc.types import BoolMask, Detections, Frame, GroundTruth, RoiMask, Segmentation


@dataclass(frozen=True, slots=True)
class Reference:
    """What the same models give of a frame that a strategy is held against."""

    detections: Detections
    """Weak ones included."""
    mask: BoolMask
    """bool [height, width]."""
    segmentation: Segmentation | None = None
    """For the prefill of whole frames; None where it isn't told."""
    bytes_up: ByteLayers | None = None
    """None where nothing was sent."""

    @classmethod
    def sent_whole(cls, passage: Passage) -> Reference:
        """The frame sent whole."""
        return cls(passage.detections, passage.segmentation.mask, passage.segmentation, bytes_up(passage))


def measured_frame(frame: Frame, passage: Passage, reference: Reference) -> MeasuredFrame:
    """Put together what one frame came to.

    Args:
        frame: as the source gave it.
        passage: its way under the strategy.
        reference: what it is held against.
    """
    proposal = passage.prepared.proposal
    sent = passage.prepared.sent_region
    truth = frame.truth
    stages = passage.stages_ns
    return MeasuredFrame(
        index=frame.index,
        keyframe=proposal.keyframe,
        coverage_roi=roi_coverage(proposal),
        coverage_tx=sent_coverage(sent.coverage, keyframe=proposal.keyframe, first=False),
        staleness=proposal.staleness,
        truth=without_masks(truth),
        detections=passage.detections,
        full_detections=reference.detections,
        overlap_roi=roi_overlaps(proposal, truth, frame.size_hw),
        overlap_sent=None if truth is None else roi_overlap(truth.boxes_xyxy, sent.pixels()),
        mask_overlap=mask_overlap(passage.segmentation.mask, reference.mask),
        bytes_up=bytes_up(passage),
        bytes_down=bytes_down(passage),
        full_bytes_up=reference.bytes_up,
        stage_ns=stages,
        end_to_end_ns=sum(stages.values()),
        prefill=frame_prefill(passage.segmentation, reference.segmentation),
    )


def dropped_frame(frame: Frame, reference: Reference) -> MeasuredFrame:
    """A frame that was never sent: nothing of it arrived, and nothing was found in it."""
    truth, nothing = frame.truth, ByteLayers(0, 0, 0, 0)
    none_of_it = None if truth is None else np.zeros(len(truth), np.float64)
    return MeasuredFrame(
        index=frame.index,
        keyframe=False,
        coverage_roi=None,
        coverage_tx=0.0,
        staleness=None,
        truth=without_masks(truth),
        detections=Detections.empty(),
        full_detections=reference.detections,
        overlap_roi=none_of_it,
        overlap_sent=none_of_it,
        mask_overlap=mask_overlap(np.zeros(frame.size_hw, np.bool_), reference.mask),
        bytes_up=nothing,
        bytes_down=nothing,
        full_bytes_up=reference.bytes_up,
    )


def roi_coverage(proposal: RoiProposal) -> float | None:
    """Share of the frame in R_k, 0..1; None where nothing was there to predict it from."""
    if sends_all(proposal):
        return 1.0
    return None if proposal.keyframe and proposal.prior_index is None else proposal.coverage


def sends_all(proposal: RoiProposal) -> bool:
    """Whether the strategy takes every frame for its region."""
    return proposal.keyframe_reason == "strategy"


def roi_pixels(proposal: RoiProposal, size_hw: tuple[int, int]) -> BoolMask | None:
    """R_k, bool [height, width]; None where it isn't known."""
    if proposal.steps is not None:
        return RoiMask(proposal.steps.region, proposal.steps.scale, *size_hw).pixels()
    return proposal.roi.pixels() if sends_all(proposal) or not proposal.keyframe else None


def roi_overlaps(
    proposal: RoiProposal, truth: GroundTruth | None, size_hw: tuple[int, int]
) -> npt.NDArray[np.float64] | None:
    """Share of each truth box inside R_k, [N]; None where either isn't known."""
    pixels = None if truth is None else roi_pixels(proposal, size_hw)
    return None if truth is None or pixels is None else roi_overlap(truth.boxes_xyxy, pixels)


def without_masks(truth: GroundTruth | None) -> GroundTruth | None:
    """The truth without its instance mask, which no metric needs and a long sequence could not hold."""
    return None if truth is None else replace(truth, instance_mask=None)


def transport_of(passage: Passage) -> TransportBytes:
    """What the frame's two messages would cost as packets, by estimate."""
    return estimate_exchange(passage.prepared.uplink_message_bytes, passage.answer.message_bytes)


def bytes_up(passage: Passage) -> ByteLayers:
    """Edge to cloud."""
    prepared = passage.prepared
    bitstream = len(prepared.encoded.data)
    with_roi = bitstream + len(prepared.message.region.data)
    return ByteLayers(bitstream, with_roi, prepared.uplink_message_bytes, transport_of(passage).uplink)


def bytes_down(passage: Passage) -> ByteLayers:
    """Cloud to edge: the mask and its uncertainty, then all of the answer."""
    answer = passage.answer
    mask = len(answer.mask_data) + len(answer.uncertainty_data)
    return ByteLayers(mask, mask, answer.message_bytes, transport_of(passage).downlink)
