"""Comparison of a loaded model with stored tensors of the original code, stage by stage.

A golden is a folder with a checkpoint in the original layout and four archives: ``inputs.npz``,
``shared_features.npz``, ``outputs_forced.npz`` and ``outputs_generate.npz``. Nothing about its sizes is known here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cable_models.errors import ModelError
from cable_models.lisa.clip_tower import clip_transformer, patch_features, project
from cable_models.lisa.decoding import Answer, ForcedPrompt, force, generate
from cable_models.lisa.images import clip_geometry, clip_input, sam_input
from cable_models.lisa.language import ImageTokens, segmentation_embeddings, source_indices, splice
from cable_models.lisa.loader import LoadedLisa
from cable_models.lisa.mask_decoder import decode_masks, dense_positional_embedding, upsample_logits
from cable_models.lisa.sam_encoder import SamFeatures, encode, grid_of
from cable_models.lisa.stage_timer import StageTimer

Array = npt.NDArray[Any]
Computed = dict[str, Array]

FLOAT_LIMIT = 1e-4
"""Largest error of a float array, relative to the largest absolute value of the stored one."""
MASK_LIMIT = 1e-4
"""Largest share of differing mask pixels."""


@dataclass(frozen=True, slots=True)
class StageError:
    """How far one computed array is from the stored one."""

    stage: str
    """"inputs", "features", "forced" or "generate"."""
    array: str
    error: float
    """Relative error of floats, share of differing mask pixels, number of differing ids; infinite if shapes differ."""
    limit: float

    @property
    def passed(self) -> bool:
        """Whether it is within the limit."""
        return self.error <= self.limit


@torch.inference_mode()
def compare_golden(loaded: LoadedLisa, folder: Path) -> list[StageError]:
    """Runs a golden's inputs and compares every array that both sides have.

    Args:
        loaded: The golden's checkpoint in float32.
        folder: Where its archives lie.

    Raises:
        ModelError: an archive is missing or damaged, or lacks an input.
    """
    inputs = read_archive(folder / "inputs.npz")
    stored = {name: read_archive(folder / f"{name}.npz") for name in ("outputs_forced", "outputs_generate")}
    try:
        computed = {"inputs": compute_inputs(loaded, inputs)}
        image, features, computed["features"] = compute_features(loaded, inputs)
        computed["forced"] = compute_forced(loaded, inputs, image, features)
        longest = stored["outputs_generate"]["token_ids"].shape[1] - inputs["input_ids_prompt"].shape[1]
        computed["generate"] = compute_generated(loaded, inputs, image, features, longest)
    except KeyError as error:
        raise ModelError(f"the golden in {folder} lacks the array {error}") from error
    truth = {
        "inputs": inputs,
        "features": read_archive(folder / "shared_features.npz"),
        "forced": stored["outputs_forced"],
        "generate": stored["outputs_generate"],
    }
    return [
        compared(stage, name, array, truth[stage][name])
        for stage, arrays in computed.items()
        for name, array in arrays.items()
        if name in truth[stage]
    ]


def read_archive(path: Path) -> Computed:
    """The arrays of an ``.npz`` file.

    Raises:
        ModelError: it is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError) as error:
        raise ModelError(f"{path} can't be read: {error}; a golden has four archives beside its weights") from error


def compared(stage: str, name: str, computed: Array, stored: Array) -> StageError:
    """The error of one array, by its kind."""
    limit = {"f": FLOAT_LIMIT, "b": MASK_LIMIT}.get(stored.dtype.kind, 0.0)
    if computed.shape != stored.shape:
        return StageError(stage, name, float("inf"), limit)
    if stored.dtype.kind == "f":
        scale = float(np.abs(stored).max(initial=0.0)) or 1.0
        return StageError(stage, name, float(np.abs(computed - stored).max(initial=0.0)) / scale, limit)
    different = np.count_nonzero(computed != stored)
    return StageError(stage, name, different / max(stored.size, 1) if limit else float(different), limit)


def compute_inputs(loaded: LoadedLisa, inputs: Computed) -> Computed:
    """Both encoders' inputs from the camera frame."""
    frame = np.ascontiguousarray(inputs["image_uint8"][..., ::-1], np.uint8)
    clip = loaded.clip_preprocessing
    geometry = clip_geometry((frame.shape[0], frame.shape[1]), clip.size)
    sam_pixels, resized = sam_input(frame, grid_of(loaded.model.sam.vision_encoder).image_size)
    return {
        "original_size": np.array(frame.shape[:2]),
        "resize_size": np.array(resized),
        "images_clip": clip_input(frame, geometry, clip.mean, clip.std)[None],
        "images_sam": sam_pixels[None],
    }


