"""Bjontegaard's deltas: how far two rate-quality curves lie apart, as one number.

Bjontegaard, "Calculation of average PSNR differences between RD-curves", VCEG-M33 (2001), with the piecewise
interpolators that later documents (JCTVC-B055, JVET-L0241) put in the place of its single cubic.

Two rules keep the number from meaning nothing: a curve needs five points, three of them beaten by none, and the
curves must share half of the range that they span together. Where one is broken there is an error, never a number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cable_rpc.errors import CableError, ConfigurationError

Float64Array = npt.NDArray[np.float64]
Interpolation = Literal["pchip", "akima", "cubic"]
"""``pchip``: shape-preserving cubics (Fritsch and Carlson 1980), which make no bump that the points don't have;
``akima``: Akima's (1970), smoother; ``cubic``: one polynomial of degree 3 in the least squares sense, VCEG-M33's own,
which bends away from curves of more than four points."""

MIN_POINTS = 5
MIN_UNDOMINATED = 3
"""Of them, that others don't beat: measures of a task are noisy, and a curve of them is never smooth."""
MIN_OVERLAP = 0.5

Area = Callable[[float, float], float]
"""Integral of an interpolated curve from one abscissa to another."""


class IncomparableCurvesError(CableError):
    """Two curves have too few points or too little in common; the text says which."""

    code = ConfigurationError.code


@dataclass(frozen=True, slots=True)
class RateQualityCurve:
    """Measured points of one way to code something, in any order.

    Raises:
        ConfigurationError: The lists differ in length, a rate isn't above 0, or a value isn't finite.
    """

    rates: tuple[float, ...]
    """Bytes, kbit/s or any other unit, the same for both curves of a comparison."""
    qualities: tuple[float, ...]
    """Decibels or another measure of which more is better."""

    def __post_init__(self) -> None:
        if len(self.rates) != len(self.qualities):
            raise ConfigurationError(
                f"a rate-quality curve has {len(self.rates)} rates and {len(self.qualities)} qualities; "
                "give one of each for every point"
            )
        for rate, quality in zip(self.rates, self.qualities, strict=True):
            if not (math.isfinite(rate) and rate > 0 and math.isfinite(quality)):
                raise ConfigurationError(
                    f"a rate-quality curve has the point ({rate}, {quality}); rates must be above 0 and both finite"
                )

    def __len__(self) -> int:
        return len(self.rates)

    def without_dominated(self) -> RateQualityCurve:
        """The points that no other point beats, by rising rate: rate and quality then both rise strictly.

        A point is beaten by one of at most its rate and at least its quality; of equal points one stays.
        """
        kept: list[tuple[float, float]] = []
        for rate, quality in sorted(
            zip(self.rates, self.qualities, strict=True), key=lambda point: (point[0], -point[1])
        ):
            if not kept or quality > kept[-1][1]:
                kept.append((rate, quality))
        return RateQualityCurve(tuple(rate for rate, _ in kept), tuple(quality for _, quality in kept))


@dataclass(frozen=True, slots=True)
class BjontegaardDelta:
    """The mean distance of a test curve from an anchor, and what it rests on."""

    value: float
    """Percent of rate (negative: the test needs less) or quality (positive: the test is better)."""
    overlap: float
    """Range that the curves share, of the range they span together, 0..1; of qualities or of log rates."""
    low: float
    """Lower end of the shared range: a quality, or the decadic logarithm of a rate."""
    high: float
    """Upper end of it."""
    anchor_dropped: int
    """Points of the anchor that were beaten by others of it and took no part."""
    test_dropped: int
    """The same for the test curve."""


def bd_rate(
    anchor: RateQualityCurve,
    test: RateQualityCurve,
    method: Interpolation = "pchip",
    *,
    min_overlap: float = MIN_OVERLAP,
    min_points: int = MIN_POINTS,
) -> BjontegaardDelta:
    """Mean difference in rate at equal quality, in percent of the anchor's rate.

    The decadic logarithm of the rate is interpolated over the quality, the difference averaged over the qualities
    that both curves reach, and turned back: -50 means half the rate.

    Args:
        anchor: What to compare with.
        test: What to judge.
        method: Interpolation.
        min_overlap: Share of the spanned qualities that the curves must have in common, 0..1.
        min_points: Points that each curve needs; `MIN_UNDOMINATED` of them must be left when beaten ones are dropped.

    Raises:
        IncomparableCurvesError: Too few points, or too small an overlap.
        ConfigurationError: Unknown method.
    """
    kept_anchor, kept_test = usable(anchor, "anchor", min_points), usable(test, "test curve", min_points)
    low, high, overlap = shared_range(kept_anchor.qualities, kept_test.qualities, "quality", min_overlap)
    difference = mean_difference(
        (kept_anchor.qualities, logarithms(kept_anchor)),
        (kept_test.qualities, logarithms(kept_test)),
        low,
        high,
        method,
    )
    return BjontegaardDelta(
        value=100.0 * (10.0**difference - 1.0),
        overlap=overlap,
        low=low,
        high=high,
        anchor_dropped=len(anchor) - len(kept_anchor),
        test_dropped=len(test) - len(kept_test),
    )


