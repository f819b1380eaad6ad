"""Skipping what is hidden must not change a pixel or a box."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.data.synthetic.occlusion import Occlusion


@pytest.mark.parametrize("seed", [0, 2])
def test_drawing_everything_gives_the_same_frame(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    config = SyntheticConfig(seed=seed, width=480, height=270)
    skipping = SyntheticSource(config).frame(20)
    asked: list[bool] = []

    def hides(*_: Any, **__: Any) -> bool:
        asked.append(True)
        return False

    monkeypatch.setattr(Occlusion, "hides", hides)
    everything = SyntheticSource(config).frame(20)
    assert asked, "nothing asks whether it is hidden: the test compares equals"
    assert np.array_equal(skipping.image, everything.image)
    assert skipping.truth is not None
    assert everything.truth is not None
    for name in ("boxes_xyxy", "class_ids", "track_ids", "visibility", "instance_mask"):
        assert np.array_equal(getattr(skipping.truth, name), getattr(everything.truth, name)), name
