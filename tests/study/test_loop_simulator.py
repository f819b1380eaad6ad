"""The simulated loop: when answers arrive, what the perfect segmenter sees, and how a run is judged."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.edge.proposal import RoiProposal, RoiSteps
from cable_rpc.edge.roi_config import PAPER, ROBUST, RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.edge.strategy import FullFrame
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.study.loop_simulator import (
    FeedbackLink,
    TruthCloud,
    simulate,
    summarise_simulation,
    whole_truth,
)
from cable_rpc.study.metrics import RECOGNITION_THRESHOLDS, recognition_curve
from cable_rpc.types import Frame, GroundTruth, RoiMask, Segmentation

HEIGHT, WIDTH = 40, 80
CAR = 2


def truth(*boxes: tuple[int, int, int, int], visibility: tuple[float, ...] | None = None) -> GroundTruth:
    """Objects that fill their boxes; later ones hide earlier ones."""
    instances = np.zeros((HEIGHT, WIDTH), np.int32)
    for row, (x0, y0, x1, y1) in enumerate(boxes):
        instances[y0:y1, x0:x1] = row + 1
    count = len(boxes)
    return GroundTruth(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.full(count, CAR, np.int32),
        np.arange(count, dtype=np.int32),
        np.ones(count, np.float32) if visibility is None else np.array(visibility, np.float32),
        instances,
    )


def frame(index: int, objects: GroundTruth | None = None) -> Frame:
    objects = truth((10, 5, 30, 35)) if objects is None else objects
    return Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), index, index * 100_000_000, truth=objects)


def region(x0: int, y0: int, x1: int, y1: int, block_size: int = 1) -> RoiMask:
    pixels = np.zeros((HEIGHT, WIDTH), np.bool_)
    pixels[y0:y1, x0:x1] = True
    return RoiMask.from_pixels(pixels, block_size)


@dataclass
class Script:
    """Proposes what it was given, whole frames after that, and keeps a diary."""

    proposals: list[RoiProposal] = field(default_factory=list)
    diary: list[tuple[str, int]] = field(default_factory=list)
    answers: list[tuple[int, np.ndarray, float, np.ndarray | None]] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)

    def propose(self, frame: Frame) -> RoiProposal:
        position = sum(kind == "propose" for kind, _ in self.diary)
        self.diary.append(("propose", frame.index))
        if position < len(self.proposals):
            return self.proposals[position]
        return RoiProposal(RoiMask.full(*frame.size_hw, 1), True, 1.0)

    def update(self, index: int, mask: np.ndarray, *, confidence: float = 1.0, uncertainty=None) -> None:
        self.diary.append(("update", index))
        self.answers.append((index, mask, confidence, uncertainty))

    def sent(self, index: int, byte_count: int) -> None:
        self.sizes.append((index, byte_count))

    def request_keyframe(self) -> None:
        raise AssertionError("the simulator asks for no keyframes")


def diary_of(count: int, link: FeedbackLink) -> list[tuple[str, int]]:
    script = Script()
    assert len(list(simulate(map(frame, range(count)), script, TruthCloud(), link))) == count
    return script.diary


def arrivals(diary: list[tuple[str, int]]) -> dict[int, int]:
    """Frame answered to the frame whose proposal came next after the answer."""
    found: dict[int, int] = {}
    waiting: list[int] = []
    for kind, index in diary:
        if kind == "update":
            waiting.append(index)
        else:
            found.update(dict.fromkeys(waiting, index))
            waiting = []
    return found


def test_lock_step_is_propose_update_propose() -> None:
    assert diary_of(3, FeedbackLink()) == [
        ("propose", 0),
        ("update", 0),
        ("propose", 1),
        ("update", 1),
        ("propose", 2),
    ]


@pytest.mark.parametrize("delay", [1, 2, 4, 8])
def test_an_answer_is_applied_before_the_proposal_that_many_frames_on(delay: int) -> None:
    assert arrivals(diary_of(20, FeedbackLink(delay))) == {j: j + delay for j in range(20 - delay)}


def test_delays_count_frames_not_indices() -> None:
    script = Script()
    list(simulate((frame(7 * k) for k in range(6)), script, TruthCloud(), FeedbackLink(2)))
    assert arrivals(script.diary) == {7 * k: 7 * (k + 2) for k in range(4)}


def test_jitter_is_even_and_swaps_answers() -> None:
    count = 900
    diary = diary_of(count, FeedbackLink(2, jitter_frames=2))
    spread = Counter(arrived - answered for answered, arrived in arrivals(diary).items())
    assert set(spread) == {2, 3, 4}
    # Binomial of 900 draws at 1/3: five standard deviations are 71.
    assert all(abs(times - count / 3) < 71 for times in spread.values())
    order = [index for kind, index in diary if kind == "update"]
    assert order != sorted(order)
    for first, second in pairwise(diary):
        if first[0] == second[0] == "update":
            assert first[1] < second[1]


def test_loss_and_outage() -> None:
    heard = arrivals(diary_of(1000, FeedbackLink(loss=0.25)))
    assert abs(len(heard) - 750) < 70
    assert not arrivals(diary_of(20, FeedbackLink(loss=1.0)))
    assert sorted(arrivals(diary_of(12, FeedbackLink(outages=((2, 4), (6, 7)))))) == [0, 1, 4, 5, 7, 8, 9, 10]


@given(st.integers(1, 9), st.integers(0, 5), st.floats(0, 1), st.integers(0, 2**32), st.integers(0, 10_000))
def test_a_link_is_a_function_of_seed_and_position(
    delay: int, jitter: int, loss: float, seed: int, position: int
) -> None:
    link = FeedbackLink(delay, jitter, loss, seed)
    drawn = link.delay_of(position)
    assert drawn == FeedbackLink(delay, jitter, loss, seed).delay_of(position)
    assert drawn is None or delay <= drawn <= delay + jitter
    # An outage takes answers away and moves no other
    assert FeedbackLink(delay, jitter, loss, seed, ((position + 1, position + 5),)).delay_of(position) == drawn


def test_seeds_differ() -> None:
    one, other = ([FeedbackLink(1, 4, 0.2, seed).delay_of(position) for position in range(50)] for seed in (0, 1))
    assert one != other


def test_the_whole_answer_reaches_the_strategy() -> None:
    uncertainty = np.full((HEIGHT, WIDTH), 9, np.uint8)
    mask = region(0, 0, 5, 5).pixels()

    def cloud(frame: Frame, sent: RoiMask) -> Segmentation:
        return Segmentation(mask, 0.25, uncertainty=uncertainty)

    script = Script()
    list(simulate(map(frame, range(2)), script, cloud))
    [(index, seen, confidence, doubt)] = script.answers
    assert (index, confidence) == (0, 0.25)
    assert seen is mask
    assert doubt is uncertainty


def test_sizes_are_told_only_where_they_are_known() -> None:
    silent, told = Script(), Script()
    list(simulate(map(frame, range(2)), silent, TruthCloud()))
    list(simulate(map(frame, range(2)), told, TruthCloud(), frame_bytes=lambda proposal: 7))
    assert silent.sizes == []
    assert told.sizes == [(0, 7), (1, 7)]


def test_frames_are_taken_one_by_one() -> None:
    taken = []

    def camera():
        for index in range(100):
            taken.append(index)
            yield frame(index)

    loop = simulate(camera(), Script(), TruthCloud())
    next(loop)
    next(loop)
    assert taken == [0, 1]


def test_the_truth_cloud_needs_a_quarter() -> None:
    # 20 px wide; the second object hides the right half of the first
    scene = frame(0, truth((10, 0, 30, 40), (20, 0, 40, 40)))
    cloud = TruthCloud()
    # 2 of the first's 10 visible columns: too little, though a cut of 2 of 20 would be even less
    assert not cloud(scene, region(8, 0, 12, 40)).mask.any()
    three = cloud(scene, region(8, 0, 13, 40)).mask
    np.testing.assert_array_equal(three, region(10, 0, 13, 40).pixels())
    # 10 of the first, 4 of the second's 20: only the first, though the region holds pixels of both
    np.testing.assert_array_equal(cloud(scene, region(0, 0, 24, 40)).mask, region(10, 0, 20, 40).pixels())
    np.testing.assert_array_equal(cloud(scene, region(0, 0, 25, 40)).mask, region(10, 0, 25, 40).pixels())
    assert TruthCloud(0.0)(scene, region(29, 0, 30, 1)).mask.sum() == 1
    assert TruthCloud(1.0)(scene, region(0, 0, 39, 40)).mask.sum() == 10 * 40


def test_the_truth_cloud_without_objects() -> None:
    assert not TruthCloud()(frame(0, truth()), RoiMask.full(HEIGHT, WIDTH)).mask.any()
    # hidden wholly: a row of the truth without a pixel
    assert TruthCloud()(frame(0, truth((0, 0, 5, 5), (0, 0, 9, 9))), region(0, 0, 9, 9)).mask.sum() == 81


def test_whole_truth_ignores_the_region() -> None:
    answer = whole_truth(frame(0), region(0, 0, 1, 1))
    np.testing.assert_array_equal(answer.mask, region(10, 5, 30, 35).pixels())


def test_whole_frames_hold_everything() -> None:
    summary = summarise_simulation(simulate(map(frame, range(5)), FullFrame(), TruthCloud()))
    assert summary.coverage_tx == summary.coverage_roi == summary.keyframe_rate == 1.0
    assert summary.recognition == (1.0,) * len(RECOGNITION_THRESHOLDS)
    assert summary.recognition_roi is None
    assert summary.staleness_mean is None
    assert summary.visible_count == 5


def steps_of(prior: RoiMask, pixels: RoiMask) -> RoiSteps:
    nothing = np.zeros_like(prior.blocks)
    return RoiSteps(prior.block_size, prior.blocks, nothing, nothing, nothing, nothing, pixels.blocks)


def test_a_run_by_hand() -> None:
    # Boxes of 30, 30 and 10 px height, the third too low to be asked for
    scene = truth((0, 5, 20, 35), (40, 5, 60, 35), (70, 20, 80, 30))
    half = region(0, 0, 10, 40)
    sent = RoiProposal(half, False, 0.1, staleness=1, steps=steps_of(region(0, 5, 20, 35), region(0, 0, 5, 40)))
    key = RoiProposal(
        RoiMask.full(HEIGHT, WIDTH, 1), True, 0.3, staleness=4, steps=steps_of(half, region(0, 0, 60, 40))
    )
    first = RoiProposal(RoiMask.full(HEIGHT, WIDTH, 1), True, 1.0)
    frames = list(simulate((frame(k, scene) for k in range(3)), Script([first, sent, key]), TruthCloud()))

    assert [simulated.visible_count for simulated in frames] == [2, 2, 2]
    np.testing.assert_allclose(frames[1].overlap_sent, [0.5, 0, 0])
    np.testing.assert_allclose(frames[1].overlap_roi, [0.25, 0, 0])
    np.testing.assert_allclose(frames[2].overlap_sent, [1, 1, 1])
    np.testing.assert_allclose(frames[2].overlap_roi, [1, 1, 0])
    assert frames[0].overlap_roi is None
    assert frames[0].prior_iou is None
    # 600 px of the 600 + 600 + 100 true ones, and 300 of them among 400 + 1300 - 300
    assert frames[1].prior_iou == pytest.approx(600 / 1300)
    assert frames[2].prior_iou == pytest.approx(300 / 1400)
    assert frames[1].recognised_sent.tolist() == [1, 1, 1, 0, 0]
    assert frames[1].segmentation.mask.sum() == 10 * 30

    summary = summarise_simulation(frames)
    assert summary.frame_count == 3
    assert summary.coverage_roi == pytest.approx(0.2)
    assert summary.coverage_tx == pytest.approx((1 + 10 / 80 + 1) / 3)
    assert summary.keyframe_rate == pytest.approx(2 / 3)
    assert summary.recognition == pytest.approx((5 / 6, 5 / 6, 5 / 6, 4 / 6, 4 / 6))
    assert summary.recognition_roi == pytest.approx((3 / 4, 3 / 4, 2 / 4, 2 / 4, 2 / 4))
    assert summary.recognition_at(0.5) == pytest.approx(5 / 6)
    assert summary.staleness_mean == pytest.approx(2.5)


def test_maps_of_a_coarser_grid() -> None:
    scene = frame(0, truth((2, 0, 10, 30)))
    prior, roi = region(8, 0, 16, 32, 8), region(0, 0, 8, 16, 8)
    proposal = RoiProposal(region(0, 0, 8, 16, 8), False, 0.04, steps=steps_of(prior, roi))
    [judged] = simulate([scene], Script([proposal]), TruthCloud())
    np.testing.assert_allclose(judged.overlap_roi, [6 * 16 / (8 * 30)])
    # On the grid of 8 px the object fills columns 0 and 1, rows 0..3; the prior column 1
    assert judged.prior_iou == pytest.approx(4 / 8)


@given(st.integers(0, 1000))
def test_recognition_is_the_published_curve(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.integers(0, (WIDTH - 1, HEIGHT - 1), (6, 2))
    boxes = [
        (int(x), int(y), int(rng.integers(x + 1, WIDTH + 1)), int(rng.integers(y + 1, HEIGHT + 1))) for x, y in corners
    ]
    scene = frame(0, truth(*boxes, visibility=tuple(rng.random(6))))
    blocks = rng.random((HEIGHT // 8, WIDTH // 8)) < 0.5
    proposal = RoiProposal(RoiMask(blocks, 8, HEIGHT, WIDTH), False, 0.5)
    [judged] = simulate([scene], Script([proposal]), TruthCloud())
    tall = np.array([box[3] - box[1] >= 25 for box in boxes])
    asked = tall & (scene.truth.visibility >= 0.5)
    expected = recognition_curve(scene.truth.boxes_xyxy[asked], proposal.roi.pixels())
    np.testing.assert_array_equal(judged.recognised_sent, expected)


def test_without_truth() -> None:
    bare = Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), 3, 0)
    with pytest.raises(FrameError, match="frame 3 has no instance masks"):
        list(simulate([bare], Script(), TruthCloud()))
    with pytest.raises(FrameError, match="frame 3 has no truth"):
        list(simulate([bare], Script(), lambda frame, sent: Segmentation(sent.pixels(), 1.0)))
    with pytest.raises(ConfigurationError, match="without frames"):
        summarise_simulation([])


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"delay_frames": 0}, "delay_frames"),
        ({"jitter_frames": -1}, "jitter_frames"),
        ({"loss": 1.5}, "loss"),
        ({"loss": float("nan")}, "loss"),
        ({"seed": -1}, "seed"),
        ({"outages": ((5, 5),)}, "outages"),
        ({"outages": ((-1, 5),)}, "outages"),
    ],
)
def test_unusable_links(changes: dict, name: str) -> None:
    with pytest.raises(ConfigurationError, match=name):
        FeedbackLink(**changes)


def test_unusable_share() -> None:
    with pytest.raises(ConfigurationError, match="min_visible_share"):
        TruthCloud(1.1)


def drifting(count: int) -> list[Frame]:
    """A textured street of which one object moves to the right."""
    street = np.random.default_rng(4).integers(60, 120, (HEIGHT, WIDTH), dtype=np.uint8)
    frames = []
    for index in range(count):
        image = street.copy()
        image[5:35, 5 + index : 25 + index] = 220
        scene = truth((5 + index, 5, 25 + index, 35))
        frames.append(Frame(np.repeat(image[..., None], 3, axis=2), index, index * 100_000_000, truth=scene))
    return frames


@pytest.mark.parametrize("config", [PAPER, ROBUST], ids=["paper", "robust"])
@pytest.mark.parametrize("delay", [1, 3])
def test_the_tracker_tells_the_links_delay(config: RoiConfig, delay: int) -> None:
    tracker = RoiTracker(config, block_size=1, keep_steps=True)
    frames = list(simulate(drifting(15), tracker, TruthCloud(), FeedbackLink(delay)))
    assert [simulated.proposal.staleness for simulated in frames] == [None] * delay + [delay] * (15 - delay)
    assert all(simulated.prior_iou is not None for simulated in frames[delay:])
    assert frames[0].proposal.keyframe


@pytest.mark.parametrize("config", [PAPER, ROBUST], ids=["paper", "robust"])
def test_runs_repeat(config: RoiConfig) -> None:
    link = FeedbackLink(1, jitter_frames=3, loss=0.2, seed=8, outages=((10, 14),))
    one, other = (
        summarise_simulation(simulate(drifting(30), RoiTracker(config), TruthCloud(), link)) for _ in range(2)
    )
    assert one == other
    assert one.recognition is not None
    assert one.recognition[0] > 0.9
