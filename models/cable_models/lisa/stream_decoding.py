"""Which answer is forced on a stream's next frame, and when greedy decoding takes over."""

from __future__ import annotations

from dataclasses import dataclass

from cable_models.lisa.options import LisaOptions


@dataclass(frozen=True, slots=True)
class DecodingStep:
    """How one frame is decoded."""

    answer: tuple[int, ...] | None
    """Ids that are forced; None = greedy decoding."""
    verify: bool = False
    """Whether the forced answer is compared with greedy decoding."""


class StreamDecoding:
    """One stream's decoding, from frame to frame.

    A forced answer is trusted once it was what greedy decoding says on the first frames. Where it is not, the frame
    is generated and the model's own answer is forced from then on, until it fails too often.
    """

    def __init__(self, options: LisaOptions, answer: tuple[int, ...] | None) -> None:
        self._options = options
        self._answer = answer
        self._verified = 0
        self._frames = 0
        self._disagreements = 0

    def next_step(self) -> DecodingStep:
        """How the next frame is to be decoded."""
        options = self._options
        given_up = self._disagreements > 0 and self._disagreements >= options.max_disagreements
        if options.decoding == "generate" or self._answer is None or given_up:
            return DecodingStep(None)
        due = options.verify_interval > 0 and self._frames % options.verify_interval == 0
        blind = options.verify_frames == 0
        return DecodingStep(self._answer, not blind and (due or self._verified < options.verify_frames))

    def agreed(self, agrees: bool | None) -> None:
        """Takes the outcome of a forced frame; None = it was not checked."""
        if agrees is False:
            self._disagreements += 1
            self._answer = None
            return
        self._frames += 1
        self._verified += bool(agrees)

    def generated(self, answer: tuple[int, ...], seg: int) -> None:
        """Takes a generated answer; one that has a mask is forced on the frames that follow."""
        self._frames += 1
        if seg in answer:
            self._answer, self._verified = answer, 0
