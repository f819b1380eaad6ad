"""The figure of examples: the right frames through the real codec, and every panel where and as it should be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import pytest

from cable_rpc.cli.figure import frame_numbers
from cable_rpc.cloud.backends import FrameContext
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.annotate import MASK_COLOUR
from cable_rpc.study.metrics import without_counterpart
from cable_rpc.study.qualitative_figure import FigureRow, FigureSettings, SentView, figure_rows, kept_pixels
from cable_rpc.types import BoolMask, Detections, Frame, Image, RoiMask, Segmentation

drawing = pytest.importorskip("cable_rpc.study.qualitative_figure_drawing", reason="needs matplotlib")

WIDTH, HEIGHT = 256, 160
SQUARE = 40
RED = (40, 40, 230)


class SquareDrive:
    """A red square that moves right by 4 px a frame over an uneven grey ground."""

    name = "drive"
    fps = 10.0
    size_wh = (WIDTH, HEIGHT)

    def __init__(self, frame_count: int) -> None:
        self.frame_count = frame_count

    def __iter__(self) -> Iterator[Frame]:
        ground = np.random.default_rng(5).integers(90, 130, (HEIGHT // 8, WIDTH // 8), np.uint8)
        ground = cv2.cvtColor(cv2.resize(ground, (WIDTH, HEIGHT)), cv2.COLOR_GRAY2BGR)
        for index in range(self.frame_count):
            image = ground.copy()
            left, top = square_corner(index)
            image[top : top + SQUARE, left : left + SQUARE] = RED
            yield Frame(image, index, index * 100_000_000)


def square_corner(index: int) -> tuple[int, int]:
    return 32 + 4 * index, 64


def red(image: Image) -> BoolMask:
    blue, _, red_part = (image[:, :, channel].astype(int) for channel in range(3))
    return np.asarray(red_part - blue > 100, np.bool_)


class RedDetector:
    name = "red"
    revision = "1"
    device = "cpu"

    def __init__(self) -> None:
        self.calls = 0

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        self.calls += len(images)
        return [self.box(red(image)) for image in images]

    @staticmethod
    def box(found: BoolMask) -> Detections:
        if not found.any():
            return Detections.empty()
        rows, columns = np.nonzero(found)
        edges = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        return Detections(np.array([edges], np.float32), np.array([2], np.int32), np.array([0.9], np.float32))


class RedSegmenter:
    name = "red"
    revision = "1"
    device = "cpu"

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        return Segmentation(red(image), 1.0)


def rows_of(count: int, frames: tuple[int, ...], strategies: tuple[str, ...] = ("motion-only", "cable")):
    detector = RedDetector()
    rows = figure_rows(SquareDrive(count), frames, FigureSettings(strategies), detector, RedSegmenter())
    return rows, detector


@pytest.fixture(scope="module")
def two_rows() -> list[FigureRow]:
    return rows_of(8, (6, 0))[0]


def test_frames_go_through_the_real_loop(two_rows):
    late, first = two_rows
    assert (late.frame.index, first.frame.index) == (6, 0)
    assert all(view.keyframe and view.region.coverage == 1.0 for view in first.views)
    left, top = square_corner(6)
    whole, cable = late.whole, late.views[1]
    np.testing.assert_allclose(whole.detections.boxes_xyxy, [[left, top, left + SQUARE, top + SQUARE]], atol=4)
    assert not cable.keyframe
    assert cable.region.coverage < 0.9
    sent = cable.region.pixels()
    assert sent[top : top + SQUARE, left : left + SQUARE].all()
    lossy = np.abs(cable.received.astype(int) - late.frame.image)[sent]
    assert 0 < lossy.mean() < 12
    assert 0 < cable.packet_bytes < first.views[1].packet_bytes
    assert not (cable.mask & ~sent).any()
    truth = np.zeros((HEIGHT, WIDTH), np.bool_)
    truth[top : top + SQUARE, left : left + SQUARE] = True
    assert np.count_nonzero(cable.mask & truth) / np.count_nonzero(cable.mask | truth) > 0.8


def test_models_run_only_where_somebody_listens_or_looks():
    _, detector = rows_of(6, (2, 5))
    # Whole frames and motion alone are looked at twice; the loop listens to every frame.
    assert detector.calls == 2 + 2 + 6


def test_without_a_number_a_settled_frame_or_the_last_is_shown():
    assert [row.frame.index for row in rows_of(7, ())[0]] == [6]
    (row,) = rows_of(40, (), ("motion-only",))[0]
    assert row.frame.index == 30


def test_a_frame_beyond_the_end_is_refused():
    with pytest.raises(ConfigurationError, match="drive has 4 frames, from 0 on; it has no frame 4, 9"):
        rows_of(4, (1, 9, 4))
    with pytest.raises(ConfigurationError, match="strategy 'best' is unknown"):
        rows_of(4, (1,), ("best",))


def detections(*boxes: tuple[int, int, int, int, int]) -> Detections:
    table = np.array(boxes, np.float32).reshape(-1, 5)
    return Detections(table[:, :4], table[:, 4].astype(np.int32), np.full(len(table), 0.8, np.float32))


def test_lost_boxes_are_those_without_a_counterpart_of_their_group():
    whole = detections((0, 0, 10, 10, 2), (20, 0, 30, 10, 0), (40, 0, 50, 10, 7), (60, 0, 70, 10, 2))
    found = detections((0, 0, 10, 9, 7), (20, 0, 30, 10, 2), (40, 6, 50, 16, 7))
    assert without_counterpart(whole, found).tolist() == [False, True, True, True]
    assert without_counterpart(whole, Detections.empty()).all()
    assert without_counterpart(Detections.empty(), found).shape == (0,)


def view_of(blocks: BoolMask, *, keyframe: bool = False) -> SentView:
    region = RoiMask(blocks, 8, 16, 32)
    mask = np.zeros((16, 32), np.bool_)
    mask[2:4, 2:4] = True
    grey = np.full((16, 32, 3), 100, np.uint8)
    return SentView("cable", grey, region, keyframe, 1234, detections((1, 1, 5, 5, 2)), mask)


def test_pictures_show_what_was_sent_and_nothing_else():
    view = view_of(np.array([[True, False, False, True], [False, False, False, False]]))
    picture = kept_pixels(view, (1, 2, 3))
    assert (picture[:8, :8] == 100).all()
    assert (picture[:8, 24:] == 100).all()
    assert (picture[8:] == (1, 2, 3)).all()
    assert (picture[:8, 8:24] == (1, 2, 3)).all()
    mask = drawing.mask_picture(view)
    assert tuple(mask[3, 3]) == MASK_COLOUR
    assert (mask[5, 5] == 255).all()
    assert tuple(mask[12, 12]) == drawing.OUTSIDE_BGR


def test_captions_tell_share_kept_and_bytes():
    whole = view_of(np.ones((2, 4), np.bool_))
    part = view_of(np.array([[True, False, False, True], [False] * 4]))
    row = FigureRow(
        "drive", Frame(whole.received, 3, 0), whole, (part, view_of(np.ones((2, 4), np.bool_), keyframe=True))
    )
    panels = drawing.panels_of(row)
    assert [panel.title for panel in panels] == ["Original", "Full frame", "CABLE", "CABLE", "ROI mask"]
    assert panels[0].caption == "32 × 16 px"
    assert panels[1].caption == "1 detection · 1.2 kB"
    assert (panels[2].badge, panels[2].caption) == ("25.0 %", "1/1 kept · 1.2 kB")
    assert panels[3].badge == "keyframe"
    assert panels[4].caption == "region 100.0 % · mask 0.8 %"


def test_the_png_has_every_panel_at_its_place(two_rows, tmp_path):
    path = tmp_path / "new" / "figure.png"
    drawing.write_figure(two_rows, path)
    image = cv2.imread(str(path))
    assert image.shape[1] == pytest.approx(drawing.WIDTH_IN * drawing.PNG_DPI, abs=2)
    assert not list(path.parent.glob("*.part"))
    panel_in = (drawing.WIDTH_IN - drawing.LABEL_IN - drawing.RIGHT_IN - 4 * drawing.GAP_IN) / 5
    for number, row in enumerate(two_rows):
        pitch_in = panel_in * HEIGHT / WIDTH + drawing.CAPTION_IN + drawing.GAP_IN
        left, top = square_corner(row.frame.index)
        middle = np.array([left + SQUARE / 2, top + SQUARE / 2]) * panel_in / WIDTH
        for column in range(4):
            x_in = drawing.LABEL_IN + column * (panel_in + drawing.GAP_IN) + middle[0]
            y_in = drawing.TITLE_IN + number * pitch_in + middle[1]
            pixel = image[round(y_in * drawing.PNG_DPI), round(x_in * drawing.PNG_DPI)]
            np.testing.assert_allclose(pixel, RED, atol=30)
        x_in = drawing.LABEL_IN + 4 * (panel_in + drawing.GAP_IN) + middle[0]
        pixel = image[round(y_in * drawing.PNG_DPI), round(x_in * drawing.PNG_DPI)]
        np.testing.assert_allclose(pixel, MASK_COLOUR, atol=3)


def test_the_pdf_embeds_its_fonts(two_rows, tmp_path):
    path = tmp_path / "figure.pdf"
    drawing.write_figure(two_rows[:1], path)
    data = path.read_bytes()
    assert data.startswith(b"%PDF-")
    assert b"/FontFile2" in data
    assert b"/Type3" not in data


def test_what_cannot_be_written_says_why(two_rows, tmp_path):
    with pytest.raises(ConfigurationError, match=r"ends in \.png or \.pdf"):
        drawing.write_figure(two_rows, tmp_path / "figure.svg")
    with pytest.raises(ConfigurationError, match="at least one frame"):
        drawing.write_figure([], tmp_path / "figure.png")
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ConfigurationError, match="can't write the figure"):
        drawing.write_figure(two_rows, blocked / "figure.png")


def test_frame_numbers_are_read_strictly():
    assert frame_numbers("0, 40,80,40") == (0, 40, 80)
    assert frame_numbers(None) == ()
    for text in ("", "1,", "-3", "a"):
        with pytest.raises(ConfigurationError, match="--frames"):
            frame_numbers(text)
