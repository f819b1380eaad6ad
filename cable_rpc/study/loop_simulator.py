"""The edge's loop without codec and network: any strategy over frames, with answers late, jittered or never.

One frame after another is proposed, "sent" and segmented at once; only the answer travels. What a strategy makes of
late, swapped and missing answers is then a matter of the strategy alone, and equal for equal seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.edge.strategy import RoiStrategy
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.study.metrics import RECOGNITION_THRESHOLDS, mask_iou, roi_overlap, visible_truth
from cable_rpc.types import Frame, Int32Array, RoiMask, Segmentation

Float64Array = npt.NDArray[np.float64]

CloudModel = Callable[[Frame, RoiMask], Segmentation]
"""The cloud's answer to a frame of which the given region was sent."""


@dataclass(frozen=True, slots=True)
class FeedbackLink:
    """When the cloud's answers arrive, in frames.

    The answer to the frame at position j of the sequence is applied before the proposal of position
    ``j + delay_frames``, later by a whole number of frames drawn evenly from ``0 .. jitter_frames``; so answers may
    swap. Answers that arrive together are applied in the order of their frames.

    Raises:
        ConfigurationError: a value is outside its range.
    """

    delay_frames: int = 1
    """1 is lock-step."""
    jitter_frames: int = 0
    loss: float = 0.0
    """Probability that an answer never comes, 0..1."""
    seed: int = 0
    outages: tuple[tuple[int, int], ...] = ()
    """Half-open ranges of positions; the frames in them are never answered."""

    def __post_init__(self) -> None:
        if self.delay_frames < 1:
            raise ConfigurationError(f"FeedbackLink.delay_frames is {self.delay_frames}; lock-step is 1, give no less")
        if self.jitter_frames < 0 or self.seed < 0:
            raise ConfigurationError(
                f"FeedbackLink.jitter_frames is {self.jitter_frames} and seed {self.seed}; give at least 0"
            )
        if not 0.0 <= self.loss <= 1.0:
            raise ConfigurationError(f"FeedbackLink.loss is {self.loss}; it is a probability, give 0..1")
        for first, end in self.outages:
            if not 0 <= first < end:
                raise ConfigurationError(f"FeedbackLink.outages has ({first}, {end}); give 0 <= first < end")

    def delay_of(self, position: int) -> int | None:
        """Frames until the answer to a position is applied, None where it never is; the same at every call."""
        random = np.random.default_rng((self.seed, position))
        lost = random.random() < self.loss
        late = int(random.integers(0, self.jitter_frames, endpoint=True))
        if lost or any(first <= position < end for first, end in self.outages):
            return None
        return self.delay_frames + late


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """One frame's way through the loop, held against its truth."""

    frame: Frame
    proposal: RoiProposal
    segmentation: Segmentation
    """What the cloud made of the sent region, whether or not the edge ever hears of it."""
    answer_delay: int | None
    """Frames until the edge hears of it; None where it never does."""
    visible: npt.NDArray[np.bool_]
    """bool [N], truth objects that are asked for."""
    overlap_sent: Float64Array
    """[N], share of each truth object's box inside the region that was sent; a keyframe holds all of it."""
    overlap_roi: Float64Array | None
    """[N], the same for R_k at the analysis resolution, on keyframes too; None where the strategy shows no steps."""
    coverage_sent: float
    """Share of the frame that was sent, 0..1; 1 on keyframes."""
    prior_iou: float | None
    """Agreement of the warped prior with this frame's true mask on the analysis grid, 0..1, 1 where both are empty;
    None where the strategy shows no prior or the truth has no masks."""

    @property
    def index(self) -> int:
        """The frame's own index."""
        return self.frame.index

    @property
    def region(self) -> RoiMask:
        """What was sent."""
        return self.proposal.roi

    @property
    def visible_count(self) -> int:
        """Objects asked for."""
        return int(np.count_nonzero(self.visible))

    @property
    def recognised_sent(self) -> npt.NDArray[np.int64]:
        """Visible objects inside the sent region, int64 [len(RECOGNITION_THRESHOLDS)]."""
        return reached(self.overlap_sent[self.visible])

    @property
    def recognised_roi(self) -> npt.NDArray[np.int64] | None:
        """Visible objects inside R_k, int64 [len(RECOGNITION_THRESHOLDS)]; None where R_k isn't known."""
        return None if self.overlap_roi is None else reached(self.overlap_roi[self.visible])


