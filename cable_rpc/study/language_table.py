"""Rows on tokens and prefill, shared by the terminal and the report."""

from __future__ import annotations

from cable_rpc.study.language_summary import LanguageCost, PrefillSpeedups
from cable_rpc.study.summary import RunSummary

UNKNOWN = "–"
PREFILL_COLUMNS = ("averaged", "paper's estimate", "operations", "measured", "of what")
"""The three columns in the middle are never shown apart."""


def language_rows(cost: LanguageCost) -> list[tuple[str, str, str]]:
    """(name, value, what it is of) of tokens, times and answers."""
    entered = f"{cost.tokens_in:.1f} of {cost.tokens_full:.0f}"
    fewer = f"{100 * cost.visual_reduction:.1f} % fewer"
    rows = [
        ("visual tokens a frame", entered, f"{fewer} in the language model, {cost.frames} frames, keyframes included")
    ]
    if cost.prompt_tokens is not None and cost.token_reduction is not None:
        rows.append(
            (
                "tokens saved",
                f"{100 * cost.token_reduction:.1f} %",
                f"the prompt's {cost.prompt_tokens:.0f} counted with both, as the paper counts",
            )
        )
    if cost.prefill_ms is not None:
        whole = UNKNOWN if cost.whole_prefill_ms is None else f"{cost.whole_prefill_ms:.1f}"
        rows.append(("prefill, ms", f"{cost.prefill_ms:.1f} / {whole}", "mean as measured / of the whole frames"))
    if cost.decodings:
        text = "; ".join(f"{name}: {count}" for name, count in cost.decodings)
        rows.append(("answers", str(sum(count for _, count in cost.decodings)), text))
    return rows


def prefill_rows(summary: RunSummary) -> list[tuple[str, ...]]:
    """A row of `PREFILL_COLUMNS` for each way of averaging; none where the segmenter tells nothing of its prefill."""
    cost = summary.language
    if cost is None or cost.of_run is None or cost.of_frames is None:
        return []
    paired = summary.layer("message").byte_saving is not None
    timing = "the full-frame pass" if paired else "whole frames that the server had seen"
    return [
        ("whole run", *speedup_texts(cost.of_run), f"work of whole frames over work done; timed against {timing}"),
        ("mean over frames", *speedup_texts(cost.of_frames), "as the paper averages"),
    ]


def speedup_texts(speedups: PrefillSpeedups) -> tuple[str, str, str]:
    """The three columns as factors."""
    measured = UNKNOWN if speedups.measured is None else factor(speedups.measured)
    return factor(speedups.quadratic), factor(speedups.flops), measured


def factor(value: float) -> str:
    """A speed-up."""
    return f"{value:.2f} ×"
