"""What tells one cell of a sweep from all others: its settings, its source, the code and the weights."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import cable_rpc
from cable_rpc.study import digests
from cable_rpc.study.sweep.cell import SweepCell

KEY_DIGITS = 24

MEASURING_PARTS = (
    "types.py",
    "cloud",
    "data",
    "edge",
    "wire",
    "study/closed_loop",
    "study/metrics",
    "study/sequence_metrics",
    "study/strategies.py",
    "study/prefill.py",
    "study/transport_estimate.py",
    "study/sweep/cell.py",
    "study/sweep/cell_run.py",
    "study/sweep/clip_store.py",
    "study/sweep/example.py",
    "study/sweep/fidelity.py",
    "study/sweep/reference.py",
    "study/sweep/simulated_link.py",
)
"""Parts of this package that a measurement goes through; what runs, keeps or draws cells may change freely."""


def cell_key(cell: SweepCell) -> str:
    """The name of a cell in the store; cells that differ in labels alone have the same."""
    return digests.key_of(cell_identity(cell, digests.source_stamp(cell.clip.source)), KEY_DIGITS)


def cell_keys(cells: Sequence[SweepCell]) -> list[str]:
    """As `cell_key` of each; a source's files are looked at once, however many cells it has."""
    sources = dict.fromkeys(cell.clip.source for cell in cells)
    stamps = {source: digests.source_stamp(source) for source in sources}
    return [digests.key_of(cell_identity(cell, stamps[cell.clip.source]), KEY_DIGITS) for cell in cells]


def cell_identity(cell: SweepCell, source_stamp: Sequence[int]) -> dict[str, Any]:
    """Everything that determines a cell's figures, as plain JSON values.

    How many processes work beside each other is left out, though the clock feels it.
    """
    models = cell.clip.models
    return {
        "settings": json.loads(json.dumps(cell.settings())),
        "source_files": list(source_stamp),
        "version": cable_rpc.__version__,
        "code": measuring_code(),
        "detector_weights": digests.weights_digest(models.detector, detector=True),
        "segmenter_weights": digests.weights_digest(models.segmenter, detector=False),
        "edge_weights": digests.weights_digest(cell.strategy.partition(":")[2], detector=True),
    }


def measuring_code() -> str:
    """Digest of the sources that a cell's measurement goes through."""
    return digests.code_digest(MEASURING_PARTS)
