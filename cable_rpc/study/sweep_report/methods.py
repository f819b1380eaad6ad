"""What a report needs of the methods of a sweep: order, anchor, looks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.report_plots import GREY
from cable_rpc.study.sweep.cell import MeasuredCell, SweepCell

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d4f")
"""Okabe and Ito, "Color Universal Design" (2008), without black and yellow, which vanish on one page or the other."""
SHAPES = (
    ("square", "s", "■"),
    ("diamond", "D", "◆"),
    ("triangle-up", "^", "▲"),
    ("triangle-down", "v", "▼"),
    ("pentagon", "p", "⬟"),
    ("star", "*", "★"),
    ("cross", "P", "✚"),
    ("x", "X", "✖"),
    ("hexagon", "h", "⬢"),
)
"""A marker by its names in Plotly and Matplotlib, and as a character. Their numbers have no common divisor, so that 63
methods differ."""
PART = " · "
"""Between the parts of a method's label."""
ANY_SCALE = "any scale"
ANCHOR_SHAPE = ("circle", "o", "●")


@dataclass(frozen=True, slots=True)
class MethodStyle:
    """How one method is drawn everywhere."""

    label: str
    colour: str
    symbol: str
    """Plotly's name of the marker."""
    marker: str
    """Matplotlib's."""
    glyph: str


def method_styles(labels: Sequence[str], anchors: Sequence[str]) -> dict[str, MethodStyle]:
    """A style for each method, in their order; anchors are grey circles."""
    styles: dict[str, MethodStyle] = {}
    others = [label for label in labels if label not in anchors]
    for label in labels:
        if label in anchors:
            styles[label] = MethodStyle(label, GREY, *ANCHOR_SHAPE)
        else:
            place = others.index(label)
            styles[label] = MethodStyle(label, COLOURS[place % len(COLOURS)], *SHAPES[place % len(SHAPES)])
    return styles


def at_any_scale(cells: Sequence[MeasuredCell]) -> tuple[MeasuredCell, ...]:
    """For each method that was measured at several upload scales, its cells once more as one method.

    Its hull takes the better scale at each rate, as a sender does that adapts its resolution ("convex hull" encoding,
    De Cock et al., ICIP 2016).
    """
    families: dict[str, list[MeasuredCell]] = {}
    for measured in cells:
        scale = f"{PART}scale {measured.cell.treatment.scale:g}"
        families.setdefault(measured.cell.method.replace(scale, "", 1), []).append(measured)
    return tuple(
        replace(one, cell=replace(one.cell, name=f"{label}{PART}{ANY_SCALE}"))
        for label, members in families.items()
        if len({one.cell.treatment.scale for one in members if one.result is not None}) > 1
        for one in members
    )


def is_repeated(cell: SweepCell) -> bool:
    """Whether it is one of `at_any_scale`, which also stands under its own method."""
    return cell.name.endswith(f"{PART}{ANY_SCALE}")


@dataclass(frozen=True, slots=True)
class ShortNames:
    """Methods named by what tells them from each other."""

    of: Mapping[str, str]
    """Whole label to short name."""
    common: str
    """What all of them have in common, left out of the names."""


def short_names(labels: Sequence[str]) -> ShortNames:
    """Names without the parts that all labels share; the first part, the strategy, always stays."""
    parts = {label: label.split(PART) for label in labels}
    shared = set.intersection(*(set(own[1:]) for own in parts.values())) if len(parts) > 1 else set()
    names = {
        label: PART.join(part for k, part in enumerate(own) if not k or part not in shared)
        for label, own in parts.items()
    }
    if len(set(names.values())) < len(names):
        return ShortNames({label: label for label in labels}, "")
    first = next(iter(parts.values()))
    return ShortNames(names, PART.join(part for part in first[1:] if part in shared))


def whole_label(name: str, labels: Sequence[str]) -> str:
    """The label that a name stands for, itself or shortened.

    Raises:
        ConfigurationError: it stands for none.
    """
    found = {short: label for label, short in short_names(labels).of.items()} | {label: label for label in labels}
    if name not in found:
        raise ConfigurationError(f"no method of this run is called '{name}'; choose of: {'; '.join(found)}")
    return found[name]


def renamed(cells: Sequence[MeasuredCell], names: Mapping[str, str]) -> tuple[MeasuredCell, ...]:
    """The cells under their methods' short names."""
    return tuple(
        replace(one, cell=replace(one.cell, name=names.get(one.cell.method, one.cell.method))) for one in cells
    )


def cells_by_method(cells: Sequence[MeasuredCell]) -> dict[str, tuple[MeasuredCell, ...]]:
    """Measured cells of each method, in their order; failed ones and methods without any are left out."""
    grouped: dict[str, list[MeasuredCell]] = {}
    for measured in cells:
        if measured.result is not None:
            grouped.setdefault(measured.cell.method, []).append(measured)
    return {label: tuple(members) for label, members in grouped.items()}


def anchors_of(
    methods: Mapping[str, Sequence[MeasuredCell]], anchor: str, *, for_all: bool = False
) -> dict[str, str | None]:
    """Which method each one is compared with; None for an anchor itself, and where there is none.

    Thinning a drive saves bytes and costs no quality that is measured on the frames that remain, so a method is
    compared with the anchor at its own frame rate, if there is one, and else with the first.

    Args:
        methods: measured cells by label.
        anchor: label of a method, its frame rate left out.
        for_all: the label is a method's whole one, and every other method is compared with that.

    Raises:
        ConfigurationError: ``for_all``, and there is no such method.
    """
    if for_all:
        if anchor not in methods:
            raise ConfigurationError(f"no method of this run is called '{anchor}'; choose of: {'; '.join(methods)}")
        return {label: None if label == anchor else anchor for label in methods}
    rates = {label: members[0].cell for label, members in methods.items()}
    candidates = {cell.clip.fps: label for label, cell in rates.items() if without_rate(cell) == anchor}
    first = next(iter(candidates.values()), None)
    return {
        label: None if label in candidates.values() else candidates.get(cell.clip.fps, first)
        for label, cell in rates.items()
    }


def without_rate(cell: SweepCell) -> str:
    """The method's label without its frame rate."""
    return cell.method if cell.clip.fps is None else cell.method.replace(f" · {cell.clip.fps:g} fps", "", 1)
