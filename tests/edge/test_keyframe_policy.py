"""Keyframe policies against literal tables, a restatement of the paper's rule, and bounds on any sequence."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.edge.keyframe_policy import ByteBudget, KeyframeScheduler, KeyframeSignals, NewAnswer
from cable_rpc.edge.refresh import mask_iou, revealed_share
from cable_rpc.edge.roi_config import RoiConfig

DT_NS = 100_000_000
ROI_ANSWER = NewAnswer(mask_empty=False, of_keyframe=False)
KEY_ANSWER = NewAnswer(mask_empty=False, of_keyframe=True)
EMPTY_KEY_ANSWER = NewAnswer(mask_empty=True, of_keyframe=True)
NO_SILENCE = {"stale_after_s": None}


def signals(number, **changes):
    """A frame of a quiet lock-step stream of 10 frames a second, but for the changes."""
    given = {
        "time_ns": number * DT_NS,
        "first": False,
        "requested": False,
        "coverage": 0.3,
        "prior_iou": 0.9,
        "answer": ROI_ANSWER,
        "staleness": 1,
        "heard_time_ns": (number - 1) * DT_NS,
    }
    return KeyframeSignals(**{**given, **changes})


def first(number=0, **changes):
    nothing = {"coverage": None, "prior_iou": None, "answer": None, "staleness": None, "heard_time_ns": 0}
    return signals(number, first=True, **nothing, **changes)


def reasons(config, rows):
    """Reasons for a first frame and then a quiet stream with the changes of each row, in order."""
    scheduler = KeyframeScheduler(config)
    assert scheduler.decide(first()) == "first"
    return [scheduler.decide(signals(number, **row)) for number, row in enumerate(rows, 1)]


def keyframe_numbers(scheduler, count, row_of):
    """Frames sent whole of a stream with given changes; answers tell of keyframes on their own, ``delay`` late."""
    found = []
    for number in range(count):
        row = row_of(number, found)
        reason = scheduler.decide(first(number) if row is None else signals(number, **row))
        if reason is not None:
            found.append(number)
    return found


def steady_scene(delay, coverage, *, mask_empty, prior_iou=1.0, revealed=0.0):
    """A scene that stays as it is, with every answer ``delay`` frames late."""

    def row_of(number, keyframes):
        answered = number - delay
        if answered < 0:
            return None
        answer = NewAnswer(mask_empty, answered in keyframes, revealed)
        judged = prior_iou if answered >= delay else None
        seen = coverage if number > delay else None
        return {"answer": answer, "staleness": delay, "coverage": seen, "prior_iou": judged}

    return row_of


def gaps(keyframes):
    return np.diff(keyframes).tolist()


# --- what is judged -------------------------------------------------------------------------------------


def test_empty_masks_agree_where_told():
    empty, full = np.zeros((4, 4), np.bool_), np.ones((4, 4), np.bool_)
    assert mask_iou(empty, empty, empty_masks_agree=True) == 1
    assert mask_iou(empty, empty) == 0
    assert mask_iou(full, empty, empty_masks_agree=True) == 0


def test_revealed_share_counts_pixels():
    mask, region = np.zeros((2, 10), np.bool_), np.zeros((2, 10), np.bool_)
    region[:, :5] = True
    assert revealed_share(mask, region) == 0
    mask[0, 3:7] = True
    assert revealed_share(mask, region) == 0.5
    assert revealed_share(mask, np.ones_like(mask)) == 0
    assert revealed_share(mask, np.zeros_like(mask)) == 1


# --- the paper's rule -----------------------------------------------------------------------------------


def test_paper_is_the_equation_frame_by_frame():
    rows = [
        {"coverage": None, "prior_iou": None, "answer": KEY_ANSWER},
        {"coverage": 0.02, "prior_iou": 0.3},
        {"coverage": 0.0199, "prior_iou": 1.0},
        {"coverage": 0.5, "prior_iou": 0.299},
        {"coverage": 0.5, "prior_iou": 0.0, "answer": KEY_ANSWER},
        {"coverage": 0.0, "prior_iou": None},
        {"coverage": 0.5, "prior_iou": None},
        {"requested": True},
        {},
    ]
    expected = [None, None, "coverage", "prior", "prior", "coverage", None, "requested", None]
    assert reasons(RoiConfig.paper(), rows) == expected


def literal_rule(rows, config):
    """Today's rule restated: requested, silent, or c_{k+1}; any keyframe ends a silence."""
    keyframe_time_ns = 0
    for row in rows:
        quiet_ns = row.time_ns - max(row.heard_time_ns, keyframe_time_ns)
        late = row.staleness is not None and row.staleness > 1
        c = (row.coverage is not None and row.coverage < 0.02) or (row.prior_iou is not None and row.prior_iou < 0.3)
        stale = config.stale_after_s is not None and late and quiet_ns > config.stale_after_s * 1_000_000_000
        keyframe = row.first or row.requested or stale or c
        if keyframe:
            keyframe_time_ns = row.time_ns
        yield keyframe


