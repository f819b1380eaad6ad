"""What the points of a codec study say: each treatment and codec against whole frames in H.264."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.bd_rate import IncomparableCurvesError, RateQualityCurve, bd_rate
from cable_rpc.study.study_points import StudyPoint
from cable_rpc.study.study_treatments import WHOLE

ANCHOR_CODEC = "h264"
COMPARISON_FILE = "codec_study_bd.csv"


@dataclass(frozen=True, slots=True, order=True)
class ClipView:
    """A clip with the region that was coded of it."""

    clip: str
    mask: str

    @property
    def title(self) -> str:
        """Short enough for the head of a column."""
        scheme, _, rest = self.clip.partition(":")
        return "/".join((Path(rest).parent.name, Path(rest).stem)) if scheme == "video" else self.clip

    @property
    def kind(self) -> str:
        """The kind of region, whoever answered the loop."""
        return self.mask.partition(",")[0]


@dataclass(frozen=True, slots=True)
class Way:
    """One way to code, on every clip."""

    treatment: str
    codec: str


@dataclass(frozen=True, slots=True)
class Comparison:
    """A way on a clip against the anchor, or why there is no number."""

    bd_rate: float | None
    """Percent, negative where it needs less."""
    overlap: float | None
    """Share of the spanned qualities that both reach."""
    dropped: int
    """Points of the way and of the anchor that others of their curve beat."""
    refusal: str = ""
    """Why there is no number."""


@dataclass(frozen=True, slots=True)
class Measure:
    """A quality that curves are drawn over."""

    name: str
    title: str
    of: Callable[[StudyPoint], float | None]


def decibels_of_similarity(similarity: float | None) -> float | None:
    """SSIM on a scale on which steps near 1 count as seen: -10 log10(1 - SSIM)."""
    if similarity is None:
        return None
    return math.inf if similarity >= 1 else -10 * math.log10(1 - similarity)


MEASURES: Mapping[str, Measure] = {
    measure.name: measure
    for measure in (
        Measure("roi_psnr", "luma PSNR inside the region", lambda point: point.roi_psnr_db),
        Measure("roi_ssim", "luma SSIM inside the region, in dB", lambda point: decibels_of_similarity(point.roi_ssim)),
        Measure("box_psnr", "luma PSNR inside the boxes of the truth", lambda point: point.box_psnr_db),
    )
}


class StudyResults:
    """The points of one plan by clip and way."""

    def __init__(self, points: Iterable[StudyPoint]) -> None:
        self.points: dict[tuple[ClipView, Way], list[StudyPoint]] = {}
        for point in points:
            place = ClipView(point.clip, point.mask), Way(point.treatment, point.codec)
            self.points.setdefault(place, []).append(point)

    def by_kind(self) -> dict[str, StudyResults]:
        """The results for each kind of region: their means have nothing to do with each other."""
        groups: dict[str, list[StudyPoint]] = {}
        for (view, _), points in self.points.items():
            groups.setdefault(view.kind, []).extend(points)
        return {kind: StudyResults(points) for kind, points in groups.items()}

    @property
    def views(self) -> list[ClipView]:
        """The clips, in the order in which they were measured."""
        return list(dict.fromkeys(view for view, _ in self.points))

    @property
    def ways(self) -> list[Way]:
        """The ways to code, likewise."""
        return list(dict.fromkeys(way for _, way in self.points))

    def of(self, view: ClipView, way: Way) -> Sequence[StudyPoint]:
        """Points of a way on a clip; none where it wasn't measured."""
        return self.points.get((view, way), ())

    def curve(self, view: ClipView, way: Way, measure: Measure) -> RateQualityCurve | None:
        """Kilobits per second, masks included, against a quality; lossless points and those without it left out."""
        rated = [(point.kbps, measure.of(point)) for point in self.of(view, way)]
        usable = [(rate, quality) for rate, quality in rated if quality is not None and math.isfinite(quality)]
        if not usable:
            return None
        return RateQualityCurve(tuple(rate for rate, _ in usable), tuple(quality for _, quality in usable))

    def compare(self, view: ClipView, way: Way, measure: Measure) -> Comparison | None:
        """A way against whole frames in H.264 on a clip; None where the clip has no such quality."""
        anchor = self.curve(view, Way(WHOLE, ANCHOR_CODEC), measure)
        test = self.curve(view, way, measure)
        if anchor is None or test is None:
            return None
        try:
            delta = bd_rate(anchor, test)
        except IncomparableCurvesError as error:
            return Comparison(None, None, 0, str(error))
        return Comparison(delta.value, delta.overlap, delta.anchor_dropped + delta.test_dropped)

    def byte_saving(self, view: ClipView, way: Way) -> float | None:
        """Share of the bytes of whole frames that are saved at the same codec and quality, mean over qualities."""
        whole = {point.quality: point.total_bytes for point in self.of(view, Way(WHOLE, way.codec))}
        shares = [
            1 - point.total_bytes / whole[point.quality] for point in self.of(view, way) if point.quality in whole
        ]
        return float(np.mean(shares)) if shares else None

    def mean(self, way: Way, value: Callable[[StudyPoint], float]) -> float:
        """A value's mean over all points of a way."""
        return float(np.mean([value(point) for view in self.views for point in self.of(view, way)]))


def mean_and_worst(comparisons: Iterable[Comparison | None]) -> tuple[float | None, float | None]:
    """Mean and largest BD-rate over clips; None unless every clip has one."""
    values = [one.bd_rate if one is not None else None for one in comparisons]
    numbers = [value for value in values if value is not None]
    if not numbers or len(numbers) < len(values):
        return None, None
    return float(np.mean(numbers)), max(numbers)


def write_comparisons(results: StudyResults, path: Path) -> None:
    """Write every comparison as a row, refusals with their reason.

    Raises:
        ConfigurationError: The file can't be written.
    """
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(
                ("clip", "mask", "treatment", "codec", "measure", "bd_rate_percent", "overlap", "dropped", "refusal")
            )
            for measure in MEASURES.values():
                for view in results.views:
                    for way in results.ways:
                        one = results.compare(view, way, measure)
                        if one is not None:
                            writer.writerow(
                                (
                                    view.clip,
                                    view.mask,
                                    way.treatment,
                                    way.codec,
                                    measure.name,
                                    cell(one.bd_rate),
                                    cell(one.overlap),
                                    one.dropped,
                                    one.refusal,
                                )
                            )
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror or error}") from error


def cell(value: float | None) -> str:
    """Four digits after the point; empty for None."""
    return "" if value is None else f"{value:.4f}"
