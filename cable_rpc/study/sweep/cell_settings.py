"""A cell of a sweep from the plain values that were written down of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from cable_codecs import RegionTreatment

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.study.closed_loop.models import ModelChoice
from cable_rpc.study.sweep.cell import ClipRequest, RatePoint, SweepCell
from cable_rpc.study.sweep.simulated_link import SimulatedLink


@dataclass(frozen=True, slots=True)
class CellLabels:
    """Names that a sweep's author chose; they take no part in a cell's identity."""

    treatment: str
    roi: str
    link: str = ""

    @classmethod
    def of(cls, cell: SweepCell) -> CellLabels:
        """Those of a cell."""
        return cls(cell.treatment_label, cell.roi_label, "" if cell.link is None else cell.link.name)


def cell_from_settings(settings: Mapping[str, Any], labels: CellLabels) -> SweepCell:
    """The inverse of `SweepCell.settings`.

    Raises:
        KeyError, TypeError, ValueError, CableError, CodecError: these are not the settings of a cell.
    """
    clip, link = settings["clip"], settings["link"]
    size = None if clip["size"] is None else tuple(clip["size"])
    return SweepCell(
        **{
            **settings,
            "clip": ClipRequest(**{**clip, "size": size, "models": ModelChoice(**clip["models"])}),
            "treatment_label": labels.treatment,
            "treatment": RegionTreatment(**settings["treatment"]),
            "rate": RatePoint(**settings["rate"]),
            "link": link
            and SimulatedLink(**{**link, "name": labels.link or "link", "trace_ms": tuple(link["trace_ms"])}),
            "roi": RoiConfig(**settings["roi"]),
            "roi_label": labels.roi,
        }
    )


def labelled_cell(cell: SweepCell, labels: CellLabels) -> SweepCell:
    """The same cell under a sweep's own names."""
    link = cell.link and replace(cell.link, name=labels.link)
    return replace(cell, treatment_label=labels.treatment, roi_label=labels.roi, link=link)
