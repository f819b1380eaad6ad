"""Loading a LISA++ checkpoint: straight into the wanted number format and device, one tensor at a time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from huggingface_hub.errors import StrictDataclassError
from torch import nn
from transformers import LlamaConfig
from transformers.models.llama.modeling_llama import LlamaRotaryEmbedding

from cable_models.errors import ModelError
from cable_models.lisa.architecture import (
    ClipPreprocessing,
    LisaArchitecture,
    read_architecture,
    read_clip_preprocessing,
)
from cable_models.lisa.checkpoint import Checkpoint, open_checkpoint, read_sam_sidecar
from cable_models.lisa.clip_weights import ClipWeights, find_clip
from cable_models.lisa.key_map import CLIP_INSIDE, IGNORED, names_by_original
from cable_models.lisa.model import LisaModel
from cable_models.lisa.sam_sizes import sam_sizes_of
from cable_models.lisa.special_tokens import SpecialTokens, read_special_tokens

if TYPE_CHECKING:
    from cable_models.lisa.tokenizer import LisaTokenizer

DECODER_PARTS = ("sam.prompt_encoder.", "sam.mask_decoder.", "sam.shared_image_embedding.")
"""Parts of the model that `decoder_dtype` is for: all of SAM but its image encoder."""


@dataclass(frozen=True, slots=True)
class LoadedLisa:
    """A model ready for inference, with what belongs to it.

    Attributes:
        model: In evaluation mode, its parameters frozen.
        architecture: Its sizes.
        tokens: Ids of its special tokens.
        tokenizer: None where the checkpoint brings no tokenizer.model; prompts are then given as ids.
        clip_preprocessing: How a frame becomes the CLIP tower's input.
        folder: Where the checkpoint lies; a hub's cache folder ends with the commit.
        image_markers: Whether <im_start> and <im_end> stood around the picture in training, as config.json says.
    """

    model: LisaModel
    architecture: LisaArchitecture
    tokens: SpecialTokens
    tokenizer: LisaTokenizer | None
    clip_preprocessing: ClipPreprocessing
    folder: Path
    image_markers: bool = False


def load_lisa(
    source: str | Path,
    *,
    clip: str | Path | None = None,
    revision: str | None = None,
    device: str | torch.device = "cpu",
    dtype: torch.dtype | None = None,
    decoder_dtype: torch.dtype | None = None,
    sam: Mapping[str, Any] | None = None,
) -> LoadedLisa:
    """Load a LISA++ checkpoint in the layout its authors publish.

    The peak of memory is the model and its largest tensor (250 MB more for .bin files); nothing is drawn at random in
    between.

    Args:
        source: Folder, or hub id such as `Senqiao/LISA_Plus_7b`.
        clip: Folder or hub id of the CLIP tower; None looks where `find_clip` says.
        revision: Branch, tag or commit of `source` on the hub.
        device: Where the weights go.
        dtype: Number format of the weights; None keeps what config.json says, bfloat16 in the published ones.
        decoder_dtype: Number format of SAM's prompt encoder and mask decoder, if not `dtype`; in float32 they cost
            next to nothing and lose no positions, but the original runs them in `dtype`.
        sam: Sizes of SAM by the names of a `sam*.json`, in place of the file beside the checkpoint.

    Raises:
        ModelError: Files are missing, damaged, contradictory, or don't make up the model; all tensors that are
            missing, unexpected or misshapen are told at once.
    """
    checkpoint = open_checkpoint(source, revision)
    tower = find_clip(checkpoint, clip)
    sidecar = read_sam_sidecar(checkpoint.folder) if sam is None else sam
    try:
        architecture = read_architecture(checkpoint.config, checkpoint.tensors.shapes, tower.config, sidecar)
        model = build_empty(architecture)
    except (KeyError, TypeError, ValueError, StrictDataclassError) as error:
        raise ModelError(f"{checkpoint.folder}: no model can be built of these sizes: {error!r}") from error
    tokens = read_special_tokens(checkpoint.folder, checkpoint.config).within(architecture.llama.vocab_size)
    preprocessing = read_clip_preprocessing(tower.preprocessing, architecture.clip)
    weights = WeightSources(checkpoint, tower)
    parameters = [name for name, _ in model.named_parameters(remove_duplicate=False)]
    targets = names_by_original(parameters, sam_sizes_of(architecture.sam).iou_head_depth)
    check_complete(model, targets, weights.shapes(), checkpoint.folder)
    wanted = dtype or _stored_dtype(checkpoint)
    for original, tensor in weights.read():
        names = targets[original]
        part = decoder_dtype if decoder_dtype and names[0].startswith(DECODER_PARTS) else wanted
        # `copy` detaches the weight from the mapped file even where neither device nor format changes.
        weight = nn.Parameter(tensor.to(device=device, dtype=part, copy=True), requires_grad=False)
        for name in names:
            _place(model, name, weight)
    materialise_buffers(model, torch.device(device))
    return LoadedLisa(
        model=model.eval(),
        architecture=architecture,
        tokens=tokens,
        tokenizer=_tokenizer(checkpoint.folder),
        clip_preprocessing=preprocessing,
        folder=checkpoint.folder,
        image_markers=bool(checkpoint.config.get("mm_use_im_start_end")),
    )


def build_empty(architecture: LisaArchitecture) -> LisaModel:
    """Build a model whose parameters and buffers have shapes but no memory yet."""
    with torch.device("meta"):
        return LisaModel(architecture)


@dataclass(frozen=True, slots=True)
class WeightSources:
    """The tensors of a checkpoint and its CLIP tower under the names `original_name` gives."""

    checkpoint: Checkpoint
    tower: ClipWeights

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Give the shapes of all tensors that matter."""
        own, clip = self.checkpoint.tensors.shapes, self.tower.tensors.shapes
        shapes = {name: own[name] for name in self._own_names()}
        return shapes | {canonical: clip[name] for name, canonical in self.tower.names().items()}

    def read(self) -> Iterator[tuple[str, torch.Tensor]]:
        """Read all tensors that matter, one by one."""
        yield from self.checkpoint.tensors.read(self._own_names())
        canonical = self.tower.names()
        for name, tensor in self.tower.tensors.read(canonical.keys()):
            yield canonical[name], tensor

    def _own_names(self) -> set[str]:
        return {
            name
            for name in self.checkpoint.tensors.shapes
            if not name.startswith(CLIP_INSIDE) and not IGNORED.fullmatch(name)
        }


