"""A sweep's configuration: a YAML text, and the cells that it stands for."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

from cable_rpc.errors import CableError, ConfigurationError
from cable_rpc.study.closed_loop.models import ModelChoice
from cable_rpc.study.sweep.axes import (
    NamedRoi,
    labelled,
    read_codec,
    read_qualities,
    read_roi,
    read_strategy,
    treatment_for,
    usual_rates,
)
from cable_rpc.study.sweep.cell import ANCHOR_CODEC, ANCHOR_STRATEGY, ClipRequest, RatePoint, SweepCell, TruthChoice
from cable_rpc.study.sweep.config_entry import Entry, read_document
from cable_rpc.study.sweep.grid import MOST_CELLS, PLAIN_ROI, Grid, merged, read_grid, unique, whole_frames
from cable_rpc.study.tables.data_sets import requests_of

KEYS = (
    "name", "sequences", "detector", "segmenter", "device", "threads", "prompt", "truth", "max_frames", "size", "roi",
    "rois", "block_size", "grids", "anchor", "report",
)  # fmt: skip
SCALAR_KEYS = (
    "name", "detector", "segmenter", "device", "threads", "prompt", "truth", "max_frames", "size", "block_size",
)  # fmt: skip
"""Keys of one value, which an option of the command may replace."""
DEVICES = ("auto", "cpu", "cuda")
ANCHOR_QUALITIES = (20, 24, 28, 32, 36, 40, 44)
"""CRFs of whole frames in H.264 where the sweep names none."""
FEWEST_POINTS = 5
"""A BD-rate needs so many."""
USUAL_QUALITIES = ("retention", "ap50")
USUAL_LEVELS = (95.0, 99.0)
LONGEST_NAME = 60
LARGEST_SIDE = 16384


@dataclass(frozen=True, slots=True)
class SweepConfig:
    """What to measure, and what to make of it."""

    name: str
    cells: tuple[SweepCell, ...]
    """Each once; those of a clip stand together, the anchor's first."""
    text: str
    """YAML as given, or as made from the command's options."""
    anchor: str = f"{ANCHOR_STRATEGY} · {ANCHOR_CODEC}"
    """Method that all others are held against, without frame rate and link."""
    qualities: tuple[str, ...] = USUAL_QUALITIES
    """Names of `cable_rpc.study.sweep.qualities.QUALITIES`, the most important first."""
    retention_levels: tuple[float, ...] = USUAL_LEVELS
    """Percent of the detections kept at which rates are compared."""
    notes: tuple[str, ...] = ()
    """What was left out, and what will be missing; for people."""


@dataclass(frozen=True, slots=True)
class Common:
    """What all grids of a sweep share."""

    sources: tuple[str, ...]
    clip: ClipRequest
    """But for source and frame rate."""
    rois: tuple[NamedRoi, ...]
    block_size: int


def read_config(path: Path) -> SweepConfig:
    """A configuration from a file.

    Args:
        path: YAML, UTF-8; without a ``name`` the sweep is called as the file. Paths inside it start at the working
            folder.

    Raises:
        ConfigurationError: the file can't be read or says what can't be done.
        SourceError: a data set's root can't be read.
    """
    return config_from_text(read_text(path), str(path))


