"""Measures what the store does not hold yet of a sweep, each cell kept the moment it is there."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep.cell import ClipRequest, MeasuredCell, SweepCell
from cable_rpc.study.sweep.cell_run import run_cell
from cable_rpc.study.sweep.executors import Executor
from cable_rpc.study.sweep.identity import cell_keys
from cable_rpc.study.sweep.reference import prepare_clip
from cable_rpc.study.sweep.run_folder import SweepRun, begin_run, end_run
from cable_rpc.study.sweep.store import CellStore

if TYPE_CHECKING:
    from cable_rpc.study.sweep.config import SweepConfig

STORE_FILE = "cells.sqlite"
CLIPS_FOLDER = "clips"
LOCK_FILE = "clips.lock"


class CellRunner(Protocol):
    """Measures a cell, and tells of a failure in it; a module's own function."""

    def __call__(self, cell: SweepCell, cache: Path) -> MeasuredCell:
        """``cache`` is the folder of decoded clips."""
        ...


class ClipPreparer(Protocol):
    """Decodes a clip and shows it to the models; a module's own function."""

    def __call__(self, request: ClipRequest, cache: Path) -> None:
        """``cache`` is the folder of decoded clips."""
        ...


class SweepListener(Protocol):
    """Told how far a sweep has come."""

    def planned(self, cells: int, found: int, clips: int) -> None:
        """Once, first: all cells, how many of them the store holds, and the clips that the others need."""
        ...

    def prepared(self, clip: ClipRequest, error: str) -> None:
        """A clip is there, or, with an error, can't be."""
        ...

    def measured(self, cell: MeasuredCell) -> None:
        """A cell has been measured, or failed, and is stored."""
        ...


def run_sweep(
    config: SweepConfig,
    folder: Path,
    *,
    executor: Executor,
    store: Path | None = None,
    listener: SweepListener | None = None,
    keep_clips: bool = False,
    command: str = "",
    runner: CellRunner = run_cell,
    preparer: ClipPreparer = prepare_clip,
) -> SweepRun:
    """Measure the cells that the store lacks, and write the run's folder.

    A sweep that was stopped goes on where it was; cells that failed are tried again. A cell that fails is stored with
    its error, and the others go on. Clips that cells share are decoded, and shown to the models whole, before.

    Args:
        config: the cells, and what is told of them.
        folder: the run's.
        executor: what measures cells beside each other; entered and left here.
        store: the file of cells, which sweeps may share; None = `STORE_FILE` beside the folder.
        listener: told how far it has come.
        keep_clips: leave the decoded clips, for the next sweep; they lie beside the store.
        command: as typed, for people.
        runner: what measures a cell.
        preparer: what prepares a clip.

    Raises:
        ConfigurationError: folder, store or executor can't be used.
        KeyboardInterrupt: what is done is kept and written down.
    """
    path = store or folder.parent / STORE_FILE
    clips = path.absolute().parent / CLIPS_FOLDER
    keys = cell_keys(config.cells)
    with CellStore(path) as cells:
        run = begin_run(config, keys, folder, path, command)
        missing = {key: cell for key, cell in zip(keys, config.cells, strict=True) if cells.find(key) is None}
        requests = list(dict.fromkeys(cell.clip for cell in missing.values()))
        if listener is not None:
            listener.planned(len(set(keys)), len(set(keys)) - len(missing), len(requests))
        whole = False
        try:
            with clips_in_use(clips, keep=keep_clips), executor:
                broken = prepare_all(requests, executor, partial(preparer, cache=clips), listener)
                for key, measured in measure_all(missing, broken, executor, partial(runner, cache=clips)):
                    cells.keep(key, measured)
                    if listener is not None:
                        listener.measured(replace(measured, key=key))
            whole = True
        finally:
            done = end_run(run, folder, path, whole=whole)
    return done


def prepare_all(
    requests: list[ClipRequest],
    executor: Executor,
    prepare: Callable[[ClipRequest], None],
    listener: SweepListener | None,
) -> dict[ClipRequest, str]:
    """Prepare every clip; those that can't be, with the reason."""
    for request in requests:
        executor.submit(prepare, request)
    broken = {}
    for outcome in executor.completed():
        if outcome.error:
            broken[outcome.argument] = outcome.error
        if listener is not None:
            listener.prepared(outcome.argument, outcome.error)
    return broken


def measure_all(
    cells: Mapping[str, SweepCell],
    broken: Mapping[ClipRequest, str],
    executor: Executor,
    run: Callable[[SweepCell], MeasuredCell],
) -> Iterator[tuple[str, MeasuredCell]]:
    """Each cell with its key, as it becomes ready, failed ones too; those of a clip stand together."""
    ordered: dict[ClipRequest, list[str]] = {}
    for key, cell in cells.items():
        ordered.setdefault(cell.clip, []).append(key)
    key_of: dict[int, str] = {}
    for clip, keys in ordered.items():
        for key in keys:
            cell = cells[key]
            if clip in broken:
                yield key, MeasuredCell(cell, None, named(cell, broken[clip]))
                continue
            key_of[id(cell)] = key
            executor.submit(run, cell)
    for outcome in executor.completed():
        key = key_of[id(outcome.argument)]
        if outcome.error:
            yield key, MeasuredCell(cells[key], None, named(cells[key], outcome.error))
        else:
            yield key, replace(outcome.result, cell=cells[key])


def named(cell: SweepCell, error: str) -> str:
    """An error that tells its source, on one line."""
    where = f"{cell.clip.source}: "
    text = " ".join(error.split())
    return text if text.startswith(where) else where + text


@contextmanager
def clips_in_use(folder: Path, *, keep: bool) -> Iterator[None]:
    """Removes the decoded clips when the last sweep that uses them is done, unless they are to be kept.

    A sweep that is interrupted leaves none either; one that is killed leaves what the next one takes up.

    Raises:
        ConfigurationError: the folder can't be written to.
    """
    lock = folder.with_name(LOCK_FILE)
    try:
        file = lock.open("ab")
    except OSError as error:
        raise ConfigurationError(f"can't write {lock}: {error.strerror or error}; choose another --store") from error
    with file:
        hold(file, shared=True)
        try:
            yield
        finally:
            if not keep and hold(file, shared=False):
                shutil.rmtree(folder, ignore_errors=True)


def hold(file: Any, *, shared: bool) -> bool:
    """Takes the lock; alone only where nobody else holds it. Whether that went well."""
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_SH if shared else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
