"""Specs of data sets taken apart, and the choice among what a root holds."""

from __future__ import annotations

from pathlib import Path

import pytest

from cable_rpc.data.sequence_spec import choose_sequence, parse_sequence_spec
from cable_rpc.data.source import DATA_SETS, open_source
from cable_rpc.errors import ConfigurationError, SourceError


def test_parts_of_a_spec() -> None:
    spec = parse_sequence_spec("cadc", "/data/ca dc#2018/0001?tree=raw&images=a%26b%3Fc", ("tree", "images"))
    assert (spec.root, spec.sequence) == (Path("/data/ca dc"), "2018/0001")
    assert spec.values == {"tree": "raw", "images": "a&b?c"}
    bare = parse_sequence_spec("kitti", "root")
    assert (bare.root, bare.sequence, bare.values) == (Path("root"), None, {})


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ("#one", "names no file or folder; write kitti:ROOT#SEQUENCE"),
        ("root?speed=1", "option 'speed=1'; .* known are tree"),
        ("root?tree", "option 'tree'; write key=value"),
        ("root?tree=", "option 'tree='; write key=value"),
        ("root?tree=a&tree=b", "give tree once"),
    ],
)
def test_wrong_specs(rest: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        parse_sequence_spec("kitti", rest, ("tree",))


def test_choice_of_a_sequence() -> None:
    names = [f"{number:04d}" for number in range(12)]
    asked, open_ended = parse_sequence_spec("kitti", "root#0003"), parse_sequence_spec("kitti", "root")
    assert choose_sequence(asked, names) == "0003"
    assert choose_sequence(open_ended, ["0007"]) == "0007"
    with pytest.raises(ConfigurationError, match=r"12 sequences; .*'0000', .*'0009' and 2 more"):
        choose_sequence(open_ended, names)
    with pytest.raises(ConfigurationError, match="no sequence '0003'; use one of '0007'"):
        choose_sequence(asked, ["0007"])
    with pytest.raises(SourceError, match="root holds no sequence"):
        choose_sequence(asked, [])


def test_unknown_schemes_are_told_the_data_sets() -> None:
    with pytest.raises(ConfigurationError, match=r"SCHEME:ROOT#SEQUENCE, see docs/datasets\.md") as caught:
        open_source("kiti:root#0003")
    assert all(f"{scheme}:..." in str(caught.value) for scheme in DATA_SETS)
