"""Runs what a folder does not hold yet: sequences side by side in processes, each cell kept the moment it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from cable_rpc.study.tables.cells import Cell, CellStore
from cable_rpc.study.tables.sequence_run import SequenceTask, run_sequence
from cable_rpc.study.tables.settings import RunSettings, SequenceRequest
from cable_rpc.study.worker_pool import worker_pool

Listener = Callable[[Cell, bool], None]
"""Told of each cell, and whether it lay in the folder already."""
Runner = Callable[[SequenceTask], list[Cell]]

WORKER_DIED = "its worker process died, probably for want of memory; give --workers 1, --size or --max-frames"


def run_cells(
    requests: Sequence[SequenceRequest],
    strategies: Sequence[str],
    settings: RunSettings,
    folder: Path,
    *,
    workers: int = 1,
    listener: Listener | None = None,
    runner: Runner = run_sequence,
) -> list[Cell]:
    """Measure every strategy on every sequence.

    A run that was stopped goes on where it was: cells that lie in the folder are taken from there, failed ones are
    tried again. A cell that fails is kept with its error and the others go on.

    Args:
        requests: the sequences.
        strategies: names of `cable_rpc.study.strategies.STRATEGIES`.
        settings: the same for all.
        folder: the cells lie below.
        workers: processes, each with its own models; 1 measures in this one.
        listener: told of each cell, those found first.
        runner: what measures a sequence.

    Returns:
        All cells, failed ones too, sequence by sequence in the order given.

    Raises:
        ConfigurationError: the folder can't be used.
    """
    store = CellStore(folder, settings)
    cells: dict[tuple[SequenceRequest, str], Cell] = {}
    tasks: list[SequenceTask] = []
    for request in requests:
        missing = []
        for strategy in strategies:
            cell = store.find(request, strategy)
            if cell is None:
                missing.append(strategy)
                continue
            cells[request, strategy] = cell
            if listener is not None:
                listener(cell, True)
        if missing:
            tasks.append(SequenceTask(request, tuple(missing), settings))
    for measured in measured_tasks(tasks, workers, runner):
        for cell in measured:
            store.keep(cell)
            cells[cell.request, cell.strategy] = cell
            if listener is not None:
                listener(cell, False)
    return [cells[request, strategy] for request in requests for strategy in strategies]


def measured_tasks(tasks: Sequence[SequenceTask], workers: int, runner: Runner) -> Iterator[list[Cell]]:
    """The cells of each task as they become ready."""
    if workers <= 1 or len(tasks) <= 1:
        yield from map(runner, tasks)
        return
    left = list(tasks)
    for task, cells in measured_side_by_side(tasks, workers, runner):
        left.remove(task)
        yield cells
    # A worker that dies takes the pool along: each task that was left gets a process to itself.
    for task in left:
        alone = [cells for _, cells in measured_side_by_side([task], 1, runner)]
        yield alone[0] if alone else [Cell(task.request, name, error=WORKER_DIED) for name in task.strategies]


def measured_side_by_side(
    tasks: Sequence[SequenceTask], workers: int, runner: Runner
) -> Iterator[tuple[SequenceTask, list[Cell]]]:
    """Each task with its cells as they become ready; ends early where a worker dies."""
    with worker_pool(min(workers, len(tasks))) as pool:
        futures: dict[Future[list[Cell]], SequenceTask] = {pool.submit(runner, task): task for task in tasks}
        for future in as_completed(futures):
            try:
                cells = future.result()
            except BrokenProcessPool:
                continue
            yield futures[future], cells
