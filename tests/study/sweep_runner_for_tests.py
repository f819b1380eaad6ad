"""A cheap stand-in for the measuring of cells, which processes of a sweep can import, and which notes every call."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cable_codecs import RegionTreatment

from cable_rpc.errors import SourceError
from cable_rpc.study.metrics import ByteLayers
from cable_rpc.study.sequence_metrics import MeasuredFrame, measure_sequence
from cable_rpc.study.sweep import identity
from cable_rpc.study.sweep.cell import (
    CellResult,
    ClipRequest,
    ExampleFrame,
    MeasuredCell,
    RatePoint,
    RegionQuality,
    SweepCell,
    UplinkBytes,
)
from cable_rpc.study.sweep.config import SweepConfig
from cable_rpc.study.sweep.engine import run_sweep
from cable_rpc.study.sweep.executors import Call, Outcome, answer
from cable_rpc.study.sweep.local_executor import LocalExecutor
from cable_rpc.types import Detections

CALLS_VARIABLE = "SWEEP_TEST_CALLS"
"""Environment variable: the file to which every measured cell is appended, a line each."""
SECONDS_VARIABLE = "SWEEP_TEST_SECONDS"
FAILING_QUALITY, RAISING_QUALITY, DEADLY_QUALITY = 51, 50, 49
SEEDS = (1, 2)


def a_cell(seed: int, quality: int, strategy: str = "cable", label: str = "zero") -> SweepCell:
    clip = ClipRequest(f"synthetic:{seed}", max_frames=2)
    return SweepCell(clip, strategy, label, RegionTreatment(), "h264", RatePoint(quality))


def a_config(
    qualities: tuple[int, ...] = (20, 30, 40), name: str = "grid", label: str = "zero", seeds: tuple[int, ...] = SEEDS
) -> SweepConfig:
    cells = tuple(a_cell(seed, quality, label=label) for seed in seeds for quality in qualities)
    return SweepConfig(name, cells, text=f"name: {name}\n")


def note(line: str) -> None:
    if path := os.environ.get(CALLS_VARIABLE):
        with open(path, "a", encoding="utf-8") as file:
            file.write(line + "\n")


def line_of(cell: SweepCell) -> str:
    return f"{cell.clip.source} q{cell.rate.quality}"


def prepare(request: ClipRequest, cache: Path) -> None:
    note(f"prepare {request.source}")
    if request.source.endswith("404"):
        raise SourceError(f"'{request.source}' has no frames")
    cache.mkdir(parents=True, exist_ok=True)
    (cache / "clip").touch()


def measure(cell: SweepCell, cache: Path) -> MeasuredCell:
    note(line_of(cell))
    time.sleep(float(os.environ.get(SECONDS_VARIABLE, "0")))
    quality = cell.rate.quality or 0
    if quality == FAILING_QUALITY:
        return MeasuredCell(cell, None, "the encoder failed")
    if quality == RAISING_QUALITY:
        raise SourceError("the disk is gone")
    if quality == DEADLY_QUALITY:
        os.kill(os.getpid(), 9)
    return MeasuredCell(cell, a_result(cell), "", ExampleFrame(1, b"\xff\xd8 a picture", quality * 10), 0.25)


def a_result(cell: SweepCell) -> CellResult:
    """Numbers that depend on the cell's settings alone."""
    quality = cell.rate.quality or 0
    layers, found = ByteLayers(quality, quality, quality, quality), Detections.empty()
    frame = MeasuredFrame(
        0, True, None, 1.0, None, None, found, found, None, None, None, layers, layers, None, end_to_end_ns=quality
    )
    metrics = measure_sequence([frame], name=cell.clip.source, fps=10.0)
    uplink = UplinkBytes(1000 - quality, 700 - quality, 20, 10)
    fidelity = RegionQuality(2, 640, 0.1 * quality * 640, 1.9, 2)
    return CellResult(
        cell.clip.source, 0.2, "annotated", "none (1, cpu)", "boxes (1, cpu)", metrics, uplink, fidelity, fidelity,
        size_wh=(160, 96),
    )  # fmt: skip


def pinned_digest() -> str:
    """Whoever edits a source while the tests run would make all cells stale."""
    return "pinned"


def pin_code() -> None:
    """For a process of its own."""
    identity.measuring_code = pinned_digest  # type: ignore[assignment]


class InlineExecutor:
    """In this process, one after the other."""

    def __init__(self) -> None:
        self.calls: list[Call] = []

    def __enter__(self) -> InlineExecutor:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.calls.clear()

    def submit(self, function: Callable[[Any], Any], argument: Any) -> None:
        self.calls.append(Call(function, argument))

    def completed(self) -> Iterator[Outcome]:
        while self.calls:
            call = self.calls.pop(0)
            yield Outcome(call.argument, *answer(call))


class PrintingListener:
    """Tells the process that started this one how far it is."""

    def planned(self, cells: int, found: int, clips: int) -> None:
        print("planned", flush=True)

    def prepared(self, clip: ClipRequest, error: str) -> None:
        print("prepared", flush=True)

    def measured(self, cell: MeasuredCell) -> None:
        print("measured", flush=True)


def sweep_in_child(folder: str, qualities: tuple[int, ...]) -> None:
    """Runs in a process of its own."""
    pin_code()
    run_sweep(
        a_config(qualities), Path(folder) / "run", executor=LocalExecutor(2), listener=PrintingListener(),
        runner=measure, preparer=prepare,
    )  # fmt: skip