def random_stream(seed):
    """A stream whose frames are first until an answer comes; from then on everything is possible."""
    rng = random.Random(seed)
    shares = [0.0, 0.01, 0.0199, 0.02, 0.29, 0.3, 0.5, 1.0]
    rows, time_ns, heard_time_ns, prior_number = [first()], 0, 0, None
    silence_ends, quietness = rng.randrange(5), rng.random()
    for number in range(1, rng.randrange(2, 81)):
        last_time_ns = time_ns
        time_ns += rng.choice([50_000_000, 125_000_000, 375_000_000])
        requested = rng.random() < 0.1
        answered = number > silence_ends and rng.random() < 0.6
        if answered:
            heard_time_ns = last_time_ns
            prior_number = rng.randrange(0 if prior_number is None else prior_number, number)
        if prior_number is None:
            rows.append(KeyframeSignals(time_ns, first=True, requested=requested))
            continue
        quiet = rng.random() < quietness
        answer = NewAnswer(rng.random() < 0.3, rng.random() < 0.5, rng.choice(shares), rng.choice(shares))
        row = KeyframeSignals(
            time_ns=time_ns,
            first=False,
            requested=requested,
            coverage=0.5 if quiet else rng.choice([None, *shares]),
            prior_iou=rng.choice([None, 1.0] if quiet else [None, *shares]) if answered else None,
            answer=answer if answered else None,
            staleness=number - prior_number,
            residual_outside=rng.choice(shares),
            heard_time_ns=heard_time_ns,
        )
        rows.append(row)
    return rows


any_stream = st.integers(0, 2**32 - 1).map(random_stream)


@given(rows=any_stream, stale_after_s=st.none() | st.sampled_from([0.25, 1.0]))
@settings(max_examples=150, deadline=None)
def test_paper_is_the_equation_on_any_stream(rows, stale_after_s):
    config = RoiConfig.paper(stale_after_s=stale_after_s)
    scheduler = KeyframeScheduler(config)
    decided = [scheduler.decide(row) is not None for row in rows]
    assert decided == list(literal_rule(rows, config))


# --- each remedy alone ----------------------------------------------------------------------------------


def test_settling_alone_ignores_what_the_keyframe_has_replaced():
    rows = [
        {"coverage": None, "prior_iou": None, "answer": KEY_ANSWER},
        {"prior_iou": 0.1},
        {"prior_iou": 0.0, "coverage": 0.01, "answer": KEY_ANSWER},
        {},
        {"coverage": 0.01},
        {"prior_iou": 0.0, "answer": EMPTY_KEY_ANSWER},
        {"prior_iou": 0.1, "answer": KEY_ANSWER},
        {"prior_iou": 0.1},
    ]
    literal = [None, "prior", "coverage", None, "coverage", "prior", "prior", "prior"]
    assert reasons(RoiConfig.paper(), rows) == literal
    settled = [None, "prior", None, None, "coverage", "prior", None, "prior"]
    assert reasons(RoiConfig.paper(settle_after_keyframe=True), rows) == settled


