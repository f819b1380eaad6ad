"""The tracker against a literal Algorithm 1, and its behaviour when answers come late, never or doubled."""

from __future__ import annotations

import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))

import algorithm1_reference as reference

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import HISTORY_FRAMES, RoiTracker
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.types import CameraIntrinsics, EgoMotion, Frame

HEIGHT, WIDTH = 48, 64
DT_NS = 125_000_000
FX = 16.0
CAMERA = CameraIntrinsics(FX, FX, WIDTH / 2, HEIGHT / 2)


def frame(index, grey=None, ego=None, size=(HEIGHT, WIDTH), **changes):
    grey = np.zeros(size, np.uint8) if grey is None else grey
    made = Frame(np.repeat(grey[..., None], 3, axis=2), index, index * DT_NS, ego, CAMERA)
    return replace(made, **changes)


def box(top, left, height=10, width=12, size=(HEIGHT, WIDTH)):
    mask = np.zeros(size, np.bool_)
    mask[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)] = True
    return mask


def random_sequence(seed, count=12):
    """Textured frames with a wandering textured actor; quarter-pixel shifts keep bilinear values whole."""
    rng = np.random.default_rng(seed)
    background = (4 * rng.integers(8, 24, (HEIGHT, 4 * WIDTH))).astype(np.uint8)
    actor = (4 * rng.integers(30, 64, (10, 12))).astype(np.uint8)
    top, left = rng.integers(0, HEIGHT - 10), rng.integers(0, WIDTH - 12)
    greys, masks, egos = [], [], []
    for _ in range(count):
        quarter = int(rng.integers(-12, 13)) if rng.random() < 0.6 else 0
        speed = 4.0 if rng.random() < 0.9 else 0.0
        egos.append(EgoMotion(speed, -quarter / 16, float(rng.normal(0, 0.02))))
        start = 96 + int(rng.integers(-2, 3))
        grey = background[:, start : start + WIDTH].copy()
        top = int(np.clip(top + rng.integers(-3, 4), 0, HEIGHT - 10))
        left = int(np.clip(left + rng.integers(-6, 7), 0, WIDTH - 12))
        if rng.random() < 0.1:
            left = int(rng.integers(0, WIDTH - 12))
        mask = np.zeros((HEIGHT, WIDTH), np.bool_)
        if rng.random() < 0.92:
            grey[top : top + 10, left : left + 12] = actor
            mask[top : top + 10, left : left + 12] = rng.random((10, 12)) < 0.9
        greys.append(grey)
        masks.append(mask)
    return greys, masks, egos


@pytest.mark.parametrize("seed", range(12))
def test_lock_step_is_algorithm_1(seed):
    greys, masks, egos = random_sequence(seed)
    base = 8.0 if seed % 2 else 2.0
    parameters = {**reference.PAPER, "b_0": base}
    if seed % 3 == 2:
        parameters.update(w_s=5, tau_min=Fraction(12, 100), h_min=Fraction(1, 4))
    config = RoiConfig.paper(
        dilation_base_px=base,
        smoothing_window_columns=parameters["w_s"],
        min_coverage=float(parameters["tau_min"]),
        min_height_fraction=float(parameters["h_min"]),
    )

    def cloud(k, region):
        return masks[k] if region is None else masks[k] & region

    tracker = RoiTracker(config, block_size=1)
    first = tracker.propose(frame(0, greys[0], egos[0]))
    assert first.keyframe
    assert first.roi.pixels().all()
    tracker.update(0, cloud(0, None))
    refreshes = 0
    for k, keyframe, region, raw, b_k in reference.algorithm1(greys, egos, FX, 0.125, cloud, parameters):
        proposal = tracker.propose(frame(k, greys[k], egos[k]))
        assert proposal.keyframe == keyframe, k
        assert proposal.coverage == region.mean()
        assert proposal.raw_coverage == raw.mean()
        assert proposal.dilation_px == pytest.approx(b_k)
        assert (proposal.prior_index, proposal.staleness) == (k - 1, 1)
        sent = proposal.roi.pixels()
        assert np.array_equal(sent, np.ones_like(sent) if keyframe else region)
        tracker.update(k, cloud(k, None if keyframe else region))
        refreshes += keyframe
    assert k == len(greys) - 1
    assert tracker.late_masks == tracker.unknown_masks == 0


