"""Our histograms against those of prometheus_client, by what a scrape says of them."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from cable_rpc.cloud.tallies import TallyHistogram

BOUNDS = (0.0005, 0.25, 1.0, 2.5, 30.0, 1e6)


def scraped(registry: CollectorRegistry) -> dict[tuple[str, str, str], float]:
    (family,) = [
        family
        for family in text_string_to_metric_families(generate_latest(registry).decode())
        if family.type == "histogram"
    ]
    assert (family.name, family.documentation) == ("cable_seconds", "A time")
    return {
        (sample.name, sample.labels["stage"], sample.labels.get("le", "")): sample.value
        for sample in family.samples
        if not sample.name.endswith("_created")
    }


@settings(max_examples=60)
@given(st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from(BOUNDS) | st.floats(-1, 1e9))))
def test_a_scrape_reads_the_same(observed: list[tuple[str, float]]) -> None:
    ours, theirs = CollectorRegistry(), CollectorRegistry()
    tallies = TallyHistogram("cable_seconds", "A time", "stage", ("a", "b"), BOUNDS)
    ours.register(tallies)
    histogram = Histogram("cable_seconds", "A time", ["stage"], buckets=BOUNDS, registry=theirs)
    for value in "ab":
        histogram.labels(value)
    for value, seconds in observed:
        tallies.tallies[value].observe(seconds)
        histogram.labels(value).observe(seconds)
    assert scraped(ours) == scraped(theirs)
