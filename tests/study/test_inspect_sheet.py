"""The inspection sheet: the right colour in the right place, on any size, and the loop behind it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cable_rpc.edge.proposal import RoiProposal, RoiSteps
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError
from cable_rpc.study import sheet_text
from cable_rpc.study.annotate import MASK_COLOUR, TRUTH_COLOUR
from cable_rpc.study.inspect_loop import DetectorCloud, inspect_last
from cable_rpc.study.inspect_panels import (
    CORRIDOR_COLOUR,
    DILATION_COLOUR,
    ENTRY_COLOUR,
    MOTION_COLOUR,
    PANEL_WIDTH,
    ModeView,
    Panel,
    mode_panels,
)
from cable_rpc.study.inspect_sheet import draw_sheet, prior_iou
from cable_rpc.study.loop_simulator import TruthCloud
from cable_rpc.types import BoolMask, Detections, Frame, GroundTruth, Image, RoiMask, Segmentation, StageTimings

HEIGHT, WIDTH = 270, 480
TIMINGS = StageTimings({"grey": 300_000, "warp": 700_000})


def box(height: int, width: int, top: int, bottom: int, left: int, right: int) -> BoolMask:
    mask = np.zeros((height, width), np.bool_)
    mask[top:bottom, left:right] = True
    return mask


def frame_of(image: Image, mask: BoolMask | None = None) -> Frame:
    truth = None
    if mask is not None:
        truth = GroundTruth(
            np.zeros((1, 4), np.float32), np.full(1, 2, np.int32), np.ones(1, np.int32), np.ones(1, np.float32),
            mask.astype(np.int32),
        )  # fmt: skip
    return Frame(image, 40, 4_000_000_000, truth=truth)


def stepped(scale: int = 1, height: int = HEIGHT, width: int = WIDTH) -> RoiSteps:
    """Nested boxes in the frame's middle, on a grid of the given scale: prior, dilation, raw ROI, corridor."""
    rows, columns = -(-height // scale), -(-width // scale)

    def cells(top: float, bottom: float, left: float, right: float) -> BoolMask:
        return box(rows, columns, *(round(part * rows) for part in (top, bottom)),
                   *(round(part * columns) for part in (left, right)))  # fmt: skip

    prior = cells(0.4, 0.6, 0.4, 0.6)
    motion = cells(0.45, 0.55, 0.3, 0.65)
    dilated = cells(0.35, 0.65, 0.35, 0.65)
    entered = cells(0.0, 1.0, 0.0, 0.05)
    raw = prior | (dilated & motion)
    return RoiSteps(scale, prior, motion, dilated, raw, entered, cells(0.25, 0.75, 0.3, 0.7) | entered)


def view(scale: int = 1, height: int = HEIGHT, width: int = WIDTH, **changes: object) -> ModeView:
    image = np.full((height, width, 3), 200, np.uint8)
    steps = stepped(scale, height, width)
    region = RoiMask(steps.region, scale, height, width).pixels()
    roi = RoiMask.from_pixels(region, 8)
    proposal = RoiProposal(
        roi, False, 0.25, prior_index=39, staleness=1, dilation_px=12.0, raw_coverage=0.05, ego_model="flow",
        timings=TIMINGS, steps=steps,
    )  # fmt: skip
    prior = RoiMask(steps.warped_prior, scale, height, width).pixels()
    return ModeView("robust", frame_of(image, prior), replace(proposal, **changes), prior)  # type: ignore[arg-type]


def named(panels: Sequence[Panel], name: str) -> Panel:
    return next(panel for panel in panels if panel.name == name)


def nearest_colour(picture: Image, x: float, y: float) -> str:
    """Which of the map's colours a pixel's tint comes closest to; grey where it has none."""
    b, g, r = (int(value) for value in picture[round(y * picture.shape[0]), round(x * picture.shape[1])])
    if max(b, g, r) - min(b, g, r) < 6:
        return "grey"
    known = {"prior": MASK_COLOUR, "motion": MOTION_COLOUR, "dilation": DILATION_COLOUR, "corridor": CORRIDOR_COLOUR,
             "entry": ENTRY_COLOUR}  # fmt: skip
    return min(known, key=lambda name: float(np.linalg.norm(np.subtract(known[name], (b, g, r)))))


@pytest.mark.parametrize("scale", [1, 4])
def test_each_map_shows_its_colour_where_it_is_and_grey_elsewhere(scale: int) -> None:
    panels = mode_panels(view(scale))
    assert [panel.name for panel in panels] == [
        "frame", "warped prior", "residual motion", "dilation", "raw ROI", "corridor", "upload",
    ]  # fmt: skip
    seen = {
        (name, x): nearest_colour(named(panels, name).picture, x, 0.5)
        for name in ("warped prior", "residual motion", "dilation", "raw ROI", "corridor")
        for x in (0.02, 0.15, 0.32, 0.37, 0.5)
    }
    grey = {"warped prior": (0.02, 0.15, 0.32, 0.37), "residual motion": (0.02, 0.15), "dilation": (0.02, 0.15, 0.32),
            "raw ROI": (0.02, 0.15, 0.32), "corridor": (0.15,)}  # fmt: skip
    for name, places in grey.items():
        assert [seen[name, x] for x in places] == ["grey"] * len(places), name
    assert seen["warped prior", 0.5] == seen["dilation", 0.5] == seen["raw ROI", 0.5] == "prior"
    assert seen["residual motion", 0.32] == seen["residual motion", 0.5] == seen["raw ROI", 0.37] == "motion"
    assert seen["dilation", 0.37] == seen["corridor", 0.37] == seen["corridor", 0.5] == "dilation"
    assert seen["corridor", 0.32] == "corridor"
    assert seen["corridor", 0.02] == "entry"


def test_what_the_cloud_was_unsure_of_is_told_from_motion() -> None:
    plain = named(mode_panels(view()), "raw ROI")
    steps = stepped()
    grown = replace(steps, raw=steps.raw | steps.dilated)
    doubtful = named(mode_panels(view(steps=grown)), "raw ROI")
    assert [text for text, _ in doubtful.legend] == [*(text for text, _ in plain.legend), "cloud unsure"]


def test_shares_count_frame_pixels_also_where_cells_hang_over_the_edge() -> None:
    """A 481 x 271 frame on a grid of 4: the last column of cells holds one column of pixels."""
    steps = stepped(4, 271, 481)
    last_column = np.zeros_like(steps.motion)
    last_column[:, -1] = True
    panels = mode_panels(view(4, 271, 481, steps=replace(steps, motion=last_column)))
    assert named(panels, "residual motion").share == pytest.approx(1 / 481)


def test_single_pixels_of_a_large_frame_stay_visible() -> None:
    steps = stepped(1, 1080, 1920)
    speck = np.zeros_like(steps.motion)
    speck[100, 100] = True
    picture = named(mode_panels(view(1, 1080, 1920, steps=replace(steps, motion=speck))), "residual motion").picture
    ground = picture[0, 0].astype(int)
    assert np.abs(picture[25, 25].astype(int) - ground).max() > 10


def test_upload_is_the_frame_inside_the_blocks_and_black_outside() -> None:
    shown = view()
    picture = named(mode_panels(shown), "upload").picture
    sent = shown.proposal.roi.pixels()
    # The outline runs along the frame's own border too.
    padded = cv2.copyMakeBorder(sent.astype(np.uint8), 3, 3, 3, 3, cv2.BORDER_CONSTANT)
    inside = cv2.erode(padded, np.ones((5, 5)))[3:-3, 3:-3] > 0
    outside = cv2.dilate(sent.astype(np.uint8), np.ones((5, 5))) == 0
    assert inside.any()
    assert (picture[inside] == 200).all()
    assert outside.any()
    assert (picture[outside] == 0).all()


def test_keyframe_shows_the_whole_frame_and_its_reason() -> None:
    whole = RoiMask.full(HEIGHT, WIDTH, 8)
    panel = named(mode_panels(view(roi=whole, keyframe=True, keyframe_reason="prior")), "upload")
    assert (panel.picture[8:-8, 8:-8] == 200).all()
    assert panel.share == 1.0
    assert "prior" in panel.legend[0][0]


def test_truth_beyond_the_clouds_mask_is_white_and_the_rest_is_the_masks() -> None:
    shown = view()
    left_half = shown.answer.copy()
    left_half[:, WIDTH // 2 :] = False
    picture = named(mode_panels(replace(shown, answer=left_half)), "frame").picture
    top = round(0.4 * HEIGHT)
    assert tuple(picture[top, round(0.55 * WIDTH)]) == TRUTH_COLOUR
    assert tuple(picture[top, round(0.45 * WIDTH)]) == MASK_COLOUR


def test_before_the_first_mask_there_are_still_seven_panels() -> None:
    shown = view(steps=None, prior_index=None, staleness=None, keyframe=True, keyframe_reason="first")
    panels = mode_panels(shown)
    assert len(panels) == 7
    assert named(panels, "dilation").share is None
    assert draw_sheet([shown], "title", "subtitle").shape[1] == 2020


@pytest.mark.parametrize("scale", [1, 4])
def test_prior_iou_is_that_of_the_masks(scale: int) -> None:
    shown = view(scale)
    assert prior_iou(shown.frame, shown.proposal) == 1.0
    half = replace(
        stepped(scale), warped_prior=stepped(scale).warped_prior & (np.arange(WIDTH // scale) < WIDTH / scale / 2)
    )
    assert prior_iou(shown.frame, replace(shown.proposal, steps=half)) == pytest.approx(0.5, abs=0.03)
    assert prior_iou(replace(shown.frame, truth=None), shown.proposal) is None


@pytest.mark.parametrize(("height", "width"), [(540, 960), (375, 1242), (1280, 720), (48, 64), (64, 1000)])
def test_any_size_keeps_every_picture_inside_its_cell(height: int, width: int) -> None:
    shown = view(1, height, width)
    one = draw_sheet([shown], "title", "subtitle")
    two = draw_sheet([shown, shown], "title", "subtitle")
    assert one.dtype == np.uint8
    assert one.shape[1] == two.shape[1] == 4 * PANEL_WIDTH + 5 * 20
    block = two.shape[0] - one.shape[0]
    picture_height = round(height * PANEL_WIDTH / width)
    assert block >= picture_height + max(250, picture_height)
    np.testing.assert_array_equal(two[-block:], two[-2 * block : -block])
    np.testing.assert_array_equal(two[: one.shape[0]], one)


def test_long_titles_stay_on_the_sheet() -> None:
    sheet = draw_sheet([view()], "title " * 200, "subtitle " * 200)
    assert sheet.shape[1] == 2020
    assert (sheet[10:76, -18:] == sheet[0, 0]).all()


def test_views_of_different_sizes_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="one size"):
        draw_sheet([view(), view(1, 100, 100)], "title", "subtitle")
    with pytest.raises(ConfigurationError, match="one size"):
        draw_sheet([], "title", "subtitle")


@pytest.fixture
def without_truetype(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delattr(cv2, "FontFace", raising=False)
    sheet_text.typeface.cache_clear()
    yield
    sheet_text.typeface.cache_clear()


@pytest.mark.usefixtures("without_truetype")
def test_older_opencv_writes_with_stroke_letters() -> None:
    canvas = np.zeros((60, 400, 3), np.uint8)
    end = sheet_text.put_text(canvas, "shift −3.2 px · 4 × 2", (10, 40), 18, (255, 255, 255))
    assert canvas.any()
    assert not canvas[:, end + 3 :].any()
    assert "?" not in sheet_text.hershey_letters("−3.2 px · 4 × 2")


@given(st.text(alphabet="abcdefghijklmnopqrstuvwxyz WM.,", max_size=60), st.integers(60, 400))
def test_fitted_text_fits_and_short_text_is_left_alone(text: str, room: int) -> None:
    fitted = sheet_text.fit_text(text, room, 16)
    assert sheet_text.text_width(fitted, 16) <= room
    assert fitted == text or fitted.endswith("...")
    assert fitted == text or sheet_text.text_width(text, 16) > room


def test_symbols_have_ink_above_and_below_their_letter() -> None:
    def rows_of_ink(symbol: sheet_text.Symbol) -> tuple[int, int]:
        canvas = np.zeros((80, 120, 3), np.uint8)
        sheet_text.put_symbol(canvas, symbol, (20, 50), 24, (255, 255, 255))
        rows = np.flatnonzero(canvas.any(axis=(1, 2)))
        return int(rows[0]), int(rows[-1])

    top, bottom = rows_of_ink(sheet_text.Symbol("M"))
    assert rows_of_ink(sheet_text.Symbol("M", accent="^"))[0] < top
    assert rows_of_ink(sheet_text.Symbol("M", accent="~"))[0] < top
    assert rows_of_ink(sheet_text.Symbol("M", index="k"))[1] > bottom


class BrightSpots:
    """A detector whose boxes are the picture's bright part."""

    name, revision, device = "spots", "1", "cpu"

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        found = []
        for image in images:
            x, y, width, height = cv2.boundingRect((image[:, :, 0] > 250).astype(np.uint8))
            edges = np.array([[x, y, x + width, y + height]], np.float32)
            found.append(Detections(edges, np.full(1, 2, np.int32), np.full(1, 0.75, np.float32)))
        return found


def test_detector_sees_only_what_was_sent_and_its_mask_stays_inside() -> None:
    image = np.full((80, 120, 3), 100, np.uint8)
    image[20:40, 20:100] = 255
    region = RoiMask.from_pixels(box(80, 120, 0, 80, 0, 64), 8)
    answer = DetectorCloud(BrightSpots())(frame_of(image), region)
    np.testing.assert_array_equal(answer.mask, box(80, 120, 20, 40, 20, 64))
    assert answer.uncertainty is not None
    assert not answer.uncertainty[~region.pixels()].any()


@pytest.mark.parametrize("delay", [1, 3])
def test_loop_applies_each_answer_after_the_delay(delay: int) -> None:
    noise = np.random.default_rng(3).integers(60, 120, (96, 160, 3), np.uint8)
    frames = []
    for index in range(8):
        actor = box(96, 160, 30, 70, 40 + 3 * index, 90 + 3 * index)
        image = np.where(actor[:, :, None], np.uint8(230), noise)
        frames.append(replace(frame_of(image, actor), index=index, capture_time_ns=index * 100_000_000))
    asked: list[tuple[int, BoolMask]] = []
    exact = TruthCloud(min_visible_share=0.0)

    def cloud(frame: Frame, region: RoiMask) -> Segmentation:
        asked.append((frame.index, region.pixels()))
        return exact(frame, region)

    views = inspect_last(frames, {"paper": RoiConfig.paper(), "robust": RoiConfig()}, cloud, delay=delay)
    assert [shown.title for shown in views] == ["paper", "robust"]
    assert [index for index, _ in asked] == [index for index in range(8) for _ in range(2)]
    for shown, (_, sent) in zip(views, asked[-2:], strict=True):
        assert shown.frame.index == 7
        assert shown.proposal.prior_index == 7 - delay
        assert shown.proposal.staleness == delay
        assert shown.proposal.steps is not None
        truth = shown.frame.truth
        assert truth is not None
        assert truth.instance_mask is not None
        np.testing.assert_array_equal(shown.answer, (truth.instance_mask > 0) & sent)


def test_loop_wants_frames_and_a_delay() -> None:
    with pytest.raises(ConfigurationError, match="no frame"):
        inspect_last([], {"paper": RoiConfig.paper()}, TruthCloud())
    with pytest.raises(ConfigurationError, match="lock-step is 1"):
        inspect_last([], {"paper": RoiConfig.paper()}, TruthCloud(), delay=0)
