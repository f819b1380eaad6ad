"""What to do about curves that can't be compared, in words."""

from __future__ import annotations

from cable_rpc.study.bd_rate import RateQualityCurve
from cable_rpc.study.rate_quality.points import Method
from cable_rpc.study.rate_quality.pooling import RateQualityGrid

LabelledCurve = tuple[str, RateQualityCurve]
"""A method's label and its measured points."""


def no_sequence_in_common(anchor: Method, test: Method) -> str:
    """Two methods were measured on different sequences."""
    return (
        f"'{anchor.label}' ({', '.join(anchor.sequences) or 'no sequence'}) and '{test.label}' "
        f"({', '.join(test.sequences) or 'no sequence'}) share no sequence; measure both on the same ones"
    )


def no_setting(label: str, grid: RateQualityGrid) -> str:
    """All settings of a method were left out."""
    return f"no setting of '{label}' can be used: {'; '.join(grid.left_out) or 'it has no points; measure some'}"


def how_to_compare(anchor: LabelledCurve, test: LabelledCurve, min_points: int, *, at_equal_rate: bool) -> str:
    """Which of two curves to code how, so that they can be compared.

    Args:
        anchor: one curve.
        test: the other.
        min_points: points that each needs after dominated ones are dropped.
        at_equal_rate: whether they are compared over rates rather than over qualities.
    """
    hulls = [(label, curve.without_dominated()) for label, curve in (anchor, test)]
    short = [f"'{label}'" for label, curve in hulls if len(curve) < min_points]
    if short:
        return f"code {' and '.join(short)} at more CRFs, finer where the quality still rises"
    unit = " kbit/s" if at_equal_rate else ""
    spans = [(label, curve.rates if at_equal_rate else curve.qualities) for label, curve in hulls]
    worse, better = sorted(spans, key=lambda span: span[1][-1])
    deeper, shallower = sorted(spans, key=lambda span: span[1][0])
    advice = []
    if worse[1][-1] < better[1][-1]:
        advice.append(f"'{worse[0]}' at lower CRFs, towards {better[1][-1]:.4g}{unit}")
    if deeper[1][0] < shallower[1][0]:
        advice.append(f"'{shallower[0]}' at higher CRFs, towards {deeper[1][0]:.4g}{unit}")
    return f"code {' and '.join(advice)}" if advice else "code both at more CRFs"
