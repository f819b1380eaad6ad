"""A sweep that was never run: cells whose rates and qualities are chosen, so that what a report says is known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from cable_codecs import RegionTreatment

from cable_rpc.study.metrics import ByteLayers
from cable_rpc.study.sequence_metrics import MaskOverlap, MeasuredFrame, SequenceMetrics, measure_sequence
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
from cable_rpc.study.sweep.run_folder import SweepRun
from cable_rpc.types import Detections, GroundTruth

CRFS = (22, 26, 30, 34, 38, 42)
KEPT = (20, 19, 18, 16, 13, 9)
"""Detections of 20 that are found again at each CRF."""
SEQUENCES = ("drive-a", "drive-b", "drive-c", "drive-d")
ANCHOR = "full-frame · h264"
FRAMES, FPS = 4, 10.0


def boxes(count: int) -> Detections:
    """The first of a row of boxes that do not touch."""
    corners = [[50.0 * place, 10.0, 50.0 * place + 40.0, 60.0] for place in range(count)]
    return Detections(
        np.array(corners, np.float32).reshape(-1, 4), np.full(count, 2, np.int32), np.full(count, 0.9, np.float32)
    )


def example() -> ExampleFrame:
    _, coded = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (60, 107, 3), np.uint8))
    return ExampleFrame(2, coded.tobytes(), 4321)


@cache
def metrics_of(kept: int, coverage: float, total: int = 20) -> SequenceMetrics:
    """Of frames that are all alike."""
    nothing = ByteLayers(0, 0, 0, 0)
    objects = boxes(total)
    truth = GroundTruth(
        objects.boxes_xyxy, objects.class_ids, np.arange(total, dtype=np.int32), np.ones(total, np.float32)
    )
    frames = [
        MeasuredFrame(
            index=index,
            keyframe=index == 0,
            coverage_roi=coverage,
            coverage_tx=coverage,
            staleness=1,
            truth=truth,
            detections=boxes(kept),
            full_detections=boxes(total),
            overlap_roi=np.ones(total),
            overlap_sent=np.ones(total),
            mask_overlap=MaskOverlap(90, 100),
            bytes_up=nothing,
            bytes_down=nothing,
            full_bytes_up=None,
            stage_ns={"encode": 5_000_000},
            end_to_end_ns=40_000_000 + 1_000_000 * index,
        )
        for index in range(FRAMES)
    ]
    return measure_sequence(frames, name="any", fps=FPS)


def result_of(sequence: str, bytes_per_frame: int, kept: int, coverage: float) -> CellResult:
    """A cell's result with a chosen rate and retention, the same in each frame."""
    total_bytes = bytes_per_frame * FRAMES
    side, overhead = total_bytes // 20, total_bytes // 50
    return CellResult(
        sequence=sequence,
        seconds=FRAMES / FPS,
        truth="detector",
        detector="embedded (r1, cpu)",
        segmenter="boxes (r1, cpu)",
        metrics=replace(metrics_of(kept, coverage), name=sequence),
        uplink=UplinkBytes(total_bytes // 4, total_bytes - total_bytes // 4 - side - overhead, side, overhead),
        sent=RegionQuality(FRAMES, 100, 400.0 + kept, 0.9 * FRAMES, FRAMES),
        objects=RegionQuality(FRAMES, 100, 500.0 + kept, 0.9 * FRAMES, FRAMES),
        size_wh=(640, 360),
    )


def cell_of(sequence: str, strategy: str, treatment: str, crf: int, **changes: object) -> SweepCell:
    clip = ClipRequest(f"synthetic:{sequence}")
    cell = SweepCell(clip, strategy, treatment, RegionTreatment(), "h264", RatePoint(crf))
    return replace(cell, **changes)  # type: ignore[arg-type]


def method_cells(
    strategy: str, treatment: str, factor: float, coverage: float, sequences: Iterable[str] = SEQUENCES
) -> list[MeasuredCell]:
    """A whole method: rates of the anchor times a factor, at the anchor's qualities."""
    cells = []
    for number, sequence in enumerate(sequences):
        for crf, kept in zip(CRFS, KEPT, strict=True):
            anchor_bytes = (1 + 0.5 * number) * 40_000 * 2 ** (-(crf - 22) / 6)
            cells.append(
                MeasuredCell(
                    cell_of(sequence, strategy, treatment, crf),
                    result_of(sequence, round(factor * anchor_bytes), kept, coverage),
                    example=example(),
                    key=f"{strategy}{treatment}{sequence}{crf}".encode().hex(),
                )
            )
    return cells


def sweep_run(folder: Path, *, sequences: Iterable[str] = SEQUENCES) -> SweepRun:
    """Whole frames, a method at 60 % of their rate, one at 90 %, and a failed cell."""
    names = tuple(sequences)
    failed = MeasuredCell(cell_of(names[0], "cable", "black", 50), None, "synthetic:<b>drive</b>: out of & memory")
    cells = (
        *method_cells("full-frame", "whole", 1.0, 1.0, names),
        *method_cells("cable", "black", 0.6, 0.3, names),
        *method_cells("motion-only", "blur", 0.9, 0.5, names),
        failed,
    )
    return SweepRun(
        folder=folder,
        name="fabricated",
        anchor=ANCHOR,
        qualities=("retention", "f1", "psnr_objects"),
        retention_levels=(95.0, 99.0),
        text="name: fabricated\naxes: &all [1, 2]\n",
        environment={"cable-rpc": "0.0", "processor": "abacus"},
        command="cable-rpc sweep fabricated.yaml",
        cells=cells,
        missing=2,
        started="2026-01-01T00:00:00+00:00",
    )