def check_complete(
    model: LisaModel, targets: Mapping[str, list[str]], given: Mapping[str, tuple[int, ...]], folder: Path
) -> None:
    """Check that a checkpoint holds exactly the model's tensors.

    Args:
        model: The model to be filled.
        targets: Names in the model by their original name.
        given: Shapes of the checkpoint's tensors by their original name.
        folder: Named in the error.

    Raises:
        ModelError: Tensors are missing, unexpected or misshapen.
    """
    faults = [f"missing {name}" for name in sorted(targets.keys() - given.keys())]
    faults += [f"unexpected {name}" for name in sorted(given.keys() - targets.keys())]
    for name in sorted(targets.keys() & given.keys()):
        shape = tuple(model.get_parameter(targets[name][0]).shape)
        if shape != given[name]:
            faults.append(f"{name} is {list(given[name])}, not {list(shape)}")
    if faults:
        shown = "; ".join(faults[:20]) + ("; ..." if len(faults) > 20 else "")
        raise ModelError(f"{folder} doesn't hold the model its files describe, {len(faults)} faults: {shown}")


def materialise_buffers(model: LisaModel, device: torch.device) -> None:
    """Compute the buffers no checkpoint holds: rotary frequencies, in float32 whatever the weights are, and indexes.

    Raises:
        ModelError: The installed transformers has a buffer that isn't known here.
    """
    for path, module in list(model.named_modules()):
        if isinstance(module, LlamaRotaryEmbedding):
            parent, _, leaf = path.rpartition(".")
            config: LlamaConfig = module.config
            setattr(model.get_submodule(parent), leaf, LlamaRotaryEmbedding(config).to(device))
    for path, buffer in list(model.named_buffers()):
        if path.endswith(".position_ids"):
            parent, _, leaf = path.rpartition(".")
            indexes = torch.arange(buffer.shape[-1], device=device).expand((1, -1))
            setattr(model.get_submodule(parent), leaf, indexes)
    tensors = [*model.named_parameters(), *model.named_buffers()]
    if empty := [name for name, tensor in tensors if tensor.is_meta]:
        raise ModelError(f"this version of transformers has tensors of unknown content: {', '.join(empty[:20])}")


def _place(model: LisaModel, name: str, weight: nn.Parameter) -> None:
    path, _, leaf = name.rpartition(".")
    setattr(model.get_submodule(path), leaf, weight)


def _stored_dtype(checkpoint: Checkpoint) -> torch.dtype:
    said = checkpoint.config.get("torch_dtype") or checkpoint.config.get("dtype")
    if said is None:
        return checkpoint.tensors.dtypes["model.embed_tokens.weight"]
    known = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
    dtype = known.get(re.sub(r"^torch\.", "", str(said)))
    if dtype is None:
        raise ModelError(f"{checkpoint.folder}/config.json: torch_dtype {said!r} is none of {', '.join(known)}")
    return dtype


def _tokenizer(folder: Path) -> LisaTokenizer | None:
    if not (folder / "tokenizer.model").is_file():
        return None
    from cable_models.lisa.tokenizer import LisaTokenizer

    return LisaTokenizer.from_folder(folder)