def read_text(path: Path) -> str:
    """A configuration's text.

    Raises:
        ConfigurationError: the file can't be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"can't read the sweep's configuration {path}: {reason}") from error


def config_from_text(text: str, where: str, *, numbered: bool = True) -> SweepConfig:
    """A configuration from a YAML text.

    Args:
        text: as docs/sweep.md describes it.
        where: its file, for people; its stem is the name of a sweep that has none.
        numbered: whether errors tell lines; of no use where nobody has seen the text.

    Raises:
        ConfigurationError: the text says what can't be done; file, line, key and what is allowed are told.
        SourceError: a data set's root can't be read.
    """
    keys = read_document(text, where, numbered=numbered).mapping(KEYS)
    if "sequences" not in keys:
        raise ConfigurationError(f"{where}: 'sequences' is missing; give e.g. sequences: [video:clip.mp4]")
    common = read_common(keys)
    grids, notes = read_grids(keys.get("grids"), where)
    check_count(grids, common, where)
    anchor, anchor_notes = read_anchor(keys.get("anchor"), grids, common)
    cells = merged((*anchor, *grid_cells(grids, common)), where)
    qualities, levels = read_report(keys.get("report"))
    return SweepConfig(
        read_name(keys.get("name"), where),
        cells,
        text,
        replace(anchor[0], clip=replace(anchor[0].clip, fps=None)).method,
        qualities,
        levels,
        (*notes, *anchor_notes),
    )


def read_name(entry: Entry | None, where: str) -> str:
    """What the sweep, and its folder, are called."""
    if entry is None:
        return re.sub(r"[^\w.-]+", "-", Path(where).stem).strip(".-")[:LONGEST_NAME] or "sweep"
    if not re.fullmatch(rf"\w[\w.-]{{0,{LONGEST_NAME - 1}}}", entry.text()):
        raise entry.unfit(f"1..{LONGEST_NAME} letters, digits, '_', '-' or '.', no '.' or '-' first")
    return entry.text()


def read_common(keys: Mapping[str, Entry]) -> Common:
    """What all grids share."""
    sources = unique(source for item in keys["sequences"].items() for source in sequences_of(item))
    models = ModelChoice(
        keys["segmenter"].text() if "segmenter" in keys else "embedded",
        keys["detector"].text() if "detector" in keys else "embedded",
        keys["device"].one_of(DEVICES) if "device" in keys else "auto",
        keys["threads"].whole(1, 1024) if "threads" in keys else 1,
    )
    prompt = keys.get("prompt")
    clip = ClipRequest(
        "",
        size=read_size(keys["size"]) if "size" in keys else None,
        max_frames=keys["max_frames"].whole(1, 10**9) if "max_frames" in keys else None,
        truth=keys["truth"].one_of(get_args(TruthChoice)) if "truth" in keys else "auto",  # type: ignore[arg-type]
        prompt="" if prompt is None or prompt.value in ("", None) else prompt.text(),
        models=models,
    )
    return Common(sources, clip, read_rois(keys), keys["block_size"].whole(1, 64) if "block_size" in keys else 8)


def sequences_of(entry: Entry) -> list[str]:
    """The sequences that one text stands for; a data set's root stands for all it holds."""
    try:
        return [request.spec for request in requests_of(entry.text())]
    except CableError as error:
        if str(error).startswith(entry.document.where):
            raise
        reason = str(error).removeprefix("--data ")
        raise type(error)(str(entry.error(f"can't be used: {reason}"))) from error


def read_size(entry: Entry) -> tuple[int, int]:
    """ "960x540" as (960, 540)."""
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", entry.value) if isinstance(entry.value, str) else None
    if found is None or max(map(int, found.groups())) > LARGEST_SIDE:
        raise entry.unfit(f"WIDTHxHEIGHT in pixels up to {LARGEST_SIDE}, e.g. 960x540")
    return int(found[1]), int(found[2])


def read_rois(keys: Mapping[str, Entry]) -> tuple[NamedRoi, ...]:
    """The ROI settings of all grids."""
    if "roi" in keys and "rois" in keys:
        raise keys["rois"].error("stands beside 'roi'; keep one of them")
    if "roi" in keys:
        config = read_roi(keys["roi"])
        return (NamedRoi(config.mode, config),)
    named = labelled(keys["rois"]) if "rois" in keys else {}
    return tuple(NamedRoi(label, read_roi(one)) for label, one in named.items()) or (PLAIN_ROI,)


def read_grids(entry: Entry | None, where: str) -> tuple[tuple[Grid, ...], tuple[str, ...]]:
    """All products, and notes on what was left out."""
    if entry is None:
        raise ConfigurationError(f"{where}: 'grids' is missing; give e.g. grids: [{{strategies: cable, codecs: h264}}]")
    found = [read_grid(item) for item in entry.items()]
    return tuple(grid for grid, _ in found), tuple(f"{where}: {note}" for _, notes in found for note in notes)


