"""The qualities that a sweep's curves can be drawn of, and the curves themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.rate_quality import Method, SequencePoint
from cable_rpc.study.sequence_metrics import FIGURES, pool
from cable_rpc.study.sweep.cell import CellResult, MeasuredCell, RegionQuality
from cable_rpc.study.tables.equal_quality import psnr

Parts = tuple[float, float]
"""What was gained, and what was possible: both add over sequences."""


@dataclass(frozen=True, slots=True)
class Quality:
    """One measure of what a cell gave."""

    name: str
    title: str
    """For the axis of a plot."""
    unit: str
    """ "%", "dB", or empty."""
    meaning: str
    parts: Callable[[CellResult], Parts | None]
    """None where the cell has nothing to measure it on. Gained over possible is a share where the unit is "%"."""

    def value(self, result: CellResult) -> float | None:
        """In its unit; None where it is undefined."""
        parts = self.parts(result)
        if parts is None or parts[1] <= 0:
            return None
        return self.scale * parts[0] / parts[1]

    @property
    def scale(self) -> float:
        """From a ratio to the unit."""
        return 100.0 if self.unit == "%" else 1.0


def figure_parts(name: str) -> Callable[[CellResult], Parts | None]:
    """Those of a named figure of `cable_rpc.study.sequence_metrics`, which is a ratio of sums."""

    def parts(result: CellResult) -> Parts | None:
        gained, possible = FIGURES[name].parts(result.metrics)
        return float(_number(gained)), float(_number(possible))

    return parts


def _number(value: object) -> float:
    """A number, or an array of one."""
    return float(getattr(value, "item", lambda: value)())  # type: ignore[arg-type]


def ap50_parts(result: CellResult) -> Parts | None:
    """The sequence's AP, each sequence counting alike: AP is no ratio of sums."""
    estimate = pool([result.metrics]).average_precision("roi", variant="visible", iou=0.5)
    return None if estimate.value is None else (estimate.value, 1.0)


def psnr_parts(region: RegionQuality) -> Parts | None:
    """Decibels of the sequence's pooled squared error, each sequence counting alike."""
    if not region.pixels or not region.squared_error:
        return None
    return psnr(region.squared_error, region.pixels), 1.0


def ssim_parts(region: RegionQuality) -> Parts:
    """Mean over frames."""
    return region.ssim, float(region.ssim_frames)


QUALITIES: Mapping[str, Quality] = {
    quality.name: quality
    for quality in (
        Quality(
            "retention",
            "detections kept",
            "%",
            "share of the detections on uncompressed whole frames that the same detector finds again in what was "
            "received (IoU 0.5, score from 0.4), pooled over detections",
            figure_parts("retention"),
        ),
        Quality(
            "recognition_50",
            "objects sent",
            "%",
            "share of the objects of which at least half the box was sent, pooled over objects",
            figure_parts("recognition_50_sent_visible"),
        ),
        Quality(
            "ap50",
            "AP50",
            "%",
            "average precision at IoU 0.5 on what was received, mean over class groups and then over sequences",
            ap50_parts,
        ),
        Quality("f1", "F1", "%", "F1 at IoU 0.5, score from 0.4, pooled over objects", figure_parts("roi_f1_visible")),
        Quality(
            "mask_iou",
            "mask IoU",
            "%",
            "the cloud's mask against that of the uncompressed whole frame, pixels pooled",
            figure_parts("mask_iou"),
        ),
        Quality(
            "psnr_objects",
            "PSNR of objects",
            "dB",
            "luma PSNR inside the boxes of all objects, sent or not; errors pooled over frames, mean over sequences",
            lambda result: psnr_parts(result.objects),
        ),
        Quality(
            "ssim_objects",
            "SSIM of objects",
            "",
            "luma SSIM inside the boxes of all objects, sent or not; mean over every third frame",
            lambda result: ssim_parts(result.objects),
        ),
        Quality(
            "psnr_sent",
            "PSNR of the region",
            "dB",
            "luma PSNR inside what was sent, which differs from strategy to strategy",
            lambda result: psnr_parts(result.sent),
        ),
        Quality(
            "ssim_sent",
            "SSIM of the region",
            "",
            "luma SSIM inside what was sent, which differs from strategy to strategy; mean over every third frame",
            lambda result: ssim_parts(result.sent),
        ),
    )
}
"""By name."""


def find_quality(name: str) -> Quality:
    """A quality by its name.

    Raises:
        ConfigurationError: there is none.
    """
    if name not in QUALITIES:
        raise ConfigurationError(f"there is no quality '{name}'; choose of {', '.join(QUALITIES)}")
    return QUALITIES[name]


def methods_of(cells: Iterable[MeasuredCell], quality: str) -> tuple[Method, ...]:
    """One curve for each method, in the order of the cells; failed cells take no part.

    Args:
        cells: of a run, in its order.
        quality: a name of `QUALITIES`.

    Raises:
        ConfigurationError: there is no such quality.
    """
    wanted = find_quality(quality)
    kept = list(cells)
    names = sequence_names(kept)
    points: dict[str, list[SequencePoint]] = {}
    for measured in kept:
        curve = points.setdefault(measured.cell.method, [])
        if measured.result is not None:
            curve.append(point_of(measured, measured.result, wanted, names[measured.cell.clip.source]))
    return tuple(Method(label, tuple(curve)) for label, curve in points.items() if curve)


def sequence_names(cells: Iterable[MeasuredCell]) -> dict[str, str]:
    """What to call each source: its own name, or all of it where another source has the same name."""
    names = {one.cell.clip.source: one.result.sequence for one in cells if one.result is not None}
    shared = Counter(names.values())
    return {source: name if shared[name] == 1 else source for source, name in names.items()}


def point_of(measured: MeasuredCell, result: CellResult, quality: Quality, sequence: str) -> SequencePoint:
    """One cell on a curve."""
    gained, possible = quality.parts(result) or (0.0, 0.0)
    return SequencePoint(
        sequence,
        measured.cell.setting,
        result.uplink.total,
        result.seconds,
        quality.scale * gained,
        possible,
        measured.key,
    )
