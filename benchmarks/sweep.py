"""How fast a sweep measures: ``python benchmarks/sweep.py --frames 10``.

The same cells over rendered clips three times, each into a store of its own: with one worker, with two beside each
other, and with one worker for which every cell decodes its clip and runs the models on the whole frames for itself.
Times include the start of the workers.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from cable_codecs import RegionTreatment

from cable_rpc.study.sweep.cell import ClipRequest, MeasuredCell, RatePoint, SweepCell
from cable_rpc.study.sweep.cell_run import run_cell
from cable_rpc.study.sweep.config import SweepConfig
from cable_rpc.study.sweep.engine import CellRunner, ClipPreparer, run_sweep
from cable_rpc.study.sweep.local_executor import LocalExecutor
from cable_rpc.study.sweep.reference import prepare_clip

STRATEGIES = ("full-frame", "cable")
QUALITIES = (24, 28, 32, 36, 40)


def nothing(request: ClipRequest, cache: Path) -> None:
    """In place of preparing a clip for all of its cells."""


def run_cell_alone(cell: SweepCell, cache: Path) -> MeasuredCell:
    """A cell that shares neither frames nor the models' results on them."""
    with tempfile.TemporaryDirectory() as folder:
        return run_cell(cell, Path(folder))


def cells_of(clips: int, frames: int, size: tuple[int, int]) -> tuple[SweepCell, ...]:
    requests = [ClipRequest(f"synthetic:{seed}", size=size, max_frames=frames) for seed in range(1, clips + 1)]
    return tuple(
        SweepCell(clip, strategy, "zero", RegionTreatment(), "h264", RatePoint(quality))
        for clip in requests
        for strategy in STRATEGIES
        for quality in QUALITIES
    )


def measured(
    cells: tuple[SweepCell, ...],
    workers: int,
    runner: CellRunner = run_cell,
    preparer: ClipPreparer = prepare_clip,
) -> float:
    """Seconds of a whole sweep into a store of its own."""
    config = SweepConfig("benchmark", cells, "name: benchmark\n")
    with tempfile.TemporaryDirectory() as folder:
        started = time.monotonic()
        run = run_sweep(config, Path(folder) / "run", executor=LocalExecutor(workers), runner=runner, preparer=preparer)
        seconds = time.monotonic() - started
    failed = [one.error for one in run.cells if one.error]
    if failed:
        raise SystemExit(f"{len(failed)} cells failed: {failed[0]}")
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=2)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), metavar=("WIDTH", "HEIGHT"))
    arguments = parser.parse_args()
    width, height = arguments.size
    cells = cells_of(arguments.clips, arguments.frames, (width, height))
    print(f"{len(cells)} cells of {arguments.frames} frames, {width}x{height}, {arguments.clips} clips")
    runs = {}
    for name, workers, runner, preparer in (
        ("1 worker", 1, run_cell, prepare_clip),
        ("2 workers", 2, run_cell, prepare_clip),
        ("1 worker, nothing shared", 1, run_cell_alone, nothing),
    ):
        runs[name] = seconds = measured(cells, workers, runner, preparer)
        print(f"{name:<26} {seconds:7.1f} s {len(cells) / seconds:7.2f} cells/s", flush=True)
    print(f"2 workers over 1: {runs['1 worker'] / runs['2 workers']:.2f}")
    print(f"shared over not: {runs['1 worker, nothing shared'] / runs['1 worker']:.2f}")


if __name__ == "__main__":
    main()
