"""Mask decoding, against the unmodified transformers decoder and the original's stored tensors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa.loader import load_lisa
from cable_models.lisa.mask_decoder import (
    OUTSIDE_LOGIT,
    PROMPTS_AT_ONCE,
    continue_border,
    decode_masks,
    dense_positional_embedding,
    upsample_logits,
)
from cable_models.lisa.sam_encoder import FrameFeatures, SamFeatures, encode_tokens, grid_of
from cable_models.lisa.sam_plan import SamPlan
from torch import Tensor
from transformers import SamConfig, SamModel

GOLDENS = Path(__file__).resolve().parents[3] / "shared" / "golden"
FOLDERS = sorted(path for path in GOLDENS.glob("lisa_*") if (path / "outputs_forced.npz").is_file())
SIDE, WIDTH = 8, 16


@pytest.fixture
def sam() -> SamModel:
    """A random SAM of 8 x 8 tokens whose mask decoder has no weight left at zero."""
    torch.manual_seed(5)
    config = SamConfig(
        vision_config={
            "image_size": 64,
            "patch_size": 8,
            "hidden_size": 16,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "mlp_dim": 16,
            "window_size": 4,
            "global_attn_indexes": [0],
            "output_channels": WIDTH,
            "num_pos_feats": WIDTH // 2,
        },
        prompt_encoder_config={"hidden_size": WIDTH, "image_size": 64, "patch_size": 8},
        mask_decoder_config={
            "hidden_size": WIDTH,
            "num_attention_heads": 2,
            "mlp_dim": 32,
            "iou_head_hidden_dim": WIDTH,
            "layer_norm_eps": 1e-5,
        },
    )
    sam = SamModel(config).eval().requires_grad_(False)
    for name, weight in sam.mask_decoder.named_parameters():
        weight.normal_(1.0 if "norm" in name and "weight" in name else 0.0, 0.3)
    return sam


def random(*shape: int, seed: int = 2) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def original(sam: SamModel, embedding: Tensor, prompts: Tensor, positions: Tensor | None = None) -> Tensor:
    """The unmodified decoder as LISA calls it: one picture [C, h, w], a batch of one-token prompts [n, C]."""
    wide = sam.get_image_wide_positional_embeddings() if positions is None else positions
    dense = sam.prompt_encoder.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(1, -1, *embedding.shape[1:])
    masks, _ = sam.mask_decoder(embedding[None], wide, prompts[None, :, None], dense, multimask_output=False)[:2]
    return masks[0, :, 0]


def listed(embedding: Tensor, indexes: Tensor) -> FrameFeatures:
    return FrameFeatures(embedding.flatten(1).T[indexes], indexes)


def test_whole_frames_share_passes_and_keep_their_own_prompts(sam: SamModel) -> None:
    maps = random(4, WIDTH, SIDE, SIDE)
    prompts = [random(2, WIDTH), random(0, WIDTH), random(PROMPTS_AT_ONCE + 3, WIDTH, seed=3), random(1, WIDTH, seed=4)]
    found = decode_masks(sam, SamFeatures(tuple(FrameFeatures(values) for values in maps), SIDE), prompts)
    for values, prompt, masks in zip(maps, prompts, found, strict=True):
        assert masks.shape == (len(prompt), 4 * SIDE, 4 * SIDE)
        if len(prompt):
            torch.testing.assert_close(masks, original(sam, values, prompt), rtol=1e-4, atol=1e-4)


def test_a_shuffled_list_of_all_tokens_gives_the_unmodified_decoder(sam: SamModel) -> None:
    """Holds only if the upscaling of a token sees no other token, and positions follow their tokens."""
    embedding, prompts = random(WIDTH, SIDE, SIDE), random(3, WIDTH, seed=3)
    indexes = torch.randperm(SIDE * SIDE, generator=torch.Generator().manual_seed(0))
    found = decode_masks(sam, SamFeatures((listed(embedding, indexes),), SIDE), [prompts])[0]
    torch.testing.assert_close(found, original(sam, embedding, prompts), rtol=1e-4, atol=1e-4)


def test_a_rectangle_of_tokens_is_the_decoder_on_that_rectangle(sam: SamModel) -> None:
    embedding, prompts = random(WIDTH, SIDE, SIDE), random(2, WIDTH, seed=3)
    rows, columns = slice(2, 5), slice(3, 8)
    indexes = torch.arange(SIDE * SIDE).view(SIDE, SIDE)[rows, columns].flatten()
    found = decode_masks(sam, SamFeatures((listed(embedding, indexes),), SIDE), [prompts])[0]
    positions = sam.get_image_wide_positional_embeddings()[:, :, rows, columns]
    expected = original(sam, embedding[:, rows, columns], prompts, positions)
    torch.testing.assert_close(found[:, 8:20, 12:32], expected, rtol=1e-4, atol=1e-4)
    # One pixel beyond the rectangle its border is repeated, everything else is outside.
    repeated = cv2.copyMakeBorder(expected[1].numpy(), 1, 1, 1, 0, cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(found[1, 7:21, 11:32].numpy(), repeated, rtol=1e-4, atol=1e-4)
    rest = torch.ones(4 * SIDE, 4 * SIDE, dtype=torch.bool)
    rest[7:21, 11:32] = False
    assert (found[:, rest] == OUTSIDE_LOGIT).all()


def test_frames_of_all_kinds_in_one_batch(sam: SamModel) -> None:
    embedding, prompts = random(WIDTH, SIDE, SIDE), random(2, WIDTH, seed=3)
    part = listed(embedding, torch.tensor([3, 12, 13]))
    nothing = FrameFeatures(embedding.new_zeros(0, WIDTH), torch.zeros(0, dtype=torch.int64))
    frames = (part, FrameFeatures(embedding), nothing, part)
    found = decode_masks(sam, SamFeatures(frames, SIDE), [prompts, prompts, prompts, prompts[:0]])
    torch.testing.assert_close(found[1], original(sam, embedding, prompts), rtol=1e-4, atol=1e-4)
    assert (found[0][:, :4, 12:16] != OUTSIDE_LOGIT).all()
    assert (found[2] == OUTSIDE_LOGIT).all()
    assert found[2].shape == (2, 4 * SIDE, 4 * SIDE)
    assert found[3].shape == (0, 4 * SIDE, 4 * SIDE)


def test_corners_are_continued_and_kept_values_are_left_alone() -> None:
    values = torch.full((1, 5, 5), -9.0)
    kept = torch.zeros(5, 5, dtype=torch.bool)
    kept[1, 1] = kept[3, 3] = True
    values[0, 1, 1], values[0, 3, 3] = 2.0, 5.0
    expected = torch.tensor(
        [[2, 2, 2, -9, -9], [2, 2, 2, -9, -9], [2, 2, 2, 5, 5], [-9, -9, 5, 5, 5], [-9, -9, 5, 5, 5]]
    ).float()
    assert torch.equal(continue_border(values, kept)[0], expected)


def test_enlarging_does_not_erode_a_mask_that_fills_the_kept_region() -> None:
    """A frame of 1.5625 pixels per input pixel; every frame pixel whose centre is inside keeps the region's value."""
    kept = torch.zeros(64, 64, dtype=torch.bool)
    kept[16:32, 8:20] = True
    values = torch.where(kept, 3.0, OUTSIDE_LOGIT)[None]
    low, high = (upsample_logits(v, (144, 256), (225, 400), 256)[0] for v in (values, continue_border(values, kept)))
    y, x = ((np.arange(size) + 0.5) * 0.64 for size in (225, 400))
    inside = ((y >= 64) & (y <= 128))[:, None] & ((x >= 32) & (x <= 80))
    assert (high[torch.from_numpy(inside)] == 3.0).all()
    assert (low[torch.from_numpy(inside)] < 0).any()
    beyond = ((y < 64 - 4) | (y > 128 + 4))[:, None] | ((x < 32 - 4) | (x > 80 + 4))
    assert (high[torch.from_numpy(beyond)] < 0).all()


