"""What a frame's prefill cost, three ways: the paper's estimate, its floating-point operations, and the clock."""

from __future__ import annotations

from dataclasses import dataclass

from transformers import LlamaConfig


@dataclass(frozen=True, slots=True)
class PrefillCost:
    """One frame's prefill beside that of the whole frame."""

    prompt_tokens: int
    """Text tokens of the prompt."""
    image_tokens: int
    """Image tokens that entered the language model."""
    whole_image_tokens: int
    """Image tokens of a whole frame."""
    speedup_quadratic: float
    """The paper's estimate, (n_whole / n)^2; it takes all of the prefill for attention."""
    speedup_flops: float
    """Ratio of the operations, which are linear in n to within 2 % at these lengths."""
    measured_ns: int
    """Duration of the pass; a batch's is divided by its frames."""
    whole_ns: int
    """Duration of whole frames with as long a prompt, median of the last ones; 0 = none was run yet."""


def linear_parameters(llama: LlamaConfig) -> int:
    """Weights of the decoder's blocks that multiply every token."""
    width, layers = llama.hidden_size, llama.num_hidden_layers
    head = getattr(llama, "head_dim", None) or width // llama.num_attention_heads
    queries = head * llama.num_attention_heads
    keys = head * (llama.num_key_value_heads or llama.num_attention_heads)
    return int(layers * (2 * width * queries + 2 * width * keys + 3 * width * llama.intermediate_size))


def prefill_flops(llama: LlamaConfig, tokens: int) -> int:
    """Operations of one pass over ``tokens``, dense attention counted in full: 2 P n + 4 L d n^2."""
    head = getattr(llama, "head_dim", None) or llama.hidden_size // llama.num_attention_heads
    attended = head * llama.num_attention_heads
    return 2 * linear_parameters(llama) * tokens + 4 * llama.num_hidden_layers * attended * tokens**2


def prefill_cost(
    llama: LlamaConfig, prompt_tokens: int, image_tokens: int, whole_image_tokens: int, measured_ns: int, whole_ns: int
) -> PrefillCost:
    """The three columns of one frame."""
    run, whole = prompt_tokens + image_tokens, prompt_tokens + whole_image_tokens
    return PrefillCost(
        prompt_tokens,
        image_tokens,
        whole_image_tokens,
        speedup_quadratic=(whole / run) ** 2,
        speedup_flops=prefill_flops(llama, whole) / prefill_flops(llama, run),
        measured_ns=measured_ns,
        whole_ns=whole_ns,
    )
