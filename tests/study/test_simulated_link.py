"""A link in simulated time: against closed formulas, and a trace against a simulation of its single packets."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep.simulated_link import MS, TRACE_PACKET_BYTES, LinkClock, SimulatedLink

FRAME_NS = 100 * MS


def test_one_frame_takes_the_sum_of_its_parts():
    link = SimulatedLink("l", uplink_kbps=1000, downlink_kbps=100, delay_ms=30, edge_ms=10, cloud_ms=50)
    # 12 500 bytes at 1 Mbit/s are 100 ms, 125 bytes at 100 kbit/s are 10 ms.
    assert LinkClock(link).send(5 * FRAME_NS, 12_500, 125) == 5 * FRAME_NS + (10 + 100 + 30 + 50 + 10 + 30) * MS


def test_a_frame_waits_for_the_one_before_it():
    link = SimulatedLink("l", uplink_kbps=1000, delay_ms=0, edge_ms=0, cloud_ms=0, downlink_kbps=1e12, window=9)
    clock = LinkClock(link)
    answers = [clock.send(k * FRAME_NS, 25_000, 0) for k in range(4)]
    # 200 ms of sending every 100 ms: the queue grows by 100 ms a frame.
    assert answers == [200 * MS, 400 * MS, 600 * MS, 800 * MS]


def test_the_cloud_works_on_one_frame_at_a_time():
    link = SimulatedLink("l", uplink_kbps=1e9, delay_ms=0, edge_ms=0, cloud_ms=150, downlink_kbps=1e12, window=9)
    clock = LinkClock(link)
    assert [clock.send(k * FRAME_NS, 1, 0) // MS for k in range(3)] == [150, 300, 450]


def test_a_full_window_has_no_room_until_an_answer_is_there():
    clock = LinkClock(SimulatedLink("l", uplink_kbps=1000, delay_ms=50, edge_ms=0, cloud_ms=0, window=2))
    first = clock.send(0, 12_500, 0)
    assert clock.has_room(FRAME_NS)
    clock.send(FRAME_NS, 12_500, 0)
    assert not clock.has_room(first - 1)
    assert clock.has_room(first)


@given(
    steps=st.lists(st.integers(0, 7), min_size=1, max_size=12).filter(any),
    frames=st.lists(st.tuples(st.integers(0, 60), st.integers(1, 9000)), min_size=1, max_size=12),
)
def test_a_trace_serves_one_packet_at_each_of_its_moments(steps: list[int], frames: list[tuple[int, int]]) -> None:
    """Mahimahi's rule, packet by packet: each moment takes at most 1500 bytes, of one frame, or is lost."""
    moments, total = [], 0
    for step in steps:
        total += step
        moments.append(total)
    link = SimulatedLink("t", trace_ms=tuple(moments), delay_ms=0, edge_ms=0, cloud_ms=0, downlink_kbps=1e12)
    clock = LinkClock(link)
    forever = (lap * moments[-1] + moment for lap in range(100_000) for moment in moments)
    capture = 0
    for gap, size in frames:
        capture += gap
        left, now = size, -1
        while left > 0:
            now = next(forever)
            if now >= capture:
                left -= TRACE_PACKET_BYTES
        assert clock.send(capture * MS, size, 0) == now * MS


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({}, "uplink_kbps or a trace"),
        ({"uplink_kbps": 1.0, "trace_ms": (1,)}, "not both"),
        ({"uplink_kbps": 0.0}, "above 0"),
        ({"uplink_kbps": 1.0, "delay_ms": -1.0}, "at least 0 ms"),
        ({"uplink_kbps": 1.0, "window": 0}, "window"),
        ({"trace_ms": (3, 2)}, "rising"),
        ({"trace_ms": (0,)}, "above 0"),
    ],
)
def test_impossible_links_are_refused(settings: dict[str, float], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        SimulatedLink("bad", **settings)
