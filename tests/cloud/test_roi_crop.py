"""The crop in front of a segmenter, against a segmenter that answers from the pixels it is shown."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.cloud.backends import BackendOptions, FrameContext, load_segmenter
from cable_rpc.cloud.roi_crop import CropOptions, CropSegmenter, crop_box
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.types import BoolMask, Detections, Image, PrefillCost, Segmentation

HEIGHT, WIDTH = 90, 160
CONTEXT = FrameContext(4, Detections.empty(), "car 7")
BLUE_LEVELS = np.random.default_rng(5).integers(1, 256, (HEIGHT, WIDTH, 3), np.uint8)


class PixelReader:
    """Its mask and doubt are a function of each pixel, so a crop must give what the whole gives there."""

    name, revision, device = "reader", "3", "cpu"

    def __init__(self) -> None:
        self.shown: list[tuple[Image, BoolMask, str, FrameContext]] = []
        self.forgotten: list[str] = []

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        self.shown.append((image, roi, prompt, context))
        prefill = PrefillCost(90, 2.0, 1.5, 10, 15)
        return Segmentation(
            image[..., 0] > 128, 0.75, 60, 256, image[..., 1].copy(), prefill, {"clip": 3}, "Sure.", "forced"
        )

    def forget_stream(self, stream: str) -> None:
        self.forgotten.append(stream)


def blanked(roi: BoolMask) -> Image:
    return np.where(roi[..., None], BLUE_LEVELS, 0).astype(np.uint8)


def region(top: int, bottom: int, left: int, right: int) -> BoolMask:
    roi = np.zeros((HEIGHT, WIDTH), np.bool_)
    roi[top:bottom, left:right] = True
    return roi


spans = st.tuples(st.integers(0, HEIGHT - 1), st.integers(1, HEIGHT), st.integers(0, WIDTH - 1), st.integers(1, WIDTH))
boxes = spans.filter(lambda box: box[0] < box[1] and box[2] < box[3])
options = st.builds(
    CropOptions, st.integers(0, 40), st.integers(1, 200), st.floats(1.0, 4.0), st.sampled_from([1, 8, 32])
)


@given(boxes, options)
def test_the_box_holds_the_region_and_its_limits_as_far_as_the_frame_reaches(
    box: tuple[int, int, int, int], settings: CropOptions
) -> None:
    top, bottom, left, right = box
    found = crop_box(region(*box), settings)
    assert 0 <= found.top <= max(top - settings.margin, 0)
    assert min(bottom + settings.margin, HEIGHT) <= found.bottom <= HEIGHT
    assert 0 <= found.left <= max(left - settings.margin, 0)
    assert min(right + settings.margin, WIDTH) <= found.right <= WIDTH
    for edge, limit in ((found.top, 0), (found.left, 0), (found.bottom, HEIGHT), (found.right, WIDTH)):
        assert edge == limit or edge % settings.align == 0
    height, width = found.bottom - found.top, found.right - found.left
    assert height >= min(settings.min_side, HEIGHT)
    assert width >= min(settings.min_side, WIDTH)
    slack = settings.align * 2 * settings.max_aspect
    assert height == HEIGHT or width <= settings.max_aspect * height + slack
    assert width == WIDTH or height <= settings.max_aspect * width + slack


@given(boxes, options)
def test_pixels_come_back_where_they_were_taken(box: tuple[int, int, int, int], settings: CropOptions) -> None:
    roi = region(*box)
    image = blanked(roi)
    whole = PixelReader().segment(image, roi, "cars", CONTEXT)
    answer = CropSegmenter(PixelReader(), settings).segment(image, roi, "cars", CONTEXT)
    assert np.array_equal(answer.mask & roi, whole.mask & roi)
    assert answer.uncertainty is not None
    assert np.array_equal(answer.uncertainty[roi], image[..., 1][roi])
    assert (answer.confidence, answer.tokens_in, answer.tokens_full) == (0.75, 60, 256)
    assert (answer.prefill, answer.stages_ns, answer.decoding) == (whole.prefill, {"clip": 3}, "forced")


def test_a_whole_frame_goes_through_untouched() -> None:
    inner = PixelReader()
    image, roi = BLUE_LEVELS, np.ones((HEIGHT, WIDTH), np.bool_)
    CropSegmenter(inner, CropOptions()).segment(image, roi, "cars", CONTEXT)
    ((shown, region_shown, prompt, context),) = inner.shown
    assert shown is image
    assert region_shown is roi
    assert (prompt, context) == ("cars", CONTEXT)


def test_an_empty_region_is_answered_without_the_model() -> None:
    inner = PixelReader()
    answer = CropSegmenter(inner, CropOptions()).segment(BLUE_LEVELS, region(0, 0, 0, 0), "cars", CONTEXT)
    assert not inner.shown
    assert not answer.mask.any()
    assert answer.mask.shape == (HEIGHT, WIDTH)
    assert answer.confidence == 1.0


def test_boxes_are_told_in_the_crop_s_pixels() -> None:
    detections = Detections(
        np.array([[50, 30, 70, 50], [0, 0, 10, 10], [64.5, 20, 200, 44]], np.float32),
        np.array([2, 0, 2], np.int32),
        np.array([0.9, 0.8, 0.6], np.float32),
    )
    context = FrameContext(0, detections)
    roi = region(24, 56, 48, 80)
    image = blanked(roi)
    cropped = CropSegmenter(BoxSegmenter(), CropOptions(margin=8, min_side=16, align=8)).segment(
        image, roi, "", context
    )
    plain = BoxSegmenter().segment(image, roi, "", context)
    assert np.array_equal(cropped.mask & roi, plain.mask & roi)
    assert cropped.confidence == pytest.approx((0.9 + 0.6) / 2)
    assert cropped.uncertainty is not None
    assert plain.uncertainty is not None
    assert np.array_equal(cropped.uncertainty[roi], plain.uncertainty[roi])


def test_a_session_s_end_is_passed_on() -> None:
    inner = PixelReader()
    CropSegmenter(inner, CropOptions()).forget_stream("car 7")
    assert inner.forgotten == ["car 7"]
    CropSegmenter(BoxSegmenter(), CropOptions()).forget_stream("car 7")


def test_an_answer_of_another_size_is_the_model_s_fault() -> None:
    class Stretching(PixelReader):
        def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
            return Segmentation(np.zeros((3, 3), np.bool_), 1.0)

    roi = region(40, 50, 60, 70)
    with pytest.raises(ModelError, match=r"a crop of 32x32 pixels with bool \[3, 3\]"):
        CropSegmenter(Stretching(), CropOptions(8, 16, 2.0, 16)).segment(blanked(roi), roi, "", CONTEXT)


def test_its_name_carries_its_options() -> None:
    plain = load_segmenter("crop:boxes", BackendOptions())
    assert plain.name == "crop:boxes"
    segmenter = load_segmenter("crop?margin=0&min_side=1&align=1&max_aspect=1.5:crop?margin=2:boxes", BackendOptions())
    assert segmenter.name == "crop:crop:boxes"
    assert isinstance(segmenter, CropSegmenter)
    assert segmenter._options == CropOptions(0, 1, 1.5, 1)


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("crop", "crop needs the segmenter"),
        ("crop?margin=3", "crop needs the segmenter"),
        ("crop?border=3:boxes", "unknown option 'border'"),
        ("crop?margin=-3:boxes", "margin is -3; give 0 or more"),
        ("crop?max_aspect=nan:boxes", "max_aspect is nan"),
        ("crop:squares", "'squares'"),
    ],
)
def test_unusable_crops_are_explained(spec: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        load_segmenter(spec, BackendOptions())
