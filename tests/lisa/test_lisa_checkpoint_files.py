"""Files of a checkpoint: damaged, dangerous or missing ones are refused in words, and the hub is asked sparingly."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa import checkpoint as checkpoint_module
from cable_models.lisa.checkpoint import open_checkpoint, read_sam_sidecar
from cable_models.lisa.tensor_files import open_tensors
from huggingface_hub.errors import LocalEntryNotFoundError
from lisa_checkpoints import write_shards
from safetensors.torch import save_file


def tensors() -> dict[str, torch.Tensor]:
    return {f"t{number}": torch.full((3, number + 1), float(number)) for number in range(5)}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_file(tensors(), tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text("{}")
    return tmp_path


@pytest.mark.parametrize("kind", ["whole", "safetensors", "bin"])
def test_tensors_are_read_by_name(kind: str, folder: Path) -> None:
    if kind != "whole":
        write_shards(folder, tensors(), kind)
    files = open_tensors(folder)
    assert dict(files.shapes) == {name: tuple(tensor.shape) for name, tensor in tensors().items()}
    assert set(files.dtypes.values()) == {torch.float32}
    found = dict(files.read({"t3", "t4", "absent"}))
    assert found.keys() == {"t3", "t4"}
    assert all(torch.equal(found[name], tensors()[name]) for name in found)


def test_safetensors_are_preferred(folder: Path) -> None:
    torch.save({"other": torch.ones(1)}, folder / "pytorch_model.bin")
    assert "other" not in open_tensors(folder).shapes


@pytest.mark.parametrize("name", ["model.safetensors", "pytorch_model.bin"])
@pytest.mark.parametrize("damage", ["cut", "empty", "noise"])
def test_damaged_files(name: str, damage: str, folder: Path) -> None:
    path = folder / name
    if path.suffix == ".bin":
        (folder / "model.safetensors").unlink()
        torch.save(tensors(), path)
    whole = path.read_bytes()
    path.write_bytes({"cut": whole[: len(whole) - 40], "empty": b"", "noise": b"\x80\x02noise" * 90}[damage])
    with pytest.raises(ModelError, match=f"{name} is truncated or no"):
        open_tensors(folder)


class Payload:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("executed"),))


def test_pickled_code_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "model.safetensors").unlink()
    torch.save({"weight": torch.ones(2), "payload": Payload()}, folder / "pytorch_model.bin")
    with pytest.raises(ModelError, match=r"pytorch_model.bin is refused.*convert it to safetensors"):
        open_tensors(folder)
    assert not (folder / "executed").exists()


def test_bin_of_something_else(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    torch.save({"state_dict": tensors(), "step": 3}, folder / "pytorch_model.bin")
    with pytest.raises(ModelError, match="something else than named tensors"):
        open_tensors(folder)


def test_missing_shard(folder: Path) -> None:
    write_shards(folder, tensors(), "safetensors")
    (folder / "model-00002-of-00002.safetensors").unlink()
    with pytest.raises(ModelError, match=r"aren't in its folder: model-00002-of-00002.safetensors"):
        open_tensors(folder)


def test_index_that_promises_too_much(folder: Path) -> None:
    write_shards(folder, tensors(), "safetensors")
    path = folder / "model.safetensors.index.json"
    index = json.loads(path.read_text())
    index["weight_map"]["t9"] = index["weight_map"]["t0"]
    path.write_text(json.dumps(index))
    with pytest.raises(ModelError, match="names tensors that its shards don't hold: t9"):
        open_tensors(folder)


def test_shards_that_repeat_a_tensor(folder: Path) -> None:
    write_shards(folder, tensors(), "safetensors")
    save_file(tensors(), folder / "model-00002-of-00002.safetensors")
    with pytest.raises(ModelError, match="repeats tensors of another shard: t0, t2, t4"):
        open_tensors(folder)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ('{"weight_map": {"t0": "../secret.safetensors"}}', "no names of .safetensors files beside it"),
        ('{"weight_map": {"t0": "code.bin"}}', "no names of .safetensors files beside it"),
        ('{"weight_map": {}}', "names no tensor"),
        ('{"weight_map": 3}', "is no index of shards"),
        ("{", "is no index of shards"),
    ],
)
def test_wrong_index(content: str, told: str, folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    (folder / "model.safetensors.index.json").write_text(content)
    with pytest.raises(ModelError, match=told):
        open_tensors(folder)


def test_quantised_weights(folder: Path) -> None:
    save_file({"t": torch.zeros(4, dtype=torch.float8_e4m3fn)}, folder / "model.safetensors")
    with pytest.raises(ModelError, match="t is of the number format F8_E4M3"):
        open_tensors(folder)


def test_folder_without_its_files(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"has no config.json"):
        open_checkpoint(tmp_path)
    (tmp_path / "config.json").write_text("[]")
    with pytest.raises(ModelError, match="must hold a JSON object, it holds list"):
        open_checkpoint(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ModelError, match=r"holds no weights; expected one of model.safetensors"):
        open_checkpoint(tmp_path)
    for name in ("sam.json", "sam_tiny.json"):
        (tmp_path / name).write_text("{}")
    with pytest.raises(ModelError, match=r"sam.json, sam_tiny.json all may give SAM's sizes"):
        read_sam_sidecar(tmp_path)


# ------------------------------------------------------------------------------------------------------- the hub


def test_neither_folder_nor_id(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"there is no folder .*missing.* no id on the hub"):
        open_checkpoint(tmp_path / "missing")


def test_without_network_the_error_tells_the_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(*_: object, **__: object) -> str:
        raise LocalEntryNotFoundError("no network and not in the cache")

    monkeypatch.setattr(checkpoint_module, "snapshot_download", offline)
    with pytest.raises(ModelError, match=r"no folder owner/name, and the hub doesn't .*config.json.*tokenizer.model"):
        open_checkpoint("owner/name")


@pytest.mark.parametrize("stored", ["safetensors", "bin"])
def test_bin_is_fetched_only_without_safetensors(stored: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in hub that copies the files of a repository that match the patterns, as the client does."""
    from fnmatch import fnmatch

    repository = {"config.json": b"{}", "training_args.bin": b"", "tf_model.h5": b"", "README.md": b""}
    if stored == "bin":
        torch.save(tensors(), tmp_path / "weights")
        repository["pytorch_model.bin"] = (tmp_path / "weights").read_bytes()
    else:
        save_file(tensors(), tmp_path / "weights")
        repository |= {"model.safetensors": (tmp_path / "weights").read_bytes(), "pytorch_model.bin": b"not wanted"}
    cache = tmp_path / "cache"
    cache.mkdir()

    def hub(name: str, *, revision: str | None, allow_patterns: list[str]) -> str:
        assert (name, revision) == ("owner/name", "v1")
        for file, content in repository.items():
            if any(fnmatch(file, pattern) for pattern in allow_patterns):
                (cache / file).write_bytes(content)
        return str(cache)

    monkeypatch.setattr(checkpoint_module, "snapshot_download", hub)
    opened = open_checkpoint("owner/name", "v1")
    assert opened.tensors.shapes.keys() == tensors().keys()
    weights = "model.safetensors" if stored == "safetensors" else "pytorch_model.bin"
    assert {path.name for path in cache.iterdir()} == {"config.json", weights}
