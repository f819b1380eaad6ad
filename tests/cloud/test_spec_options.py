from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import pytest

from cable_rpc.cloud.spec_options import read_options
from cable_rpc.errors import ConfigurationError


@dataclass(frozen=True)
class Fruit:
    kind: Literal["apple", "pear"] = field(default="apple", metadata={"help": "what grows"})
    count: int = 3
    weight: float | None = None


@dataclass(frozen=True)
class Basket:
    label: str = field(default="", metadata={"help": "what stands on it"})
    lid: bool = False
    sizes: tuple[int, ...] | None = None


def test_values_take_the_types_of_their_fields() -> None:
    query = "weight=0.25&lid=yes&kind=pear&label=Sure%2C%20[SEG].&sizes=3,1,-2&count=-1"
    fruit, basket = read_options("x", query, Fruit, Basket)
    assert fruit == {"weight": 0.25, "kind": "pear", "count": -1}
    assert basket == {"lid": True, "label": "Sure, [SEG].", "sizes": (3, 1, -2)}
    assert read_options("x", "", Fruit, Basket) == [{}, {}]


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("colour=red", r"'x\?': unknown option 'colour'; known are\n  kind=apple\|pear \(default apple\)  what grows"),
        ("colour=red", r"  weight=NUMBER\n  label=TEXT  what stands on it\n  lid=yes\|no \(default no\)\n  sizes="),
        ("kind=plum", r"kind=plum can't be read; give apple\|pear"),
        ("count=1.5", "count=1.5 can't be read; give INTEGER"),
        ("weight=heavy", "give NUMBER"),
        ("sizes=1,,2", "give INTEGER,INTEGER"),
        ("lid=1", r"give yes\|no"),
        ("count=1&lid=no&count=2", "'count' is given twice"),
        ("count", "write options as key=value"),
    ],
)
def test_what_can_t_be_used_is_told_with_what_can(query: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        read_options("x?", query, Fruit, Basket)
