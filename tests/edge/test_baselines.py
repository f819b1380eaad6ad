"""The strategies that the method is compared with, against hand-made scenes."""

from __future__ import annotations

import numpy as np
import pytest

from cable_rpc.edge.baselines import BoxRegions, MotionOnly, OpenLoop, truth_boxes
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.strategy import FullFrame
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.study.strategies import STRATEGIES, open_strategy
from cable_rpc.types import Frame, GroundTruth

SIZE = (120, 200)
PLAIN = RoiConfig.paper(corridor=False)


def frame(index, grey=None, truth=None):
    grey = np.full(SIZE, 90, np.uint8) if grey is None else grey
    return Frame(np.repeat(grey[..., None], 3, axis=2), index, index * 100_000_000, truth=truth)


def box(top, left, height, width):
    mask = np.zeros(SIZE, np.bool_)
    mask[top : top + height, left : left + width] = True
    return mask


def with_actor(actor):
    return np.where(actor, 200, 90).astype(np.uint8)


def truth_of(*boxes):
    count = len(boxes)
    return GroundTruth(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.full(count, 2, np.int32),
        np.arange(count, dtype=np.int32),
        np.ones(count, np.float32),
    )


def test_motion_only_is_what_changed():
    strategy = MotionOnly(PLAIN, block_size=1)
    first = strategy.propose(frame(0, with_actor(box(40, 50, 20, 30))))
    assert first.keyframe
    assert first.roi.blocks.all()
    moved = strategy.propose(frame(1, with_actor(box(40, 60, 20, 30))))
    changed = box(40, 50, 20, 30) ^ box(40, 60, 20, 30)
    assert np.array_equal(moved.roi.pixels(), changed)
    assert moved.coverage == moved.raw_coverage == changed.mean()
    strategy.update(1, box(0, 0, 50, 50))
    assert not strategy.propose(frame(2, with_actor(box(40, 60, 20, 30)))).roi.blocks.any()
    strategy.request_keyframe()
    assert strategy.propose(frame(3, with_actor(box(40, 60, 20, 30)))).keyframe
    assert not strategy.propose(frame(4, with_actor(box(40, 60, 20, 30)))).keyframe


def test_motion_only_has_the_corridor():
    strategy = MotionOnly(RoiConfig.paper(), block_size=1)
    strategy.propose(frame(0))
    both = box(40, 20, 10, 10) | box(60, 150, 10, 10)
    band = strategy.propose(frame(1, with_actor(both))).roi.pixels()
    assert band.any(axis=0)[20:160].all()
    assert not band.any(axis=0)[:20].any()


def test_open_loop_never_takes_a_second_mask():
    strategy = OpenLoop(PLAIN, block_size=1)
    actor = box(40, 50, 20, 30)
    assert strategy.propose(frame(0, with_actor(actor))).keyframe
    strategy.update(0, actor)
    proposal = strategy.propose(frame(1, with_actor(actor)))
    assert not proposal.keyframe
    assert np.array_equal(proposal.roi.pixels(), actor)
    strategy.update(1, box(0, 0, 50, 50))
    assert np.array_equal(strategy.propose(frame(2, with_actor(actor))).roi.pixels(), actor)


def test_open_loop_grows_by_gated_motion():
    """Eight pixels to the right each frame: Rraw takes the changed pixels within b_0 = 8 of it, and keeps the old."""
    strategy = OpenLoop(PLAIN, block_size=1)
    strategy.propose(frame(0, with_actor(box(40, 50, 20, 30))))
    strategy.update(0, box(40, 50, 20, 30))
    for k in range(1, 5):
        region = strategy.propose(frame(k, with_actor(box(40, 50 + 8 * k, 20, 30)))).roi.pixels()
        assert np.array_equal(region, box(40, 50, 20, 30 + 8 * k)), k


def test_open_loop_waits_for_a_late_first_mask():
    strategy = OpenLoop(PLAIN, block_size=1)
    actor = box(40, 50, 20, 30)
    for k in range(3):
        assert strategy.propose(frame(k, with_actor(actor))).keyframe
    strategy.update(1, actor)
    proposal = strategy.propose(frame(3, with_actor(actor)))
    assert (proposal.keyframe, proposal.prior_index, proposal.staleness) == (False, 1, 2)
    strategy.update(99, actor)
    strategy.request_keyframe()
    assert strategy.propose(frame(4, with_actor(actor))).keyframe


def test_boxes_are_covered_with_their_margin():
    truth = truth_of((30.5, 40.2, 60.0, 70.9), (180, 100, 230, 150))
    strategy = BoxRegions(truth_boxes, margin_share=0.01, block_size=1)
    region = strategy.propose(frame(0, truth=truth)).roi.pixels()
    expected = box(38, 28, 35, 34) | box(98, 178, 22, 22)
    assert np.array_equal(region, expected)
    assert not strategy.propose(frame(1, truth=truth_of())).roi.blocks.any()
    strategy.request_keyframe()
    assert strategy.propose(frame(2, truth=truth)).keyframe
    with pytest.raises(FrameError, match="truth"):
        strategy.propose(frame(3))


def test_full_frame_is_whole():
    strategy = FullFrame(8)
    proposal = strategy.propose(frame(0))
    assert proposal.keyframe
    assert proposal.roi.coverage == proposal.coverage == 1


@pytest.mark.parametrize("name", [name for name in STRATEGIES if ":" not in name])
def test_every_strategy_runs_by_name(name):
    strategy = open_strategy(name, RoiConfig(), 8)
    for k in range(4):
        actor = box(40, 50 + 6 * k, 20, 30)
        proposal = strategy.propose(frame(k, with_actor(actor), truth_of((50 + 6 * k, 40, 80 + 6 * k, 60))))
        strategy.sent(k, 1000)
        strategy.update(k, actor & proposal.roi.pixels(), confidence=0.5, uncertainty=np.zeros(SIZE, np.uint8))
        assert proposal.roi.block_size == 8


def test_unknown_strategy_is_named():
    with pytest.raises(ConfigurationError, match=r"'cabel' is unknown.*no-corridor"):
        open_strategy("cabel", RoiConfig())
