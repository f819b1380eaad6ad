"""Products of axes, and the cells that they make."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from cable_codecs import STILL_CODECS, RegionTreatment

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep.axes import (
    LARGEST_DELAY,
    NamedRoi,
    labelled,
    read_fps,
    read_link,
    read_rates,
    read_strategy,
    read_treatments,
)
from cable_rpc.study.sweep.cell import ANCHOR_STRATEGY as FULL_FRAME
from cable_rpc.study.sweep.cell import ClipRequest, RatePoint, SweepCell
from cable_rpc.study.sweep.config_entry import Entry
from cable_rpc.study.sweep.simulated_link import SimulatedLink

GRID_KEYS = ("strategies", "treatments", "codecs", "fps", "upload_scale", "feedback_delay", "links")
MOST_CELLS = 100_000
SMALLEST_SCALE = 1 / 16
PLAIN_ROI = NamedRoi("robust", RoiConfig())


@dataclass(frozen=True, slots=True)
class Grid:
    """One product of axes."""

    strategies: tuple[str, ...]
    rates: Mapping[str, tuple[RatePoint, ...]]
    """Codec to the points of its curves."""
    treatments: Mapping[str, Mapping[str, RegionTreatment]]
    """Label to codec to treatment."""
    fps: tuple[float | None, ...] = (None,)
    scales: tuple[float, ...] = (1.0,)
    delays: tuple[int, ...] = (1,)
    links: tuple[SimulatedLink | None, ...] = (None,)

    def size(self, rois: int) -> int:
        """Cells of one sequence, equal ones included."""
        regions = sum(strategy != FULL_FRAME for strategy in self.strategies)
        treated = sum(len(self.rates[codec]) for by_codec in self.treatments.values() for codec in by_codec)
        whole = sum(map(len, self.rates.values())) * (len(self.strategies) - regions)
        both = regions * treated * len(self.delays) * rois + whole
        return both * len(self.fps) * len(self.scales) * len(self.links)

    def cells(self, clip: ClipRequest, rois: Iterable[NamedRoi], block_size: int) -> Iterator[SweepCell]:
        """Cells of one sequence at one of the frame rates.

        Whole frames have no region: treatment, ROI settings and feedback make no difference to them.
        """
        for strategy, (codec, rates), scale, link in (
            (strategy, rate, scale, link)
            for strategy in self.strategies
            for rate in self.rates.items()
            for scale in self.scales
            for link in self.links
        ):
            if strategy == FULL_FRAME:
                for rate in rates:
                    yield whole_frames(clip, codec, rate, scale, link, block_size)
                continue
            for label, by_codec in self.treatments.items():
                if codec not in by_codec:
                    continue
                treatment = replace(by_codec[codec], scale=scale)
                for roi in rois:
                    for delay in self.delays:
                        for rate in rates:
                            yield SweepCell(
                                clip, strategy, label, treatment, codec, rate, delay, link,
                                roi.config, roi.label, block_size,
                            )  # fmt: skip


def whole_frames(
    clip: ClipRequest, codec: str, rate: RatePoint, scale: float, link: SimulatedLink | None, block_size: int
) -> SweepCell:
    """A cell of the strategy that sends everything."""
    treatment = replace(RegionTreatment.default_for(stateless=codec in STILL_CODECS), scale=scale)
    return SweepCell(clip, FULL_FRAME, "default", treatment, codec, rate, 1, link, block_size=block_size)


def read_grid(entry: Entry) -> tuple[Grid, tuple[str, ...]]:
    """A product of axes from a configuration, and notes on what was left out of it."""
    keys = entry.mapping(GRID_KEYS)

    def key(name: str, default: Any) -> Entry:
        return keys.get(name, Entry(entry.document, f"{entry.path}.{name}", default))

    strategies = unique(read_strategy(item) for item in key("strategies", "cable").items())
    rates = read_rates(key("codecs", "h264"))
    if not rates:
        raise key("codecs", None).error("is empty; name at least one codec")
    treatments: Mapping[str, Mapping[str, RegionTreatment]] = {}
    notes: tuple[str, ...] = ()
    if any(strategy != FULL_FRAME for strategy in strategies):
        treatments, notes = read_treatments(key("treatments", None), tuple(rates))
    links = {label: read_link(label, one) for label, one in labelled(key("links", None)).items()} or {"none": None}
    grid = Grid(
        strategies,
        rates,
        treatments,
        unique(read_fps(item) for item in key("fps", None).items()),
        unique(item.number(SMALLEST_SCALE, 1) for item in key("upload_scale", 1.0).items()),
        unique(item.whole(1, LARGEST_DELAY) for item in key("feedback_delay", 1).items()),
        tuple(links.values()),
    )
    return grid, notes


def unique(values: Iterable[Any]) -> tuple[Any, ...]:
    """Each value once, in the order of their first appearance."""
    return tuple(dict.fromkeys(values))


def merged(cells: Iterable[SweepCell], where: str) -> tuple[SweepCell, ...]:
    """Each cell once; those of a clip stand together, in the order of their first appearance.

    Raises:
        ConfigurationError: two cells differ and have the same name.
    """
    by_clip: dict[ClipRequest, dict[tuple[SweepCell, int], SweepCell]] = {}
    names: dict[tuple[ClipRequest, str, str], SweepCell] = {}
    numbers = LinkNumbers()
    for cell in cells:
        identity = replace(cell, treatment_label="", roi_label="", link=None), numbers.of(cell.link)
        kept = by_clip.setdefault(cell.clip, {}).setdefault(identity, cell)
        if names.setdefault((cell.clip, kept.method, kept.rate.label), kept) is not kept:
            raise ConfigurationError(
                f"{where}: two different cells are both called '{kept.title}'; give their treatments, links or rois "
                "labels that differ"
            )
    return tuple(cell for of_clip in by_clip.values() for cell in of_clip.values())


class LinkNumbers:
    """Tells links apart by all but their names; their traces are too long to be compared for each cell."""

    def __init__(self) -> None:
        self._by_object: dict[int, int] = {}
        self._by_content: dict[SimulatedLink | None, int] = {}

    def of(self, link: SimulatedLink | None) -> int:
        """Equal for equal links. The link must live as long as this object."""
        if id(link) not in self._by_object:
            nameless = None if link is None else replace(link, name="")
            self._by_object[id(link)] = self._by_content.setdefault(nameless, len(self._by_content))
        return self._by_object[id(link)]
