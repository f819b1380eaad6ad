"""The answers of a batch of frames, each decoded as its own stream's past suggests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cable_models.lisa.decoding import Answer, ForcedPrompt, force, generate
from cable_models.lisa.language import ImageTokens
from cable_models.lisa.model import LisaModel
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.special_tokens import SpecialTokens
from cable_models.lisa.stage_timer import StageTimer
from cable_models.lisa.stream_decoding import StreamDecoding


class StreamAnswers:
    """Decodes frames of many streams, and remembers of each whether its forced answer can be trusted."""

    def __init__(
        self, model: LisaModel, tokens: SpecialTokens, options: LisaOptions, answer: tuple[int, ...] | None
    ) -> None:
        self._model = model
        self._tokens = tokens
        self._options = options
        self._answer = answer
        self._streams: dict[str, tuple[tuple[int, ...], StreamDecoding]] = {}

    def forget(self, stream: str) -> None:
        """Drops what is known of a stream that has ended."""
        self._streams.pop(stream, None)

    def answer(
        self,
        streams: Sequence[str],
        prompts: Sequence[tuple[int, ...]],
        images: Sequence[ImageTokens],
        timer: StageTimer,
    ) -> list[Answer]:
        """One answer for each frame: forced ones in one pass, the others token by token.

        Args:
            streams: Name of each frame's stream.
            prompts: Ids of each frame's prompt, with the image placeholder.
            images: Visual tokens of each frame.
            timer: Takes the stages ``prefill`` and ``decode``.
        """
        states = [self._decoding(stream, ids) for stream, ids in zip(streams, prompts, strict=True)]
        steps = [state.next_step() for state in states]
        forced = {
            index: ForcedPrompt(prompts[index], step.answer, images[index], step.verify)
            for index, step in enumerate(steps)
            if step.answer is not None
        }
        answers = dict(zip(forced, self._force(list(forced.values()), timer), strict=True))
        for index, answer in answers.items():
            states[index].agreed(answer.agrees)
        for index, state in enumerate(states):
            refused = index in answers and answers[index].agrees is False
            if index not in answers or refused:
                answer = self._generate(prompts[index], images[index], timer)
                state.generated(answer.ids, self._tokens.seg)
                answers[index] = replace(answer, agrees=False if refused else None)
        return [answers[index] for index in range(len(states))]

    def _decoding(self, stream: str, ids: tuple[int, ...]) -> StreamDecoding:
        """The stream's state; a new question starts a new one."""
        known = self._streams.get(stream)
        if known is None or known[0] != ids:
            known = (ids, StreamDecoding(self._options, self._answer))
            self._streams[stream] = known
        return known[1]

    def _force(self, prompts: Sequence[ForcedPrompt], timer: StageTimer) -> list[Answer]:
        if not prompts:
            return []
        options = self._options
        return force(
            self._model,
            self._tokens,
            prompts,
            compact=options.image_tokens == "compact",
            timer=timer,
            bucket=options.token_bucket,
        )

    def _generate(self, ids: tuple[int, ...], image: ImageTokens, timer: StageTimer) -> Answer:
        options = self._options
        return generate(
            self._model,
            self._tokens,
            ids,
            image,
            max_new_tokens=options.max_new_tokens,
            compact=options.image_tokens == "compact",
            timer=timer,
        )
