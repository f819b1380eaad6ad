"""A LISA++ of a few hundred thousand random weights on disk, with a tokenizer: all of the real thing but its size.

The weights are drawn so that every part matters, the language model says a given answer by itself, and the masks of
a random picture cover about half of it.
"""

from __future__ import annotations

import io
import json
import math
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import sentencepiece
import torch
from cable_models.lisa.architecture import LisaArchitecture
from cable_models.lisa.model import LisaModel
from cable_models.lisa.sam_sizes import SamSizes
from cable_models.lisa.saver import save_lisa
from cable_models.lisa.special_tokens import SpecialTokens
from torch import Tensor, nn
from transformers import CLIPVisionConfig, LlamaConfig

TEXT = """A chat between a curious human and an artificial intelligence assistant.
The assistant gives helpful, detailed, and polite answers to the human's questions.
USER: Can you segment the cars in this image? ASSISTANT: Sure, [SEG].
Please segment all vehicles, pedestrians and cyclists on the road.
What is the bicycle in this image? Please output segmentation mask. It is . Sure, it is . Sure, they are .
Generate a mask for semantic segmentation. Focus on identifying the category as a whole; do not distinguish between
individual instances within the same category. Generate instance segmentation masks."""
SPOKEN = "Sure, . " * 40
ANSWER = "Sure, [SEG]."
SHORT_ANSWER = "[SEG]."


def build_tiny_lisa(
    folder: Path,
    *,
    seed: int = 0,
    clip_size: int = 56,
    sam_size: int = 256,
    says: str = ANSWER,
    tokenizer: bool = True,
    projector: str = "mlp2x_gelu",
) -> Path:
    """Write a checkpoint in the layout the authors publish.

    Args:
        folder: A new one; parents are created.
        seed: Draws every weight.
        clip_size: Side of CLIP's input, a multiple of 14; 56 gives 16 image tokens.
        sam_size: Side of SAM's input, a multiple of 16; 256 gives a grid of 16 x 16 tokens, window 14.
        says: `ANSWER` or `SHORT_ANSWER`, what greedy decoding answers to any prompt that ends with ":".
        tokenizer: Whether it can read text.
        projector: From CLIP to the language model.

    Returns:
        The folder.
    """
    proto = train_tokenizer()
    pieces = sentencepiece.SentencePieceProcessor(model_proto=proto)
    seg = pieces.vocab_size()
    architecture = tiny_architecture(seg + 1, clip_size, sam_size, projector)
    chain = answer_chain(pieces, says, seg)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = LisaModel(architecture).eval()
        draw_weights(model)
        teach_answer(model, chain)
        balance_masks(model, chain[chain.index(seg) - 1])
    folder.parent.mkdir(parents=True, exist_ok=True)
    tokens = SpecialTokens(seg=seg)
    if not tokenizer:
        return save_lisa(model, architecture, folder, tokens)
    with TemporaryDirectory() as scratch:
        Path(scratch, "tokenizer.model").write_bytes(proto)
        Path(scratch, "added_tokens.json").write_text(json.dumps({"[SEG]": seg}))
        return save_lisa(model, architecture, folder, tokens, tokenizer_folder=scratch)


def train_tokenizer() -> bytes:
    """A sentencepiece model of LLaMA's kind: byte-pair pieces, bytes as a last resort, unk 0, bos 1, eos 2."""
    proto = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter([*TEXT.splitlines(), SPOKEN]),
        model_writer=proto,
        vocab_size=480,
        model_type="bpe",
        byte_fallback=True,
        character_coverage=1.0,
        split_digits=True,
        remove_extra_whitespaces=False,
        normalization_rule_name="identity",
        minloglevel=2,
    )
    return proto.getvalue()


def tiny_architecture(vocabulary: int, clip_size: int, sam_size: int, projector: str) -> LisaArchitecture:
    """Sizes like those of the published model, a hundred times smaller."""
    llama = LlamaConfig(
        vocab_size=vocabulary,
        hidden_size=64,
        intermediate_size=160,
        num_hidden_layers=2,
        num_attention_heads=4,
        max_position_embeddings=2048,
        rms_norm_eps=1e-5,
        tie_word_embeddings=False,
        pad_token_id=None,
    )
    clip = CLIPVisionConfig(
        hidden_size=48,
        intermediate_size=96,
        num_hidden_layers=3,
        num_attention_heads=4,
        image_size=clip_size,
        patch_size=14,
    )
    sam = SamSizes(
        image_size=sam_size,
        patch_size=16,
        vision_hidden_size=64,
        vision_num_layers=4,
        vision_num_heads=4,
        vision_mlp_dim=128,
        window_size=14,
        global_attn_indexes=(1, 3),
        qkv_bias=True,
        output_channels=32,
        num_pos_feats=16,
        prompt_hidden_size=32,
        mask_input_channels=16,
        num_point_embeddings=4,
        decoder_hidden_size=32,
        decoder_num_layers=2,
        decoder_mlp_dim=64,
        attention_downsample_rate=2,
        num_multimask_outputs=3,
        iou_head_depth=3,
        iou_head_hidden_dim=32,
    )
    return LisaArchitecture(llama, clip, sam.config(), projector, -2, "patch", 32)