def compute_features(loaded: LoadedLisa, inputs: Computed) -> tuple[ImageTokens, SamFeatures, Computed]:
    """Everything that doesn't depend on the text, from the stored inputs of both encoders."""
    model = loaded.model
    clip_pixels = torch.from_numpy(inputs["images_clip"]).to(model.device)
    sam_pixels = torch.from_numpy(inputs["images_sam"]).to(model.device)
    patches = patch_features(model, clip_pixels)
    tokens = project(model, patches)
    features = encode(model.sam.vision_encoder, sam_pixels)
    embedding = features.frames[0].values
    no_mask = model.sam.prompt_encoder.no_mask_embed.weight
    computed = {
        "clip_hidden_states": clip_hidden_states(loaded, clip_pixels),
        "clip_patch_features": patches[0][None],
        "image_features": tokens[0][None],
        "sam_image_embedding": embedding[None],
        "dense_pe": dense_positional_embedding(model.sam),
        "dense_embeddings": no_mask.reshape(1, -1, 1, 1).expand(1, -1, *embedding.shape[1:]),
    }
    image = ImageTokens(tokens[0], None, loaded.architecture.image_tokens)
    return image, features, as_arrays(computed)


def clip_hidden_states(loaded: LoadedLisa, pixels: Tensor) -> Tensor:
    """[layers + 1, 1, patches + 1, width], of every layer, those above the selected one too."""
    tower = clip_transformer(loaded.model.vision_tower)
    states = [tower.pre_layrnorm(tower.embeddings(pixels))]
    for layer in tower.encoder.layers:
        output = layer(states[-1], None)
        states.append(output[0] if isinstance(output, tuple) else output)
    return torch.stack(states)


def compute_forced(loaded: LoadedLisa, inputs: Computed, image: ImageTokens, features: SamFeatures) -> Computed:
    """The teacher-forced pass: all hidden states as the original has them, masks as the pipeline makes them."""
    prompt, everything = (inputs[name][0].tolist() for name in ("input_ids_prompt", "input_ids_forced"))
    forced = ForcedPrompt(tuple(prompt), tuple(everything[len(prompt) :]), image, verify=False)
    timer = StageTimer(loaded.model.device)
    (answer,) = force(loaded.model, loaded.tokens, [forced], compact=False, timer=timer)
    return compute_text(loaded, everything, everything, image) | compute_masks(loaded, inputs, features, answer)


def compute_generated(
    loaded: LoadedLisa, inputs: Computed, image: ImageTokens, features: SamFeatures, longest: int
) -> Computed:
    """Greedy decoding with a cache; its ids are compared with those of the uncached path as well.

    Raises:
        ModelError: cached and uncached decoding disagree.
    """
    prompt = inputs["input_ids_prompt"][0].tolist()
    answers = [
        generate(
            loaded.model,
            loaded.tokens,
            prompt,
            image,
            max_new_tokens=longest,
            compact=False,
            timer=StageTimer(loaded.model.device),
            use_cache=use_cache,
        )
        for use_cache in (True, False)
    ]
    if answers[0].ids != answers[1].ids:
        raise ModelError(f"with a key-value cache the answer is {answers[0].ids}, without {answers[1].ids}")
    everything = [*prompt, *answers[0].ids]
    text = compute_text(loaded, everything, everything[:-1], image)
    return text | compute_masks(loaded, inputs, features, answers[0])


def compute_text(loaded: LoadedLisa, everything: Sequence[int], run: Sequence[int], image: ImageTokens) -> Computed:
    """Every hidden state and logit of one pass over ``run``, and where the [SEG] tokens of ``everything`` look."""
    model, seg = loaded.model, loaded.tokens.seg
    spliced = splice(model, run, image, loaded.tokens.image_placeholder, compact=False)
    output = model.language_model(inputs_embeds=spliced.embeddings[None], use_cache=False, output_hidden_states=True)
    positions = [index for index, token in enumerate(everything) if token == seg]
    return {
        "token_ids": np.array([everything]),
        "seg_positions_in_ids": np.array(positions, np.int64),
        "seg_source_positions_expanded": np.array(source_indices(everything, spliced, seg), np.int64),
    } | as_arrays(
        {
            "inputs_embeds": spliced.embeddings[None],
            "llm_hidden_states_all": torch.stack(output.hidden_states),
            "llm_last_hidden": output.last_hidden_state,
            "logits": model.lm_head(output.last_hidden_state),
        }
    )


def compute_masks(loaded: LoadedLisa, inputs: Computed, features: SamFeatures, answer: Answer) -> Computed:
    """[SEG] embeddings and masks of an answer."""
    model = loaded.model
    embeddings = segmentation_embeddings(model, answer.states)
    low_resolution = decode_masks(model.sam, features, [embeddings])[0]
    frame_hw, resized = (tuple(inputs[name].tolist()) for name in ("original_size", "resize_size"))
    logits = upsample_logits(low_resolution, resized, frame_hw, grid_of(loaded.model.sam.vision_encoder).image_size)
    computed = {
        "seg_embeddings": embeddings,
        "sparse_embeddings": embeddings[:, None],
        "low_res_masks": low_resolution[:, None],
        "mask_logits": logits,
        "masks": logits > 0,
    }
    return as_arrays(computed)


def as_arrays(tensors: Mapping[str, Tensor]) -> Computed:
    """The tensors on the host."""
    return {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
