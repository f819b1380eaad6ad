"""Ids of the tokens LISA++ gives a meaning of its own: found beside the checkpoint, checked against its words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cable_models.errors import ModelError
from cable_models.lisa.json_files import read_json

IMAGE_PLACEHOLDER = -200
"""Id that stands for the picture in a prompt; it's no row of the embedding table."""


@dataclass(frozen=True, slots=True)
class SpecialTokens:
    """Token ids of a LISA++ checkpoint; `im_start` and `im_end` are None where the tokenizer never learnt them."""

    seg: int
    bos: int = 1
    eos: int = 2
    pad: int = 0
    im_start: int | None = None
    im_end: int | None = None
    image_placeholder: int = IMAGE_PLACEHOLDER

    def within(self, vocabulary: int) -> SpecialTokens:
        """Check every id against the rows of the embedding table.

        Args:
            vocabulary: Rows of `embed_tokens`.

        Returns:
            These ids, unchanged.

        Raises:
            ModelError: An id lies outside the table, or the placeholder inside it.
        """
        named = {"[SEG]": self.seg, "bos": self.bos, "eos": self.eos, "pad": self.pad}
        named |= {"<im_start>": self.im_start or 0, "<im_end>": self.im_end or 0}
        outside = {name: token for name, token in named.items() if not 0 <= token < vocabulary}
        if outside:
            raise ModelError(
                f"token ids {outside} have no row in an embedding table of {vocabulary} rows; "
                "the tokenizer files belong to another checkpoint"
            )
        if self.image_placeholder >= 0:
            raise ModelError(f"the image placeholder must be negative, it is {self.image_placeholder}")
        return self

    def as_json(self) -> dict[str, int]:
        """Give the content of a `tokens.json`, which `read_special_tokens` reads back."""
        ids = {"seg_token_idx": self.seg, "image_token_index": self.image_placeholder}
        ids |= {"bos": self.bos, "eos": self.eos, "pad": self.pad}
        if self.im_start is not None and self.im_end is not None:
            ids |= {"im_start_id": self.im_start, "im_end_id": self.im_end}
        return ids


def read_special_tokens(folder: Path, config: Mapping[str, Any]) -> SpecialTokens:
    """Find the special tokens of a checkpoint folder.

    `tokens.json` is read where there is one (keys seg_token_idx, im_start_id, im_end_id, image_token_index, bos, eos,
    pad); else [SEG], <im_start> and <im_end> are looked up by name among the tokens the tokenizer was given in
    training: `added_tokens.json`, `tokenizer_config.json`, `tokenizer.json`. Tokenising the text "[SEG]" instead, as
    the original does, gives a wrong id with other tokenizer versions.

    Args:
        folder: Folder of the checkpoint.
        config: Its `config.json`, for the ids of bos, eos and pad.

    Raises:
        ModelError: [SEG] is named nowhere, or a file can't be read.
    """
    said = {name: config.get(f"{name}_token_id") for name in ("bos", "eos", "pad")}
    ends = {name: token for name, token in said.items() if isinstance(token, int) and token >= 0}
    table = read_json(folder / "tokens.json")
    if table is not None:
        return _from_table(table, ends, folder / "tokens.json")
    added = read_added_tokens(folder)
    if "[SEG]" not in added:
        raise ModelError(
            f"{folder}: no [SEG] among the added tokens; a LISA checkpoint brings added_tokens.json or "
            "tokenizer_config.json (or tokens.json with seg_token_idx)"
        )
    ids = {"seg": added["[SEG]"], **ends}
    if {"<im_start>", "<im_end>"} <= added.keys():
        ids |= {"im_start": added["<im_start>"], "im_end": added["<im_end>"]}
    return SpecialTokens(**ids)


def _from_table(table: Mapping[str, Any], ends: Mapping[str, int], path: Path) -> SpecialTokens:
    known = {
        "seg": "seg_token_idx",
        "im_start": "im_start_id",
        "im_end": "im_end_id",
        "image_placeholder": "image_token_index",
        "bos": "bos",
        "eos": "eos",
        "pad": "pad",
    }
    found = {field: table[key] for field, key in known.items() if table.get(key) is not None}
    if wrong := {key: token for key, token in found.items() if type(token) is not int}:
        raise ModelError(f"{path}: {wrong} are no token ids")
    if "seg" not in found:
        raise ModelError(f"{path}: no seg_token_idx")
    return SpecialTokens(**{**ends, **found})


def read_added_tokens(folder: Path) -> dict[str, int]:
    """Read the ids of a tokenizer's added tokens by their text; empty where the folder has no tokenizer files.

    Raises:
        ModelError: A file can't be read, or doesn't give texts and ids.
    """
    whole, config, added = (
        read_json(folder / name) or {} for name in ("tokenizer.json", "tokenizer_config.json", "added_tokens.json")
    )
    try:
        tokens = {str(entry["content"]): int(entry["id"]) for entry in whole.get("added_tokens") or ()}
        decoder = config.get("added_tokens_decoder") or {}
        tokens |= {str(entry["content"]): int(token) for token, entry in decoder.items()}
        return tokens | {text: int(token) for text, token in added.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{folder}: the added tokens of its tokenizer files can't be read: {error!r}") from error
