"""Measured cells: one strategy over one sequence, each in a JSON file of its own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.run_record import write_json
from cable_rpc.study.sequence_metrics import SequenceMetrics
from cable_rpc.study.tables.equal_quality import EqualQuality
from cable_rpc.study.tables.identity import cell_identity, cell_key
from cable_rpc.study.tables.settings import RunSettings, SequenceRequest

SCHEMA_VERSION = 2
CELLS_FOLDER = "cells"


@dataclass(frozen=True, slots=True)
class Cell:
    """What became of one strategy on one sequence."""

    request: SequenceRequest
    strategy: str
    sequence: str = ""
    """The source's own name; empty where it could not be opened."""
    metrics: SequenceMetrics | None = None
    """None where it failed."""
    error: str = ""
    """Why it failed; empty where it didn't."""
    skipped: tuple[str, ...] = ()
    """Damage that was left out, one line each."""
    detector: str = ""
    segmenter: str = ""
    equal_quality: EqualQuality | None = None
    """None where it failed, or was not asked for."""

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.sequence or self.request.spec}, {self.strategy}"

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {
            "dataset": self.request.dataset,
            "spec": self.request.spec,
            "strategy": self.strategy,
            "sequence": self.sequence,
            "error": self.error,
            "skipped": list(self.skipped),
            "detector": self.detector,
            "segmenter": self.segmenter,
            "metrics": None if self.metrics is None else self.metrics.to_json(),
            "equal_quality": None if self.equal_quality is None else self.equal_quality.to_json(),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """The inverse of `to_json`."""
        metrics, equal_quality = content["metrics"], content["equal_quality"]
        return cls(
            SequenceRequest(content["dataset"], content["spec"]),
            content["strategy"],
            content["sequence"],
            None if metrics is None else SequenceMetrics.from_json(metrics),
            content["error"],
            tuple(content["skipped"]),
            content["detector"],
            content["segmenter"],
            None if equal_quality is None else EqualQuality.from_json(equal_quality),
        )


class CellStore:
    """The folder that holds the cells of one or many runs; a file is there whole or not at all.

    Raises:
        ConfigurationError: the folder can't be made.
    """

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.folder = folder / CELLS_FOLDER
        self.settings = settings
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(f"can't make {self.folder}: {error.strerror or error}") from error

    def path(self, request: SequenceRequest, strategy: str) -> Path:
        """Where a cell of these settings lies."""
        return self.folder / f"{cell_key(cell_identity(request, strategy, self.settings))}.json"

    def find(self, request: SequenceRequest, strategy: str) -> Cell | None:
        """A measured cell; None where there is none, or it failed, or the file is damaged."""
        try:
            content = json.loads(self.path(request, strategy).read_text(encoding="utf-8"))
            cell = Cell.from_json(content["cell"])
        except (OSError, ValueError, KeyError, TypeError, ConfigurationError):
            return None
        return None if cell.metrics is None else cell

    def keep(self, cell: Cell) -> None:
        """Write a cell, failed ones too, for whoever looks for the reason.

        Raises:
            ConfigurationError: the folder can't be written to.
        """
        identity = cell_identity(cell.request, cell.strategy, self.settings)
        path = self.folder / f"{cell_key(identity)}.json"
        try:
            write_json(path, {"schema_version": SCHEMA_VERSION, "identity": identity, "cell": cell.to_json()})
        except OSError as error:
            raise ConfigurationError(f"can't write {path}: {error.strerror or error}") from error