@pytest.mark.skipif(not FOLDERS, reason=f"no reference tensors of the original code in {GOLDENS}")
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: path.name)
@pytest.mark.parametrize("name", ["forced", "generate"])
def test_enlarged_logits_are_the_originals(folder: Path, name: str) -> None:
    inputs, outputs = np.load(folder / "inputs.npz"), np.load(folder / f"outputs_{name}.npz")
    frame_hw, resized_hw = (tuple(inputs[key].tolist()) for key in ("original_size", "resize_size"))
    low_res = torch.from_numpy(outputs["low_res_masks"])
    found = upsample_logits(low_res, resized_hw, frame_hw, inputs["images_sam"].shape[-1])
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), outputs["mask_logits"], rtol=0, atol=1e-5)
    assert np.array_equal(found.numpy() > 0, outputs["masks"])


@pytest.mark.skipif(not FOLDERS, reason=f"no reference tensors of the original code in {GOLDENS}")
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: path.name)
def test_a_list_of_all_tokens_gives_the_originals_masks(folder: Path) -> None:
    """The way of partial frames, on every token: encoder, neck, decoder and scattering against the stored tensors."""
    network = load_lisa(str(folder), dtype=torch.float32).model.sam
    inputs, outputs = np.load(folder / "inputs.npz"), np.load(folder / "outputs_forced.npz")
    grid = grid_of(network.vision_encoder)
    every = SamPlan(grid, np.ones((grid.side, grid.side), np.bool_))
    with torch.inference_mode():
        pixels = torch.from_numpy(inputs["images_sam"])
        features = SamFeatures(tuple(encode_tokens(network.vision_encoder, pixels, {0: every})), grid.side)
        masks = decode_masks(network, features, [torch.from_numpy(outputs["seg_embeddings"])])[0].numpy()
    embedding = np.load(folder / "shared_features.npz")["sam_image_embedding"][0]
    assert features.frames[0].indexes is not None
    expected = embedding.reshape(len(embedding), -1).T[features.frames[0].indexes.numpy()]
    np.testing.assert_allclose(features.frames[0].values.numpy(), expected, rtol=0, atol=1e-4 * abs(expected).max())
    stored = outputs["low_res_masks"][:, 0]
    np.testing.assert_allclose(masks, stored, rtol=0, atol=1e-4 * abs(stored).max())


