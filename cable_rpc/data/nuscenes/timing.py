"""Frame rates of cameras whose frames aren't evenly spaced.

nuScenes' cameras run at 12 Hz, triggered by a lidar of 20 Hz: their frames are 50 or 100 ms apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean, median

import numpy as np

NS_PER_S = 1_000_000_000
HOLE_PERIODS = 2.5
"""Steps longer than so many usual ones are holes and say nothing about the rate."""


def mean_rate(times_ns: Sequence[int]) -> float | None:
    """Frames per second over rising times, holes aside; None for a single frame."""
    steps = [later - earlier for earlier, later in pairwise(times_ns)]
    if not steps:
        return None
    usual = median(steps)
    return NS_PER_S / fmean(step for step in steps if step <= HOLE_PERIODS * usual)


def thinned_evenly(times_ns: Sequence[int], fps: float) -> list[int]:
    """Places of the frames that lie nearest to the beats of a lower rate, each once.

    The first frame beyond every beat, as a video is thinned, would be off by up to a lidar turn here.
    """
    since = np.array(times_ns, np.int64) - times_ns[0]
    beats = np.arange(0.0, float(since[-1]) + 0.5 * NS_PER_S / fps, NS_PER_S / fps)
    after = np.searchsorted(since, beats).clip(0, len(since) - 1)
    before = (after - 1).clip(0)
    nearest = np.where(beats - since[before] < since[after] - beats, before, after)
    places: list[int] = np.unique(nearest).tolist()
    return places