def bd_quality(
    anchor: RateQualityCurve,
    test: RateQualityCurve,
    method: Interpolation = "pchip",
    *,
    min_overlap: float = MIN_OVERLAP,
    min_points: int = MIN_POINTS,
) -> BjontegaardDelta:
    """Mean difference in quality at equal rate, in the unit of the qualities (BD-PSNR where they are decibels).

    Quality is interpolated over the decadic logarithm of the rate, so the overlap is one of rates: curves far apart
    have a BD-rate long before they have this.

    Args:
        anchor: What to compare with.
        test: What to judge.
        method: Interpolation.
        min_overlap: Share of the spanned log rates that the curves must have in common, 0..1.
        min_points: Points that each curve needs; `MIN_UNDOMINATED` of them must be left when beaten ones are dropped.

    Raises:
        IncomparableCurvesError: Too few points, or too small an overlap.
        ConfigurationError: Unknown method.
    """
    kept_anchor, kept_test = usable(anchor, "anchor", min_points), usable(test, "test curve", min_points)
    anchor_logs, test_logs = logarithms(kept_anchor), logarithms(kept_test)
    low, high, overlap = shared_range(anchor_logs, test_logs, "log rate", min_overlap)
    difference = mean_difference(
        (anchor_logs, kept_anchor.qualities), (test_logs, kept_test.qualities), low, high, method
    )
    return BjontegaardDelta(
        value=difference,
        overlap=overlap,
        low=low,
        high=high,
        anchor_dropped=len(anchor) - len(kept_anchor),
        test_dropped=len(test) - len(kept_test),
    )


def usable(curve: RateQualityCurve, name: str, min_points: int) -> RateQualityCurve:
    """The curve without dominated points.

    Raises:
        IncomparableCurvesError: Too few were measured, or are left.
    """
    if len(curve) < min_points:
        raise IncomparableCurvesError(
            f"the {name} has {len(curve)} points, {min_points} are needed; code at more qualities"
        )
    kept = curve.without_dominated()
    needed = min(MIN_UNDOMINATED, min_points)
    if len(kept) < needed:
        raise IncomparableCurvesError(
            f"the {name} has {len(kept)} points once {len(curve) - len(kept)} beaten by others are dropped, "
            f"{needed} are needed; code at more qualities"
        )
    return kept


def shared_range(
    anchor: Sequence[float], test: Sequence[float], axis: str, min_overlap: float
) -> tuple[float, float, float]:
    """(low, high, share of the union) of the range that two rising sequences have in common.

    Raises:
        IncomparableCurvesError: The share is below ``min_overlap``, or there is nothing in common.
    """
    low, high = max(anchor[0], test[0]), min(anchor[-1], test[-1])
    union = max(anchor[-1], test[-1]) - min(anchor[0], test[0])
    overlap = max(0.0, high - low) / union if union > 0 else 0.0
    if overlap < min_overlap or high <= low:
        raise IncomparableCurvesError(
            f"the curves share {100 * overlap:.0f} % of their {axis} range (anchor {anchor[0]:.4g} to "
            f"{anchor[-1]:.4g}, test {test[0]:.4g} to {test[-1]:.4g}), {100 * min_overlap:.0f} % are needed; "
            "choose qualities that bring them closer"
        )
    return low, high, overlap


def mean_difference(
    anchor: tuple[Sequence[float], Sequence[float]],
    test: tuple[Sequence[float], Sequence[float]],
    low: float,
    high: float,
    method: Interpolation,
) -> float:
    """Mean of test minus anchor over low..high, each curve given as rising abscissae and ordinates.

    Raises:
        ConfigurationError: Unknown method, or scipy is missing.
    """
    area_of = interpolator(method)
    anchor_area, test_area = (area_of(np.asarray(x, np.float64), np.asarray(y, np.float64)) for x, y in (anchor, test))
    return (test_area(low, high) - anchor_area(low, high)) / (high - low)


def interpolator(method: Interpolation) -> Callable[[Float64Array, Float64Array], Area]:
    """What turns rising abscissae and ordinates into the area under their curve.

    Raises:
        ConfigurationError: Unknown method, or scipy is missing.
    """
    if method not in get_args(Interpolation):
        raise ConfigurationError(
            f"interpolation '{method}' is unknown; use one of {', '.join(get_args(Interpolation))}"
        )
    return INTERPOLATORS[method]


def pchip_area(x: Float64Array, y: Float64Array) -> Area:
    """Area under the shape-preserving piecewise cubic."""
    return piecewise_area("PchipInterpolator", x, y)


def akima_area(x: Float64Array, y: Float64Array) -> Area:
    """Area under Akima's piecewise cubic."""
    return piecewise_area("Akima1DInterpolator", x, y)


def piecewise_area(kind: str, x: Float64Array, y: Float64Array) -> Area:
    """Area under one of scipy's piecewise polynomials.

    Raises:
        ConfigurationError: scipy is missing.
    """
    try:
        from scipy import interpolate
    except ImportError as error:
        raise ConfigurationError("BD-rate needs scipy: pip install 'cable-rpc[study]'") from error
    curve = getattr(interpolate, kind)(x, y)
    return lambda low, high: float(curve.integrate(low, high))


def cubic_area(x: Float64Array, y: Float64Array) -> Area:
    """Area under the polynomial of degree 3 that fits best."""
    # Centred and scaled abscissae: powers of raw decibels lose digits.
    area = np.polynomial.Polynomial.fit(x, y, 3).integ()
    return lambda low, high: float(area(high) - area(low))


def logarithms(curve: RateQualityCurve) -> tuple[float, ...]:
    """Decadic logarithms of the rates."""
    return tuple(math.log10(rate) for rate in curve.rates)


INTERPOLATORS: Mapping[Interpolation, Callable[[Float64Array, Float64Array], Area]] = {
    "pchip": pchip_area,
    "akima": akima_area,
    "cubic": cubic_area,
}
