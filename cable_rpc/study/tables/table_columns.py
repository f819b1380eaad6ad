"""The columns of both tables, and which figure of the metrics fills each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from cable_rpc.study.metrics import BYTE_LAYERS
from cable_rpc.study.sequence_metrics import AP_FIGURES, DatasetMetrics, Estimate
from cable_rpc.study.tables.equal_quality import EQUAL_QUALITY_FIGURES, EqualQualityPool
from cable_rpc.study.tables.result_table import Column, Value

PERCENT = 100.0
LAYER_NAMES = {"bitstream": "coded", "with_roi": "+mask", "message": "message", "transport": "IP"}


@dataclass(frozen=True, slots=True)
class PooledCells:
    """The sequences of a data set under one strategy."""

    metrics: DatasetMetrics
    equal_quality: EqualQualityPool

    def figure(self, name: str) -> Value:
        """One of `FIGURES`, `AP_FIGURES` or `EQUAL_QUALITY_FIGURES`."""
        if name in EQUAL_QUALITY_FIGURES:
            return value_of(self.equal_quality.figure(name))
        return value_of(estimate(self.metrics, name))


@dataclass(frozen=True, slots=True)
class Measure:
    """A column, and what fills it by either way of averaging."""

    column: Column
    pooled: str
    """Figure of `PooledCells` for the headline."""
    by_frame: str = ""
    """The paper's counterpart; empty where there is one way only."""

    def value(self, cells: PooledCells, *, by_frame: bool) -> Value:
        """The figure of a data set."""
        name = self.by_frame if by_frame and self.by_frame else self.pooled
        special = SPECIAL_FIGURES.get(name)
        return cells.figure(name) if special is None else Value(special(cells.metrics))


def estimate(metrics: DatasetMetrics, name: str) -> Estimate:
    """A named figure; average precision without its interval, of which each draw ranks all detections anew."""
    return (replace(metrics, bootstrap=None) if name in AP_FIGURES else metrics).figure(name)


def value_of(found: Estimate) -> Value:
    """An estimate as a table takes it."""
    interval = found.interval
    return Value(found.value) if interval is None else Value(found.value, interval.low, interval.high)


def latency(metrics: DatasetMetrics, tail: str) -> float | None:
    """A percentile of the end-to-end time in milliseconds."""
    tails = metrics.end_to_end_ms()
    return None if tails is None else float(getattr(tails, tail))


SPECIAL_FIGURES: Mapping[str, Callable[[DatasetMetrics], float | None]] = {
    "up_kbps": lambda metrics: metrics.layer("message").up_kbps,
    "down_kbps": lambda metrics: metrics.layer("message").down_kbps,
    "latency_p50_ms": lambda metrics: latency(metrics, "p50"),
    "latency_p95_ms": lambda metrics: latency(metrics, "p95"),
    "sequences": lambda metrics: float(len(metrics.sequences)),
    "frames": lambda metrics: float(metrics.frames),
    "truth_frames": lambda metrics: float(metrics.truth_frames),
}
"""Figures that are no ratio of sums."""


def percentage(key: str, name: str, group: str = "", *, interval: bool = False) -> Column:
    """A share, printed in percent."""
    return Column(key, name, group, PERCENT, interval=interval)


def score(key: str, name: str, group: str, *, interval: bool = False) -> Column:
    """A share, printed as .88."""
    return Column(key, name, group, decimals=2, leading_zero=False, interval=interval)


def number(key: str, name: str, group: str = "", decimals: int = 0) -> Column:
    """A plain number."""
    return Column(key, name, group, decimals=decimals)


