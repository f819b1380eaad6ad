"""A LISA++ checkpoint on disk: the folder, or the hub's id it's fetched by, its JSON files and its tensors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download
from huggingface_hub.errors import HfHubHTTPError

from cable_models.errors import ModelError
from cable_models.lisa.json_files import read_json
from cable_models.lisa.tensor_files import WEIGHT_FILES, TensorFiles, open_tensors

LAYOUT = (
    "a folder with config.json, model.safetensors (or its shards with model.safetensors.index.json, or the same as "
    "pytorch_model.bin), tokenizer.model and added_tokens.json works without network"
)


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """An opened folder of weights."""

    folder: Path
    config: Mapping[str, Any]
    tensors: TensorFiles


def open_checkpoint(source: str | Path, revision: str | None = None, *, base: Path | None = None) -> Checkpoint:
    """Open a model's folder, fetching it from the hub where it's named by an id.

    Args:
        source: A folder, or a hub id such as `Senqiao/LISA_Plus_7b`.
        revision: Branch, tag or commit on the hub; of no meaning for a folder.
        base: Folder that a relative `source` is looked for in first.

    Raises:
        ModelError: There is no such folder and it can't be fetched, or its files are missing or damaged.
    """
    folder = find_folder(source, base) or fetch(str(source), revision)
    config = read_json(folder / "config.json")
    if config is None:
        raise ModelError(f"{folder} has no config.json; {LAYOUT}")
    return Checkpoint(folder, config, open_tensors(folder))


def find_folder(source: str | Path, base: Path | None = None) -> Path | None:
    """Give the folder a source names, relative to `base` or to the working directory; None if there is none."""
    path = Path(source).expanduser()
    places = [path] if base is None else [base / path, path]
    return next((place for place in places if place.is_dir()), None)


def fetch(name: str, revision: str | None = None) -> Path:
    """Download what a model's folder needs from the hub, or find it in the hub's cache.

    safetensors are preferred; .bin files are fetched only where there are none.

    Raises:
        ModelError: `name` is no hub id, the hub doesn't have it, or there's no network.
    """
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise ModelError(f"there is no folder {name}, and it's no id on the hub (owner/name) either; {LAYOUT}")
    try:
        folder = Path(
            snapshot_download(
                name,
                revision=revision,
                allow_patterns=["*.json", "*.model", "model*.safetensors", "*/model*.safetensors"],
            )
        )
        if not any((folder / weights).is_file() for weights in WEIGHT_FILES[:2]):
            folder = Path(snapshot_download(name, revision=revision, allow_patterns=["pytorch_model*.bin"]))
    except (HfHubHTTPError, OSError, ValueError) as error:
        raise ModelError(f"there is no folder {name}, and the hub doesn't give it ({error}); {LAYOUT}") from error
    return folder


def read_sam_sidecar(folder: Path) -> dict[str, Any] | None:
    """Read the sizes of SAM that lie beside a checkpoint as `sam*.json`; None if there are none.

    Raises:
        ModelError: There are several such files, or it isn't readable.
    """
    found = sorted(folder.glob("sam*.json"))
    if len(found) > 1:
        raise ModelError(f"{folder}: {', '.join(path.name for path in found)} all may give SAM's sizes; keep one")
    return read_json(found[0]) if found else None
