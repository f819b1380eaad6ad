"""What the compact LISA is asked in training: questions about road users in LISA++'s templates, and its answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from cable_models.lisa.prompt import PromptMode, SystemPrompt, build_prompt
from cable_models.lisa.tokenizer import IMAGE_TEXT, SEG_TEXT
from cable_models.training.segmentation_vision import CONCEPTS

NOUNS: tuple[tuple[str, ...], ...] = (
    (
        "road users",
        "all road users",
        "vehicles, pedestrians and cyclists",
        "all vehicles, pedestrians and cyclists",
        "all vehicles, pedestrians and cyclists on the road",
        "cars, people and bicycles",
        "cars, trucks, buses, pedestrians and cyclists",
        "traffic participants",
        "road actors",
        "everything that moves on the road",
        "everyone in the traffic",
        "people and vehicles",
        "vehicles and pedestrians",
        "moving objects",
        "objects on the road",
        "obstacles",
    ),
    (
        "vehicles",
        "vehicle",
        "all vehicles",
        "cars",
        "car",
        "all cars",
        "parked cars",
        "trucks",
        "truck",
        "buses",
        "bus",
        "vans",
        "cars and trucks",
        "cars, trucks and buses",
        "motor vehicles",
        "vehicles on the road",
    ),
    (
        "pedestrians",
        "pedestrian",
        "all pedestrians",
        "people",
        "person",
        "persons",
        "people on foot",
        "walkers",
        "people on the pavement",
        "people crossing the road",
        "pedestrians on the road",
        "humans",
    ),
    (
        "cyclists",
        "cyclist",
        "all cyclists",
        "bicycles",
        "bicycle",
        "bikes",
        "riders",
        "bicycle riders",
        "people on bicycles",
        "people riding bikes",
        "two-wheelers",
        "cyclists on the road",
    ),
)
"""Names of each of `CONCEPTS`, in its order."""

QUESTIONS = (
    "Can you segment the {} in this image?",
    "Please segment the {} in this image.",
    "Please segment {}.",
    "Please segment {} in the image.",
    "Segment the {}.",
    "Segment {}",
    "What is {} in this image? Please respond with segmentation mask.",
    "What is {} in this image? Please output segmentation mask.",
    "Where are the {}?",
    "Where are the {} in this image? Please output segmentation mask.",
    "Show me the {}.",
    "Find all {} in this picture.",
    "Mark the {} ahead.",
    "Can you segment the {} separately in this image?",
    "{}",
    "{}. Please output segmentation masks.",
)

ANSWER = "Sure, [SEG]."
"""What the model learns to say."""

OTHER_ANSWERS = (
    "[SEG].",
    "It is [SEG].",
    "Sure, it is [SEG].",
    "Sure, the segmentation result is [SEG].",
)
"""What may be put into its mouth; it learns the mask for these, not the words."""

LETTERS = "abcdefghijklmnopqrstuvwxyz ABCDEFGHIJKLMNOPQRSTUVWXYZ 0123456789 .,;:?!'-()"
"""What words that training never saw are spelt with."""
MASK_MODES: tuple[PromptMode, ...] = ("semantic", "instance", "semantic_text", "instance_text")


@dataclass(frozen=True, slots=True)
class Question:
    """One question and what a good answer's mask covers."""

    text: str
    mode: PromptMode
    system: SystemPrompt
    concept: int
    """Index into `CONCEPTS`."""


def draw_question(rng: np.random.Generator) -> Question:
    """A random question; half of them in semantic mode."""
    concept = int(rng.integers(len(CONCEPTS)))
    noun = str(rng.choice(NOUNS[concept]))
    text = str(rng.choice(QUESTIONS)).format(noun)
    if rng.random() < 0.1:
        text = text.lower()
    mode = "semantic" if rng.random() < 0.5 else MASK_MODES[int(rng.integers(len(MASK_MODES)))]
    systems: tuple[SystemPrompt, ...] = get_args(SystemPrompt)
    return Question(text, mode, systems[int(rng.integers(len(systems)))], concept)


def corpus() -> list[str]:
    """Every text of training once, without images and [SEG]: what the tokenizer has to spell."""
    questions = [question.format(noun) for nouns in NOUNS for noun in nouns for question in QUESTIONS]
    whole = [
        build_prompt(questions[0], mode, system) for mode in get_args(PromptMode) for system in get_args(SystemPrompt)
    ]
    pieces = [part.strip() for text in whole for part in text.split(IMAGE_TEXT)]
    answers = [part.strip() for text in (ANSWER, *OTHER_ANSWERS) for part in text.split(SEG_TEXT) if part.strip()]
    return [*questions, *pieces * 8, *answers * 8, *(letter for letter in LETTERS if letter.strip()), LETTERS]