COVERAGE = (
    Measure(percentage("coverage", "%", "Cov", interval=True), "coverage_tx", "coverage_roi"),
    Measure(percentage("pixel_saving", "%", "px saved"), "pixel_saving", "pixel_saving_paper"),
    Measure(percentage("token_reduction", "%", "Tok"), "token_reduction", "token_reduction_paper"),
    Measure(number("prefill_quadratic", "paper", "prefill ×", 1), "prefill_quadratic", "prefill_quadratic_paper"),
    Measure(number("prefill_flops", "FLOPs", "prefill ×", 1), "prefill_flops", "prefill_flops_paper"),
    Measure(number("prefill_measured", "timed", "prefill ×", 1), "prefill_measured", "prefill_measured_paper"),
)
"""Pixels, tokens, and the prefill in the three columns that are never shown apart."""

RECOGNITION = (
    Measure(percentage("recognition_05", "5 %", "Recog"), "recognition_05_sent_visible", "recognition_05"),
    Measure(
        percentage("recognition_50", "50 %", "Recog", interval=True), "recognition_50_sent_visible", "recognition_50"
    ),
)

RETENTION = (Measure(percentage("retention", "%", "Det.Ret", interval=True), "retention"),)
SPURIOUS = (Measure(percentage("spurious_rate", "%", "Spur", interval=True), "spurious_rate"),)


def detection(picture: str, group: str) -> tuple[Measure, ...]:
    """Recall, precision and F1 on one of the pictures."""
    names = {"recall": "R", "precision": "P", "f1": "F1"}
    return tuple(
        Measure(
            score(f"{picture}_{name}", short, group, interval=name == "f1"),
            f"{picture}_{name}_visible",
            f"{picture}_{name}_paper",
        )
        for name, short in names.items()
    )


FULL_DETECTION = detection("full", "full frame")
ROI_DETECTION = detection("roi", "ROI only")

BYTES = (
    *(
        Measure(
            percentage(f"byte_saving_{layer}", LAYER_NAMES[layer], "bytes saved %", interval=layer == "message"),
            f"byte_saving_{layer}",
        )
        for layer in BYTE_LAYERS
    ),
    Measure(percentage("byte_saving_equal_psnr", "saved", "equal PSNR", interval=True), "byte_saving_equal_psnr"),
    Measure(number("roi_psnr_db", "dB", "equal PSNR", 1), "roi_psnr_db"),
    Measure(number("up_kbps", "up", "kbit/s"), "up_kbps"),
    Measure(number("down_kbps", "down", "kbit/s"), "down_kbps"),
)
LOOP = (
    Measure(percentage("coverage_sent", "%", "Sent"), "coverage_tx"),
    Measure(percentage("keyframe_rate", "%", "Key"), "keyframe_rate"),
    Measure(percentage("token_reduction_model", "real %", "Tok"), "token_reduction_model"),
)
MASKS = (Measure(score("mask_iou", "IoU", "mask"), "mask_iou", "mask_iou_frames"),)
PRECISION = (
    Measure(score("full_ap50", "full", "AP50"), "full_ap50_visible", "full_ap50"),
    Measure(score("roi_ap50", "ROI", "AP50"), "roi_ap50_visible", "roi_ap50"),
)
LATENCY = (
    Measure(number("latency_p50_ms", "p50", "ms"), "latency_p50_ms"),
    Measure(number("latency_p95_ms", "p95", "ms"), "latency_p95_ms"),
)
SIZE = (
    Measure(number("sequences", "seqs"), "sequences"),
    Measure(number("frames", "frames"), "frames"),
)

ACROSS_DATA_SETS = (
    ("the paper's columns", (*COVERAGE, *RECOGNITION, *FULL_DETECTION, *ROI_DETECTION, *SIZE)),
    ("what it cost and kept", (*BYTES, *LOOP, *SPURIOUS, *MASKS, *PRECISION, *LATENCY)),
)
"""Table I, part by part."""

ACROSS_STRATEGIES = (
    ("the paper's columns", (*COVERAGE, *RECOGNITION, *RETENTION, *ROI_DETECTION)),
    ("what it cost and kept", (*BYTES, *LOOP, *SPURIOUS, *MASKS, *PRECISION[1:], *LATENCY)),
)
"""Table II, part by part."""