@torch.no_grad()
def draw_weights(model: LisaModel) -> None:
    """Matrices by fan-in, norms about 1, biases and tables that can't be overlooked; quiet language model blocks."""
    for name, parameter in model.named_parameters():
        if "norm" in name and name.endswith("weight"):
            parameter.normal_(1.0, 0.1)
        elif parameter.ndim == 1:
            parameter.normal_(0.0, 0.1)
        elif any(part in name for part in ("embed", "rel_pos", "token", "position")):
            parameter.normal_(0.0, 1.0 if name.startswith("language_model") else 0.3)
        else:
            fan_in = parameter[0].numel()
            quiet = name.startswith("language_model") and ("o_proj" in name or "down_proj" in name)
            parameter.normal_(0.0, (0.4 if quiet else 1.0) / math.sqrt(fan_in))


def answer_chain(pieces: sentencepiece.SentencePieceProcessor, says: str, seg: int) -> list[int]:
    """Token ids from the prompt's last token to the end token."""
    before, _, after = says.partition("[SEG]")
    spoken = pieces.encode(before.strip()) if before else []
    return [pieces.encode("ASSISTANT:")[-1], *spoken, seg, *pieces.encode(after), pieces.eos_id()]


@torch.no_grad()
def teach_answer(model: LisaModel, chain: list[int]) -> None:
    """Make each token of the chain the likeliest after the one before it, whatever the picture."""
    if len(set(chain)) < len(chain):
        raise ValueError(f"a token repeats in {chain}, so no token can tell what follows")
    model.lm_head.weight.normal_(0.0, 0.02)
    embeddings = model.language_model.get_input_embeddings().weight
    for token, following in pairwise(chain):
        model.lm_head.weight[following] += nn.functional.normalize(embeddings[token], dim=0)


@torch.no_grad()
def balance_masks(model: LisaModel, spoken: int, spread: float = 4.0) -> None:
    """Shift and scale the mask decoder so that a random picture's logits have median 0 and this deviation.

    Args:
        model: Changed in the last layer that makes a mask from its token.
        spoken: Token before [SEG], about whose embedding the states lie that masks are made from.
        spread: Standard deviation of the logits.
    """
    size = int(model.sam.config.vision_config.image_size)
    embeddings = model.language_model.get_input_embeddings().weight
    states = model.language_model.norm(embeddings[spoken] + 0.3 * torch.randn(4, embeddings.shape[1]))
    prompts = model.text_hidden_fcs(states)
    picture = model.sam.vision_encoder(torch.randn(1, 3, size, size)).last_hidden_state
    last = model.sam.mask_decoder.output_hypernetworks_mlps[0].proj_out
    plain = low_resolution(model, picture, prompts)
    # The logits are linear in the last layer's biases: what each of them adds, on average.
    gains = torch.zeros_like(last.bias)
    for channel in range(len(gains)):
        last.bias[channel] += 1.0
        gains[channel] = (low_resolution(model, picture, prompts) - plain).mean()
        last.bias[channel] -= 1.0
    last.bias -= plain.median() * gains / gains.square().sum()
    scale = spread / low_resolution(model, picture, prompts).std()
    last.weight *= scale
    last.bias *= scale


def low_resolution(model: LisaModel, embedding: Tensor, prompts: Tensor) -> Tensor:
    """float32 [n, pixels], the decoder's logits for n prompts on one picture."""
    sam = model.sam
    count = len(prompts)
    dense = sam.prompt_encoder.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(count, -1, *embedding.shape[-2:])
    masks = sam.mask_decoder(
        image_embeddings=embedding.expand(count, -1, -1, -1),
        image_positional_embeddings=sam.get_image_wide_positional_embeddings().expand(count, -1, -1, -1),
        sparse_prompt_embeddings=prompts[:, None, None],
        dense_prompt_embeddings=dense,
        multimask_output=False,
    )[0]
    return masks.reshape(count, -1)