@dataclass(frozen=True, slots=True)
class SimulationSummary:
    """What a simulated run sent and what it caught; None where there was nothing to take a mean of."""

    frame_count: int
    coverage_roi: float | None
    """Mean share of R_k over all frames but the first, keyframes by their R_k."""
    coverage_tx: float
    """Mean share that was sent, keyframes and the first frame as 1."""
    keyframe_rate: float
    """Share of frames sent whole, the first included."""
    visible_count: int
    """Objects asked for, summed over frames."""
    recognition: tuple[float, ...] | None
    """Share of them inside the sent region at each of ``RECOGNITION_THRESHOLDS``, pooled over frames."""
    recognition_roi: tuple[float, ...] | None
    """The same for R_k, over the frames that show it."""
    staleness_mean: float | None
    """Mean age of the prior in frames."""

    def recognition_at(self, threshold: float) -> float | None:
        """Pooled recognition at one of the published thresholds."""
        return None if self.recognition is None else self.recognition[RECOGNITION_THRESHOLDS.index(threshold)]


class TruthCloud:
    """A perfect segmenter that needs to see a quarter of an object.

    A truth object of which at least ``min_visible_share`` of the visible pixels lie in the sent region is segmented
    exactly, cut to the region; any other isn't seen at all. It never errs, and never sees what isn't annotated.

    Args:
        min_visible_share: 0 segments whatever the region touches, 1 only objects wholly inside.

    Raises:
        ConfigurationError: the share is outside 0..1.
    """

    def __init__(self, min_visible_share: float = 0.25) -> None:
        if not 0.0 <= min_visible_share <= 1.0:
            raise ConfigurationError(f"TruthCloud.min_visible_share is {min_visible_share}; give 0..1")
        self.min_visible_share = min_visible_share

    def __call__(self, frame: Frame, region: RoiMask) -> Segmentation:
        """Segment one frame.

        Raises:
            FrameError: the frame has no instance masks in its truth.
        """
        instances = true_instances(frame)
        inside = region.pixels()
        count = 0 if frame.truth is None else len(frame.truth)
        visible_px = np.bincount(instances.ravel(), minlength=count + 1)
        inside_px = np.bincount(instances[inside], minlength=count + 1)
        seen = inside_px >= self.min_visible_share * visible_px
        seen[0] = False
        return Segmentation(np.asarray(seen[instances] & inside, np.bool_), 1.0)


def whole_truth(frame: Frame, region: RoiMask) -> Segmentation:
    """A cloud that knows the true mask of the whole frame whatever was sent; isolates the edge from its own losses.

    Raises:
        FrameError: the frame has no instance masks in its truth.
    """
    return Segmentation(np.asarray(true_instances(frame) > 0, np.bool_), 1.0)


def simulate(
    frames: Iterable[Frame],
    strategy: RoiStrategy,
    cloud: CloudModel,
    link: FeedbackLink | None = None,
    frame_bytes: Callable[[RoiProposal], int] | None = None,
) -> Iterator[SimulatedFrame]:
    """Run a strategy over frames against a simulated cloud, frame by frame as the result is iterated.

    Args:
        frames: with truth, in order.
        strategy: a fresh one; it is left as after the last frame.
        cloud: what the far end answers.
        link: when its answers arrive; lock-step by default.
        frame_bytes: coded size of a proposal, told to the strategy; it hears of no sizes by default.

    Raises:
        FrameError: a frame has no truth, or what strategy and cloud raise.
    """
    link = FeedbackLink() if link is None else link
    under_way: dict[int, list[tuple[int, Segmentation]]] = {}
    for position, frame in enumerate(frames):
        for index, answer in sorted(under_way.pop(position, []), key=lambda arrived: arrived[0]):
            strategy.update(index, answer.mask, confidence=answer.confidence, uncertainty=answer.uncertainty)
        proposal = strategy.propose(frame)
        if frame_bytes is not None:
            strategy.sent(frame.index, frame_bytes(proposal))
        answer = cloud(frame, proposal.roi)
        delay = link.delay_of(position)
        if delay is not None:
            under_way.setdefault(position + delay, []).append((frame.index, answer))
        yield judge(frame, proposal, answer, delay)


