"""What the language model of a run cost: tokens, and its prefill in three columns that are only shown together."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cable_rpc.study.metrics import mean_or_none
from cable_rpc.study.run_record import FrameRecord


@dataclass(frozen=True, slots=True)
class PrefillSpeedups:
    """The prefill of whole frames over that of the frames as they were."""

    quadratic: float
    """The paper's estimate, which takes all work for attention."""
    flops: float
    """By floating-point operations."""
    measured: float | None
    """By the clock; None where no whole frame was timed."""


@dataclass(frozen=True, slots=True)
class LanguageCost:
    """Tokens and prefill of the answered frames whose segmenter has a language model."""

    frames: int
    tokens_in: float
    """Mean visual tokens that entered the language model."""
    tokens_full: float
    """Mean visual tokens of the whole frames."""
    visual_reduction: float
    """1 - visual tokens that entered / those of the whole frames."""
    decodings: tuple[tuple[str, int], ...]
    """How the answers came about and how often, the commonest first."""
    prompt_tokens: float | None = None
    """Mean tokens of the prompt; None, as all below, where the segmenter tells nothing of its prefill."""
    token_reduction: float | None = None
    """The same with the prompt in both, as the paper counts."""
    of_run: PrefillSpeedups | None = None
    """Whole frames' work over the work that was done, each summed over the run: what the run saved."""
    of_frames: PrefillSpeedups | None = None
    """Mean of the frames' own speed-ups, as the paper averages; never below ``of_run`` for the two estimates."""
    prefill_ms: float | None = None
    """Mean measured prefill."""
    whole_prefill_ms: float | None = None
    """Mean measured prefill of whole frames."""
    timed_frames: int = 0
    """Frames behind the measured column."""


def language_cost(records: Sequence[FrameRecord]) -> LanguageCost | None:
    """Aggregate the answered frames that state tokens, keyframes included; None where there are none."""
    told = [record for record in records if record.tokens_full]
    if not told:
        return None
    entered, whole = sum(record.tokens_in or 0 for record in told), sum(record.tokens_full or 0 for record in told)
    decodings = Counter(record.decoding for record in told if record.decoding)
    costed = [record for record in told if record.prefill_quadratic is not None and record.prefill_flops is not None]
    prompts = sum(record.prompt_tokens or 0 for record in costed)
    timed = timed_pairs(costed)
    return LanguageCost(
        frames=len(told),
        tokens_in=entered / len(told),
        tokens_full=whole / len(told),
        visual_reduction=1.0 - entered / whole,
        decodings=tuple(decodings.most_common()),
        prompt_tokens=prompts / len(costed) if costed else None,
        token_reduction=token_reduction(costed),
        of_run=speedups_of_run(costed, timed),
        of_frames=speedups_of_frames(costed, timed),
        prefill_ms=mean_or_none(record.prefill_ns / 1e6 for record in costed if record.prefill_ns),
        whole_prefill_ms=mean_or_none(whole_ns / 1e6 for _, whole_ns in timed),
        timed_frames=len(timed),
    )


def timed_pairs(records: Iterable[FrameRecord]) -> list[tuple[int, int]]:
    """(prefill, prefill of the whole frame) in nanoseconds, where both were measured."""
    pairs = ((record.prefill_ns, record.prefill_whole_ns) for record in records)
    return [(ours, whole) for ours, whole in pairs if ours and whole]


def sequence_tokens(record: FrameRecord, visual: int | None) -> int:
    """Prompt and visual tokens of a frame."""
    return (record.prompt_tokens or 0) + (visual or 0)


def token_reduction(costed: Sequence[FrameRecord]) -> float | None:
    """1 - tokens run / tokens of whole frames, prompt included in both; pooled."""
    whole = sum(sequence_tokens(record, record.tokens_full) for record in costed)
    return 1.0 - sum(sequence_tokens(record, record.tokens_in) for record in costed) / whole if whole else None


def speedups_of_run(costed: Sequence[FrameRecord], timed: Sequence[tuple[int, int]]) -> PrefillSpeedups | None:
    """Work of the whole frames over the work done.

    A frame told by its speed-up s did the share 1/s of its whole frame's work, which counts as (n_p + n_v)^2 in the
    paper's column and as n_p + n_v in that of the operations; where all prompts are equally long, that is exact.
    """
    if not costed:
        return None
    lengths = [sequence_tokens(record, record.tokens_full) for record in costed]
    return PrefillSpeedups(
        pooled([(length**2, record.prefill_quadratic or 1.0) for length, record in zip(lengths, costed, strict=True)]),
        pooled([(length, record.prefill_flops or 1.0) for length, record in zip(lengths, costed, strict=True)]),
        sum(whole for _, whole in timed) / sum(ours for ours, _ in timed) if timed else None,
    )


def pooled(rows: Sequence[tuple[int, float]]) -> float:
    """Of (work of a whole frame, speed-up): all work of whole frames over all work done."""
    return sum(work for work, _ in rows) / math.fsum(work / speedup for work, speedup in rows)


def speedups_of_frames(costed: Sequence[FrameRecord], timed: Sequence[tuple[int, int]]) -> PrefillSpeedups | None:
    """Means of the frames' own speed-ups."""
    quadratic = mean_or_none(record.prefill_quadratic for record in costed)
    flops = mean_or_none(record.prefill_flops for record in costed)
    if quadratic is None or flops is None:
        return None
    return PrefillSpeedups(quadratic, flops, mean_or_none(whole / ours for ours, whole in timed))
