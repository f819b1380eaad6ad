"""What a sequence's frames add up to in coverage, tokens, prefill, masks and bytes; it all adds over sequences too."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Self

from cable_rpc.study.metrics import BYTE_LAYERS, sent_coverage
from cable_rpc.study.prefill import prefill_flops, speedup_flops, speedup_quadratic, token_reduction, tokens_in
from cable_rpc.study.sequence_metrics.frame import MeasuredFrame


class Sums:
    """Base of frozen dataclasses of numbers that add field by field."""

    __slots__ = ()

    def __add__(self, other: Self) -> Self:
        return type(self)(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class CoverageTally(Sums):
    """Sums over frames of one notion of coverage, and of the prefill that it would allow (`study.prefill`)."""

    frames: int = 0
    coverage: float = 0.0
    tokens: float = 0.0
    """n_in, unfloored, for (n_v, n_p) = (256, 94)."""
    token_reduction: float = 0.0
    quadratic: float = 0.0
    """Speed-ups by the paper's estimate."""
    flops_speedup: float = 0.0
    flops: float = 0.0
    """Operations of the prefill."""


@dataclass(frozen=True, slots=True)
class KeyframeTally(Sums):
    """Frames sent whole."""

    frames: int = 0
    keyframes: int = 0
    later_frames: int = 0
    """All frames but a sequence's first."""
    refreshes: int = 0
    """Keyframes among them."""


@dataclass(frozen=True, slots=True)
class PrefillTally(Sums):
    """Sums over the frames whose segmenter tells tokens and prefill."""

    frames: int = 0
    tokens: int = 0
    """Visual and prompt tokens that entered."""
    whole_tokens: int = 0
    """The same of whole frames."""
    quadratic: float = 0.0
    """Speed-ups of the frames."""
    flops: float = 0.0
    whole_quadratic_work: float = 0.0
    """Squared lengths of whole frames."""
    quadratic_work: float = 0.0
    """The same over each frame's speed-up: work done, in the same unit."""
    flops_work: float = 0.0
    """Lengths of whole frames over each frame's speed-up; ``whole_tokens`` is the work they'd have been."""
    timed_frames: int = 0
    """Frames with both prefills timed."""
    measured_speedup: float = 0.0
    measured_ns: int = 0
    whole_ns: int = 0


@dataclass(frozen=True, slots=True)
class MaskTally(Sums):
    """Cloud masks of received frames against those of whole frames."""

    frames: int = 0
    iou: float = 0.0
    intersection_px: int = 0
    union_px: int = 0


@dataclass(frozen=True, slots=True)
class LayerTally(Sums):
    """Bytes at one layer."""

    frames: int = 0
    up: int = 0
    down: int = 0
    paired_up: int = 0
    """Bytes up of the frames that were sent whole as well."""
    full_up: int = 0
    """Bytes up of those frames sent whole."""
    paired_frames: int = 0


def coverage_of(coverage: float | None) -> CoverageTally:
    """One frame's; None counts for nothing."""
    if coverage is None:
        return CoverageTally()
    tokens = tokens_in(coverage)
    return CoverageTally(
        1,
        coverage,
        tokens,
        token_reduction(coverage),
        speedup_quadratic(coverage),
        speedup_flops(coverage),
        prefill_flops(tokens),
    )


def coverages_of(frame: MeasuredFrame, *, first: bool) -> tuple[CoverageTally, CoverageTally]:
    """One frame's R_k, none of the first frame, and what was sent of it."""
    sent = sent_coverage(frame.coverage_tx, keyframe=frame.keyframe, first=first)
    return coverage_of(None if first else frame.coverage_roi), coverage_of(sent)


def keyframes_of(frame: MeasuredFrame, *, first: bool) -> KeyframeTally:
    """One frame's; a sequence's first frame counts as sent whole."""
    return KeyframeTally(1, int(frame.keyframe or first), int(not first), int(frame.keyframe and not first))


def prefill_of(frame: MeasuredFrame) -> PrefillTally:
    """One frame's."""
    told = frame.prefill
    if told is None:
        return PrefillTally()
    whole = told.prompt_tokens + told.tokens_full
    timed = told.measured_ns > 0 and told.whole_ns > 0
    return PrefillTally(
        frames=1,
        tokens=told.prompt_tokens + told.tokens_in,
        whole_tokens=whole,
        quadratic=told.speedup_quadratic,
        flops=told.speedup_flops,
        whole_quadratic_work=float(whole) ** 2,
        quadratic_work=whole**2 / told.speedup_quadratic,
        flops_work=whole / told.speedup_flops,
        timed_frames=int(timed),
        measured_speedup=told.whole_ns / told.measured_ns if timed else 0.0,
        measured_ns=told.measured_ns if timed else 0,
        whole_ns=told.whole_ns if timed else 0,
    )


def masks_of(frame: MeasuredFrame) -> MaskTally:
    """One frame's."""
    overlap = frame.mask_overlap
    if overlap is None:
        return MaskTally()
    return MaskTally(1, overlap.iou, overlap.intersection_px, overlap.union_px)


def layers_of(frame: MeasuredFrame) -> tuple[LayerTally, ...]:
    """One frame's, in the order of ``BYTE_LAYERS``."""
    whole = frame.full_bytes_up
    return tuple(
        LayerTally(
            1,
            frame.bytes_up.of(layer),
            frame.bytes_down.of(layer),
            0 if whole is None else frame.bytes_up.of(layer),
            0 if whole is None else whole.of(layer),
            int(whole is not None),
        )
        for layer in BYTE_LAYERS
    )


def add_layers(first: Iterable[LayerTally], second: Iterable[LayerTally]) -> tuple[LayerTally, ...]:
    """Sums layer by layer."""
    return tuple(one + other for one, other in zip(first, second, strict=True))
