"""LISA++'s tokenizer: LLaMA's sentencepiece model, the tokens added to it, and the place of the image.

It gives the ids that transformers 4.31's slow tokenizer gave in training. Later versions keep the white space
around added tokens, which moves [SEG] by one token (JIA-Lab-research/LISA issue 55), so neither they nor a
`tokenizer.json` are used.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from sentencepiece import SentencePieceProcessor

from cable_models.errors import ModelError
from cable_models.lisa.json_files import read_json
from cable_models.lisa.special_tokens import IMAGE_PLACEHOLDER, read_added_tokens

IMAGE_TEXT = "<image>"
"""Stands for the picture in the text of a prompt; not a token."""
IM_START_TEXT = "<im_start>"
IM_END_TEXT = "<im_end>"
SEG_TEXT = "[SEG]"
SPACE_PIECE = "▁"
"""How sentencepiece writes a space."""


class LisaTokenizer:
    """Text to token ids and back; build it with `from_folder`."""

    def __init__(
        self,
        pieces: SentencePieceProcessor,
        added: Mapping[str, int],
        *,
        legacy: bool = True,
        add_bos: bool = True,
    ) -> None:
        """Joins a sentencepiece model and the tokens that were added to it.

        Args:
            pieces: LLaMA's model, with the control tokens <unk>, <s> and </s>.
            added: Ids of the added tokens by their text.
            legacy: Whether text after an added token begins with a space piece, as transformers had it up to 4.30
                and later has it by default. Chooses 869 ("▁.") or 29889 (".") for the full stop in "[SEG].".
            add_bos: Whether a text begins with <s> where the caller doesn't say.

        Raises:
            ModelError: the sentencepiece model has no <s> or </s>.
        """
        if min(pieces.bos_id(), pieces.eos_id(), pieces.unk_id()) < 0:
            raise ModelError("the sentencepiece model has no <unk>, <s> or </s>; LISA++ needs LLaMA's tokenizer.model")
        self._pieces = pieces
        self._legacy = legacy
        self._add_bos = add_bos
        control = (pieces.unk_id(), pieces.bos_id(), pieces.eos_id())
        self._control = {pieces.id_to_piece(token): token for token in control}
        self._whole = {**added, **self._control}
        self._names = {token: text for text, token in self._whole.items()}
        longest_first = sorted(self._whole, key=len, reverse=True)
        self._splitter = re.compile("(" + "|".join(map(re.escape, longest_first)) + ")")

    @classmethod
    def from_folder(cls, folder: str | Path) -> LisaTokenizer:
        """Reads `tokenizer.model`, and the added tokens in `added_tokens.json` or `tokenizer_config.json`.

        Raises:
            ModelError: there is no `tokenizer.model`, or a file can't be read.
        """
        folder = Path(folder)
        path = folder / "tokenizer.model"
        if not path.is_file():
            raise ModelError(
                f"{folder} has no tokenizer.model; copy it from the checkpoint (LLaMA's, 32000 pieces), or give "
                "prompts as token ids"
            )
        pieces = SentencePieceProcessor()
        try:
            pieces.LoadFromSerializedProto(path.read_bytes())
        except (OSError, RuntimeError) as error:
            raise ModelError(f"{path} can't be read as a sentencepiece model: {error}") from error
        config = read_json(folder / "tokenizer_config.json") or {}
        # transformers 4.31 takes a missing or null "legacy" for true.
        legacy, add_bos = config.get("legacy") is not False, config.get("add_bos_token") is not False
        return cls(pieces, read_added_tokens(folder), legacy=legacy, add_bos=add_bos)

    @property
    def bos(self) -> int:
        """Id of <s>."""
        return self._pieces.bos_id()

    @property
    def eos(self) -> int:
        """Id of </s>, which ends an answer."""
        return self._pieces.eos_id()

    @property
    def vocabulary_size(self) -> int:
        """Number of ids, from 0 to the highest added one; the embedding table has at least so many rows."""
        return max(self._pieces.get_piece_size(), *(token + 1 for token in self._whole.values()))

    def token_id(self, text: str) -> int:
        """Id of an added token, a control token or a piece, looked up by its name and not by tokenising it.

        Raises:
            ModelError: the tokenizer has no such token.
        """
        token = self._whole.get(text, self._pieces.piece_to_id(text))
        if token == self._pieces.unk_id() and text not in self._control:
            added = sorted(self._whole.keys() - self._control)
            raise ModelError(f"the tokenizer has no token {text!r}; its added tokens are {added}")
        return token

    def encode(self, text: str, *, bos: bool | None = None) -> list[int]:
        """Token ids of a text.

        Added tokens are taken out first and swallow the white space on both sides; the control tokens don't.

        Args:
            text: Without "<image>".
            bos: Whether <s> comes first; None = as the tokenizer's configuration says.
        """
        ids = [self.bos] if (self._add_bos if bos is None else bos) else []
        if not self._legacy:
            text = SPACE_PIECE + text.replace(SPACE_PIECE, " ")
        parts = self._splitter.split(text)
        for position, part in enumerate(parts):
            if position % 2:
                ids.append(self._whole[part])
                continue
            if position > 0 and parts[position - 1] not in self._control:
                part = part.lstrip()
            if position + 1 < len(parts) and parts[position + 1] not in self._control:
                part = part.rstrip()
            ids.extend(self._plain_ids(part))
        return ids

    def _plain_ids(self, text: str) -> list[int]:
        """Ids of a text without added tokens; sentencepiece puts a space before it unless that must be undone."""
        if not text:
            return []
        if self._legacy:
            return self._pieces.encode(text)
        begins = text.startswith(SPACE_PIECE)
        text = text.removeprefix(SPACE_PIECE)
        pieces: list[str] = self._pieces.encode(text, out_type=str)
        if not begins and not text.startswith(" ") and pieces[0].startswith(SPACE_PIECE):
            pieces[0] = pieces[0][1:]
        return [self._pieces.piece_to_id(piece) for piece in pieces if piece]

    def encode_prompt(self, prompt: str) -> list[int]:
        """Token ids of a prompt with one "<image>", which becomes -200.

        The texts before and after the image are tokenised each on its own, as LLaVA does, so the second one begins
        with a space piece.

        Raises:
            ModelError: the prompt doesn't hold "<image>" exactly once, or marks the image with tokens that this
                tokenizer doesn't have.
        """
        before, *after = prompt.split(IMAGE_TEXT)
        if len(after) != 1:
            raise ModelError(f"a prompt needs {IMAGE_TEXT} exactly once, it is there {len(after)} times: {prompt!r}")
        for marker in (IM_START_TEXT, IM_END_TEXT):
            if marker in prompt and marker not in self._whole:
                raise ModelError(f"{marker} is no token of this checkpoint; leave the image markers out of its prompts")
        return [*self.encode(before), IMAGE_PLACEHOLDER, *self.encode(after[0], bos=False)]

    def decode(self, ids: Iterable[int]) -> str:
        """Text of token ids: added tokens by name with a space around them, without control tokens and the image.

        Embedding tables may have more rows than the tokenizer has tokens; such an id is written as its number.
        """
        texts: list[str] = []
        plain: list[int] = []
        for token in ids:
            if token in self._control.values() or token == IMAGE_PLACEHOLDER:
                continue
            if token in self._names:
                texts += [self._plain_text(plain), self._names[token]]
                plain = []
            elif 0 <= token < self._pieces.get_piece_size():
                plain.append(token)
            else:
                texts += [self._plain_text(plain), f"<{token}>"]
                plain = []
        texts.append(self._plain_text(plain))
        return " ".join(filter(None, texts))

    def _plain_text(self, ids: list[int]) -> str:
        return self._pieces.decode(ids) if ids else ""