def test_settling_waits_for_late_answers():
    """Answers three frames late: those to frames before the keyframe's mask was there judge the old prior."""
    unheard = {"coverage": None, "prior_iou": None}
    lost = {"prior_iou": 0.0, "staleness": 3}
    rows = [
        {**unheard, "staleness": 1, "answer": KEY_ANSWER},
        {**unheard, "staleness": 2, "answer": None},
        {**unheard, "staleness": 3, "answer": None},
    ]
    # Frame 4 is the keyframe; its answer comes before frame 7, and frame 7 is the first to profit from it.
    rows += [lost, lost, lost, {**lost, "answer": KEY_ANSWER}, lost, lost, lost, {"staleness": 3}]
    config = {"settle_after_keyframe": True, **NO_SILENCE}
    assert [n for n, r in enumerate(reasons(RoiConfig.paper(**config), rows), 1) if r] == [4, 10]
    assert [n for n, r in enumerate(reasons(RoiConfig.paper(**NO_SILENCE), rows), 1) if r] == [4, 5, 6, 7, 8, 9, 10]


def test_settling_does_not_wait_for_an_answer_that_is_overtaken():
    rows = [{"coverage": None, "prior_iou": None, "answer": KEY_ANSWER}, {"requested": True}]
    rows += [{"answer": None, "staleness": 2, "prior_iou": None}, {"staleness": 1}, {"coverage": 0.0}]
    config = RoiConfig.paper(settle_after_keyframe=True)
    assert reasons(config, rows) == [None, "requested", None, None, "coverage"]


def test_minimum_interval_alone_puts_off_but_does_not_forget():
    rows = [
        {"prior_iou": 0.1},
        {},
        {"coverage": 0.01},
        {},
        {"coverage": 0.01},
        {},
        {},
        {"coverage": 0.01},
        {"requested": True},
        {"coverage": 0.01},
    ]
    expected = [None, None, None, "prior", None, None, None, "coverage", "requested", None]
    assert reasons(RoiConfig.paper(min_keyframe_interval=4), rows) == expected


def test_maximum_interval_alone_is_a_scheduled_refresh():
    rows = [{}] * 11
    rows[5] = {"requested": True}
    found = reasons(RoiConfig.paper(max_keyframe_interval=4), rows)
    assert found == [None, None, None, "interval", None, "requested", None, None, None, "interval", None]


def test_backoff_alone_doubles_until_something_is_revealed():
    config = RoiConfig.paper(keyframe_backoff=True)
    nothing_there = steady_scene(1, 0.0, mask_empty=True)
    assert keyframe_numbers(KeyframeScheduler(config), 100, nothing_there) == [0, 2, 6, 14, 30, 62]
    always_something = steady_scene(1, 0.01, mask_empty=False, revealed=0.5)
    assert gaps(keyframe_numbers(KeyframeScheduler(config), 20, always_something)) == [2] + [1] * 17


@pytest.mark.parametrize(
    "event",
    [
        {"answer": NewAnswer(False, True, revealed=0.5)},
        {"prior_iou": 0.1},
        {"coverage": 0.05},
    ],
)
def test_backoff_starts_anew(event):
    quiet = steady_scene(1, 0.0, mask_empty=True)

    def row_of(number, keyframes):
        row = quiet(number, keyframes)
        return row if number != 31 else {**row, **event}

    found = keyframe_numbers(KeyframeScheduler(RoiConfig.paper(keyframe_backoff=True)), 60, row_of)
    assert found[:5] == [0, 2, 6, 14, 30]
    assert found[5] <= 32
    assert found[6] <= 36


def test_backoff_ends_at_the_maximum_interval():
    config = RoiConfig.paper(keyframe_backoff=True, max_keyframe_interval=5)
    scheduler, quiet, found = KeyframeScheduler(config), steady_scene(1, 0.0, mask_empty=True), {0: "first"}
    assert scheduler.decide(first()) == "first"
    for number in range(1, 22):
        reason = scheduler.decide(signals(number, **quiet(number, found)))
        if reason:
            found[number] = reason
    assert found == {0: "first", 2: "coverage", 6: "coverage", 11: "coverage", 16: "coverage", 21: "coverage"}


def test_first_keyframes_before_any_answer_double_the_wait_once():
    row_of = steady_scene(3, 0.0, mask_empty=True)
    assert keyframe_numbers(KeyframeScheduler(RoiConfig()), 100, row_of) == [0, 1, 2, 8, 20, 44, 92]


