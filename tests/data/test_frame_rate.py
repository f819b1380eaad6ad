"""Nominal rates and thinning against what is known of the stamps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.data.frame_rate import nominal_fps, thinned

MS = 1_000_000
LIDAR_TIMED = [50 * MS * round(k * 20 / 12) for k in range(61)]
"""A camera of 12 Hz that waits for a lidar of 20 Hz: steps of 100, 50, 100, ... ms."""


def test_rate_of_uneven_steps() -> None:
    assert nominal_fps(LIDAR_TIMED) == pytest.approx(12.0)
    assert nominal_fps([time + 1_532_402_927_612_460_000 for time in LIDAR_TIMED]) == pytest.approx(12.0)


def test_holes_say_nothing_about_the_rate() -> None:
    assert nominal_fps([*LIDAR_TIMED, LIDAR_TIMED[-1] + 3_000 * MS]) == pytest.approx(12.0)
    assert nominal_fps([100 * MS * number for number in range(50) if number not in (7, 20, 21, 30)]) == 10.0


def test_a_single_frame_has_no_rate() -> None:
    assert nominal_fps([5 * MS]) is None
    assert thinned([5 * MS], None) == thinned([5 * MS], 2.0) == [0]


def test_thinning_of_uneven_steps_is_even() -> None:
    kept = thinned(LIDAR_TIMED, 4.0)
    assert (kept[0], len(kept)) == (0, 21)
    assert np.abs(np.array([LIDAR_TIMED[place] for place in kept]) - np.arange(21) * 250e6).max() <= 50e6
    assert thinned(LIDAR_TIMED, 2.0) == list(range(0, 61, 6))


def test_thinning_by_a_whole_number_takes_each_nth() -> None:
    rounded = [round(number * 1e9 / 30) for number in range(12)]
    assert thinned(rounded, 10.0) == [0, 3, 6, 9]
    assert thinned(rounded, 15.0) == [0, 2, 4, 6, 8, 10]
    assert thinned(rounded, None) == list(range(12))


def test_nothing_stands_for_a_beat_within_a_hole() -> None:
    """10 Hz with nothing between 1.0 s and 1.8 s; the beat at 1.5 s has no frame within its half period of 250 ms."""
    times = [100 * MS * number for number in range(31) if not 10 < number < 18]
    kept = [times[place] // MS for place in thinned(times, 2.0)]
    assert kept == [0, 500, 1000, 2000, 2500, 3000]


@given(st.lists(st.integers(1, 400), min_size=1, max_size=60), st.floats(0.5, 30.0))
def test_each_frame_kept_is_the_nearest_to_a_beat(steps_ms: list[int], fps: float) -> None:
    times = [0]
    for step in steps_ms:
        times.append(times[-1] + step * MS)
    kept = thinned(times, fps)
    assert kept[0] == 0
    assert kept == sorted(set(kept))
    period = 1e9 / fps
    for place in kept:
        beats = [number * period for number in (times[place] // period, times[place] // period + 1)]
        assert any(meets(times, times[place], beat, period) for beat in beats)


def meets(times: list[int], time: int, beat: float, period: float) -> bool:
    """Whether no frame is nearer to a beat than one that is within half a period of it."""
    off = abs(time - beat)
    return off <= 0.502 * period and off <= min(abs(other - beat) for other in times) + 1e-3
