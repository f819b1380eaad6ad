"""Histograms for the path that every frame takes: cheap to count, put into form at a scrape."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate

from prometheus_client.core import HistogramMetricFamily
from prometheus_client.registry import Collector
from prometheus_client.utils import floatToGoString

go_text: Callable[[float], str] = floatToGoString


class Tally:
    """One histogram. One thread observes, any thread may read; a scrape can miss the value that is just coming."""

    __slots__ = ("_bounds", "_counts", "_sum")

    def __init__(self, bounds: Sequence[float]) -> None:
        self._bounds = bounds
        self._counts = [0] * (len(bounds) + 1)
        self._sum = 0.0

    def observe(self, value: float) -> None:
        """Counts a value; a bound belongs to the bucket that it ends."""
        self._counts[bisect_left(self._bounds, value)] += 1
        self._sum += value

    def buckets(self) -> list[tuple[str, float]]:
        """Cumulative counts by upper bound, the last without one."""
        names = [*(go_text(bound) for bound in self._bounds), "+Inf"]
        return list(zip(names, accumulate(self._counts), strict=True))

    @property
    def sum(self) -> float:
        """Of all values."""
        return self._sum


class TallyHistogram(Collector):
    """Histograms by the value of one label, all of them there from the beginning.

    `prometheus_client.Histogram` takes a lock and goes through the bounds one by one at each observation.

    Args:
        name: of the metric.
        documentation: for people.
        label: its name.
        values: of the label.
        bounds: upper bounds of the buckets, rising, without infinity.
    """

    def __init__(
        self, name: str, documentation: str, label: str, values: Sequence[str], bounds: Sequence[float]
    ) -> None:
        self._name = name
        self._documentation = documentation
        self._label = label
        self.tallies = {value: Tally(bounds) for value in values}

    def collect(self) -> Iterator[HistogramMetricFamily]:
        """See `prometheus_client.registry.Collector`."""
        family = HistogramMetricFamily(self._name, self._documentation, labels=[self._label])
        for value, tally in self.tallies.items():
            family.add_metric([value], tally.buckets(), tally.sum)
        yield family
