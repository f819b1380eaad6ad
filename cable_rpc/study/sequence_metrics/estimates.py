"""Figures of pooled sequences, their intervals, and paired differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import (
    GROUPS,
    Bootstrap,
    Interval,
    RankedMatches,
    TruthVariant,
    bootstrap_interval,
    drawn_ratios,
)
from cable_rpc.study.metrics.average_precision import drawn_average_precision
from cable_rpc.study.sequence_metrics.figures import FIGURES, Figure
from cable_rpc.study.sequence_metrics.parts import rows_of, threshold_rows
from cable_rpc.study.sequence_metrics.perception import AP_ROWS, Picture
from cable_rpc.study.sequence_metrics.sequence import SequenceMetrics

Float64Array = npt.NDArray[np.float64]

AP_DRAWS = 500
"""Most draws for an interval of AP."""
NO_DETECTIONS = (RankedMatches(np.zeros(0, np.float32), np.zeros(0, np.uint16), np.zeros(0, np.uint16), 0),) * len(
    GROUPS
)
AP_FIGURES: Mapping[str, tuple[Picture, TruthVariant, float | None]] = {
    "roi_ap": ("roi", "all", None),
    "roi_ap50": ("roi", "all", 0.5),
    "full_ap": ("full", "all", None),
    "full_ap50": ("full", "all", 0.5),
    "roi_ap_visible": ("roi", "visible", None),
    "roi_ap50_visible": ("roi", "visible", 0.5),
    "full_ap_visible": ("full", "visible", None),
    "full_ap50_visible": ("full", "visible", 0.5),
}
"""Named APs: picture, truth variant, IoU threshold (None: the mean over all ten)."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure with its interval."""

    value: float | None
    """None where it is undefined or was not measured."""
    interval: Interval | None = None
    """None unless asked for, and for fewer than three sequences that bear on the figure."""


@dataclass(frozen=True, slots=True)
class DrawnFigure:
    """A figure of some sequences that can be asked for again with every sequence counted as often as it is drawn."""

    statistic: Callable[[npt.NDArray[np.int64]], Float64Array]
    """From weights, int64 [B, S], to the figure, float64 [B], NaN where it is undefined."""
    informative: npt.NDArray[np.bool_]
    """bool [S], sequences that bear on it."""
    max_draws: int | None = None

    @property
    def value(self) -> float | None:
        """The figure of all sequences; None where it is undefined."""
        value = float(self.statistic(np.ones((1, len(self.informative)), np.int64))[0])
        return None if np.isnan(value) else value

    def estimate(self, bootstrap: Bootstrap | None) -> Estimate:
        """The figure, with its interval if draws are told."""
        value = self.value
        if value is None or bootstrap is None:
            return Estimate(value)
        return Estimate(value, self.interval(bootstrap))

    def interval(self, bootstrap: Bootstrap) -> Interval | None:
        """Its interval; None for fewer than three sequences that bear on it."""
        draws = bootstrap.draws if self.max_draws is None else min(bootstrap.draws, self.max_draws)
        clusters, informative = len(self.informative), int(np.count_nonzero(self.informative))
        return bootstrap_interval(clusters, self.statistic, replace(bootstrap, draws=draws), informative=informative)

    def less(self, other: DrawnFigure) -> DrawnFigure:
        """The difference from another figure of the same sequences in the same order, drawn together."""
        limits = [limit for limit in (self.max_draws, other.max_draws) if limit is not None]
        return DrawnFigure(
            lambda weights: self.statistic(weights) - other.statistic(weights),
            self.informative & other.informative,
            min(limits, default=None),
        )


def drawn_figure(sequences: Sequence[SequenceMetrics], name: str) -> DrawnFigure:
    """A figure by name, of ``FIGURES`` or ``AP_FIGURES``.

    Raises:
        ConfigurationError: there is no such figure.
    """
    if name in AP_FIGURES:
        picture, variant, iou = AP_FIGURES[name]
        return drawn_ap(sequences, picture, variant, iou=iou)
    if name in FIGURES:
        return drawn_ratio(FIGURES[name], sequences)
    raise ConfigurationError(f"there is no figure '{name}'; choose of {', '.join((*FIGURES, *AP_FIGURES))}")


def drawn_ratio(figure: Figure, sequences: Sequence[SequenceMetrics]) -> DrawnFigure:
    """A ratio of sums over sequences."""
    parts = [figure.parts(sequence) for sequence in sequences]
    above = np.array([np.atleast_1d(np.asarray(part[0], np.float64)) for part in parts])
    below = np.array([np.atleast_1d(np.asarray(part[1], np.float64)) for part in parts])
    return DrawnFigure(
        lambda weights: figure.transform(drawn_ratios(above, below, weights)), np.min(below > 0.0, axis=1)
    )


def drawn_ap(
    sequences: Sequence[SequenceMetrics],
    picture: Picture,
    variant: TruthVariant,
    *,
    iou: float | None = None,
    group: str | None = None,
) -> DrawnFigure:
    """COCO's AP over all frames of the sequences; the arguments are those of `DatasetMetrics.average_precision`.

    Raises:
        ConfigurationError: an unknown IoU or group.
    """
    rows = ap_rows(iou)
    wanted = rows_of(group, GROUPS)
    ranked = [sequence.ranked.get((picture, variant), NO_DETECTIONS)[wanted] for sequence in sequences]
    by_group = list(zip(*ranked, strict=True))
    return DrawnFigure(
        lambda weights: drawn_average_precision(by_group, weights, rows).mean(axis=1),
        np.array([any(group.asked for group in groups) for groups in ranked]),
        AP_DRAWS,
    )


def ap_rows(iou: float | None) -> slice:
    """Rows of ``AP_IOU_THRESHOLDS``.

    Raises:
        ConfigurationError: the threshold isn't among them.
    """
    if iou is None:
        return slice(None)
    row = threshold_rows(iou).start - AP_ROWS.start
    if row < 0:
        raise ConfigurationError(f"AP is not taken at IoU {iou}; choose of 0.5, 0.55 ... 0.95")
    return slice(row, row + 1)
