"""The compact LISA's tokenizer: LLaMA's kind of sentencepiece model, small, of the texts that training holds."""

from __future__ import annotations

import io
import json
from pathlib import Path

import sentencepiece

from cable_models.lisa.special_tokens import SpecialTokens
from cable_models.lisa.tokenizer import SEG_TEXT
from cable_models.training.segmentation_prompts import corpus

PIECES = 768
"""256 bytes, three control tokens, the letters, and the words of the templates."""


def write_tokenizer(folder: Path, pieces: int = PIECES) -> SpecialTokens:
    """Trains the tokenizer and writes ``tokenizer.model`` and ``added_tokens.json``; ``folder`` must exist.

    Returns:
        The ids of its special tokens.
    """
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter(corpus()),
        model_writer=model,
        vocab_size=pieces,
        model_type="bpe",
        byte_fallback=True,
        normalization_rule_name="identity",
        add_dummy_prefix=True,
        remove_extra_whitespaces=False,
        split_digits=True,
        character_coverage=1.0,
        hard_vocab_limit=False,
        num_threads=1,
        minloglevel=2,
    )
    (folder / "tokenizer.model").write_bytes(model.getvalue())
    tokens = SpecialTokens(seg=pieces)
    (folder / "added_tokens.json").write_text(json.dumps({SEG_TEXT: tokens.seg}) + "\n", encoding="utf-8")
    return tokens
