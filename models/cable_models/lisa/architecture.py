"""What a LISA++ checkpoint is made of: the sizes of its language model, its CLIP tower, its projector and its SAM."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from transformers import CLIPVisionConfig, LlamaConfig, SamConfig

from cable_models.errors import ModelError
from cable_models.lisa.images import CLIP_MEAN, CLIP_STD
from cable_models.lisa.sam_sizes import Shapes, read_sam_sizes

_CLIP_FIELDS = (
    "hidden_size",
    "intermediate_size",
    "num_hidden_layers",
    "num_attention_heads",
    "num_channels",
    "image_size",
    "patch_size",
    "hidden_act",
    "layer_norm_eps",
)


@dataclass(frozen=True, slots=True)
class ClipPreprocessing:
    """How a frame becomes CLIP's input: a square of `size` pixels, then (x / 255 - mean) / std per RGB channel."""

    size: int
    mean: tuple[float, float, float] = CLIP_MEAN
    std: tuple[float, float, float] = CLIP_STD


@dataclass(frozen=True, slots=True)
class LisaArchitecture:
    """Sizes of every part of a LISA++ model.

    Attributes:
        llama: The language model.
        clip: The image tower the language model sees through.
        sam: The segmenter, image encoder included.
        projector: "linear" or "mlpNx_gelu" (N linear layers with exact GELU between), from CLIP to the language model.
        select_layer: Index into CLIP's hidden states, number 0 being the embedding; -2 is the block before the last.
        select_feature: "patch" drops CLIP's class token, "cls_patch" keeps it in front.
        out_dim: Numbers per [SEG] embedding, SAM's prompt width.
    """

    llama: LlamaConfig
    clip: CLIPVisionConfig
    sam: SamConfig
    projector: str
    select_layer: int
    select_feature: str
    out_dim: int

    @property
    def patch_grid(self) -> int:
        """Patches along one side of CLIP's square input."""
        return square_side(self.clip.image_size) // square_side(self.clip.patch_size)

    @property
    def image_tokens(self) -> int:
        """Tokens one whole picture becomes in the language model's input."""
        return self.patch_grid**2 + (self.select_feature == "cls_patch")

    @property
    def projector_layers(self) -> int:
        """Linear layers of the projector."""
        return projector_depth(self.projector)


def square_side(size: int | list[int] | tuple[int, int] | None) -> int:
    """Give the side of a square that a configuration writes as a number or as a pair.

    Raises:
        ModelError: It isn't a square.
    """
    sides = {size} if isinstance(size, int) else set(size or ())
    if len(sides) != 1:
        raise ModelError(f"a square was expected where the CLIP tower's configuration says {size}")
    return sides.pop()


def projector_depth(projector: str) -> int:
    """Give the number of linear layers of a projector type.

    Raises:
        ModelError: The type is neither "linear" nor "mlpNx_gelu".
    """
    if projector == "linear":
        return 1
    match = re.fullmatch(r"mlp([1-9]\d*)x_gelu", projector)
    if match is None:
        raise ModelError(f"projector type {projector!r}: only linear and mlpNx_gelu are known")
    return int(match[1])


def read_architecture(
    config: Mapping[str, Any],
    shapes: Shapes,
    clip_config: Mapping[str, Any],
    sam_sizes: Mapping[str, Any] | None = None,
) -> LisaArchitecture:
    """Read a model's sizes from its files.

    Args:
        config: The checkpoint's `config.json`, in the original style.
        shapes: Shapes of the checkpoint's tensors under their original names.
        clip_config: `config.json` of the CLIP tower, of a whole CLIP or of its image half.
        sam_sizes: Content of the `sam*.json` beside the checkpoint; None infers everything from the tensors.

    Raises:
        ModelError: A size is missing, of a kind that isn't known, or two sources contradict each other.
    """
    sam = read_sam_sizes(shapes, sam_sizes)
    clip = read_clip_config(clip_config)
    feature = str(config.get("mm_vision_select_feature") or "patch")
    if feature not in ("patch", "cls_patch"):
        raise ModelError(f"config.json: mm_vision_select_feature {feature!r} is neither 'patch' nor 'cls_patch'")
    layer = int(config.get("mm_vision_select_layer", -2))
    if not -clip.num_hidden_layers - 1 <= layer <= clip.num_hidden_layers:
        raise ModelError(
            f"config.json: mm_vision_select_layer {layer} isn't among the {clip.num_hidden_layers + 1} hidden states "
            "of the CLIP tower"
        )
    out_dim = _out_dim(config, shapes)
    if out_dim != sam.prompt_hidden_size:
        raise ModelError(f"[SEG] embeddings of {out_dim} numbers don't fit SAM's prompts of {sam.prompt_hidden_size}")
    return LisaArchitecture(
        llama=_llama_config(config, shapes),
        clip=clip,
        sam=sam.config(),
        projector=_projector(config, shapes, clip.hidden_size),
        select_layer=layer,
        select_feature=feature,
        out_dim=out_dim,
    )


def read_clip_config(config: Mapping[str, Any]) -> CLIPVisionConfig:
    """Read the sizes of a CLIP image tower from its `config.json`; a whole CLIP's is taken apart.

    Sizes the file leaves out are the format's defaults.

    Raises:
        ModelError: It's the configuration of another kind of model.
    """
    vision = config.get("vision_config", config)
    kind = vision.get("model_type", "clip_vision_model")
    if kind != "clip_vision_model":
        raise ModelError(f"the CLIP tower's config.json is of a {kind!r}; a CLIPModel or CLIPVisionModel was expected")
    given = {name: vision[name] for name in _CLIP_FIELDS if vision.get(name) is not None}
    return CLIPVisionConfig(**given)


