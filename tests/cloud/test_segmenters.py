from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.backends import BackendOptions, FrameContext, load_segmenter
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.types import Detections

HEIGHT, WIDTH = 20, 30
coordinate = st.floats(-15, 45, width=32)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), max_size=4))
def test_boxes_cover_every_pixel_they_touch_and_no_other(corners: list[tuple[float, float, float, float]]) -> None:
    boxes = [(min(a, c), min(b, d), max(a, c), max(b, d)) for a, b, c, d in corners]
    detections = Detections(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.full(len(boxes), 2, np.int32),
        np.full(len(boxes), 0.5, np.float32),
    )
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    found = BoxSegmenter().segment(image, np.ones((HEIGHT, WIDTH), np.bool_), "", FrameContext(0, detections))
    for y in range(HEIGHT):
        for x in range(WIDTH):
            touched = any(
                np.floor(x0) <= x < np.ceil(x1) and np.floor(y0) <= y < np.ceil(y1) for x0, y0, x1, y1 in boxes
            )
            assert found.mask[y, x] == touched


scored_box = st.tuples(coordinate, coordinate, coordinate, coordinate, st.floats(0, 1, width=32))


@given(st.lists(scored_box, max_size=4))
def test_each_pixel_is_as_sure_as_the_best_of_its_boxes(rows: list[tuple[float, float, float, float, float]]) -> None:
    boxes = [(min(a, c), min(b, d), max(a, c), max(b, d)) for a, b, c, d, _ in rows]
    scores = [score for *_, score in rows]
    detections = Detections(
        np.array(boxes, np.float32).reshape(-1, 4), np.full(len(rows), 2, np.int32), np.array(scores, np.float32)
    )
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    found = BoxSegmenter().segment(image, np.ones((HEIGHT, WIDTH), np.bool_), "", FrameContext(0, detections))
    assert found.uncertainty is not None
    assert found.uncertainty.dtype == np.uint8
    for y in range(HEIGHT):
        for x in range(WIDTH):
            here = [
                score
                for (x0, y0, x1, y1), score in zip(boxes, scores, strict=True)
                if np.floor(x0) <= x < np.ceil(x1) and np.floor(y0) <= y < np.ceil(y1)
            ]
            assert found.uncertainty[y, x] == (round(255 * (1 - max(here))) if here else 0)


def test_doubtful_boxes_join_the_mask_from_the_score_that_is_asked_for() -> None:
    boxes = np.array([[0, 0, 2, 2], [4, 0, 6, 2], [8, 0, 10, 2]], np.float32)
    found = Detections(boxes, np.full(3, 2, np.int32), np.array([0.8, 0.3, 0.1], np.float32))
    context = FrameContext(0, found.select(np.array([0])), doubtful=found.select(np.array([1, 2])))
    image, whole = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.ones((HEIGHT, WIDTH), np.bool_)
    for spec, corners in (("boxes", [0]), ("boxes?min_score=0.2", [0, 4]), ("boxes?min_score=0.05", [0, 4, 8])):
        answer = load_segmenter(spec, BackendOptions()).segment(image, whole, "", context)
        assert np.flatnonzero(answer.mask[0]).tolist() == [x + dx for x in corners for dx in (0, 1)]
        assert answer.confidence == pytest.approx(0.8)
    with pytest.raises(ConfigurationError, match=r"min_score must be 0\.\.1"):
        load_segmenter("boxes?min_score=2", BackendOptions())
    with pytest.raises(ConfigurationError, match="no argument"):
        load_segmenter("boxes:file", BackendOptions())


def test_oracle_answers_with_the_world_s_own_masks() -> None:
    oracle = load_segmenter("oracle:synthetic:3", BackendOptions())
    frame = SyntheticSource(SyntheticConfig(seed=3)).frame(2)
    assert frame.truth is not None
    assert frame.truth.instance_mask is not None
    roi = np.ones(frame.size_hw, np.bool_)
    answer = oracle.segment(frame.image, roi, "", FrameContext(2, Detections.empty()))
    assert np.array_equal(answer.mask, frame.truth.instance_mask > 0)
    assert answer.uncertainty is None
    with pytest.raises(FrameError, match="same source and size"):
        oracle.segment(frame.image[:100], roi[:100], "", FrameContext(2, Detections.empty()))


def test_oracle_of_a_plain_video_is_refused(shared_clip: object) -> None:
    with pytest.raises(ConfigurationError, match="random access and ground truth"):
        load_segmenter(f"oracle:video:{shared_clip}", BackendOptions())


@pytest.mark.parametrize(
    ("spec", "said"),
    [("lips:folder", "installed: boxes, crop,"), ("boxes:7", "no argument"), ("oracle", "oracle:")],
)
def test_unusable_names_are_explained(spec: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        load_segmenter(spec, BackendOptions())
