"""SAM's encoder on chosen tokens, against the unmodified transformers module and a masked, slow reading of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa.sam_encoder import FrameFeatures, embed_patches, encode, encode_tokens, grid_of, pack, run_layer
from cable_models.lisa.sam_plan import BoolGrid, SamPlan, plan_sam
from torch import Tensor, nn
from transformers import SamConfig, SamModel

FRAMES = {"landscape": (90, 160), "portrait": (160, 90)}


def small_sam(image_size: int = 96, window: int = 5, **vision: object) -> SamModel:
    """A random SAM of 12 x 12 tokens, by default with windows that hang over by 3; no weight is left at zero."""
    torch.manual_seed(3)
    config = SamConfig(
        vision_config={
            "image_size": image_size,
            "patch_size": 8,
            "hidden_size": 32,
            "num_hidden_layers": 5,
            "num_attention_heads": 2,
            "mlp_dim": 64,
            "window_size": window,
            "global_attn_indexes": [2, 4],
            "output_channels": 16,
            "num_pos_feats": 8,
            **vision,
        },
        prompt_encoder_config={"hidden_size": 16, "image_size": image_size, "patch_size": 8},
        mask_decoder_config={"hidden_size": 16, "num_attention_heads": 2, "mlp_dim": 32, "iou_head_hidden_dim": 16},
    )
    sam = SamModel(config).eval().requires_grad_(False)
    for name, weight in sam.vision_encoder.named_parameters():
        weight.normal_(1.0 if "norm" in name and "weight" in name else 0.0, 0.3)
    return sam


def blob(frame_hw: tuple[int, int]) -> BoolGrid:
    """Two rectangles that leave most windows alone."""
    roi = np.zeros(frame_hw, np.bool_)
    roi[8:30, 20:42] = True
    roi[60:80, 30:55] = True
    return roi


def plan_of(sam: SamModel, frame: str, padding: str, windows: str, margin: int = 0) -> SamPlan:
    hw = FRAMES[frame]
    grid = grid_of(sam.vision_encoder)
    return plan_sam(blob(hw), hw, grid, padding=padding, windows=windows, margin=margin)  # type: ignore[arg-type]


def pictures(sam: SamModel, count: int) -> Tensor:
    """Random input whose lower half is zero padding."""
    size = sam.config.vision_config.image_size
    pixels = torch.randn(count, 3, size, size, generator=torch.Generator().manual_seed(1))
    pixels[:, :, size * 9 // 16 :] = 0
    return pixels


def block_outputs(encoder: nn.Module, pixels: Tensor) -> list[Tensor]:
    """What every block of the unmodified module gives, [B, side, side, C] each."""
    outputs: list[Tensor] = []
    hooks = [layer.register_forward_hook(lambda *call: outputs.append(call[2])) for layer in encoder.layers]
    encoder(pixels)
    for hook in hooks:
        hook.remove()
    return outputs


def masked_attention(attention: nn.Module, tokens: Tensor, hidden: Tensor) -> Tensor:
    """The original's formula on a full rectangle [b, h, w, C] with keys that are hidden ([b, h, w]) left out."""
    batch, height, width, channels = tokens.shape
    heads = attention.num_attention_heads
    qkv = attention.qkv(tokens).reshape(batch, height * width, 3, heads, -1).permute(2, 0, 3, 1, 4)
    query, key, value = qkv.reshape(3, batch * heads, height * width, -1).unbind(0)
    scores = query * attention.scale @ key.transpose(1, 2)
    if attention.use_rel_pos:
        size = (height, width)
        bias = attention.get_decomposed_rel_pos(query, attention.rel_pos_h, attention.rel_pos_w, size, size)
        scores = scores + bias.reshape_as(scores)
    scores = scores.masked_fill(hidden.reshape(batch, 1, -1).repeat_interleave(heads, 0), float("-inf"))
    # A window without any key gives no number; none of its queries is looked at.
    mixed = scores.softmax(-1).nan_to_num() @ value
    mixed = mixed.view(batch, heads, height, width, -1).permute(0, 2, 3, 1, 4).reshape(batch, height, width, channels)
    return attention.proj(mixed)


