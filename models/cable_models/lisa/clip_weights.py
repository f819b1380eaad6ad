"""Where the CLIP tower of a LISA++ checkpoint comes from: a checkpoint normally leaves it out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cable_models.errors import ModelError
from cable_models.lisa.architecture import clip_config_of
from cable_models.lisa.checkpoint import Checkpoint, find_folder, open_checkpoint
from cable_models.lisa.json_files import read_json
from cable_models.lisa.key_map import CLIP_INSIDE, CLIP_PREFIX
from cable_models.lisa.tensor_files import TensorFiles


@dataclass(frozen=True, slots=True)
class ClipWeights:
    """A CLIP tower's files.

    Attributes:
        config: Its `config.json`.
        preprocessing: Its `preprocessor_config.json`, if it has one.
        tensors: The files its tensors lie in, perhaps among others.
        prefix: What the names of its tensors begin with there.
    """

    config: Mapping[str, Any]
    preprocessing: Mapping[str, Any] | None
    tensors: TensorFiles
    prefix: str

    def names(self) -> dict[str, str]:
        """Give the names in the files, with the name each has in a CLIPVisionModel's own folder."""
        return {
            name: CLIP_PREFIX + name.removeprefix(self.prefix)
            for name in self.tensors.shapes
            if name.startswith(self.prefix) and not name.endswith(".position_ids")
        }


def find_clip(checkpoint: Checkpoint, clip: str | Path | None) -> ClipWeights:
    """Find the tower of a checkpoint.

    In this order: `clip` if given; the folder that config.json names as vision_tower or mm_vision_tower, relative to
    the checkpoint or absolute; a tower inside the checkpoint; the hub id that config.json names.

    Args:
        checkpoint: The opened LISA++ checkpoint.
        clip: Folder or hub id of a CLIPModel or a CLIPVisionModel.

    Raises:
        ModelError: There is none, it can't be fetched, or its files are damaged.
    """
    if clip is not None:
        return _from_checkpoint(open_checkpoint(clip))
    named = checkpoint.config.get("vision_tower") or checkpoint.config.get("mm_vision_tower")
    if named and find_folder(str(named), checkpoint.folder) is not None:
        return _from_checkpoint(open_checkpoint(str(named), base=checkpoint.folder))
    prefix = CLIP_INSIDE + CLIP_PREFIX
    inside = {
        name.removeprefix(prefix): shape for name, shape in checkpoint.tensors.shapes.items() if name.startswith(prefix)
    }
    if inside:
        return ClipWeights(clip_config_of(inside), None, checkpoint.tensors, prefix)
    if not named:
        raise ModelError(
            f"{checkpoint.folder}: neither config.json (vision_tower, mm_vision_tower) names a CLIP tower nor do the "
            "weights hold one; give its folder or hub id as `clip`"
        )
    try:
        return _from_checkpoint(open_checkpoint(str(named)))
    except ModelError as error:
        raise ModelError(f"the CLIP tower that config.json names: {error}; or give a folder as `clip`") from error


def _from_checkpoint(tower: Checkpoint) -> ClipWeights:
    prefix = CLIP_PREFIX if any(name.startswith(CLIP_PREFIX) for name in tower.tensors.shapes) else ""
    if f"{prefix}embeddings.class_embedding" not in tower.tensors.shapes:
        raise ModelError(f"{tower.folder} holds no CLIP image tower: no {CLIP_PREFIX}embeddings.class_embedding in it")
    return ClipWeights(tower.config, read_json(tower.folder / "preprocessor_config.json"), tower.tensors, prefix)
