"""What a smaller region should save in the language model's prefill: the paper's estimate and a FLOP-true one.

A frame enters the model as ``n_p`` prompt tokens and ``n_v`` visual ones, of which those inside the region are
kept: ``n_in = n_p + n_v rho`` with ``rho`` the share of the frame inside it. The defaults ``(n_v, n_p) = (256, 94)``
are the pair that reproduces every row of the paper's tables. The paper floors ``n_v rho``, which only ``floor=True``
does here: its own tables need the unfloored value.

All of these are estimates of the prefill alone, which is neither the whole of a cloud's work nor a measurement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cable_rpc.errors import ConfigurationError

VISUAL_TOKENS = 256
"""n_v of CLIP ViT-L/14 at 224x224 pixels, the tower of LISA's own code."""
PROMPT_TOKENS = 94
"""n_p that, with 256 visual tokens, gives the paper's token column."""

LINEAR_PARAMETERS = 6.5e9
"""Weights of a 7B model that multiply every token; its embeddings don't."""
LAYERS = 32
MODEL_WIDTH = 4096


def tokens_in(coverage: float, n_v: int = VISUAL_TOKENS, n_p: int = PROMPT_TOKENS, *, floor: bool = False) -> float:
    """Tokens that enter the language model, ``n_p + n_v rho``.

    Args:
        coverage: rho, share of the frame inside the region, 0..1.
        n_v: visual tokens of a whole frame.
        n_p: prompt tokens.
        floor: whole visual tokens only, ``n_p + floor(n_v rho)``, as the formula is printed.

    Raises:
        ConfigurationError: the coverage isn't a share, or a count is negative, or there are no tokens at all.
    """
    if not 0.0 <= coverage <= 1.0:
        raise ConfigurationError(f"coverage is {coverage}; it is a share of the frame, give a number of 0..1")
    if n_v < 0 or n_p < 0 or n_v + n_p == 0:
        raise ConfigurationError(f"n_v = {n_v} and n_p = {n_p} tokens; give counts of at least 0, not both 0")
    visual = n_v * coverage
    return n_p + (math.floor(visual) if floor else visual)


def token_reduction(
    coverage: float, n_v: int = VISUAL_TOKENS, n_p: int = PROMPT_TOKENS, *, floor: bool = False
) -> float:
    """Share of the tokens saved, ``1 - n_in / (n_p + n_v)``, 0..1.

    It is linear in the coverage unless floored, so the mean over frames is that of the mean coverage.

    Raises:
        ConfigurationError: as `tokens_in`.
    """
    return 1.0 - tokens_in(coverage, n_v, n_p, floor=floor) / (n_p + n_v)


def speedup_quadratic(
    coverage: float, n_v: int = VISUAL_TOKENS, n_p: int = PROMPT_TOKENS, *, floor: bool = False
) -> float:
    """The paper's prefill speed-up of one frame, ``((n_p + n_v) / n_in)^2``, at least 1.

    It takes all of the prefill for attention. At the paper's lengths that is about 1 % of a 7B model's work:
    read it beside `speedup_flops`.

    Returns:
        The factor; infinite where no token is left (nothing covered, no prompt).

    Raises:
        ConfigurationError: as `tokens_in`.
    """
    kept = tokens_in(coverage, n_v, n_p, floor=floor)
    return ((n_p + n_v) / kept) ** 2 if kept else math.inf


def speedup_of_mean(
    coverages: Sequence[float], n_v: int = VISUAL_TOKENS, n_p: int = PROMPT_TOKENS, *, floor: bool = False
) -> float:
    """Quadratic speed-up of the mean frame, ``((n_p + n_v) / mean(n_in))^2``; the conservative headline.

    Args:
        coverages: rho of each frame, 0..1.
        n_v: visual tokens of a whole frame.
        n_p: prompt tokens.
        floor: whole visual tokens only.

    Raises:
        ConfigurationError: there is no frame, or as `tokens_in`.
    """
    kept = mean([tokens_in(coverage, n_v, n_p, floor=floor) for coverage in coverages])
    return ((n_p + n_v) / kept) ** 2 if kept else math.inf


def speedup_mean_of_ratios(
    coverages: Sequence[float], n_v: int = VISUAL_TOKENS, n_p: int = PROMPT_TOKENS, *, floor: bool = False
) -> float:
    """Mean over frames of their quadratic speed-ups, as the paper's prefill column averages.

    Never below `speedup_of_mean` (Jensen: the map is convex), equal only where all frames keep as many tokens.

    Raises:
        ConfigurationError: there is no frame, or as `tokens_in`.
    """
    return mean([speedup_quadratic(coverage, n_v, n_p, floor=floor) for coverage in coverages])


def prefill_flops(tokens: float) -> float:
    """Floating-point operations of a 7B model's prefill, ``2 * 6.5e9 n + 4 * 32 * 4096 n^2``.

    The first term is two operations per weight and token, the second the scores and the weighted sum of attention
    in 32 layers of width 4096.

    Args:
        tokens: n, length of the prompt with its visual tokens, at least 0.

    Raises:
        ConfigurationError: the length is negative or not a number.
    """
    if not (math.isfinite(tokens) and tokens >= 0.0):
        raise ConfigurationError(f"a prefill of {tokens} tokens; give a finite number of at least 0")
    return 2.0 * LINEAR_PARAMETERS * tokens + 4.0 * LAYERS * MODEL_WIDTH * tokens**2


def speedup_flops(coverage: float, n_v: int = VISUAL_TOKENS, n_p: int = PROMPT_TOKENS, *, floor: bool = False) -> float:
    """Speed-up of one frame's prefill by its true operations, `prefill_flops` of the whole over those of the kept.

    Returns:
        The factor, at least 1; infinite where no token is left.

    Raises:
        ConfigurationError: as `tokens_in`.
    """
    kept = prefill_flops(tokens_in(coverage, n_v, n_p, floor=floor))
    return prefill_flops(n_p + n_v) / kept if kept else math.inf


def mean(values: Sequence[float]) -> float:
    """Arithmetic mean, exactly rounded.

    Raises:
        ConfigurationError: there is no value.
    """
    if not values:
        raise ConfigurationError("a mean speed-up needs at least one frame's coverage")
    return math.fsum(values) / len(values)
