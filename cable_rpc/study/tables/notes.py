"""What a reader must know before quoting a figure of the tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cable_rpc.study.metrics import GROUPS
from cable_rpc.study.prefill import PROMPT_TOKENS, VISUAL_TOKENS
from cable_rpc.study.sequence_metrics import OPERATING_SCORE
from cable_rpc.study.tables.cells import Cell
from cable_rpc.study.tables.data_sets import paper_order, title_of
from cable_rpc.study.tables.settings import REFERENCE_CODEC, RunSettings

FEW_SEQUENCES = 10
"""Below, a bootstrap's intervals are too narrow."""
LEAST_SEQUENCES = 3


def table_notes(cells: Sequence[Cell], settings: RunSettings, *, by_frame: bool, workers: int) -> tuple[str, ...]:
    """The footnotes of both tables."""
    return (
        averaging_note(settings, by_frame=by_frame),
        treatment_note(settings),
        "Pixels saved is no measure of bytes. Bytes saved is against the same frames whole in "
        f"{settings.reference_text}, counted at four layers: coded picture, + mask, + protobuf message, + headers of "
        "gRPC, HTTP/2, TCP and IP (an estimate). kbit/s is of messages.",
        quality_note(settings),
        *equal_quality_notes(cells, settings),
        f"Tokens and the prefill's paper and FLOPs columns follow from coverage with {VISUAL_TOKENS} visual and "
        f"{PROMPT_TOKENS} prompt tokens; the paper's column takes all work for attention. Timed is the prefill of the "
        "whole frame over that of the received one, Tok real the share of tokens that never entered, both as the "
        "segmenter ran.",
        f"Detections from score {OPERATING_SCORE:g} count, AP takes all; IoU 0.5, classes merged to "
        f"{', '.join(GROUPS)}. Det.Ret, Spur and mask IoU are against the same models on the whole frame.",
        f"Latency is the sum of the measured stages of a frame, from ROI prediction to the applied mask, without any "
        f"link or waiting, {beside(workers)}.",
        *interval_notes(cells),
        *model_notes(cells),
        *data_notes(cells),
        "Rows marked paper are as printed by Que et al.: LISA++ 7B and RT-DETR R50, sequences and frames not told.",
    )


def treatment_note(settings: RunSettings) -> str:
    """What the codec and the models get outside the region."""
    treatment = settings.used_treatment
    shown = "the region's own colours, spread outward" if treatment.refill == "diffuse" else "a constant colour"
    if treatment.compose or not treatment.refills:
        shown = "what was received there"
    return (
        f"Regions lie on a grid of {treatment.grid} px; outside them the codec gets the fill '{treatment.fill}', the "
        f"models see {shown}."
    )


def averaging_note(settings: RunSettings, *, by_frame: bool) -> str:
    """Which definitions the figures follow."""
    mode = f"ROI mode {settings.roi.mode}, feedback one frame late (lock-step)."
    if by_frame:
        return (
            f"{mode} Averages as the paper's: over frames, coverage and recognition of R_k on all frames but the first "
            "(keyframes by their R_k; Sent counts them whole), speed-ups as means of ratios, all annotated objects."
        )
    return (
        f"{mode} Counts are pooled over frames; coverage and recognition are of what was sent (keyframes count whole); "
        "objects of at least 25 px height that are at least half visible."
    )


def quality_note(settings: RunSettings) -> str:
    """How comparable the bytes are."""
    if settings.codec == REFERENCE_CODEC:
        return "Equal encoder setting is not equal quality: a region alone is coded better than in its frame."
    return (
        f"Regions were coded in {settings.quality_text}, whole frames in {settings.reference_text}: the two settings "
        "are not equal quality."
    )


def equal_quality_notes(cells: Sequence[Cell], settings: RunSettings) -> Iterator[str]:
    """What the bytes at equal quality are, and where there are none."""
    if not settings.equal_quality:
        yield "Bytes at equal PSNR were not measured (--no-equal-quality)."
        return
    yield (
        "Equal PSNR: dB is the luma PSNR inside what was sent (keyframes whole), squared errors pooled over frames; "
        f"saved, in %, is messages against those of the same frames whole in {REFERENCE_CODEC} at the CRF that gives "
        "that PSNR there, interpolated (PCHIP of log bytes) between CRFs that were coded, never beyond."
    )
    found: dict[str, list[str]] = {}
    for cell in cells:
        if cell.equal_quality is not None and cell.equal_quality.whole_bytes() is None:
            found.setdefault(cell.sequence, []).append(cell.strategy)
    if found:
        lost = "; ".join(f"{sequence} ({', '.join(names)})" for sequence, names in found.items())
        yield f"Left out of the saving at equal PSNR, which lies beyond the CRFs coded: {lost}."


def beside(workers: int) -> str:
    """How crowded the machine was."""
    return "one sequence at a time" if workers == 1 else f"up to {workers} sequences at a time on one machine"


def interval_notes(cells: Sequence[Cell]) -> Iterator[str]:
    """How far the intervals can be trusted."""
    counts = {dataset: len(found) for dataset, found in sequences_by_dataset(cells).items()}
    if any(count >= LEAST_SEQUENCES for count in counts.values()):
        yield "Intervals are 95 %, by cluster bootstrap over sequences; average precision has none."
    few = [title_of(dataset) for dataset, count in counts.items() if LEAST_SEQUENCES <= count < FEW_SEQUENCES]
    if few:
        yield f"Fewer than {FEW_SEQUENCES} sequences of {', '.join(few)}: these intervals are too narrow."
    none = [title_of(dataset) for dataset, count in counts.items() if count < LEAST_SEQUENCES]
    if none:
        yield f"Fewer than {LEAST_SEQUENCES} sequences of {', '.join(none)}: no interval."


def model_notes(cells: Sequence[Cell]) -> Iterator[str]:
    """Which models answered."""
    measured = [cell for cell in cells if cell.metrics is not None]
    for kind, names in (
        ("Detector", {cell.detector for cell in measured}),
        ("Segmenter", {cell.segmenter for cell in measured}),
    ):
        if names:
            yield f"{kind}: {', '.join(sorted(names))}."
    if any(cell.segmenter.startswith("oracle") for cell in measured):
        yield "The oracle reads the ground truth: its figures are an upper bound of what a real model reaches."


def data_notes(cells: Sequence[Cell]) -> Iterator[str]:
    """What was measured of each data set."""
    for dataset, found in sequences_by_dataset(cells).items():
        metrics = [cell.metrics for cell in found if cell.metrics is not None]
        frames, annotated = sum(one.frames for one in metrics), sum(one.truth_frames for one in metrics)
        plural = "" if len(found) == 1 else "s"
        truth = "all annotated" if annotated == frames else f"{annotated} annotated"
        yield f"{title_of(dataset)}: {len(found)} sequence{plural}, {frames} frames, {truth}."


def sequences_by_dataset(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    """One measured cell of each sequence, by data set in the order of the rows."""
    found: dict[str, dict[str, Cell]] = {}
    for cell in cells:
        if cell.metrics is not None:
            found.setdefault(cell.request.dataset, {}).setdefault(cell.request.spec, cell)
    return {dataset: list(found[dataset].values()) for dataset in sorted(found, key=paper_order)}