def check_count(grids: tuple[Grid, ...], common: Common, where: str) -> None:
    """Refuses what nobody waits for.

    Raises:
        ConfigurationError: there are more than `MOST_CELLS` cells.
    """
    count = sum(grid.size(len(common.rois)) for grid in grids) * len(common.sources)
    if count > MOST_CELLS:
        raise ConfigurationError(
            f"{where}: the grids make {count} cells, at most {MOST_CELLS} are run; split the sweep, its parts share "
            "cells"
        )


def grid_cells(grids: tuple[Grid, ...], common: Common) -> Iterator[SweepCell]:
    """Cells of all products, equal ones included."""
    for source in common.sources:
        for grid in grids:
            for fps in grid.fps:
                yield from grid.cells(replace(common.clip, source=source, fps=fps), common.rois, common.block_size)


def read_anchor(
    entry: Entry | None, grids: tuple[Grid, ...], common: Common
) -> tuple[list[SweepCell], tuple[str, ...]]:
    """What all methods are held against, for every sequence and frame rate, and notes on it.

    Its points are those that the grids give its codec, so that they are shared where the grids hold it already.
    """
    keys = {} if entry is None else entry.mapping(("strategy", "codec", "quality"))
    strategy = read_strategy(keys["strategy"]) if "strategy" in keys else ANCHOR_STRATEGY
    codec = read_codec(keys["codec"], keys["codec"].text()) if "codec" in keys else ANCHOR_CODEC
    if "quality" in keys:
        rates = [RatePoint(quality) for quality in read_qualities(codec, keys["quality"])]
    else:
        rates = anchor_rates(codec, grids)
    rates = sorted(dict.fromkeys(rates), key=lambda rate: rate.quality or 0)
    notes: tuple[str, ...] = ()
    if len(rates) < FEWEST_POINTS:
        notes = (
            f"the anchor has {len(rates)} points; a BD-rate needs {FEWEST_POINTS}: give more qualities of {codec}",
        )
    cells = []
    for source in common.sources:
        for fps in unique(fps for grid in grids for fps in grid.fps):
            clip = replace(common.clip, source=source, fps=fps)
            cells += [anchor_cell(clip, strategy, codec, rate, common) for rate in rates]
    return cells, notes


def anchor_rates(codec: str, grids: tuple[Grid, ...]) -> list[RatePoint]:
    """All qualities that the grids give a codec, or the usual ones."""
    given = [rate for grid in grids for rate in grid.rates.get(codec, ()) if rate.quality is not None]
    if given:
        return given
    return [RatePoint(crf) for crf in ANCHOR_QUALITIES] if codec == ANCHOR_CODEC else list(usual_rates(codec))


def anchor_cell(clip: ClipRequest, strategy: str, codec: str, rate: RatePoint, common: Common) -> SweepCell:
    """One cell of the anchor: full resolution, no delay, no link."""
    if strategy == ANCHOR_STRATEGY:
        return whole_frames(clip, codec, rate, 1.0, None, common.block_size)
    roi = common.rois[0]
    return SweepCell(
        clip, strategy, "default", treatment_for(codec, {}), codec, rate,
        roi=roi.config, roi_label=roi.label, block_size=common.block_size,
    )  # fmt: skip


def read_report(entry: Entry | None) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Which qualities curves are drawn of, and at which shares of detections kept rates are compared."""
    from cable_rpc.study.sweep.qualities import QUALITIES

    keys = {} if entry is None else entry.mapping(("qualities", "retention_levels"))
    qualities: tuple[str, ...] = USUAL_QUALITIES
    levels: tuple[float, ...] = USUAL_LEVELS
    if "qualities" in keys:
        qualities = unique(item.one_of(tuple(QUALITIES)) for item in keys["qualities"].items())
    if "retention_levels" in keys:
        levels = unique(item.number(1, 100) for item in keys["retention_levels"].items())
    return qualities, levels