def test_empty_mask_reveals_nothing_whatever_is_said():
    row_of = steady_scene(1, 0.0, mask_empty=True, revealed=1.0)
    assert keyframe_numbers(KeyframeScheduler(RoiConfig()), 100, row_of) == [0, 6, 18, 42, 90]


def test_ragged_edge_of_a_keyframes_mask_reveals_nothing():
    config = RoiConfig.paper(keyframe_backoff=True)
    ragged = steady_scene(1, 0.01, mask_empty=False, revealed=0.01)
    assert len(keyframe_numbers(KeyframeScheduler(config), 100, ragged)) == 6


# --- the remedies together ------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [1, 2, 3, 5])
@pytest.mark.parametrize("scene", [(0.0, True), (0.012, False)])
def test_empty_scene_and_far_actors_make_no_storm(delay, scene):
    coverage, mask_empty = scene
    row_of = steady_scene(delay, coverage, mask_empty=mask_empty)
    found = keyframe_numbers(KeyframeScheduler(RoiConfig()), 100, row_of)
    assert found[:delay] == list(range(delay))
    assert len(found) - (delay - 1) <= 8
    # The scene is still looked at, and waits only grow up to the maximum.
    assert gaps(found)[delay - 1 :] == sorted(gaps(found)[delay - 1 :])
    assert 100 - found[-1] <= RoiConfig().max_keyframe_interval


def test_empty_scene_is_sent_whole_for_ever_in_paper_mode():
    row_of = steady_scene(1, 0.0, mask_empty=True, prior_iou=0.0)
    found = keyframe_numbers(KeyframeScheduler(RoiConfig.paper()), 101, row_of)
    # c_1 has no region and no prior to look at.
    assert found == [0, *range(2, 101)]


@pytest.mark.parametrize("delay", [1, 2, 4])
def test_flickering_mask_brings_one_keyframe_per_minimum_interval(delay):
    row_of = steady_scene(delay, 0.2, mask_empty=False, prior_iou=0.0)
    config = RoiConfig(min_keyframe_interval=5)
    found = keyframe_numbers(KeyframeScheduler(config), 100, row_of)[delay - 1 :]
    assert min(gaps(found)) >= 5
    assert len(found) >= 10


def test_lost_actor_is_looked_for_at_once():
    rows = [{"coverage": None, "prior_iou": None, "answer": KEY_ANSWER}] + [{}] * 10
    rows += [{"prior_iou": 0.0}, {"prior_iou": 0.0, "answer": KEY_ANSWER}] + [{}] * 8
    found = reasons(RoiConfig(), rows)
    assert [(n, r) for n, r in enumerate(found, 1) if r] == [(12, "prior")]


FORCED = {"first", "requested"}


