"""Shape-preserving cubics (PCHIP) through many small curves at once, a row each.

Fritsch and Butland, "A method for constructing local monotone piecewise cubic interpolants" (1984), with the one-sided
three-point slopes at the ends of Moler, "Numerical Computing with MATLAB" (2004), as scipy's `PchipInterpolator`, which
takes one curve at a time and most of a bootstrap's time.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]


def slopes(x: Float64Array, y: Float64Array) -> Float64Array:
    """Derivatives at the knots, float64 [R, N].

    Args:
        x: [R, N], rising strictly along each row, N at least 2.
        y: [R, N].
    """
    steps = np.diff(x, axis=1)
    secants = np.diff(y, axis=1) / steps
    if x.shape[1] == 2:
        return np.repeat(secants, 2, axis=1)
    found = np.empty_like(x)
    before, after = secants[:, :-1], secants[:, 1:]
    weight_before, weight_after = 2 * steps[:, 1:] + steps[:, :-1], steps[:, 1:] + 2 * steps[:, :-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        harmonic = (weight_before + weight_after) / (weight_before / before + weight_after / after)
    found[:, 1:-1] = np.where(before * after > 0, harmonic, 0.0)
    found[:, 0] = end_slope(steps[:, 0], steps[:, 1], secants[:, 0], secants[:, 1])
    found[:, -1] = end_slope(steps[:, -1], steps[:, -2], secants[:, -1], secants[:, -2])
    return found


def end_slope(
    step: Float64Array, next_step: Float64Array, secant: Float64Array, next_secant: Float64Array
) -> Float64Array:
    """One-sided slope that keeps the shape, float64 [R]."""
    slope = ((2 * step + next_step) * secant - step * next_secant) / (step + next_step)
    turns = np.sign(slope) != np.sign(secant)
    overshoots = (np.sign(secant) != np.sign(next_secant)) & (np.abs(slope) > 3 * np.abs(secant))
    return np.where(turns, 0.0, np.where(overshoots, 3 * secant, slope))


def integrals(x: Float64Array, y: Float64Array, low: Float64Array, high: Float64Array) -> Float64Array:
    """Area under each curve from ``low`` to ``high``, both [R] within the row's knots, float64 [R]."""
    at_knots = slopes(x, y)
    steps = np.diff(x, axis=1)
    start = np.clip((low[:, None] - x[:, :-1]) / steps, 0.0, 1.0)
    end = np.clip((high[:, None] - x[:, :-1]) / steps, 0.0, 1.0)
    pieces = antiderivative(end, y, at_knots, steps) - antiderivative(start, y, at_knots, steps)
    total: Float64Array = (steps * pieces).sum(axis=1)
    return total


def antiderivative(share: Float64Array, y: Float64Array, at_knots: Float64Array, steps: Float64Array) -> Float64Array:
    """Of each cubic piece from its left end to a share of its length, in units of its length, float64 [R, N - 1]."""
    second, third, fourth = share**2, share**3, share**4
    left, right = share - third + fourth / 2, third - fourth / 2
    left_slope, right_slope = second / 2 - 2 * third / 3 + fourth / 4, fourth / 4 - third / 3
    found: Float64Array = (
        left * y[:, :-1] + right * y[:, 1:] + steps * (left_slope * at_knots[:, :-1] + right_slope * at_knots[:, 1:])
    )
    return found


def values(x: Float64Array, y: Float64Array, at: float) -> Float64Array:
    """Each curve at one abscissa, float64 [R], NaN beyond the row's knots."""
    at_knots = slopes(x, y)
    rows = np.arange(len(x))
    piece = np.clip((x <= at).sum(axis=1) - 1, 0, x.shape[1] - 2)
    step = x[rows, piece + 1] - x[rows, piece]
    share = (at - x[rows, piece]) / step
    second, third = share**2, share**3
    found = (
        (1 - 3 * second + 2 * third) * y[rows, piece]
        + (3 * second - 2 * third) * y[rows, piece + 1]
        + step * ((share - 2 * second + third) * at_knots[rows, piece] + (third - second) * at_knots[rows, piece + 1])
    )
    return np.where((x[:, 0] <= at) & (at <= x[:, -1]), found, np.nan)
