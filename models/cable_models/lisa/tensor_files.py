"""Tensors of a checkpoint folder, read one by one: safetensors or torch's .bin, in one file or in shards."""

from __future__ import annotations

import json
import pickle
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from cable_models.errors import ModelError

WEIGHT_FILES = (
    "model.safetensors",
    "model.safetensors.index.json",
    "pytorch_model.bin",
    "pytorch_model.bin.index.json",
)
"""What a folder's weights may be called, the preferred first."""

REMAP_BYTES = 250_000_000
"""Bytes read of a .bin before its mapping is made anew."""


@dataclass(frozen=True, slots=True)
class TensorFiles:
    """Where the tensors of a checkpoint lie and which shapes they have; nothing is read but file headers."""

    folder: Path
    names: Mapping[Path, tuple[str, ...]]
    """Names of the tensors in each file."""
    shapes: Mapping[str, tuple[int, ...]]
    dtypes: Mapping[str, torch.dtype]

    def read(self, wanted: Collection[str]) -> Iterator[tuple[str, torch.Tensor]]:
        """Read tensors in the order of the files.

        A tensor is mapped memory of its file: copy it and let go of it, so that little of a file is ever held.

        Args:
            wanted: Names to read; those the checkpoint lacks are passed over.

        Raises:
            ModelError: A file can't be read.
        """
        for path, names in self.names.items():
            chosen = [name for name in names if name in wanted]
            if chosen:
                yield from (_read_safetensors if path.suffix == ".safetensors" else _read_bin)(path, chosen)


def open_tensors(folder: Path) -> TensorFiles:
    """Open the weights of a folder and check that they are whole.

    Args:
        folder: Holds one of `WEIGHT_FILES`, with the shards its index names.

    Raises:
        ModelError: There are none, a file is missing, truncated or no tensor file, a pickle holds code, an index names
            tensors its shards don't hold, or two shards hold the same name.
    """
    found = next((folder / name for name in WEIGHT_FILES if (folder / name).is_file()), None)
    if found is None:
        raise ModelError(f"{folder} holds no weights; expected one of {', '.join(WEIGHT_FILES)}")
    index = _read_index(found) if found.suffix == ".json" else {}
    paths = sorted({folder / file for file in index.values()}) or [found]
    if missing := [path.name for path in paths if not path.is_file()]:
        raise ModelError(f"{found} names shards that aren't in its folder: {', '.join(missing)}; fetch them too")
    names: dict[Path, tuple[str, ...]] = {}
    shapes: dict[str, tuple[int, ...]] = {}
    dtypes: dict[str, torch.dtype] = {}
    for path in paths:
        headers = _safetensors_headers(path) if path.suffix == ".safetensors" else _bin_headers(path)
        if twice := headers.keys() & shapes.keys():
            raise ModelError(f"{path} repeats tensors of another shard: {_some(twice)}")
        names[path] = tuple(headers)
        shapes |= {name: shape for name, (shape, _) in headers.items()}
        dtypes |= {name: dtype for name, (_, dtype) in headers.items()}
    absent = [name for name, file in index.items() if name not in names[folder / file]]
    if absent:
        raise ModelError(f"{found} names tensors that its shards don't hold: {_some(absent)}")
    return TensorFiles(folder, names, shapes, dtypes)


_Header = dict[str, tuple[tuple[int, ...], torch.dtype]]


def _read_index(path: Path) -> dict[str, str]:
    try:
        index = json.loads(path.read_text(encoding="utf-8"))["weight_map"]
        files = {str(name): str(file) for name, file in index.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelError(f"{path} is no index of shards: {error!r}") from error
    suffix = ".safetensors" if ".safetensors" in path.name else ".bin"
    if outside := {file for file in files.values() if Path(file).name != file or not file.endswith(suffix)}:
        raise ModelError(f"{path}: {_some(outside)} are no names of {suffix} files beside it")
    if not files:
        raise ModelError(f"{path} names no tensor")
    return files


def _safetensors_headers(path: Path) -> _Header:
    types = {
        "F64": torch.float64,
        "F32": torch.float32,
        "F16": torch.float16,
        "BF16": torch.bfloat16,
        "I64": torch.int64,
        "I32": torch.int32,
        "I16": torch.int16,
        "I8": torch.int8,
        "U8": torch.uint8,
        "BOOL": torch.bool,
    }
    headers: _Header = {}
    try:
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118  # the handle is no mapping
                tensor = file.get_slice(name)
                kind = str(tensor.get_dtype())
                if kind not in types:
                    raise ModelError(f"{path}: {name} is of the number format {kind}; quantised weights aren't read")
                headers[name] = (tuple(tensor.get_shape()), types[kind])
    except (OSError, SafetensorError) as error:
        raise ModelError(f"{path} is truncated or no safetensors file ({error}); fetch it again") from error
    return headers


def _read_safetensors(path: Path, names: Collection[str]) -> Iterator[tuple[str, torch.Tensor]]:
    for name in names:
        # Opened anew for every tensor: pages of a mapping stay resident until it's closed, a second model's worth.
        try:
            with safe_open(path, framework="pt") as file:
                tensor = file.get_tensor(name)
        except (OSError, SafetensorError) as error:
            raise ModelError(f"{path}: {name} can't be read ({error}); fetch the file again") from error
        yield name, tensor


def _read_bin(path: Path, names: Collection[str]) -> Iterator[tuple[str, torch.Tensor]]:
    tensors: Mapping[str, torch.Tensor] = {}
    resident = 0
    for name in names:
        # As above, but unpickling a file's whole table for each of its tensors would take longer than reading them.
        if not tensors or resident > REMAP_BYTES:
            tensors = _load_bin(path)
            resident = 0
        resident += tensors[name].nbytes
        yield name, tensors[name]


def _bin_headers(path: Path) -> _Header:
    return {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in _load_bin(path).items()}


def _load_bin(path: Path) -> dict[str, torch.Tensor]:
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise ModelError(
            f"{path} is refused: it holds Python objects beside tensors, which loading would run as code, or it's "
            "damaged; convert it to safetensors where it comes from"
        ) from error
    except (OSError, RuntimeError, EOFError, ValueError) as error:
        raise ModelError(f"{path} is truncated or no torch file ({error}); fetch it again") from error
    if not isinstance(tensors, dict) or not all(isinstance(tensor, torch.Tensor) for tensor in tensors.values()):
        raise ModelError(f"{path} holds something else than named tensors; save the model's state_dict alone")
    return {str(name): tensor for name, tensor in tensors.items()}


def _some(names: Collection[str]) -> str:
    shown = sorted(names)[:20]
    return ", ".join(shown) + (f" and {len(names) - len(shown)} more" if len(names) > len(shown) else "")
