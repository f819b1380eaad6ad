"""Data sets by name: the sequences that a root stands for, and how the tables call each set."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import cast

from cable_rpc.data.source import SOURCES
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.tables.settings import SequenceRequest

LISTING_PACKAGES: Mapping[str, str] = {
    "nuscenes": "nuscenes",
    "wod_zb": "coco",
    "waymo": "waymo",
    "kitti": "kitti",
    "cadc": "cadc",
    "coco-video": "coco",
}
"""Scheme to the package of `cable_rpc.data` whose ``sequences`` lists what a root holds."""

TITLES: Mapping[str, str] = {
    "nuscenes": "nuScenes",
    "wod_zb": "WOD-ZB",
    "waymo": "Waymo",
    "kitti": "KITTI",
    "cadc": "CADC",
    "coco-video": "COCO video",
    "synthetic": "rendered",
    "video": "video",
}
"""Scheme of a source to the name that the tables print, in the order of the paper's rows."""


def sequence_requests(specs: Iterable[str]) -> tuple[SequenceRequest, ...]:
    """Every sequence that is asked for, once, in the order asked for.

    Args:
        specs: ``SCHEME:REST`` each; a data set's root without ``#SEQUENCE`` stands for all its sequences.

    Raises:
        ConfigurationError: a scheme is unknown, a root has no sequences, or nothing is asked for.
        SourceError: a root can't be read.
    """
    found = tuple(dict.fromkeys(request for spec in specs for request in requests_of(spec)))
    if not found:
        raise ConfigurationError("tables need data; give --data SCHEME:..., e.g. --data synthetic:90100")
    return found


def requests_of(spec: str) -> list[SequenceRequest]:
    """The sequences of one spec."""
    scheme, separator, rest = spec.partition(":")
    if scheme not in SOURCES or not separator or not rest:
        known = ", ".join(f"{name}:..." for name in sorted(SOURCES))
        raise ConfigurationError(f"--data '{spec}' is no source; known are {known}")
    listing = sequence_listing(scheme)
    if listing is None or "#" in rest:
        return [SequenceRequest(scheme, spec)]
    root, mark, query = rest.partition("?")
    names = listing(Path(root))
    if not names:
        raise ConfigurationError(f"--data '{spec}': {root} holds no sequences")
    return [SequenceRequest(scheme, f"{scheme}:{root}#{name}{mark}{query}") for name in names]


def sequence_listing(scheme: str) -> Callable[[Path], list[str]] | None:
    """What lists a root's sequences; None for sources that are one sequence themselves."""
    package = LISTING_PACKAGES.get(scheme)
    if package is None:
        return None
    listing = importlib.import_module(f"cable_rpc.data.{package}").sequences
    return cast("Callable[[Path], list[str]]", listing)


def title_of(dataset: str) -> str:
    """The name that a scheme has in the tables."""
    return TITLES.get(dataset, dataset)


def paper_order(dataset: str) -> tuple[int, str]:
    """Sorts schemes as the paper's rows, others behind."""
    known = list(TITLES)
    return (known.index(dataset) if dataset in known else len(known), dataset)
