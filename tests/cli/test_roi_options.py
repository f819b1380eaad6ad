"""Switches of the method as texts."""

from __future__ import annotations

from dataclasses import fields

import pytest

from cable_rpc.cli.roi_options import parse_roi_changes, roi_config
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError


def test_modes_and_changes():
    assert roi_config("robust") == RoiConfig()
    assert roi_config("paper") == RoiConfig.paper()
    changed = roi_config("paper", ["ego_model=flow", "top-margin=0.2", "corridor=off", "stale_after_s=none"], "budget")
    assert changed == RoiConfig.paper(
        ego_model="flow", top_margin=0.2, corridor=False, stale_after_s=None, keyframe_policy="budget"
    )


def test_every_switch_can_be_written_as_its_own_text():
    for config in (RoiConfig(), RoiConfig.paper()):
        texts = [f"{setting.name}={getattr(config, setting.name)}" for setting in fields(RoiConfig)]
        assert RoiConfig(**parse_roi_changes(texts)) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("top_margin", "KEY=VALUE"),
        ("top_margn=1", "top_margin"),
        ("top_margin=high", "a number"),
        ("analysis_scale=1.5", "whole number"),
        ("corridor=maybe", "true or false"),
        ("ego_model=wheels", "ground_plane"),
        ("top_margin=2", "0..1"),
    ],
)
def test_errors_say_what_to_write(text, message):
    with pytest.raises(ConfigurationError, match=message):
        roi_config("robust", [text])


def test_unknown_mode_and_policy():
    with pytest.raises(ConfigurationError, match="robust or paper"):
        roi_config("bold")
    with pytest.raises(ConfigurationError, match="periodic"):
        roi_config("robust", keyframes="often")
