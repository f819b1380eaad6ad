"""Sequences pooled to a data set: figures by name, the whole cube of recognition and detection, bytes and latency."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import BYTE_LAYERS, Bootstrap, MatchCounts, Percentiles, TruthVariant, percentiles
from cable_rpc.study.sequence_metrics.estimates import AP_FIGURES, Estimate, drawn_ap, drawn_figure, drawn_ratio
from cable_rpc.study.sequence_metrics.figures import FIGURES, Figure
from cable_rpc.study.sequence_metrics.parts import (
    SCORE_NAMES,
    Parts,
    macro_parts,
    match_counts,
    micro_parts,
    place_of,
    recognition_parts,
)
from cable_rpc.study.sequence_metrics.perception import Picture, Region
from cable_rpc.study.sequence_metrics.sequence import SequenceMetrics

Average = Literal["micro", "macro_frame"]


@dataclass(frozen=True, slots=True)
class ScoreEstimates:
    """Precision, recall and F1, each 0..1."""

    precision: Estimate
    recall: Estimate
    f1: Estimate


@dataclass(frozen=True, slots=True)
class LayerRates:
    """Bytes at one layer, the layers before it included."""

    layer: str
    up_per_frame: float
    down_per_frame: float
    full_up_per_frame: float | None
    """Of the same frames sent whole; None where none was."""
    up_kbps: float | None
    """None where a sequence has no frame rate."""
    down_kbps: float | None
    saving: Estimate


@dataclass(frozen=True, slots=True)
class DatasetMetrics:
    """Any number of sequences under one strategy, pooled over frames, objects and detections.

    Raises:
        ConfigurationError: there is no frame.
    """

    sequences: tuple[SequenceMetrics, ...]
    bootstrap: Bootstrap | None = None
    """How intervals are drawn; None gives none."""

    def __post_init__(self) -> None:
        if not self.frames:
            raise ConfigurationError("there is no frame to pool; give at least one sequence that has frames")

    @property
    def frames(self) -> int:
        """All frames."""
        return sum(sequence.frames for sequence in self.sequences)

    @property
    def truth_frames(self) -> int:
        """Annotated frames."""
        return sum(sequence.truth_frames for sequence in self.sequences)

    def figure(self, name: str) -> Estimate:
        """One of `FIGURES`, or ``roi_ap``, ``roi_ap50``, ``full_ap``, ``full_ap50`` (each also with ``_visible``).

        Raises:
            ConfigurationError: there is no such figure.
        """
        return drawn_figure(self.sequences, name).estimate(self.bootstrap)

    def figures(self) -> dict[str, Estimate]:
        """Every named figure, in the order of a report."""
        return {name: self.figure(name) for name in (*FIGURES, *AP_FIGURES)}

    def estimate(self, figure: Figure) -> Estimate:
        """A ratio of sums over the sequences."""
        return drawn_ratio(figure, self.sequences).estimate(self.bootstrap)

    def recognition(
        self,
        threshold: float = 0.5,
        *,
        region: Region = "roi",
        variant: TruthVariant = "all",
        group: str | None = None,
        size: str | None = None,
    ) -> Estimate:
        """Share of the objects of which a region holds a share of the box; pooled over objects.

        Args:
            threshold: one of ``RECOGNITION_THRESHOLDS``; the paper's is 0.05.
            region: R_k, or what was sent.
            variant: of the truth.
            group: one of ``GROUPS``; None for all.
            size: one of ``SIZE_BINS``; None for all.

        Raises:
            ConfigurationError: an argument isn't among those.
        """
        parts = partial(recognition_parts, threshold=threshold, region=region, variant=variant, group=group, size=size)
        return self.estimate(Figure("", parts))

    def detection(
        self,
        picture: Picture = "roi",
        *,
        variant: TruthVariant = "all",
        iou: float | None = 0.5,
        average: Average = "micro",
        group: str | None = None,
    ) -> ScoreEstimates:
        """Precision, recall and F1 of detections from score 0.4 on.

        Args:
            picture: detections on the received frame or on the whole one.
            variant: of the truth.
            iou: 0.3, or 0.5 to 0.95 in steps of 0.05; None is the mean over the latter ten.
            average: pooled counts (the headline), or the mean over frames (the paper's).
            group: one of ``GROUPS``; None for all. Only for pooled counts.

        Raises:
            ConfigurationError: an unknown IoU or group, or a group with ``macro_frame``.
        """
        if average == "macro_frame" and group is not None:
            raise ConfigurationError(
                f"scores averaged over frames are kept for all groups together, not for {group}; ask for pooled ones"
            )
        estimates = []
        for name in SCORE_NAMES:
            parts: Callable[[SequenceMetrics], Parts]
            if average == "micro":
                parts = partial(micro_parts, score=name, picture=picture, variant=variant, iou=iou, group=group)
            else:
                parts = partial(macro_parts, score=name, picture=picture, variant=variant, iou=iou)
            estimates.append(self.estimate(Figure("", parts)))
        return ScoreEstimates(*estimates)

    def matches(
        self, picture: Picture = "roi", *, variant: TruthVariant = "all", iou: float = 0.5, group: str | None = None
    ) -> MatchCounts:
        """Pooled counts behind `detection`.

        Raises:
            ConfigurationError: an unknown IoU or group.
        """
        counts = [match_counts(sequence, picture, variant, iou, group)[0] for sequence in self.sequences]
        right, wrong, missed = np.sum(counts, axis=0).tolist()
        return MatchCounts(right, wrong, missed)

    def average_precision(
        self,
        picture: Picture = "roi",
        *,
        variant: TruthVariant = "all",
        iou: float | None = None,
        group: str | None = None,
    ) -> Estimate:
        """COCO's AP over all frames of all sequences, mean over the class groups that have objects.

        Its interval takes at most 500 draws.

        Args:
            picture: detections on the received frame or on the whole one.
            variant: of the truth.
            iou: one threshold of 0.5 to 0.95; None is the mean over all ten.
            group: one of ``GROUPS``; None for all.

        Raises:
            ConfigurationError: an unknown IoU or group.
        """
        return drawn_ap(self.sequences, picture, variant, iou=iou, group=group).estimate(self.bootstrap)

    def layers(self) -> tuple[LayerRates, ...]:
        """Bytes at the four layers, keyframes and all frames counted."""
        return tuple(self.layer(name) for name in BYTE_LAYERS)

    def layer(self, name: str) -> LayerRates:
        """Bytes at one of ``BYTE_LAYERS``."""
        tallies = [sequence.layers[place_of(name, BYTE_LAYERS)] for sequence in self.sequences]
        up, down = sum(tally.up for tally in tallies), sum(tally.down for tally in tallies)
        paired = sum(tally.paired_frames for tally in tallies)
        seconds = self.seconds
        return LayerRates(
            name,
            up / self.frames,
            down / self.frames,
            sum(tally.full_up for tally in tallies) / paired if paired else None,
            None if seconds is None else up * 8e-3 / seconds,
            None if seconds is None else down * 8e-3 / seconds,
            self.figure(f"byte_saving_{name}"),
        )

    @property
    def seconds(self) -> float | None:
        """Duration of all sequences at their nominal rates; None where one has none."""
        durations = [sequence.frames / sequence.fps if sequence.fps else None for sequence in self.sequences]
        known = [duration for duration in durations if duration is not None]
        return sum(known) if len(known) == len(durations) else None

    def end_to_end_ms(self) -> Percentiles | None:
        """Percentiles of the frames' end-to-end time in ms; None where it was not measured."""
        return percentiles(value / 1e6 for sequence in self.sequences for value in sequence.end_to_end_ns)

    def stages_ms(self) -> dict[str, Percentiles]:
        """Percentiles in ms of each stage over the frames that have it."""
        samples: dict[str, list[float]] = {}
        for sequence in self.sequences:
            for stage, sample in sequence.stage_ns.items():
                samples.setdefault(stage, []).extend(value / 1e6 for value in sample)
        return {stage: tails for stage, sample in samples.items() if (tails := percentiles(sample)) is not None}

    def staleness(self) -> Mapping[int, int]:
        """Frames by the age of their prior."""
        ages: dict[int, int] = {}
        for sequence in self.sequences:
            for age, count in sequence.staleness.items():
                ages[age] = ages.get(age, 0) + count
        return dict(sorted(ages.items()))

    @property
    def staleness_mean(self) -> float | None:
        """Mean age of the prior in frames."""
        ages = self.staleness()
        count = sum(ages.values())
        return sum(age * frames for age, frames in ages.items()) / count if count else None

    @property
    def staleness_max(self) -> int | None:
        """Greatest age of the prior in frames."""
        return max(self.staleness(), default=None)


def pool(sequences: Sequence[SequenceMetrics], *, bootstrap: Bootstrap | None = None) -> DatasetMetrics:
    """Pool the sequences of a data set under one strategy.

    Args:
        sequences: at least one.
        bootstrap: gives every ratio figure an interval that resamples sequences.

    Raises:
        ConfigurationError: there is no frame.
    """
    return DatasetMetrics(tuple(sequences), bootstrap)


def paired_difference(
    first: DatasetMetrics, second: DatasetMetrics, name: str, bootstrap: Bootstrap, *, second_name: str | None = None
) -> Estimate:
    """A figure of one strategy less that of another on the same sequences, which are paired by name.

    Args:
        first: one strategy.
        second: the other, or the same for a difference of two of its figures.
        name: the figure.
        bootstrap: how to draw; each draw has the same sequences on both sides.
        second_name: the other's figure, if it is another one.

    Raises:
        ConfigurationError: no such figure, or the two were not measured on the same sequences, each once.
    """
    ordered = [sorted(one.sequences, key=lambda sequence: sequence.name) for one in (first, second)]
    names = [[sequence.name for sequence in sequences] for sequences in ordered]
    if names[0] != names[1] or len(set(names[0])) != len(names[0]):
        raise ConfigurationError(
            f"a paired difference of {', '.join(names[0])} and {', '.join(names[1])}: "
            "give both strategies the same sequences, each once"
        )
    other = drawn_figure(ordered[1], name if second_name is None else second_name)
    return drawn_figure(ordered[0], name).less(other).estimate(bootstrap)
