"""torch.compile for the deep stacks of LISA++: the blocks of its language model, of CLIP and of SAM's encoder."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from torch import Tensor
from transformers import Cache

from cable_models.errors import ModelError
from cable_models.lisa.sam_encoder import run_layer

if TYPE_CHECKING:
    from cable_models.lisa.model import LisaModel

CompileMode = Literal["none", "default", "reduce-overhead"]
"""none: PyTorch as it is. default: blocks are compiled one by one, for all lengths at once. reduce-overhead: whole
stacks are compiled and replayed as CUDA graphs, one for each length (pad prompts with ``token_bucket``)."""
COMPILE_MODES: tuple[CompileMode, ...] = get_args(CompileMode)

HfModule = Any
"""A module of transformers, whose submodules have no static types."""
BlockRunner = Callable[..., Tensor]


def decoder_block(
    block: HfModule, hidden: Tensor, rotary: tuple[Tensor, Tensor], positions: Tensor, cache: Cache | None
) -> Tensor:
    """A block of a Llama, [B, n, width], without an attention mask: causal, or one token after those of the cache."""
    return hidden_of(
        block(
            hidden,
            attention_mask=None,
            position_embeddings=rotary,
            position_ids=positions,
            past_key_values=cache,
            use_cache=cache is not None,
        )
    )


def clip_block(block: HfModule, hidden: Tensor, mask: Tensor | None) -> Tensor:
    """A block of CLIP, [B, n, width]."""
    return hidden_of(block(hidden, mask))


def sam_block(block: HfModule, hidden: Tensor) -> Tensor:
    """A block of SAM's encoder on whole frames, [B, side, side, width]."""
    return hidden_of(block(hidden))


def hidden_of(output: Tensor | tuple[Tensor, ...]) -> Tensor:
    """What a block of transformers makes; some releases return it in a tuple."""
    return output[0] if isinstance(output, tuple) else output


def decoder_stack(
    language_model: HfModule,
    embeddings: Tensor,
    positions: Tensor,
    cache: Cache | None = None,
    *,
    run: BlockRunner = decoder_block,
) -> Tensor:
    """All blocks and the last norm of a Llama, without an attention mask.

    The attention is causal by itself, which the fastest kernels know how to do. `LlamaModel.forward` wants a mask
    where positions have gaps, and reads its values, for which a GPU has to be waited for; compiled, it makes the
    whole matrix.

    Args:
        language_model: `LlamaModel`.
        embeddings: [B, n, width]; n is 1 where the cache holds anything.
        positions: int64 [B, n], rotary positions, gaps allowed.
        cache: Keys and values of the tokens before; grows by these.
        run: Runs a block.

    Returns:
        [B, n, width].
    """
    rotary = language_model.rotary_emb(embeddings, position_ids=positions)
    hidden = embeddings
    for block in language_model.layers:
        hidden = run(block, hidden, rotary, positions, cache)
    normed: Tensor = language_model.norm(hidden)
    return normed


def clip_stack(
    blocks: Iterable[HfModule], hidden: Tensor, mask: Tensor | None, *, run: BlockRunner = clip_block
) -> Tensor:
    """Blocks of CLIP on [B, n, width], with an additive mask [B, 1, 1, n] or none."""
    for block in blocks:
        hidden = run(block, hidden, mask)
    return hidden


def sam_stack(encoder: HfModule, pixels: Tensor, *, run: BlockRunner = sam_block) -> Tensor:
    """SAM's image encoder on whole frames: [B, 3, S, S] to [B, C, side, side]."""
    hidden = encoder.patch_embed(pixels)
    if encoder.pos_embed is not None:
        hidden = hidden + encoder.pos_embed
    for block in encoder.layers:
        hidden = run(block, hidden)
    embedding: Tensor = encoder.neck(hidden)
    return embedding


@dataclass(frozen=True, slots=True)
class Stacks:
    """The functions that run a model's deep stacks."""

    language: Callable[[HfModule, Tensor, Tensor], Tensor] = decoder_stack
    """A pass without a cache; token-by-token decoding isn't compiled, for its length changes with every token."""
    clip: Callable[[Iterable[HfModule], Tensor, Tensor | None], Tensor] = clip_stack
    sam: Callable[[HfModule, Tensor], Tensor] = sam_stack
    """Whole frames."""
    sam_tokens: BlockRunner = run_layer
    """A block on the listed tokens of frames that are encoded in part."""


@lru_cache
def compiled_stacks(mode: CompileMode) -> Stacks:
    """The stacks in one of the modes; a graph is compiled when the first input of its kind comes.

    Args:
        mode: See `CompileMode`. The number of tokens is free in every graph; one frame, several frames, and a mask
            or none are kinds of their own.

    Raises:
        ModelError: unknown mode.
    """
    if mode not in COMPILE_MODES:
        raise ModelError(f"unknown compile mode {mode!r}; choose one of {', '.join(COMPILE_MODES)}")
    if mode == "none":
        return Stacks()
    # Another number of tokens in every frame: one graph for all of them, which CUDA graphs can't replay.
    sam_tokens = torch.compile(run_layer, dynamic=True)
    if mode == "default":
        return Stacks(
            partial(decoder_stack, run=torch.compile(decoder_block, dynamic=True)),
            partial(clip_stack, run=torch.compile(clip_block, dynamic=True)),
            partial(sam_stack, run=torch.compile(sam_block)),
            sam_tokens,
        )
    return Stacks(
        kept(torch.compile(decoder_stack, mode=mode, dynamic=True)),
        kept(torch.compile(clip_stack, mode=mode, dynamic=True)),
        kept(torch.compile(sam_stack, mode=mode)),
        sam_tokens,
    )


def kept(stack: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """The stack, with a result that the next replay of its CUDA graph doesn't overwrite."""

    def run(*inputs: Any) -> Tensor:
        return stack(*inputs).clone()

    return run


def compile_model(model: LisaModel, mode: CompileMode) -> None:
    """Has a model's stacks run in one of the modes from now on; see `compiled_stacks`."""
    model.stacks = compiled_stacks(mode)