@given(
    size=st.tuples(st.integers(1, 20), st.integers(1, 28)),
    block_size=st.integers(1, 17),
    base=st.floats(0, 5),
    quarters=st.lists(st.integers(-160, 160), min_size=4, max_size=4),
    yaw=st.floats(-0.5, 0.5),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_any_size_mask_and_motion(size, block_size, base, quarters, yaw, seed):
    rng = np.random.default_rng(seed)
    greys = [(4 * rng.integers(0, 64, size)).astype(np.uint8) for _ in quarters]
    masks = [rng.random(size) < rng.choice([0.02, 0.3, 0.9]) for _ in quarters]
    egos = [EgoMotion(4.0, -quarter / 16, yaw) for quarter in quarters]
    parameters = {**reference.PAPER, "b_0": base}

    def cloud(k, region):
        return masks[k] if region is None else masks[k] & region

    tracker = RoiTracker(RoiConfig.paper(dilation_base_px=base), block_size)
    tracker.propose(frame(0, greys[0], egos[0]))
    tracker.update(0, masks[0])
    for k, keyframe, region, _, _ in reference.algorithm1(greys, egos, FX, 0.125, cloud, parameters):
        proposal = tracker.propose(frame(k, greys[k], egos[k]))
        assert proposal.keyframe == keyframe
        assert proposal.coverage == region.mean()
        if not keyframe:
            blocks = proposal.roi.blocks
            for row, column in np.ndindex(blocks.shape):
                y, x = row * block_size, column * block_size
                assert blocks[row, column] == region[y : y + block_size, x : x + block_size].any()
        tracker.update(k, cloud(k, None if keyframe else region))


@pytest.mark.parametrize("ego", [EgoMotion(1e300, 1e300, 1e300), EgoMotion(0.0, 1e302), EgoMotion(0.0, -1e200)])
def test_absurd_motion_only_loses_the_mask(ego):
    tracker = RoiTracker(RoiConfig.paper())
    tracker.propose(frame(0))
    tracker.update(0, box(10, 10, 20, 40))
    for k in range(1, 4):
        proposal = tracker.propose(frame(k, ego=ego))
        assert 0 <= proposal.coverage <= 1


def test_sequences_exercise_both_kinds_of_frame():
    kinds = []
    for seed in range(4):
        greys, masks, egos = random_sequence(seed)
        run = reference.algorithm1(
            greys,
            egos,
            FX,
            0.125,
            lambda k, region, masks=masks: masks[k] if region is None else masks[k] & region,
            reference.PAPER,
        )
        kinds += [keyframe for _, keyframe, *_ in run]
    assert 0.1 < np.mean(kinds) < 0.9


def test_empty_scene_is_sent_whole_for_ever():
    tracker = RoiTracker(RoiConfig.paper())
    nothing = np.zeros((HEIGHT, WIDTH), np.bool_)
    keyframes = []
    for k in range(102):
        keyframes.append(tracker.propose(frame(k)).keyframe)
        tracker.update(k, nothing)
    # Frame 0 starts the loop and c_1 = 0; from then on every frame.
    assert keyframes[:2] == [True, False]
    assert all(keyframes[2:])


def test_newcomer_from_the_side_is_missed_until_a_refresh():
    size = (120, 640)
    tracker = RoiTracker(RoiConfig.paper(), block_size=1)
    known = box(50, 60, 40, 80, size)
    for k in range(8):
        newcomer = box(50, 640 - 30 * k, 40, 60, size)
        proposal = tracker.propose(frame(k, np.where(newcomer, 200, 0).astype(np.uint8), size=size))
        if k:
            assert not proposal.keyframe
            assert not (proposal.roi.pixels() & newcomer).any()
        tracker.update(k, known)
    tracker.request_keyframe()
    newcomer = box(50, 640 - 30 * 8, 40, 60, size)
    proposal = tracker.propose(frame(8, np.where(newcomer, 200, 0).astype(np.uint8), size=size))
    assert proposal.keyframe
    assert (proposal.roi.pixels() & newcomer).sum() == newcomer.sum()


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_late_answers_on_a_translating_scene(delay):
    size = (96, 256)
    shift = 3
    rng = np.random.default_rng(delay)
    texture = rng.integers(0, 256, (96, 512)).astype(np.uint8)
    ego = EgoMotion(4.0, -shift * 4.0 / FX, yaw_rate_radps=0.01)
    config = RoiConfig.paper(stale_after_s=None)
    tracker = RoiTracker(config, block_size=1)
    answers = {}
    for k in range(25):
        picture = texture[:, 256 - shift * k :][:, :256]
        actor = box(40, 20 + shift * k, 20, 30, size)
        proposal = tracker.propose(frame(k, picture, ego, size))
        if k < delay:
            assert proposal.keyframe
            assert proposal.prior_index is None
            assert proposal.coverage == 1
        else:
            assert not proposal.keyframe
            assert (proposal.prior_index, proposal.staleness) == (k - delay, delay)
            assert proposal.shift_px == pytest.approx(shift * delay)
            metres = delay * 0.125 * np.hypot(4.0, ego.lateral_mps)
            degrees = delay * np.degrees(0.125 * 0.01)
            assert proposal.dilation_px == pytest.approx(8 + 1.5 * metres + 20 * degrees)
            # The scene moves just as the warp says: no residual, and the prior is the actor.
            assert proposal.raw_coverage == actor.mean()
            assert (proposal.roi.pixels() & actor).sum() == actor.sum()
        answers[k] = actor
        if k + 1 >= delay:
            tracker.update(k + 1 - delay, answers.pop(k + 1 - delay))
    assert tracker.late_masks == tracker.unknown_masks == 0


def test_prior_is_judged_at_the_masks_own_frame():
    """Two frames late, the actor has left the prior's place; only the warp to its own frame agrees."""
    size = (96, 256)
    tracker = RoiTracker(RoiConfig.paper(stale_after_s=None), block_size=1)
    still = box(40, 30, 20, 30, size)
    moved = box(40, 150, 20, 30, size)
    tracker.propose(frame(0, size=size))
    tracker.update(0, still)
    assert not tracker.propose(frame(1, size=size)).keyframe
    assert not tracker.propose(frame(2, size=size)).keyframe
    tracker.update(1, still)
    assert not tracker.propose(frame(3, size=size)).keyframe
    tracker.update(2, moved)
    assert tracker.propose(frame(4, size=size)).keyframe
    # Judged once: without a new answer there is no second keyframe.
    assert not tracker.propose(frame(5, size=size)).keyframe


def test_older_doubled_and_unknown_answers_are_counted_and_ignored():
    tracker = RoiTracker(RoiConfig.paper(), block_size=1)
    for k in range(4):
        tracker.propose(frame(k))
    tracker.update(2, box(10, 10))
    tracker.update(1, box(30, 40))
    tracker.update(2, box(30, 40))
    tracker.update(17, box(30, 40))
    assert (tracker.late_masks, tracker.unknown_masks) == (2, 1)
    proposal = tracker.propose(frame(4))
    assert (proposal.prior_index, proposal.staleness) == (2, 2)
    assert proposal.raw_coverage == box(10, 10).mean()


def test_history_is_bounded():
    tracker = RoiTracker(RoiConfig.paper())
    for k in range(HISTORY_FRAMES + 10):
        tracker.propose(frame(k))
    tracker.update(5, box(0, 0))
    assert tracker.unknown_masks == 1
    tracker.update(20, box(0, 0))
    assert tracker.propose(frame(HISTORY_FRAMES + 10)).staleness == HISTORY_FRAMES + 10 - 20


def test_silence_brings_one_keyframe_per_period():
    tracker = RoiTracker(RoiConfig.paper(stale_after_s=1.0))
    tracker.propose(frame(0))
    tracker.update(0, box(10, 10, 20, 40))
    keyframes = [k for k in range(1, 30) if tracker.propose(frame(k)).keyframe]
    # Eight frames a second: the ninth frame after the last sign of life is more than a second later.
    assert keyframes == [9, 18, 27]


def test_slow_lock_step_is_not_stale():
    tracker = RoiTracker(RoiConfig.paper(stale_after_s=1.0))
    for k in range(6):
        proposal = tracker.propose(frame(k, capture_time_ns=k * 3_000_000_000))
        assert proposal.keyframe == (k == 0)
        tracker.update(k, box(10, 10, 20, 40))


def test_requested_keyframe_comes_once():
    tracker = RoiTracker(RoiConfig.paper())
    tracker.propose(frame(0))
    tracker.update(0, box(10, 10, 20, 40))
    tracker.request_keyframe()
    proposal = tracker.propose(frame(1))
    assert proposal.keyframe
    assert proposal.roi.pixels().all()
    assert proposal.coverage < 1
    tracker.update(1, box(10, 10, 20, 40))
    assert not tracker.propose(frame(2)).keyframe


def test_what_travels_is_the_region_grown_to_blocks():
    fine, coarse = RoiTracker(RoiConfig.paper(), block_size=1), RoiTracker(RoiConfig.paper(), block_size=16)
    for tracker in (fine, coarse):
        tracker.propose(frame(0))
        tracker.update(0, box(13, 21))
    exact, grown = fine.propose(frame(1)), coarse.propose(frame(1))
    assert exact.coverage == grown.coverage == exact.roi.coverage < grown.roi.coverage
    assert not (exact.roi.pixels() & ~grown.roi.pixels()).any()


def test_standstill_with_lateral_noise_loses_the_mask():
    tracker = RoiTracker(RoiConfig.paper())
    tracker.propose(frame(0))
    tracker.update(0, box(10, 10, 20, 40))
    proposal = tracker.propose(frame(1, ego=EgoMotion(0.0, 0.02)))
    assert proposal.coverage == 0
    tracker.update(1, box(10, 10, 20, 40) & proposal.roi.pixels())
    assert tracker.propose(frame(2, ego=EgoMotion(0.0, 0.02))).keyframe


def test_reset_starts_a_new_stream():
    tracker = RoiTracker(RoiConfig.paper())
    tracker.propose(frame(5))
    tracker.update(5, box(10, 10))
    tracker.reset()
    assert tracker.propose(frame(0, size=(20, 30))).keyframe


def test_mask_belongs_to_the_tracker():
    tracker = RoiTracker(RoiConfig.paper(), block_size=1)
    mask = box(10, 10, 20, 40)
    tracker.propose(frame(0))
    tracker.update(0, mask)
    mask[:] = False
    assert tracker.propose(frame(1)).raw_coverage > 0


def test_bad_input_is_refused_and_changes_nothing():
    tracker = RoiTracker(RoiConfig.paper())
    tracker.propose(frame(3))
    tracker.update(3, box(10, 10, 20, 40))
    with pytest.raises(ConfigurationError, match="32x20"):
        tracker.propose(frame(4, size=(20, 32)))
    with pytest.raises(FrameError, match="indices must rise"):
        tracker.propose(frame(3))
    with pytest.raises(FrameError, match="clock"):
        tracker.propose(frame(4, capture_time_ns=0))
    with pytest.raises(FrameError, match="finite"):
        tracker.propose(frame(4, ego=EgoMotion(float("nan"))))
    with pytest.raises(FrameError, match="uint8"):
        tracker.propose(frame(4, image=np.zeros((HEIGHT, WIDTH), np.uint8)))
    assert tracker.propose(frame(4)).staleness == 1
    with pytest.raises(FrameError, match="mask of frame 4"):
        tracker.update(4, np.zeros((3, 3), np.bool_))
    with pytest.raises(ConfigurationError, match="block_size"):
        RoiTracker(RoiConfig.paper(), block_size=0)


def test_stages_are_timed():
    tracker = RoiTracker(RoiConfig.paper())
    tracker.propose(frame(0))
    tracker.update(0, box(10, 10))
    stages = tracker.propose(frame(1)).timings.stages_ns
    assert set(stages) == {"grey", "warp", "residual", "dilate", "corridor", "entry", "decide"}
    assert all(duration > 0 for duration in stages.values())
