"""What LISA++ is asked and made to answer: conversation template, task suffixes, forced answers.

The texts are those of dvlab-research/LISA, branch lisa_plus (utils/utils.py, model/llava1p5/conversation.py); the
model was trained on them word by word.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

from cable_models.errors import ModelError
from cable_models.lisa.tokenizer import IM_END_TEXT, IM_START_TEXT, IMAGE_TEXT, SEG_TEXT, LisaTokenizer

PromptMode = Literal["semantic", "instance", "semantic_text", "instance_text", "text", "step_by_step"]
SystemPrompt = Literal["human", "user"]

RESERVED_TEXTS = (IMAGE_TEXT, SEG_TEXT, IM_START_TEXT, IM_END_TEXT, "<s>", "</s>", "<unk>")
"""Texts that become tokens with a meaning of their own, and so have no place in a question."""

SYSTEM_PROMPTS: Mapping[str, str] = {
    name: f"A chat between a curious {name} and an artificial intelligence assistant. "
    f"The assistant gives helpful, detailed, and polite answers to the {name}'s questions."
    for name in get_args(SystemPrompt)
}
"""The authors' chat scripts use "human", their training data sets used "user"."""

MODE_SUFFIXES: Mapping[str, str] = {
    "semantic": " Generate a mask for semantic segmentation. Focus on identifying the category as a whole; "
    "do not distinguish between individual instances within the same category.",
    "instance": " Generate instance segmentation masks. Each countable object within the same category should have "
    "a separate mask. Ignore uncountable categories for individual masking.",
    "semantic_text": " Provide a textual answer and generate a semantic segmentation mask. "
    "Focus on categorizing the entire class without separating individual instances.",
    "instance_text": " Respond with text and provide instance segmentation mask predictions. Different instances "
    "within the same countable category should be identified with separate masks. "
    "A single mask suffices for uncountable categories.",
    "text": " Respond to the question using text only. Do not generate any segmentation masks.",
    "step_by_step": " Answer the question with a step-by-step explanation.",
}
"""What LISA++ was trained to find behind the question, by mode."""


def build_prompt(
    question: str,
    mode: PromptMode = "semantic",
    system: SystemPrompt = "human",
    *,
    im_start_end: bool = False,
) -> str:
    """The text of a whole prompt, "<image>" standing for the picture, up to and including "ASSISTANT:".

    Args:
        question: What the user asks, without the suffix of the mode.
        mode: Task; decides the suffix.
        system: Wording of the system prompt.
        im_start_end: Puts "<im_start>" and "<im_end>" around the picture, for checkpoints whose tokenizer has them.

    Raises:
        ModelError: an empty question, one that holds a reserved text such as "[SEG]", or an unknown mode or system.
    """
    if not question.strip():
        raise ModelError("the question is empty; ask for what is to be segmented")
    if found := [text for text in RESERVED_TEXTS if text in question]:
        raise ModelError(f"the question holds {', '.join(found)}, which the tokenizer gives a meaning of its own")
    if mode not in MODE_SUFFIXES:
        raise ModelError(f"unknown prompt mode {mode!r}; choose one of {', '.join(MODE_SUFFIXES)}")
    if system not in SYSTEM_PROMPTS:
        raise ModelError(f"unknown system prompt {system!r}; choose one of {', '.join(SYSTEM_PROMPTS)}")
    image = f"{IM_START_TEXT}{IMAGE_TEXT}{IM_END_TEXT}" if im_start_end else IMAGE_TEXT
    return f"{SYSTEM_PROMPTS[system]} USER: {image}\n{question}{MODE_SUFFIXES[mode]} ASSISTANT:"


def category_question(categories: Sequence[str], mode: PromptMode = "semantic") -> str:
    """A question of the training data's form that names all the categories at once.

    Args:
        categories: For example ["cars", "trucks", "pedestrians"].
        mode: The instance modes ask for the objects "separately".

    Raises:
        ModelError: no category.
    """
    if not categories:
        raise ModelError("name at least one category to segment")
    separately = " separately" if mode in ("instance", "instance_text") else ""
    return f"Can you segment the {enumeration(categories)}{separately} in this image?"


def enumeration(words: Sequence[str]) -> str:
    """ "a", "a and b", "a, b, and c"."""
    if len(words) < 3:
        return " and ".join(words)
    return f"{', '.join(words[:-1])}, and {words[-1]}"


def forced_answer_ids(tokenizer: LisaTokenizer, answer: str, seg_id: int) -> list[int]:
    """Token ids of an answer that the model is made to give, </s> included, as they follow "ASSISTANT:".

    In the joined text a space stands before the answer; it is the one that the tokenizer puts before every text.

    Args:
        tokenizer: The checkpoint's.
        answer: With "[SEG]" for each mask, as "Sure, [SEG].".
        seg_id: Id of [SEG] in the checkpoint.

    Raises:
        ModelError: the answer has no "[SEG]", or the tokenizer has another id for it or none.
    """
    if SEG_TEXT not in answer:
        raise ModelError(f"the forced answer {answer!r} has no {SEG_TEXT}, so it would give no mask")
    if tokenizer.token_id(SEG_TEXT) != seg_id:
        raise ModelError(
            f"{SEG_TEXT} is token {tokenizer.token_id(SEG_TEXT)} of the tokenizer but {seg_id} of the checkpoint; "
            "their files don't belong together"
        )
    return [*tokenizer.encode(answer, bos=False), tokenizer.eos]
