"""Two tokenizers without the 7B checkpoint: one trained like LLaMA's on a few words, one with LLaMA's own ids."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path

from sentencepiece import SentencePieceTrainer
from sentencepiece import sentencepiece_model_pb2 as sentencepiece_model

WORDS = """A chat between a curious human and an artificial intelligence assistant. The assistant gives helpful,
detailed, and polite answers to the human's questions. USER: Can you segment the cars, trucks and pedestrians in this
image? Please segment the lane, the kerb and every cyclist. ASSISTANT: Sure, it is here. The segmentation result is
shown. Generate a mask for semantic segmentation. Focus on the category as a whole, not on individual instances."""

LLAMA_WORDS = {
    "▁": 29871,
    ",": 29892,
    ".": 29889,
    ":": 29901,
    "▁,": 1919,
    "▁.": 869,
    "▁it": 372,
    "▁is": 338,
    "▁It": 739,
    "▁the": 278,
    "▁and": 322,
    "▁Sure": 18585,
    "▁Hello": 15043,
    "▁result": 1121,
    "▁segment": 10768,
    "ation": 362,
    "▁US": 3148,
    "ER": 1001,
}
"""Pieces of LLaMA's vocabulary of 32000 at their ids there."""


def trained_model(pieces: int = 380) -> bytes:
    """A sentencepiece model with LLaMA's settings."""
    model = io.BytesIO()
    SentencePieceTrainer.train(
        sentence_iterator=iter(WORDS.splitlines()),
        model_writer=model,
        model_type="bpe",
        vocab_size=pieces,
        byte_fallback=True,
        normalization_rule_name="identity",
        remove_extra_whitespaces=False,
        split_digits=True,
        allow_whitespace_only_pieces=True,
        minloglevel=2,
    )
    return model.getvalue()


def llama_excerpt() -> bytes:
    """32000 pieces of which those in `LLAMA_WORDS`, the control tokens and the bytes are LLaMA's, at LLaMA's ids.

    Sentencepiece joins two neighbours only if the result is a piece, so every beginning of a word becomes one too, at
    a free id.
    """
    model = sentencepiece_model.ModelProto()
    model.ParseFromString(trained_model())
    control = {position: (piece.piece, piece.type) for position, piece in enumerate(model.pieces[:259])}
    beginnings = {word[:end] for word in LLAMA_WORDS for end in range(1, len(word))} - LLAMA_WORDS.keys()
    by_id = {token: word for word, token in LLAMA_WORDS.items()}
    free = iter(sorted(beginnings | {letter for word in LLAMA_WORDS for letter in word[1:]} - LLAMA_WORDS.keys()))
    del model.pieces[:]
    for token in range(32000):
        piece = model.pieces.add()
        if token in control:
            piece.piece, piece.type = control[token]
        else:
            piece.piece = by_id.get(token) or next(free, None) or f"<unused {token}>"
            piece.score = -token
    return model.SerializeToString()


def save_tokenizer(folder: Path, model: bytes, added: Mapping[str, int], config: Mapping[str, object]) -> Path:
    """A folder as transformers 4.31 writes it."""
    folder.mkdir(exist_ok=True)
    (folder / "tokenizer.model").write_bytes(model)
    (folder / "added_tokens.json").write_text(json.dumps(dict(added)))
    (folder / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "LlamaTokenizer", **config}))
    return folder
