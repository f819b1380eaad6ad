"""How `serve` shares its models out among streams: options."""

from __future__ import annotations

from typing import Annotated

import typer

PANEL = "Scheduling"
DetectorBatch = Annotated[
    int | None,
    typer.Option(
        "--detector-batch",
        help="Most frames of several streams in one run of the detector; 8 on a GPU, 2 on a CPU.",
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