def masked_encoder(encoder: nn.Module, pixels: Tensor, kept: Tensor) -> Tensor:
    """The whole network on the full grid, tokens outside `kept` hidden from all others; [C, side, side]."""
    hidden = encoder.patch_embed(pixels[None])
    if encoder.pos_embed is not None:
        hidden = hidden + encoder.pos_embed
    for layer in encoder.layers:
        normed, away = layer.layer_norm1(hidden), ~kept[None]
        if layer.window_size:
            windows, padded = layer.window_partition(normed, layer.window_size)
            cut_away, _ = layer.window_partition(away[..., None], layer.window_size)
            mixed = masked_attention(layer.attn, windows, cut_away[..., 0])
            mixed = layer.window_unpartition(mixed, layer.window_size, padded, away.shape[1:])
        else:
            mixed = masked_attention(layer.attn, normed, away)
        hidden = hidden + mixed
        hidden = hidden + layer.mlp(layer.layer_norm2(hidden))
    neck = encoder.neck
    narrow = neck.layer_norm1(neck.conv1(hidden.permute(0, 3, 1, 2)))
    framed = nn.functional.pad(narrow, (1, 1, 1, 1))
    known = nn.functional.pad(kept, (1, 1, 1, 1), value=True)
    result = torch.zeros_like(narrow)
    for row, column in torch.nonzero(kept).tolist():
        around = framed[:, :, row : row + 3, column : column + 3]
        here = known[row : row + 3, column : column + 3]
        patch = torch.where(here, around, narrow[:, :, row, column, None, None])
        result[:, :, row, column] = nn.functional.conv2d(patch, neck.conv2.weight)[:, :, 0, 0]
    return neck.layer_norm2(result)[0]


def on_map(frame: FrameFeatures, side: int) -> Tensor:
    assert frame.indexes is not None
    flat = frame.values.new_full((side * side, frame.values.shape[1]), float("nan"))
    return flat.index_copy(0, frame.indexes, frame.values).T.reshape(-1, side, side)


