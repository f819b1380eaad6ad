"""What tells one measured cell from all others: its sequence, its settings, the code and the weights."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import cable_rpc
from cable_rpc.study import digests
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
    "study/closed_loop/lane.py",
    "study/closed_loop/measured_frame.py",
    "study/closed_loop/score_keeper.py",
    "study/tables/sequence_run.py",
    "study/closed_loop/session_in_process.py",
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
        "source_file": digests.source_stamp(request.spec),
        "strategy": strategy,
        "settings": json.loads(json.dumps(run)),
        "version": cable_rpc.__version__,
        "code": code_digest(),
        "detector_weights": digests.weights_digest(settings.detector, detector=True),
        "segmenter_weights": digests.weights_digest(settings.segmenter, detector=False),
    }


def cell_key(identity: dict[str, Any]) -> str:
    """A file name for an identity."""
    return digests.key_of(identity, KEY_DIGITS)


def code_digest() -> str:
    """Of the sources that a table's measurement goes through."""
    return digests.code_digest(MEASURING_PARTS)
