"""Prompts word by word, and forced answers against the ids measured with LLaMA's vocabulary."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
from cable_models.errors import ModelError
from cable_models.lisa.prompt import MODE_SUFFIXES, PromptMode, build_prompt, category_question, forced_answer_ids
from cable_models.lisa.tokenizer import LisaTokenizer
from sentencepiece import SentencePieceProcessor
from tiny_tokenizer import llama_excerpt

REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "reference" / "lisa.md"


@pytest.fixture(scope="module")
def llama() -> LisaTokenizer:
    return LisaTokenizer(SentencePieceProcessor(model_proto=llama_excerpt()), {"[SEG]": 32000})


@pytest.mark.parametrize(
    ("answer", "ids"),
    [
        ("It is [SEG].", [739, 338, 32000, 869, 2]),
        ("Sure, [SEG].", [18585, 29892, 32000, 869, 2]),
        ("[SEG].", [32000, 869, 2]),
        ("Sure, it is [SEG].", [18585, 29892, 372, 338, 32000, 869, 2]),
        ("Sure, the segmentation result is [SEG].", [18585, 29892, 278, 10768, 362, 1121, 338, 32000, 869, 2]),
        ("Sure, [SEG], [SEG], and [SEG].", [18585, 29892, 32000, 1919, 32000, 1919, 322, 32000, 869, 2]),
    ],
)
def test_forced_answers_as_tokenised_in_training(llama: LisaTokenizer, answer: str, ids: list[int]) -> None:
    assert forced_answer_ids(llama, answer, 32000) == ids


@pytest.mark.parametrize("answer", ["Sure, [SEG].", "[SEG].", "It is [SEG], and [SEG]."])
@pytest.mark.parametrize("legacy", [True, False])
def test_forced_answer_continues_the_prompt(answer: str, legacy: bool) -> None:
    """The ids are those of the whole conversation tokenised at once, as the authors' validation does."""
    llama = LisaTokenizer(SentencePieceProcessor(model_proto=llama_excerpt()), {"[SEG]": 32000}, legacy=legacy)
    prompt = "USER: <image>\nit is ASSISTANT:"
    whole = llama.encode_prompt(f"{prompt} {answer}</s>")
    assert whole == [*llama.encode_prompt(prompt), *forced_answer_ids(llama, answer, 32000)]


def test_prompt_word_by_word() -> None:
    assert build_prompt("Where is it?", "step_by_step", "user") == (
        "A chat between a curious user and an artificial intelligence assistant. The assistant gives helpful, "
        "detailed, and polite answers to the user's questions. USER: <image>\nWhere is it? Answer the question with a "
        "step-by-step explanation. ASSISTANT:"
    )
    assert build_prompt("Where is it?", "semantic", im_start_end=True) == (
        "A chat between a curious human and an artificial intelligence assistant. The assistant gives helpful, "
        "detailed, and polite answers to the human's questions. USER: <im_start><image><im_end>\nWhere is it? Generate "
        "a mask for semantic segmentation. Focus on identifying the category as a whole; do not distinguish between "
        "individual instances within the same category. ASSISTANT:"
    )


def test_suffixes_are_those_of_training() -> None:
    if not REFERENCE.exists():
        pytest.skip("needs the authors' texts, lisa.md in ../shared/reference")
    table = REFERENCE.read_text(encoding="utf-8").split("### LISA++ mode suffixes")[1].split("\n###")[0]
    texts = [row.split("`")[1] for row in table.splitlines() if row.count("`") == 2]
    assert list(MODE_SUFFIXES.values()) == texts
    assert list(MODE_SUFFIXES) == list(get_args(PromptMode))


def test_category_questions() -> None:
    assert category_question(["road"]) == "Can you segment the road in this image?"
    assert category_question(["cars", "vans"]) == "Can you segment the cars and vans in this image?"
    assert (
        category_question(["cars", "trucks", "cyclists"], "instance")
        == "Can you segment the cars, trucks, and cyclists separately in this image?"
    )


def test_refusals(llama: LisaTokenizer) -> None:
    with pytest.raises(ModelError, match="empty"):
        build_prompt(" \n")
    for text in ("[SEG]", "<image>", "</s>", "<im_end>"):
        with pytest.raises(ModelError, match="meaning of its own"):
            build_prompt(f"Segment the {text} car")
    with pytest.raises(ModelError, match="mode"):
        build_prompt("Where?", "panoptic")
    with pytest.raises(ModelError, match="system"):
        build_prompt("Where?", system="robot")
    with pytest.raises(ModelError, match="category"):
        category_question([])
    with pytest.raises(ModelError, match="no mask"):
        forced_answer_ids(llama, "Sure.", 32000)
    with pytest.raises(ModelError, match="belong together"):
        forced_answer_ids(llama, "Sure, [SEG].", 32001)
    bare = LisaTokenizer(SentencePieceProcessor(model_proto=llama_excerpt()), {})
    with pytest.raises(ModelError, match="no token"):
        forced_answer_ids(bare, "Sure, [SEG].", 32000)
