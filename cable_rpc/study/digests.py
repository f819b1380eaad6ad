"""What tells that something measured is out of date: stamps of sources, digests of code and of weights."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cable_codecs
import cable_models
from cable_models import ModelError as EmbeddedError
from cable_models import embedded_detector_path
from cable_models.embedded import embedded_segmenter_path

import cable_rpc
from cable_rpc.cloud.weights_revision import weights_revision

LISTED_LEVELS = 3
"""How deep a data set's root is looked into."""


def key_of(identity: Any, digits: int) -> str:
    """A short name for plain JSON values: the first hexadecimal digits of their SHA-256."""
    text = json.dumps(identity, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:digits]


def source_stamp(spec: str) -> list[int]:
    """What changes when somebody changes the files behind a source; empty where there are none.

    A file: its size in bytes and time of change in nanoseconds. A folder: count, sizes and latest time of change of all
    that lies in it. A data set's ``ROOT#SEQUENCE``: the same over ROOT down to `LISTED_LEVELS`, and over every folder
    there that has the sequence's name, whole; a root of thousands of recordings is too large to be walked for each.

    Args:
        spec: as `cable_rpc.data.source.open_source` takes it.
    """
    scheme, _, rest = spec.partition(":")
    if scheme == "synthetic":
        return []
    root, _, sequence = rest.partition("?")[0].partition("#")
    path = Path(rest if Path(rest).exists() else root)
    if path.is_file():
        status = path.stat()
        return [status.st_size, status.st_mtime_ns]
    if not path.is_dir():
        return []
    stamps = [*stamps_below(path, Path(sequence).name, LISTED_LEVELS if sequence else None), path.stat()]
    return [len(stamps), sum(one.st_size for one in stamps), max(one.st_mtime_ns for one in stamps)]


def stamps_below(folder: Path, wanted: str, levels: int | None) -> Iterator[os.stat_result]:
    """Of all entries to so many levels, None = all; on the lowest of them, only of those that are named as wanted."""
    with os.scandir(folder) as entries:
        for entry in entries:
            named = wanted in (entry.name, Path(entry.name).stem)
            # Links are followed above a sequence only, so that a loop of them ends.
            is_folder = entry.is_dir(follow_symlinks=levels is not None)
            if (levels == 1 and not named) or not (is_folder or entry.is_file()):
                continue
            yield entry.stat()
            if is_folder:
                yield from stamps_below(Path(entry.path), wanted, None if named or levels is None else levels - 1)


@cache
def code_digest(parts: tuple[str, ...]) -> str:
    """SHA-256 over the sources that a measurement goes through, 12 hexadecimal digits.

    Args:
        parts: files and folders of this package; those of `cable_codecs` and `cable_models` are always among them.
    """
    digest = hashlib.sha256()
    for path in measuring_sources(parts):
        digest.update(f"{path.parent.name}/{path.name}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def measuring_sources(parts: tuple[str, ...]) -> Iterator[Path]:
    """Python files of the packages, in a fixed order."""
    here = Path(cable_rpc.__file__).parent
    roots = [*(here / part for part in parts)]
    roots += [Path(package.__file__).parent for package in (cable_codecs, cable_models) if package.__file__]
    for root in roots:
        if root.is_file():
            yield root
        yield from sorted(root.rglob("*.py"))


@cache
def weights_digest(spec: str, *, detector: bool) -> str:
    """A digest of the weights that a back end's name leads to; empty where no local file is named.

    Wrapped back ends (``crop?margin=32:lisa:FOLDER``) are searched for the innermost path. A hub's id is told by its
    name alone, together with the revision that it may ask for.
    """
    rest = spec
    while rest:
        name, _, inner = rest.partition(":")
        if name.partition("?")[0] == "embedded":
            return embedded_digest(detector=detector)
        path = Path(rest.partition("?")[0]).expanduser()
        if path.is_dir():
            return weights_revision(path)
        if path.is_file():
            return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        rest = inner
    return ""


def embedded_digest(*, detector: bool) -> str:
    """Digest of the weights that ship with the package; empty where this installation has none."""
    try:
        if detector:
            return hashlib.sha256(embedded_detector_path().read_bytes()).hexdigest()[:12]
        return weights_revision(embedded_segmenter_path())
    except EmbeddedError:
        return ""
