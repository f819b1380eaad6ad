"""The folder of one sweep: what was asked for, on what it ran, and a table; the cells themselves lie in the store."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.run_record import write_json, write_text
from cable_rpc.study.sweep.cell import MeasuredCell, SweepCell
from cable_rpc.study.sweep.cell_settings import CellLabels, labelled_cell
from cable_rpc.study.sweep.cells_csv import cells_csv
from cable_rpc.study.sweep.environment import environment
from cable_rpc.study.sweep.store import CellStore

if TYPE_CHECKING:
    from cable_rpc.study.sweep.config import SweepConfig

SCHEMA_VERSION = 1
RUN_FILE = "run.json"
CELLS_FILE = "cells.csv"


@dataclass(frozen=True, slots=True)
class SweepRun:
    """A sweep and what has been measured of it."""

    folder: Path
    name: str
    anchor: str
    qualities: tuple[str, ...]
    retention_levels: tuple[float, ...]
    text: str
    """The configuration, YAML."""
    environment: Mapping[str, str]
    command: str
    cells: tuple[MeasuredCell, ...]
    """Measured and failed, in the configuration's order, with its labels."""
    missing: int
    """Cells that have not been tried, or whose row is damaged."""
    notes: tuple[str, ...] = ()
    started: str = ""
    """UTC, ISO 8601, as the next."""
    finished: str = ""
    """Empty where the sweep was stopped, or goes on."""


@dataclass(frozen=True, slots=True)
class RunFile:
    """The content of `RUN_FILE`."""

    name: str
    anchor: str
    qualities: Sequence[str]
    retention_levels: Sequence[float]
    text: str
    notes: Sequence[str]
    command: str
    environment: Mapping[str, str]
    store: str
    """Path from the folder."""
    keys: Sequence[str]
    """In the order of the cells."""
    labels: Sequence[Sequence[str]]
    """Of each cell: treatment, region settings, link."""
    started: str
    finished: str | None = None

    def write(self, folder: Path) -> None:
        """Whole or not at all.

        Raises:
            ConfigurationError: the folder can't be written to.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_json(folder / RUN_FILE, {"schema_version": SCHEMA_VERSION} | asdict(self))
        except OSError as error:
            raise ConfigurationError(f"can't write {folder / RUN_FILE}: {error.strerror or error}") from error

    @classmethod
    def read(cls, folder: Path) -> RunFile:
        """The inverse of `write`.

        Raises:
            ConfigurationError: there is none, or it is of another version, or no sweep's.
        """
        path = folder / RUN_FILE
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            version = content.pop("schema_version", None)
        except (OSError, ValueError, AttributeError) as error:
            raise ConfigurationError(f"{folder} is no folder of a sweep: can't read {RUN_FILE}: {error}") from error
        if version != SCHEMA_VERSION:
            raise ConfigurationError(f"{path} has schema version {version}, this program reads {SCHEMA_VERSION}")
        try:
            run = cls(**content)
        except TypeError as error:
            raise ConfigurationError(f"{path} is not what a sweep writes: {error}") from error
        if len(run.keys) != len(run.labels):
            raise ConfigurationError(
                f"{path} has {len(run.keys)} keys for {len(run.labels)} cells; run the sweep again"
            )
        return run


def begin_run(config: SweepConfig, keys: Sequence[str], folder: Path, store: Path, command: str) -> RunFile:
    """Write down what is about to be measured.

    Raises:
        ConfigurationError: the folder can't be written to.
    """
    run = RunFile(
        config.name,
        config.anchor,
        config.qualities,
        config.retention_levels,
        config.text,
        config.notes,
        command,
        environment(),
        Path(os.path.relpath(store.absolute(), folder.absolute())).as_posix(),
        keys,
        [label_list(cell) for cell in config.cells],
        now(),
    )
    run.write(folder)
    return run


def end_run(run: RunFile, folder: Path, store: Path, *, whole: bool) -> SweepRun:
    """Write the table of what is there, and whether that is all; both files are there whole or not at all.

    Raises:
        ConfigurationError: the folder can't be written to, or the store can't be read.
    """
    run = replace(run, finished=now() if whole else None)
    with CellStore(store) as cells:
        found = run_of(run, folder, cells)
    try:
        write_text(folder / CELLS_FILE, cells_csv(found.cells))
    except OSError as error:
        raise ConfigurationError(f"can't write {folder / CELLS_FILE}: {error.strerror or error}") from error
    run.write(folder)
    return found


def read_run(folder: Path, store: Path | None = None) -> SweepRun:
    """A sweep from its folder, one that was stopped or goes on too.

    Args:
        folder: what `cable-rpc sweep --out` named.
        store: where the cells lie now; None = where the folder says.

    Raises:
        ConfigurationError: this is no folder of a sweep, or the store is not there or can't be read.
    """
    run = RunFile.read(folder)
    path = store or folder / run.store
    if not path.is_file():
        raise ConfigurationError(f"the cells of {folder} should lie in {path}, which isn't there; name it with --store")
    with CellStore(path) as cells:
        return run_of(run, folder, cells)


def run_of(run: RunFile, folder: Path, store: CellStore) -> SweepRun:
    """What the store has of a run."""
    cells = []
    for key, labels in zip(run.keys, run.labels, strict=True):
        measured = store.read(key)
        if measured is not None:
            cells.append(replace(measured, cell=labelled_cell(measured.cell, CellLabels(*labels))))
    return SweepRun(
        folder,
        run.name,
        run.anchor,
        tuple(run.qualities),
        tuple(run.retention_levels),
        run.text,
        run.environment,
        run.command,
        tuple(cells),
        len(run.keys) - len(cells),
        tuple(run.notes),
        run.started,
        run.finished or "",
    )


def label_list(cell: SweepCell) -> list[Any]:
    """As plain JSON values."""
    return list(asdict(CellLabels.of(cell)).values())


def now() -> str:
    """UTC, ISO 8601, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")
