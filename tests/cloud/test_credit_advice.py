"""Credit follows what limits a stream: two frames for a slow link, one for busy models."""

from __future__ import annotations

import pytest

from cable_rpc.cloud.credit_advice import CreditAdvice


def overtaking(advice: CreditAdvice, frames: int) -> None:
    for _ in range(frames):
        advice.frame_taken(1)
        advice.frame_answered(wait_ns=100, run_ns=100)


def finding_room(advice: CreditAdvice, frames: int) -> None:
    for _ in range(frames):
        advice.frame_taken(0)
        advice.frame_answered(wait_ns=10, run_ns=100)


def frames_until_raised(advice: CreditAdvice) -> int:
    for count in range(1, 1000):
        finding_room(advice, 1)
        if advice.in_flight > 1:
            return count
    raise AssertionError("never raised")


def test_a_frame_overtaken_now_and_then_changes_nothing() -> None:
    advice = CreditAdvice(2)
    for _ in range(20):
        finding_room(advice, 5)
        overtaking(advice, 1)
    assert advice.in_flight == 2


def test_overtaking_as_a_rule_lowers_and_room_raises_again_later_each_time() -> None:
    advice = CreditAdvice(3)
    waits = []
    for _ in range(7):
        overtaking(advice, 8)
        assert advice.in_flight == 1
        waits.append(frames_until_raised(advice))
        assert advice.in_flight == 3
    assert waits == [8, 16, 32, 64, 128, 128, 128]


def test_one_busy_moment_starts_the_count_of_room_again() -> None:
    advice = CreditAdvice(2)
    overtaking(advice, 8)
    finding_room(advice, 7)
    advice.frame_answered(wait_ns=90, run_ns=100)
    finding_room(advice, 7)
    assert advice.in_flight == 1
    finding_room(advice, 1)
    assert advice.in_flight == 2


@pytest.mark.parametrize("granted", [1, 2, 5])
def test_advice_stays_within_the_grant(granted: int) -> None:
    advice = CreditAdvice(granted)
    for frames in (3, 9, 30):
        overtaking(advice, frames)
        assert 1 <= advice.in_flight <= granted
        finding_room(advice, 200)
        assert advice.in_flight == granted