def read_clip_preprocessing(config: Mapping[str, Any] | None, clip: CLIPVisionConfig) -> ClipPreprocessing:
    """Read CLIP's input geometry and statistics.

    Args:
        config: The tower's `preprocessor_config.json`; None takes the published CLIP's statistics.
        clip: The tower's sizes.

    Raises:
        ModelError: The two files speak of different picture sizes, or the statistics aren't of three channels.
    """
    size = square_side(clip.image_size)
    if config is None:
        return ClipPreprocessing(size)
    crop = config.get("crop_size", size)
    sides = {int(side) for side in crop.values()} if isinstance(crop, Mapping) else {int(crop)}
    if sides != {size}:
        raise ModelError(
            f"the CLIP tower's preprocessor_config.json crops to {sorted(sides)} pixels, its config.json says {size}"
        )
    return ClipPreprocessing(size, _channels(config, "image_mean", CLIP_MEAN), _channels(config, "image_std", CLIP_STD))


def _channels(config: Mapping[str, Any], name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    values = config.get(name) or default
    if len(values) != 3:
        raise ModelError(f"the CLIP tower's preprocessor_config.json: {name} has {len(values)} channels, not 3")
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _llama_config(config: Mapping[str, Any], shapes: Shapes) -> LlamaConfig:
    needed = ("intermediate_size", "num_hidden_layers", "num_attention_heads")
    if missing := [name for name in needed if config.get(name) is None]:
        raise ModelError(f"config.json doesn't give {', '.join(missing)} of the language model")
    vocabulary, hidden = _matrix(shapes, "model.embed_tokens.weight")
    if config.get("hidden_size", hidden) != hidden:
        raise ModelError(f"config.json: hidden_size {config['hidden_size']}, model.embed_tokens.weight has {hidden}")
    rope = dict(config.get("rope_parameters") or config.get("rope_scaling") or {})
    rope["rope_type"] = rope.pop("type", rope.get("rope_type", "default"))
    rope.setdefault("rope_theta", float(config.get("rope_theta") or 10000.0))
    return LlamaConfig(
        vocab_size=vocabulary,
        hidden_size=hidden,
        intermediate_size=config["intermediate_size"],
        num_hidden_layers=config["num_hidden_layers"],
        num_attention_heads=config["num_attention_heads"],
        num_key_value_heads=config.get("num_key_value_heads") or config["num_attention_heads"],
        hidden_act=config.get("hidden_act") or "silu",
        max_position_embeddings=config.get("max_position_embeddings") or 2048,
        rms_norm_eps=config.get("rms_norm_eps") or 1e-6,
        rope_parameters=rope,
        attention_bias=bool(config.get("attention_bias", False)),
        tie_word_embeddings=False,
        pad_token_id=None,
        use_cache=True,
    )


def _projector(config: Mapping[str, Any], shapes: Shapes, clip_width: int) -> str:
    prefix = "model.mm_projector."
    layers = sum(bool(re.fullmatch(rf"{re.escape(prefix)}\d+\.weight", name)) for name in shapes)
    seen = "linear" if f"{prefix}weight" in shapes else f"mlp{layers}x_gelu"
    if seen == "mlp0x_gelu":
        raise ModelError(f"the checkpoint has no {prefix}weight or {prefix}0.weight: its projector is missing")
    said = str(config.get("mm_projector_type") or seen)
    if said != seen:
        raise ModelError(f"config.json: mm_projector_type {said!r}, but the tensors are those of {seen!r}")
    width = _matrix(shapes, f"{prefix}weight" if seen == "linear" else f"{prefix}0.weight")[1]
    if width != clip_width:
        raise ModelError(
            f"the projector takes CLIP features of {width} numbers, this CLIP tower gives {clip_width}: "
            "give the tower the model was trained with"
        )
    return seen


def _out_dim(config: Mapping[str, Any], shapes: Shapes) -> int:
    name = "model.text_hidden_fcs.0.2.weight"
    rows = _matrix(shapes, name)[0]
    if config.get("out_dim", rows) != rows:
        raise ModelError(f"config.json: out_dim {config['out_dim']}, but {name} has {rows} rows")
    return rows


def _matrix(shapes: Shapes, name: str) -> tuple[int, int]:
    shape = shapes.get(name)
    if shape is None:
        raise ModelError(f"the checkpoint has no {name}; is it a LISA checkpoint?")
    if len(shape) != 2:
        raise ModelError(f"{name} has the shape {list(shape)}; two dimensions were expected")
    return shape[0], shape[1]


def clip_config_of(shapes: Shapes) -> dict[str, Any]:
    """Infer a CLIP tower's sizes from its tensors alone.

    For a checkpoint that carries its tower but no configuration of it: every published CLIP has heads of 64 channels.

    Args:
        shapes: Shapes under names relative to `vision_model.`.

    Raises:
        ModelError: A tensor that gives a size is missing or has an impossible shape.
    """
    patches = shapes.get("embeddings.patch_embedding.weight", ())
    positions = shapes.get("embeddings.position_embedding.weight", ())
    mlp = shapes.get("encoder.layers.0.mlp.fc1.weight", ())
    if (len(patches), len(positions), len(mlp)) != (4, 2, 2) or patches[0] % 64:
        raise ModelError("the CLIP tower inside the checkpoint is incomplete or of an unknown kind; give `clip`")
    layers = {int(match[1]) for name in shapes if (match := re.match(r"encoder\.layers\.(\d+)\.", name))}
    return {
        "hidden_size": patches[0],
        "intermediate_size": mlp[0],
        "num_hidden_layers": max(layers) + 1,
        "num_attention_heads": patches[0] // 64,
        "patch_size": patches[2],
        "image_size": math.isqrt(positions[0] - 1) * patches[2],
    }
