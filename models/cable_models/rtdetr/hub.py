"""Finds a checkpoint: a file or folder here, or a snapshot from the Hugging Face hub."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

from huggingface_hub import snapshot_download
from huggingface_hub.errors import (
    GatedRepoError,
    HfHubHTTPError,
    LocalEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from cable_models.errors import ModelError

HUB_ID = re.compile(r"[\w][\w.-]*/[\w][\w.-]*")
HUB_FILES = ("config.json", "preprocessor_config.json", "processor_config.json", "*.safetensors", "*.index.json")


@dataclass(frozen=True, slots=True)
class Located:
    """A checkpoint on this machine."""

    path: Path
    """Folder of transformers (with config.json), or a safetensors file."""
    source: str
    """As the user named it, for metadata and messages."""
    revision: str
    """Commit on the hub, or a digest of the files."""


def locate(name: str, revision: str | None = None) -> Located:
    """Finds a checkpoint by folder, file or hub id; what exists here goes first.

    Raises:
        ModelError: nothing of that name here or there, or the hub can't be reached and nothing is cached.
    """
    path = Path(name).expanduser()
    if path.is_file():
        return located_file(path, name)
    if path.is_dir():
        return located_folder(path, name)
    if not HUB_ID.fullmatch(name):
        raise ModelError(
            f"no checkpoint '{name}': there is no such folder or file, and a model on the hub is named OWNER/NAME, "
            "e.g. PekingU/rtdetr_r50vd"
        )
    return located_on_hub(name, revision)


def located_file(path: Path, name: str) -> Located:
    """A single file.

    Raises:
        ModelError: not of safetensors.
    """
    if path.suffix == ".onnx":
        raise ModelError(f"'{name}' is exported already; serve it as onnx:{name}")
    if path.suffix != ".safetensors":
        raise ModelError(f"'{name}' is no safetensors file; name a folder written by save_pretrained instead")
    return Located(path, name, digest([path]))


def located_folder(folder: Path, name: str) -> Located:
    """A folder of transformers, or one that holds a compact checkpoint.

    Raises:
        ModelError: neither.
    """
    # a training's folder also holds its state, to go on from
    weights = sorted(path for path in folder.glob("*.safetensors") if not path.name.endswith(".state.safetensors"))
    if (folder / "config.json").is_file():
        # pytorch_model.bin is pickled: it could run code
        if not weights:
            raise ModelError(f"folder '{name}' has a config.json but no *.safetensors; convert its weights first")
        return Located(folder, name, digest([*sorted(folder.glob("*config.json")), *weights]))
    if len(weights) == 1:
        return Located(weights[0], str(weights[0]), digest(weights))
    raise ModelError(
        f"folder '{name}' holds no checkpoint: expected config.json and *.safetensors as save_pretrained writes them, "
        f"or one *.safetensors of the compact RT-DETR, found {len(weights)} *.safetensors"
    )


def located_on_hub(name: str, revision: str | None) -> Located:
    """A snapshot, downloaded where it isn't cached yet; without network, what the hub's cache holds.

    Raises:
        ModelError: no such model or revision, no access, or neither network nor cache.
    """
    try:
        folder = Path(snapshot_download(name, revision=revision, allow_patterns=list(HUB_FILES)))
    except GatedRepoError as error:
        raise ModelError(
            f"'{name}' asks for an accepted licence on the hub; accept it, then `hf auth login`"
        ) from error
    except RevisionNotFoundError as error:
        raise ModelError(f"the hub's '{name}' has no revision '{revision}'") from error
    except RepositoryNotFoundError as error:
        raise ModelError(
            f"no folder '{name}' here and no such model on the hub (or it is private: `hf auth login`)"
        ) from error
    except (LocalEntryNotFoundError, HfHubHTTPError, OSError) as error:
        raise ModelError(
            f"no folder '{name}' here, nothing of that name in the hub's cache, and the hub can't be reached "
            f"({first_line(error)}); connect, or copy a folder written by save_pretrained and name it"
        ) from error
    if not (folder / "config.json").is_file() or not list(folder.glob("*.safetensors")):
        raise ModelError(f"the hub's '{name}' has no config.json with *.safetensors; it can't be loaded safely")
    # snapshots are kept in folders named by their commit
    return Located(folder, name, folder.name)


def first_line(error: Exception) -> str:
    """The beginning of an error's text."""
    return (str(error) or type(error).__name__).splitlines()[0][:120]


def digest(paths: list[Path]) -> str:
    """SHA-256 over names and contents, the first 40 hexadecimal digits, as long as a commit."""
    total = hashlib.sha256()
    for path in paths:
        total.update(path.name.encode())
        with path.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()[:40]
