"""From a segmenter's mask logits to what the wire carries: one mask, how sure it is, and where it is not."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from cable_rpc.types import BoolMask, Float32Array, UncertaintyMap

UNDECIDED_LOGIT = 3.0
"""Logits of smaller size count as undecided: probabilities of 4.7 % to 95.3 %.

The wire rounds any doubt up to a third (docs/wire-protocol.md), and the edge keeps every doubtful pixel: a tail that
never ends would make the whole frame doubtful."""


def united_logits(logits: Float32Array) -> Float32Array:
    """Logits of the union of several masks: of each pixel the largest.

    Args:
        logits: float32 [n, height, width], n of at least 1.

    Returns:
        float32 [height, width].
    """
    united: Float32Array = logits[0] if len(logits) == 1 else logits.max(axis=0)
    return united


def mask_confidence(logits: Float32Array, region: BoolMask) -> float:
    """Mean probability of the mask's pixels, 0.5..1; of an empty mask the probability that it is rightly empty.

    That is one minus the largest probability in the region, so the figure does not jump where the last pixel of a
    mask goes: a segmenter that has all but found something is as unsure as one that barely has. An edge that counts
    doubt (keyframe policy ``uncertainty``) then asks for a whole frame, which a constant 1 would put off.

    Args:
        logits: float32 [height, width], the mask where above 0.
        region: bool [height, width]; pixels outside don't count.

    Returns:
        0.5..1; 1 for an empty region.
    """
    inside = logits[region].astype(np.float64)
    if not len(inside):
        return 1.0
    found = inside[inside > 0]
    if len(found):
        return float(np.mean(1.0 / (1.0 + np.exp(-found))))
    return float(1.0 / (1.0 + np.exp(inside.max())))


def uncertainty_of(logits: Float32Array) -> UncertaintyMap:
    """Doubt of each pixel, ``255 * 4 p (1 - p)``, 0 where the logit's size is `UNDECIDED_LOGIT` or more.

    ``4 p (1 - p)`` is the variance of a yes-no answer of probability p, scaled to 1 at the mask's border.

    Args:
        logits: float32 [height, width].

    Returns:
        uint8 [height, width], good to 1 of 255.
    """
    within = np.clip(logits, -UNDECIDED_LOGIT, UNDECIDED_LOGIT)
    sizes = cv2.convertScaleAbs(within, alpha=255 / UNDECIDED_LOGIT)
    return np.asarray(cv2.LUT(sizes, doubt_table()), np.uint8)


@cache
def doubt_table() -> UncertaintyMap:
    """uint8 [256], the doubt of logits of the sizes 0 to `UNDECIDED_LOGIT` in even steps."""
    sizes = np.linspace(0.0, UNDECIDED_LOGIT, 256)
    # 4 p (1 - p) = 1 / cosh^2(x / 2)
    table = np.rint(255.0 / np.square(np.cosh(0.5 * sizes))).astype(np.uint8)
    table[255] = 0
    return table
