"""What tells one measured cell from all others: its sequence, its settings, the code and the weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict
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
from cable_rpc.study.tables.settings import RunSettings, SequenceRequest

KEY_DIGITS = 20

MEASURING_PARTS = (
    "types.py",
    "cloud",
    "data",
    "edge",
    "wire",
    "study/metrics",
    "study/sequence_metrics",
    "study/strategies.py",
    "study/prefill.py",
    "study/transport_estimate.py",
    "study/tables/equal_quality.py",
    "study/tables/ladder.py",
    "study/tables/lane.py",
    "study/tables/measured_frame.py",
    "study/tables/score_keeper.py",
    "study/tables/sequence_run.py",
    "study/tables/session_in_process.py",
)
"""Parts of this package that a measurement goes through; what only draws tables may change without a new one."""


def cell_identity(request: SequenceRequest, strategy: str, settings: RunSettings) -> dict[str, Any]:
    """Everything that determines a cell's figures, as plain JSON values.

    How many processes work beside each other is left out, though the clock feels it.
    """
    run = asdict(settings)
    run["treatment"] = asdict(settings.used_treatment)
    return {
        "source": request.spec,
        "source_file": file_stamp(request.spec.partition(":")[2]),
        "strategy": strategy,
        "settings": json.loads(json.dumps(run)),
        "version": cable_rpc.__version__,
        "code": code_digest(),
        "detector_weights": weights_digest(settings.detector, detector=True),
        "segmenter_weights": weights_digest(settings.segmenter, detector=False),
    }


def cell_key(identity: dict[str, Any]) -> str:
    """A file name for an identity: hexadecimal digits of its SHA-256."""
    text = json.dumps(identity, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]


def file_stamp(rest: str) -> list[int]:
    """Size in bytes and time of change in nanoseconds of a source that is one file; empty for any other."""
    path = Path(rest)
    if not path.is_file():
        return []
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


@cache
def code_digest() -> str:
    """SHA-256 over the sources that a measurement goes through, 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for path in measuring_sources():
        digest.update(f"{path.parent.name}/{path.name}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def measuring_sources() -> Iterator[Path]:
    """Python files of the packages, in a fixed order."""
    here = Path(cable_rpc.__file__).parent
    roots = [*(here / part for part in MEASURING_PARTS)]
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