def judge(frame: Frame, proposal: RoiProposal, answer: Segmentation, delay: int | None) -> SimulatedFrame:
    """Hold one frame's region and prior against its truth.

    Raises:
        FrameError: the frame has no truth.
    """
    truth = frame.truth
    if truth is None:
        raise FrameError(f"frame {frame.index} has no truth to judge it by; simulate an annotated or synthetic source")
    sent = proposal.roi.pixels()
    overlap_roi = prior_iou = None
    if proposal.steps is not None:
        scale = proposal.steps.scale
        overlap_roi = roi_overlap(truth.boxes_xyxy, RoiMask(proposal.steps.region, scale, *frame.size_hw).pixels())
        if truth.instance_mask is not None:
            true_mask = RoiMask.from_pixels(truth.instance_mask > 0, scale).blocks
            prior_iou = mask_iou(proposal.steps.warped_prior, true_mask)
    return SimulatedFrame(
        frame=frame,
        proposal=proposal,
        segmentation=answer,
        answer_delay=delay,
        visible=visible_truth(truth),
        overlap_sent=roi_overlap(truth.boxes_xyxy, sent),
        overlap_roi=overlap_roi,
        coverage_sent=float(np.count_nonzero(sent) / sent.size),
        prior_iou=prior_iou,
    )


def summarise_simulation(frames: Iterable[SimulatedFrame]) -> SimulationSummary:
    """Pool a run; objects count alike, whichever frame they stand in.

    Raises:
        ConfigurationError: there is no frame.
    """
    thresholds = len(RECOGNITION_THRESHOLDS)
    sent_hits, roi_hits = np.zeros(thresholds, np.int64), np.zeros(thresholds, np.int64)
    coverages_roi: list[float] = []
    coverages_tx: list[float] = []
    staleness: list[int] = []
    keyframes = visible = visible_roi = 0
    for simulated in frames:
        proposal = simulated.proposal
        if coverages_tx:
            coverages_roi.append(proposal.coverage)
        coverages_tx.append(simulated.coverage_sent)
        keyframes += proposal.keyframe
        visible += simulated.visible_count
        sent_hits += simulated.recognised_sent
        recognised_roi = simulated.recognised_roi
        if recognised_roi is not None:
            visible_roi += simulated.visible_count
            roi_hits += recognised_roi
        if proposal.staleness is not None:
            staleness.append(proposal.staleness)
    if not coverages_tx:
        raise ConfigurationError("a simulation without frames has no summary")
    count = len(coverages_tx)
    return SimulationSummary(
        frame_count=count,
        coverage_roi=float(np.mean(coverages_roi)) if coverages_roi else None,
        coverage_tx=float(np.mean(coverages_tx)),
        keyframe_rate=keyframes / count,
        visible_count=visible,
        recognition=shares(sent_hits, visible),
        recognition_roi=shares(roi_hits, visible_roi),
        staleness_mean=float(np.mean(staleness)) if staleness else None,
    )


def reached(overlaps: Float64Array) -> npt.NDArray[np.int64]:
    """Number of overlaps at or above each published threshold, int64 [len(RECOGNITION_THRESHOLDS)]."""
    levels = np.asarray(RECOGNITION_THRESHOLDS)
    return np.count_nonzero(overlaps[None, :] >= levels[:, None], axis=1).astype(np.int64)


def shares(hits: npt.NDArray[np.int64], count: int) -> tuple[float, ...] | None:
    """Hits as shares of a count; None of nothing."""
    return tuple(float(hit) / count for hit in hits) if count else None


def true_instances(frame: Frame) -> Int32Array:
    """The truth's instance mask, int32 [H, W].

    Raises:
        FrameError: there is none.
    """
    if frame.truth is None or frame.truth.instance_mask is None:
        raise FrameError(f"frame {frame.index} has no instance masks; simulate a source with pixel-exact truth")
    return frame.truth.instance_mask
