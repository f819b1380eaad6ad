"""How `serve` shares its models out among streams: options and what they make."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from cable_rpc.cloud.batching import BatchPolicy

PANEL = "Scheduling"
GPU_BATCH, CPU_BATCH = 8, 2
"""Defaults: a GPU takes several frames in hardly more time than one; a CPU gains little and each frame waits longer."""

HAND_OVER_S = 0.2e-3
"""What a run in another thread costs at least, there and back; a model that is done sooner (an oracle, boxes on small
pictures) is not handed over."""

DetectorBatch = Annotated[
    int | None,
    typer.Option(
        "--detector-batch",
        help=f"Most frames of several streams in one run of the detector; {GPU_BATCH} on a GPU, {CPU_BATCH} on a CPU.",
        min=1,
        rich_help_panel=PANEL,
    ),
]
SegmenterBatch = Annotated[
    int | None,
    typer.Option("--segmenter-batch", help="The same for the segmenter.", min=1, rich_help_panel=PANEL),
]
BatchWait = Annotated[
    float,
    typer.Option(
        "--batch-wait",
        help="Seconds that a free model waits for a batch to fill; 0 begins with the frames that are there.",
        min=0.0,
        max=10.0,
        rich_help_panel=PANEL,
    ),
]
DetectorWorkers = Annotated[
    int,
    typer.Option(
        "--detector-workers",
        help="Runs of the detector at a time, with --threads each: on CPUs better than more threads in one run.",
        min=1,
        rich_help_panel=PANEL,
    ),
]
LatencyBound = Annotated[
    float,
    typer.Option(
        "--latency-bound",
        help="Seconds after which a frame that no model could begin with is shed (OVERLOADED); batches are kept so "
        "small that one runs for half of it at most. 0 = no bound.",
        min=0.0,
        rich_help_panel=PANEL,
    ),
]


def batch_policy(size: int | None, device: str, wait_s: float, latency_bound_s: float, workers: int = 1) -> BatchPolicy:
    """How one model's frames are batched.

    Args:
        size: most frames in a run; None = what suits the device.
        device: of the model, as it tells it.
        wait_s: for a batch to fill.
        latency_bound_s: 0 = none.
        workers: runs at a time.
    """
    from cable_rpc.cloud.batching import BatchPolicy

    usual = CPU_BATCH if "cpu" in device.lower() else GPU_BATCH
    return BatchPolicy(size or usual, wait_s, workers, latency_bound_s / 2 or math.inf, HAND_OVER_S)