@given(
    rows=any_stream,
    policy=st.sampled_from(["paper", "budget", "uncertainty"]),
    least=st.integers(0, 6),
    more=st.integers(1, 12),
    settle=st.booleans(),
    backoff=st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_intervals_hold_on_any_stream(rows, policy, least, more, settle, backoff):
    config = RoiConfig(
        keyframe_policy=policy,
        min_keyframe_interval=least,
        max_keyframe_interval=least + more,
        settle_after_keyframe=settle,
        keyframe_backoff=backoff,
        stale_after_s=0.25,
    )
    scheduler, last = KeyframeScheduler(config), 0
    for number, row in enumerate(rows):
        reason = scheduler.decide(row)
        if reason is not None:
            scheduler.sent(True, 10_000, row.time_ns)
            assert reason in FORCED or number - last >= least
            last = number
        assert not (row.first or row.requested) or reason in FORCED
        assert policy == "budget" or number - last < config.max_keyframe_interval


@given(rows=any_stream, policy=st.sampled_from(["paper", "periodic", "budget", "uncertainty"]))
@settings(max_examples=60, deadline=None)
def test_same_stream_same_decisions(rows, policy):
    config = RoiConfig(keyframe_policy=policy)
    one, two = KeyframeScheduler(config), KeyframeScheduler(config)
    assert [one.decide(row) for row in rows] == [two.decide(row) for row in rows]


# --- silence --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["paper", "periodic", "budget", "uncertainty"])
@pytest.mark.parametrize("preset", [RoiConfig, RoiConfig.paper])
def test_silence_brings_one_keyframe_per_period_under_every_policy(policy, preset):
    config = preset(keyframe_policy=policy, keyframe_period=1000, uncertainty_limit=1000.0, keyframe_budget_kbps=1.0)
    scheduler = KeyframeScheduler(config)
    scheduler.decide(first())
    scheduler.sent(True, 1_000_000, 0)
    silent = {"answer": None, "prior_iou": None, "heard_time_ns": 0}
    rows = [signals(n, staleness=n, **silent) for n in range(1, 36)]
    found = [(n, reason) for n, row in enumerate(rows, 1) if (reason := scheduler.decide(row))]
    assert found == [(11, "stale"), (22, "stale"), (33, "stale")]


def test_slow_lock_step_is_not_silence():
    rows = [{"time_ns": n * 3_000_000_000, "heard_time_ns": (n - 1) * 3_000_000_000} for n in range(1, 20)]
    assert not any(reasons(RoiConfig(), rows))


def test_silence_of_a_slow_stream_respects_the_minimum_interval():
    rows = [
        {"time_ns": n * 2_000_000_000, "heard_time_ns": 0, "staleness": n, "answer": None, "prior_iou": None}
        for n in range(1, 10)
    ]
    stale = [None, None, "stale"]
    assert reasons(RoiConfig(min_keyframe_interval=3), rows) == stale * 3


# --- periodic -------------------------------------------------------------------------------------------


def test_periodic_counts_frames_and_looks_at_nothing_else():
    rows = [{"coverage": 0.0, "prior_iou": 0.0}] * 12
    rows[6] = {"requested": True}
    found = reasons(RoiConfig(keyframe_policy="periodic", keyframe_period=4), rows)
    assert [(n, r) for n, r in enumerate(found, 1) if r] == [(4, "periodic"), (7, "requested"), (11, "periodic")]
    every = RoiConfig(keyframe_policy="periodic", keyframe_period=1)
    assert reasons(every, [{}] * 5) == ["periodic"] * 5


# --- budget ---------------------------------------------------------------------------------------------


def test_bucket_by_hand():
    budget = ByteBudget(rate_kbps=8.0, burst_s=2.0)
    assert (budget.bytes_per_s, budget.capacity) == (1000, 2000)
    budget.fill(0)
    assert budget.full
    assert budget.affordable
    budget.order(0)
    assert not budget.full
    assert not budget.affordable
    budget.charge(True, 1500, 0)
    assert not budget.affordable
    budget.fill(999_000_000)
    assert not budget.affordable
    budget.fill(1_000_000_000)
    assert budget.affordable
    assert not budget.full
    budget.fill(9_000_000_000)
    assert budget.full
    # A keyframe beyond the capacity needs a full bucket and leaves a debt.
    budget.charge(True, 5000, 9_000_000_000)
    budget.fill(13_900_000_000)
    assert not budget.affordable
    budget.fill(14_000_000_000)
    assert budget.affordable


def test_later_frame_tells_of_a_dropped_keyframe():
    budget = ByteBudget(8.0, 2.0)
    budget.order(5)
    budget.charge(False, 70, 4)
    assert not budget.affordable
    budget.charge(False, 70, 6)
    assert budget.full


def test_budget_pays_for_the_papers_causes_and_forgets_no_lost_prior():
    config = RoiConfig(keyframe_policy="budget", keyframe_budget_kbps=8.0, keyframe_budget_burst_s=2.0)
    scheduler = KeyframeScheduler(config)
    scheduler.decide(first())
    scheduler.sent(True, 2000, 0)
    found = {}
    for number in range(1, 60):
        row = {"prior_iou": 0.0 if number in (5, 45) else 1.0, "coverage": 0.3}
        reason = scheduler.decide(signals(number, **row))
        if reason:
            found[number] = reason
            scheduler.sent(True, 1000, number * DT_NS)
    # 100 bytes a frame: the 2000 of the last keyframe are there at frame 20, a full bucket again at 30 and 40,
    # and at 45 the 1500 bytes that are there pay a keyframe like the last, of 1000.
    assert found == {20: "prior", 30: "budget", 40: "budget", 45: "prior"}


def test_budget_is_used_up():
    config = RoiConfig(keyframe_policy="budget")
    scheduler, spent = KeyframeScheduler(config), 0
    for number in range(1000):
        if scheduler.decide(signals(number) if number else first()):
            scheduler.sent(True, 40_000, number * DT_NS)
            spent += 40_000
    income = 200 * 125 * 100
    assert income - 40_000 <= spent <= income + 125_000


@given(
    rows=any_stream,
    sizes=st.lists(st.integers(1, 40_000), min_size=80, max_size=80),
    rate_kbps=st.sampled_from([8.0, 80.0, 800.0]),
    burst_s=st.sampled_from([0.0, 0.5, 3.0]),
    latency=st.integers(0, 3),
    drops=st.sets(st.integers(0, 79)),
)
@settings(max_examples=200, deadline=None)
def test_budget_bound_over_any_window(rows, sizes, rate_kbps, burst_s, latency, drops):
    """All keyframes of a window that ends with a bought one cost at most burst + income + that last one."""
    config = RoiConfig(
        keyframe_policy="budget",
        keyframe_budget_kbps=rate_kbps,
        keyframe_budget_burst_s=burst_s,
        min_keyframe_interval=0,
    )
    scheduler, whole, spent = KeyframeScheduler(config), {}, []
    for number, row in enumerate(rows):
        coded = number - latency - 1
        if coded >= 0 and coded not in drops:
            keyframe = whole[coded] is not None
            scheduler.sent(keyframe, sizes[coded], rows[coded].time_ns)
            if keyframe:
                spent.append((rows[coded].time_ns, sizes[coded], whole[coded]))
        whole[number] = scheduler.decide(row)
    bytes_per_s = rate_kbps * 125
    for last, (end_ns, last_size, reason) in enumerate(spent):
        if reason in ("first", "requested", "stale"):
            continue
        total = last_size
        for begin_ns, size, _ in reversed(spent[:last]):
            total += size
            assert total - last_size <= bytes_per_s * (burst_s + (end_ns - begin_ns) / 1e9) + 1e-3


# --- uncertainty ----------------------------------------------------------------------------------------


def uncertain(count=101, **row):
    config = RoiConfig(keyframe_policy="uncertainty")
    found = reasons(config, [row] * (count - 1))
    assert set(found) <= {None, "uncertainty", "interval"}
    return [n for n, reason in enumerate(found, 1) if reason]


def answer_of(confidence):
    return NewAnswer(mask_empty=False, of_keyframe=False, confidence=confidence)


def test_confident_quiet_scene_waits_for_the_maximum_interval():
    assert uncertain(answer=answer_of(1.0)) == [50, 100]
    # Nothing seen for sure is no doubt either.
    assert uncertain(answer=answer_of(1.0), coverage=0.0) == [50, 100]


def test_each_kind_of_doubt_brings_keyframes_sooner():
    assert uncertain(answer=answer_of(0.5)) == list(range(10, 101, 10))
    assert uncertain(answer=answer_of(0.75)) == list(range(20, 101, 20))
    assert uncertain(answer=answer_of(0.0))[:2] == [5, 10]
    assert uncertain(answer=answer_of(float("nan")))[:2] == [5, 10]
    assert uncertain(staleness=3, heard_time_ns=2**62)[:2] == [25, 50]
    assert uncertain(residual_outside=0.005)[:2] == [20, 40]
    # A background that moves as a whole doubts no more than one actor would.
    assert uncertain(residual_outside=0.6) == uncertain(residual_outside=0.01)


def test_uncertainty_is_a_sum_since_the_last_keyframe():
    scheduler = KeyframeScheduler(RoiConfig(keyframe_policy="uncertainty"))
    scheduler.decide(first())
    for number in (1, 2):
        scheduler.decide(signals(number, answer=answer_of(0.5), staleness=2, residual_outside=0.002))
    assert scheduler.uncertainty == pytest.approx(2 * (0.2 * 0.5 + 0.02 * 1 + 10 * 0.002))
    assert scheduler.decide(signals(3, requested=True)) == "requested"
    assert scheduler.uncertainty == 0