@pytest.mark.parametrize("vision", [{}, {"use_rel_pos": False}, {"use_abs_pos": False, "qkv_bias": False}], ids=str)
@pytest.mark.parametrize("window", [5, 4], ids=["overhang", "even"])
def test_a_list_of_all_tokens_gives_the_unmodified_network(window: int, vision: dict[str, object]) -> None:
    sam = small_sam(window=window, **vision)
    pixels = pictures(sam, 1)
    grid = grid_of(sam.vision_encoder)
    every = SamPlan(grid, np.ones((grid.side, grid.side), np.bool_))
    found = on_map(encode_tokens(sam.vision_encoder, pixels, {0: every})[0], grid.side)
    torch.testing.assert_close(found, sam.vision_encoder(pixels)[0][0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(("padding", "windows"), [("drop", "all"), ("always", "all"), ("keep", "skip")])
def test_kept_windows_are_exact_up_to_the_first_global_block(frame: str, padding: str, windows: str) -> None:
    sam = small_sam()
    encoder, pixels = sam.vision_encoder, pictures(sam, 1)
    if frame == "portrait":
        pixels = pixels.transpose(2, 3).contiguous()
    plan = plan_of(sam, frame, padding, windows)
    assert 0 < plan.token_count < plan.tokens.size
    packed = pack([(0, plan.layout())], pixels.device)
    hidden = embed_patches(encoder, pixels, packed)
    expected = block_outputs(encoder, pixels)
    for number, layer in enumerate(encoder.layers[:2]):
        hidden = run_layer(layer, hidden, packed)
        original = expected[number][0, packed.rows, packed.columns]
        torch.testing.assert_close(hidden, original, rtol=1e-4, atol=1e-4)
    after_global = run_layer(encoder.layers[2], hidden, packed)
    assert not torch.allclose(after_global, expected[2][0, packed.rows, packed.columns], atol=1e-2)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("windows", ["all", "skip", "tokens"])
@pytest.mark.parametrize("vision", [{}, {"use_rel_pos": False}], ids=str)
def test_partial_encoding_is_the_network_with_the_other_tokens_hidden(
    frame: str, windows: str, vision: dict[str, object]
) -> None:
    sam = small_sam(**vision)
    pixels, plan = pictures(sam, 1), plan_of(sam, frame, "drop", windows)
    found = encode(sam.vision_encoder, pixels, [plan])
    expected = masked_encoder(sam.vision_encoder, pixels[0], torch.from_numpy(plan.tokens))
    kept = torch.from_numpy(plan.tokens)
    torch.testing.assert_close(on_map(found.frames[0], found.side)[:, kept], expected[:, kept], rtol=1e-4, atol=1e-4)


def test_frames_of_one_batch_do_not_touch_each_other() -> None:
    sam = small_sam()
    pixels = pictures(sam, 5)
    encoder, grid = sam.vision_encoder, grid_of(sam.vision_encoder)
    nothing = SamPlan(grid, np.zeros((grid.side, grid.side), np.bool_))
    plans = [
        plan_of(sam, "landscape", "drop", "skip"),
        None,
        nothing,
        plan_of(sam, "portrait", "keep", "tokens", margin=1),
        plan_sam(None, (90, 160), grid, padding="drop", windows="skip"),
    ]
    together = encode(encoder, pixels, plans).frames
    for number, plan in enumerate(plans):
        alone = encode(encoder, pixels[number : number + 1], [plan]).frames[0]
        torch.testing.assert_close(together[number].values, alone.values, rtol=1e-4, atol=1e-4)
        assert (together[number].indexes is None) == (plan is None or plan.whole)
    assert together[2].values.shape == (0, 16)
    assert encode(encoder, pixels[:1], [nothing]).frames[0].values.shape == (0, 16)


def test_whole_frames_are_bit_identical_to_the_unmodified_module() -> None:
    sam = small_sam()
    pixels = pictures(sam, 2)
    expected = sam.vision_encoder(pixels)[0]
    whole = plan_sam(
        np.ones((90, 160), np.bool_), (90, 160), grid_of(sam.vision_encoder), padding="drop", windows="skip"
    )
    for plans in (None, [None, whole]):
        found = encode(sam.vision_encoder, pixels, plans)
        assert torch.equal(torch.stack([frame.values for frame in found.frames]), expected)


def test_half_precision_stays_half_precision() -> None:
    sam = small_sam()
    plan = plan_of(sam, "landscape", "drop", "tokens")
    exact = encode(sam.vision_encoder, pictures(sam, 1), [plan]).frames[0].values
    half = encode(sam.vision_encoder.bfloat16(), pictures(sam, 1).bfloat16(), [plan]).frames[0].values
    assert half.dtype == torch.bfloat16
    assert float((half.float() - exact).abs().mean()) < 0.1 * float(exact.abs().mean())


def test_what_does_not_fit_the_encoder_is_refused() -> None:
    sam = small_sam()
    with pytest.raises(ModelError, match=r"SAM takes pixels \[B, 3, 96, 96\]"):
        encode(sam.vision_encoder, torch.zeros(1, 3, 96, 88))
    with pytest.raises(ModelError, match="1 SAM plans were given for 2 frames"):
        encode(sam.vision_encoder, pictures(sam, 2), [None])
    other = plan_of(small_sam(window=4), "landscape", "drop", "skip")
    with pytest.raises(ModelError, match="made for other sizes"):
        encode(sam.vision_encoder, pictures(sam, 1), [other])