def test_enlarging_half_precision_and_nothing() -> None:
    found = upsample_logits(torch.full((2, 64, 64), 1.5, dtype=torch.bfloat16), (144, 256), (90, 160), 256)
    assert found.dtype == torch.float32
    assert found.shape == (2, 90, 160)
    assert (found == 1.5).all()
    assert upsample_logits(torch.zeros(0, 64, 64), (144, 256), (90, 160), 256).shape == (0, 90, 160)
    with pytest.raises(ModelError, match=r"must be \[n, rows, columns\], got \[2, 4, 8, 8\]"):
        upsample_logits(torch.zeros(2, 4, 8, 8), (8, 8), (8, 8), 8)


def test_positions_are_computed_once_and_again_after_the_weights_change(sam: SamModel) -> None:
    first = dense_positional_embedding(sam)
    assert torch.equal(first, sam.get_image_wide_positional_embeddings())
    assert dense_positional_embedding(sam) is first
    weight = sam.shared_image_embedding.positional_embedding
    weight.copy_(torch.randn(weight.shape))
    assert torch.equal(dense_positional_embedding(sam), sam.get_image_wide_positional_embeddings())
    assert dense_positional_embedding(sam.bfloat16()).dtype == torch.bfloat16


def test_prompts_that_do_not_fit_are_refused(sam: SamModel) -> None:
    features = SamFeatures((FrameFeatures(random(WIDTH, SIDE, SIDE)),), SIDE)
    for prompts in ([], [random(2, WIDTH + 1)], [random(WIDTH)]):
        with pytest.raises(ModelError, match=r"1 frames need as many prompts \[n_seg, 16\]"):
            decode_masks(sam, features, prompts)
