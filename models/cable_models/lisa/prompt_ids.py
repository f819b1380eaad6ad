"""The token ids of a frame's prompt, and of the answer that is forced on it."""

from __future__ import annotations

from collections.abc import Sequence

from cable_models.errors import ModelError
from cable_models.lisa.loader import LoadedLisa
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.prompt import build_prompt, forced_answer_ids


def prompt_ids(loaded: LoadedLisa, prompt: str | Sequence[int], options: LisaOptions) -> tuple[int, ...]:
    """Ids of a prompt, with the image placeholder.

    Args:
        loaded: The model.
        prompt: A question, which gets the template and the mode's suffix; or the ids of a whole prompt.
        options: Mode, system prompt and image markers.

    Raises:
        ModelError: a text without a tokenizer, ids beyond the vocabulary, or not exactly one image placeholder.
    """
    if isinstance(prompt, str):
        return question_ids(loaded, prompt, options)
    placeholder, vocabulary = loaded.tokens.image_placeholder, loaded.architecture.llama.vocab_size
    ids = tuple(int(token) for token in prompt)
    if wrong := [token for token in ids if token != placeholder and not 0 <= token < vocabulary]:
        raise ModelError(f"ids {wrong[:10]} of a prompt are not in the vocabulary of {vocabulary} tokens")
    if ids.count(placeholder) != 1:
        raise ModelError(
            f"a prompt needs exactly one image placeholder ({placeholder}), this one of {len(ids)} ids has "
            f"{ids.count(placeholder)}"
        )
    return ids


def question_ids(loaded: LoadedLisa, question: str, options: LisaOptions) -> tuple[int, ...]:
    """Ids of a question in the conversation's template.

    Raises:
        ModelError: no tokenizer, no such mode, or markers that the checkpoint doesn't have.
    """
    if loaded.tokenizer is None:
        raise ModelError(
            f"{loaded.folder} has no tokenizer.model, so it takes prompts as token ids only; copy the tokenizer.model "
            "and the added tokens of the checkpoint there to ask in words"
        )
    has_markers = loaded.tokens.im_start is not None
    if options.image_markers == "yes" and not has_markers:
        raise ModelError(f"{loaded.folder} has no <im_start> and <im_end>; leave image_markers at config or no")
    wanted = loaded.image_markers if options.image_markers == "config" else options.image_markers == "yes"
    text = build_prompt(question, options.mode, options.system, im_start_end=wanted and has_markers)
    return tuple(loaded.tokenizer.encode_prompt(text))


def first_forced_answer(loaded: LoadedLisa, options: LisaOptions) -> tuple[int, ...] | None:
    """Ids of the answer that is forced on a stream's first frame; None = that frame is generated.

    Raises:
        ModelError: the answer has no [SEG], or its ids are not in the vocabulary.
    """
    if options.forced_ids is not None:
        return check_answer(loaded, options.forced_ids)
    if loaded.tokenizer is None or options.decoding == "generate" or options.mode == "text":
        return None
    return tuple(forced_answer_ids(loaded.tokenizer, options.answer, loaded.tokens.seg))


def check_answer(loaded: LoadedLisa, ids: tuple[int, ...]) -> tuple[int, ...]:
    """The ids, if they make an answer with a mask.

    Raises:
        ModelError: as `first_forced_answer`.
    """
    vocabulary = loaded.architecture.llama.vocab_size
    if loaded.tokens.seg not in ids or not all(0 <= token < vocabulary for token in ids):
        raise ModelError(f"forced_ids {ids[:20]} need [SEG] ({loaded.tokens.seg}) and ids below {vocabulary}")
    return ids
