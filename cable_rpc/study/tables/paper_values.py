"""The figures that the paper prints, for comparison: H. Que, Z. Bao, Q. Wu, H. Yao, "CABLE: Cloud-Assisted
Bandwidth-efficient LMM-based Encoding for V2X Systems", its cross-data-set table and its comparison on nuScenes.
"""

from __future__ import annotations

from collections.abc import Mapping

PaperRow = Mapping[str, float]
"""Column's key to the printed value; shares as 0..1."""

CROSS_DATA_SET_KEYS = ("coverage", "pixel_saving", "token_reduction", "prefill_quadratic", "recognition_05",
                       "full_recall", "full_precision", "full_f1", "roi_recall", "roi_precision", "roi_f1")  # fmt: skip
STRATEGY_KEYS = ("coverage", "pixel_saving", "token_reduction", "prefill_quadratic", "recognition_05", "retention")

COMPARISON_DATA_SET = "nuscenes"
"""What the paper compares strategies on."""


def printed(keys: tuple[str, ...], percents: tuple[float, ...], factor: float, rest: tuple[float, ...]) -> PaperRow:
    """A printed row: percentages up to the prefill's factor, then one more percentage, then the rest."""
    shares = [round(value / 100.0, 4) for value in percents]
    return dict(zip(keys, [*shares[:3], factor, shares[3], *rest], strict=True))


CROSS_DATA_SET: Mapping[str, PaperRow] = {
    name: printed(CROSS_DATA_SET_KEYS, percents, factor, scores)
    for name, percents, factor, scores in (
        ("nuscenes", (23.7, 76.3, 55.8, 98.4), 5.2, (0.88, 0.88, 0.86, 0.88, 0.88, 0.86)),
        ("wod_zb", (13.9, 86.1, 62.9, 88.1), 7.5, (0.68, 0.16, 0.15, 0.61, 0.18, 0.16)),
        ("waymo", (20.3, 79.7, 58.3, 80.9), 6.2, (0.45, 0.81, 0.54, 0.32, 0.77, 0.40)),
        ("kitti", (26.4, 73.6, 53.8, 88.6), 5.3, (0.81, 0.65, 0.66, 0.70, 0.64, 0.59)),
        ("cadc", (19.8, 80.2, 58.6, 85.1), 6.0, (0.16, 0.38, 0.14, 0.15, 0.42, 0.13)),
        ("average", (20.8, 79.2, 57.9, 88.2), 6.0, (0.60, 0.58, 0.47, 0.53, 0.58, 0.43)),
    )
}
"""Scheme of a data set, or ``average``, to its row."""

STRATEGIES: Mapping[str, PaperRow] = {
    name: printed(STRATEGY_KEYS, percents[:4], factor, (round(percents[4] / 100.0, 4),))
    for name, percents, factor in (
        ("motion-only", (88.2, 11.8, 8.6, 98.0, 96.6), 1.4),
        ("open-loop", (56.6, 43.4, 31.8, 97.9, 96.7), 2.2),
        ("cable", (23.7, 76.3, 55.8, 98.4, 97.1), 5.2),
        ("no-corridor", (6.0, 94.0, 68.7, 90.6, 42.7), 10.4),
    )
}
"""Strategy to its row."""
