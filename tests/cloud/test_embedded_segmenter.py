"""The compact LISA that ships with the package, on scenes that it never saw."""

from __future__ import annotations

import numpy as np
import pytest

from cable_rpc.cloud.backends import BackendOptions, FrameContext, load_segmenter
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import mask_iou
from cable_rpc.types import CLASS_GROUPS, Detections

pytest.importorskip("torch", reason="the embedded segmenter needs torch, in the cloud extra")

CPU = BackendOptions(device="cpu")
WHOLE_SCENE = FrameContext(0, Detections.empty(), "test")


@pytest.mark.parametrize(
    ("question", "only_vehicles"),
    [
        ("Please segment all vehicles, pedestrians and cyclists on the road.", False),
        ("Can you segment the vehicles in this image?", True),
    ],
)
def test_what_is_asked_for_is_found_on_held_out_scenes(question: str, only_vehicles: bool) -> None:
    segmenter = load_segmenter("embedded", CPU)
    overlaps = []
    for seed in (90_003, 90_006, 90_009):
        frame = SyntheticSource(SyntheticConfig(seed=seed, width=640, height=360)).frame(40)
        assert frame.truth is not None
        assert frame.truth.instance_mask is not None
        groups = (CLASS_GROUPS[int(class_id)] for class_id in frame.truth.class_ids)
        wanted = np.array([False, *(group == "vehicle" or not only_vehicles for group in groups)])
        answer = segmenter.segment(frame.image, np.ones(frame.size_hw, np.bool_), question, WHOLE_SCENE)
        overlaps.append(mask_iou(answer.mask, wanted[frame.truth.instance_mask]))
        assert answer.answer == "Sure, [SEG] ."
        assert (answer.tokens_in, answer.tokens_full) == (64, 64)
    assert np.mean(overlaps) > 0.6, overlaps


def test_argument_that_is_no_option_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="options only"):
        load_segmenter("embedded:somewhere", CPU)
