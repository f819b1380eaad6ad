"""What the documents say of the code."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from cable_rpc.edge.roi_config import PAPER, ROBUST, RoiConfig
from cable_rpc.study.strategies import STRATEGIES


def test_every_switch_of_the_edge_is_explained(repository: Path) -> None:
    text = (repository / "docs" / "edge.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`([a-z_]+)`", row.split("|")[1])}
    assert named == {setting.name for setting in fields(RoiConfig)}
    for row in rows:
        _, names, paper, robust, *_ = (cell.strip() for cell in row.split("|"))
        for index, name in enumerate(re.findall(r"`([a-z_]+)`", names)):
            for shown, preset in ((paper, PAPER), (robust, ROBUST)):
                value = getattr(preset, name)
                text_of_value = shown.split(", ")[index] if ", " in shown else shown
                if isinstance(value, bool):
                    assert text_of_value == ("on" if value else "off"), name
                elif isinstance(value, str):
                    assert text_of_value == value, name
                elif text_of_value not in {"–", "none"}:
                    assert float(text_of_value) == value, name
    for strategy in STRATEGIES:
        assert f"`{strategy}`" in text
