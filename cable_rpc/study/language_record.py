"""What a frame's record holds of the segmenter's own time and of its language model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cable_rpc.types import Segmentation

RECORDED_PARTS = ("preprocess", "clip", "prefill", "decode", "sam_encoder", "mask_decoder", "postprocess")
"""Parts of the stage ``segment`` that have a column, ``segment_<part>_ns``."""


def segment_parts(parts_ns: Mapping[str, int]) -> dict[str, Any]:
    """The columns ``segment_<part>_ns``; None for a part that was not told."""
    return {f"segment_{part}_ns": parts_ns.get(part) for part in RECORDED_PARTS}


def language_columns(segmentation: Segmentation | None) -> dict[str, Any]:
    """The columns on tokens and prefill; none for a segmenter without tokens."""
    if segmentation is None or segmentation.tokens_full == 0:
        return {}
    columns: dict[str, Any] = {
        "tokens_in": segmentation.tokens_in,
        "tokens_full": segmentation.tokens_full,
        "decoding": segmentation.decoding,
    }
    prefill = segmentation.prefill
    if prefill is not None:
        columns |= {
            "prompt_tokens": prefill.prompt_tokens,
            "prefill_quadratic": prefill.speedup_quadratic,
            "prefill_flops": prefill.speedup_flops,
            "prefill_ns": prefill.measured_ns,
            "prefill_whole_ns": prefill.whole_ns or None,
        }
    return columns


def whole_prefill(segmentation: Segmentation | None) -> dict[str, Any]:
    """The column ``prefill_whole_ns`` from the same frame sent whole; none where its prefill was not timed."""
    prefill = None if segmentation is None else segmentation.prefill
    return {"prefill_whole_ns": prefill.measured_ns} if prefill is not None and prefill.measured_ns > 0 else {}
