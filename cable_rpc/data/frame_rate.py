"""Nominal rates of recordings, and thinning them to a lower rate, by their time stamps.

Stamps are seldom even. nuScenes' cameras of 12 Hz wait for a lidar of 20 Hz, which puts their frames 50 or 100 ms
apart: the median step says 10 Hz there, and the first frame of each period is up to a turn of the lidar late.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean, median

import numpy as np

NS_PER_S = 1_000_000_000
HOLE_PERIODS = 1.75
"""Steps longer than so many usual ones are holes, of one missing frame or more, and say nothing about the rate."""
ROUNDED_PERIODS = 1e-3
"""Of the lower rate, by which stamps may be off because they are rounded."""


def nominal_fps(times_ns: Sequence[int]) -> float | None:
    """Frames per second by the mean step of rising times, holes aside; None for a single frame."""
    steps = [later - earlier for earlier, later in pairwise(times_ns)]
    if not steps:
        return None
    usual = median(steps)
    return NS_PER_S / fmean(step for step in steps if step <= HOLE_PERIODS * usual)


def thinned(times_ns: Sequence[int], fps: float | None) -> list[int]:
    """Places of the frames that lie nearest to the beats of a lower rate, each once.

    Beats run from the first frame to the last one. In a hole of the recording those farther than half a period from any
    frame have none.

    Args:
        times_ns: rising, at least one.
        fps: the lower rate; None takes all frames.
    """
    if fps is None:
        return list(range(len(times_ns)))
    period = NS_PER_S / fps
    since = np.array(times_ns, np.int64) - times_ns[0]
    beats = np.arange(0.0, float(since[-1]) + ROUNDED_PERIODS * period, period)
    after = np.searchsorted(since, beats).clip(0, len(since) - 1)
    before = (after - 1).clip(0)
    nearest = np.where(beats - since[before] < since[after] - beats, before, after)
    met = np.abs(since[nearest] - beats) <= (0.5 + ROUNDED_PERIODS) * period
    places: list[int] = np.unique(nearest[met]).tolist()
    return places
