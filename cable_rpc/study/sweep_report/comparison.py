"""The methods of a sweep held against their anchors by one quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cable_rpc.study.bd_rate import Interpolation
from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.rate_quality import (
    DeltaResult,
    FixedQuality,
    Method,
    PooledPoint,
    SavingAtQuality,
    bd_quality_between,
    bd_rate_between,
    left_out,
    pooled_points,
    rate_at,
    saving_at,
)
from cable_rpc.study.sweep.cell import MeasuredCell
from cable_rpc.study.sweep.qualities import Quality, find_quality, methods_of

LEVELLED_QUALITY = "retention"
"""Whose fixed levels are looked at."""
OTHER_INTERPOLATIONS: tuple[Interpolation, ...] = ("akima", "cubic")


@dataclass(frozen=True, slots=True)
class LevelResult:
    """What a method needs for a fixed quality."""

    level: float
    rate: FixedQuality
    saving: SavingAtQuality | None
    """Against the anchor; None for an anchor."""


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One method by one quality."""

    method: Method
    anchor: str | None
    """None for an anchor itself, and where there is none."""
    points: tuple[PooledPoint, ...]
    levels: tuple[LevelResult, ...]
    bd_rate: DeltaResult | None
    bd_quality: DeltaResult | None
    other_bd_rates: Mapping[Interpolation, DeltaResult]
    """By other interpolations, without intervals."""

    @property
    def label(self) -> str:
        """The method's name."""
        return self.method.label

    @property
    def remarks(self) -> tuple[str, ...]:
        """Why figures are missing, and what was left out; each once."""
        said = [*left_out(self.method)]
        for delta, name in ((self.bd_rate, "BD-rate"), (self.bd_quality, "BD-quality")):
            if delta is not None:
                said += [f"{name}: {delta.reason}"] if delta.reason else []
                said += delta.notes
        for one in self.levels:
            for figure in (one.rate, one.saving):
                if figure is not None:
                    said += [f"at {one.level:g} %: {text}" for text in (figure.reason, *figure.notes) if text]
        return tuple(dict.fromkeys(said))


@dataclass(frozen=True, slots=True)
class QualityResult:
    """All methods by one quality."""

    quality: Quality
    methods: tuple[MethodResult, ...]

    @property
    def sequences(self) -> tuple[str, ...]:
        """Of all methods, each once, sorted."""
        return tuple(sorted({name for one in self.methods for name in one.method.sequences}))

    @property
    def best(self) -> MethodResult | None:
        """The method of lowest BD-rate; None where there is none."""
        rated = [
            (one.bd_rate.value, one)
            for one in self.methods
            if one.bd_rate is not None and one.bd_rate.value is not None
        ]
        return min(rated, key=lambda pair: pair[0])[1] if rated else None


def quality_result(
    cells: Sequence[MeasuredCell],
    name: str,
    anchors: Mapping[str, str | None],
    levels: Sequence[float],
    bootstrap: Bootstrap | None,
) -> QualityResult:
    """Compare every method with its anchor.

    Args:
        cells: of a run.
        name: of a quality.
        anchors: by method, None for none.
        levels: in percent, of retention.
        bootstrap: how to draw sequences; None for no intervals.

    Raises:
        ConfigurationError: there is no such quality, a method has two cells of one sequence and setting, or scipy is
            missing.
    """
    quality = find_quality(name)
    methods = {method.label: judged(method) for method in methods_of(cells, name)}
    wanted = tuple(levels) if name == LEVELLED_QUALITY else ()
    results = []
    for label, method in methods.items():
        anchor = methods.get(anchors.get(label) or "")
        results.append(
            MethodResult(
                method,
                None if anchor is None else anchor.label,
                pooled_points(method, bootstrap),
                tuple(level_result(anchor, method, level, bootstrap) for level in wanted),
                None if anchor is None else bd_rate_between(anchor, method, bootstrap),
                None if anchor is None else bd_quality_between(anchor, method, bootstrap),
                {}
                if anchor is None
                else {kind: bd_rate_between(anchor, method, None, interpolation=kind) for kind in OTHER_INTERPOLATIONS},
            )
        )
    return QualityResult(quality, tuple(one for one in results if one.points))


def judged(method: Method) -> Method:
    """The method without points at which nothing was sent, which have no place on a logarithmic axis."""
    return replace(method, points=tuple(point for point in method.points if point.bytes_up))


def level_result(anchor: Method | None, method: Method, level: float, bootstrap: Bootstrap | None) -> LevelResult:
    """One method at one fixed quality."""
    saving = None if anchor is None else saving_at(anchor, method, level, bootstrap)
    return LevelResult(level, rate_at(method, level, bootstrap), saving)
