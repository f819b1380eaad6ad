"""The codec study: its regions, its points against literal coding, what it keeps, and what it makes of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder, encode_mask
from rich.console import Console

from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.study import codec_study
from cable_rpc.study.codec_compare import (
    MEASURES,
    ClipView,
    Comparison,
    StudyResults,
    Way,
    mean_and_worst,
    write_comparisons,
)
from cable_rpc.study.codec_measure import box_pixels, check_clip, measure_point, prepare_clip
from cable_rpc.study.codec_study import Cell, StudyPlan, default_qualities, run_study
from cable_rpc.study.codec_study_tables import render_study
from cable_rpc.study.loop_simulator import TruthCloud
from cable_rpc.study.study_masks import corridor_mask
from cable_rpc.study.study_points import POINTS_FILE, ClipRequest, PointStore, Setting, StudyPoint
from cable_rpc.study.study_treatments import TREATMENTS, applies
from cable_rpc.types import Detections, GroundTruth

pytest.importorskip("scipy", reason="needs scipy, in the study extra")

CLIP = ClipRequest("synthetic:8", 4, "corridor", size=(192, 112))
LOOP = replace(CLIP, mask="loop")
CRFS = (18, 23, 28, 33, 38)


def plan(*treatments: str, clips: Sequence[ClipRequest] = (CLIP,)) -> StudyPlan:
    return StudyPlan(tuple(clips), treatments, ("h264",))


def without_times(point: StudyPoint) -> StudyPoint:
    return replace(point, treat_ms=0.0, encode_ms=0.0, decode_ms=0.0, restore_ms=0.0)


def point(treatment: str, quality: int, total_bytes: int, psnr: float, **changes: object) -> StudyPoint:
    base = StudyPoint(
        "video:drives/a.mp4", "corridor", "first 10 frames", treatment, "h264", quality, "1", 64, 48, 10.0, 10, 0,
        0.22, 0.25, total_bytes - 100, 100, psnr, 0.9, None, None, 20.0, 1.0, 2.0, 3.0, 0.5,
    )  # fmt: skip
    return replace(base, **changes)  # type: ignore[arg-type]


def luma(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float64)


@pytest.mark.parametrize(("height", "width"), [(540, 960), (720, 1280), (375, 1242), (96, 161)])
def test_corridor_covers_22_percent_moves_smoothly_and_is_the_same_again(height: int, width: int) -> None:
    masks = [corridor_mask(height, width, position) for position in range(12)]
    for mask in masks:
        assert mask.shape == (height, width)
        assert mask.dtype == np.bool_
        assert mask.mean() == pytest.approx(0.22, abs=2 / height)
    changes = [np.mean(before != after) for before, after in pairwise(masks)]
    assert min(changes) > 0
    assert max(changes) < 0.08
    assert np.array_equal(masks[5], corridor_mask(height, width, 5))


def test_corridor_keeps_its_coverage_for_hours() -> None:
    for position in (1_000, 54_321, 1_000_000):
        assert corridor_mask(108, 192, position).mean() == pytest.approx(0.22, abs=0.02)


@pytest.mark.parametrize("treatment", ["whole", "align8-zero"])
def test_point_is_what_literal_coding_gives(treatment: str) -> None:
    found = measure_point(prepare_clip(CLIP), Setting(treatment, "h264", 28))
    frames = prepare_clip(CLIP).frames
    parameters = CodecParameters("h264", 192, 112, frame_rate=10.0, quality=28)
    bitstream, masks, errors, box_errors = 0, 0, [], []
    with create_encoder(parameters) as encoder, create_decoder(parameters) as decoder:
        for position, frame in enumerate(frames):
            region = corridor_mask(112, 192, position)
            blocks = region.reshape(14, 8, 24, 8).any(axis=(1, 3))
            image = frame.image
            if treatment != "whole":
                image = image * np.kron(blocks, np.ones((8, 8), np.bool_)).astype(np.uint8)[..., None]
                masks += len(encode_mask(blocks))
            data = encoder.encode(image).data
            bitstream += len(data)
            shown = decoder.decode(data)
            if treatment != "whole":
                shown = shown * np.kron(blocks, np.ones((8, 8), np.bool_)).astype(np.uint8)[..., None]
            squares = (luma(frame.image) - luma(shown)) ** 2
            errors.append(squares[region].mean())
            boxes = np.zeros((112, 192), np.bool_)
            truth = frame.truth
            for (x0, y0, x1, y1), visibility in zip(truth.boxes_xyxy, truth.visibility, strict=True):
                if y1 - y0 >= 25 and visibility >= 0.5:
                    boxes[math.floor(y0) : math.ceil(y1), math.floor(x0) : math.ceil(x1)] = True
            if boxes.any():
                box_errors.append(squares[boxes].mean())
    assert (found.bitstream_bytes, found.mask_bytes) == (bitstream, masks)
    assert found.kbps == pytest.approx((bitstream + masks) * 8 / 0.4 / 1e3)
    assert found.roi_psnr_db == pytest.approx(10 * math.log10(255**2 / np.mean(errors)), abs=1e-6)
    if box_errors:
        assert found.box_psnr_db == pytest.approx(10 * math.log10(255**2 / np.mean(box_errors)), abs=1e-6)
    else:
        assert found.box_psnr_db is None
    assert found.coverage == pytest.approx(0.22, abs=0.01)
    assert found.frames == 4


def test_whole_frames_of_the_loop_are_sent_whole_and_without_mask() -> None:
    tracker, cloud = RoiTracker(block_size=1), TruthCloud()
    masks = whole = 0
    for frame in prepare_clip(LOOP).frames:
        proposal = tracker.propose(frame)
        tracker.update(frame.index, cloud(frame, proposal.roi).mask)
        whole += proposal.keyframe
        if not proposal.keyframe:
            blocks = proposal.roi.pixels().reshape(14, 8, 24, 8).any(axis=(1, 3))
            masks += len(encode_mask(blocks))
    found = measure_point(prepare_clip(LOOP), Setting("align8-zero", "h264", 28))
    assert whole >= 1
    assert (found.whole_frames, found.mask_bytes) == (whole, masks)
    assert found.mask == "loop, truth"


def test_every_treatment_keeps_the_region_as_well_as_its_codec_can() -> None:
    clip = prepare_clip(CLIP)
    for codec, quality in (("h264", 18), ("jpeg", 90)):
        for name, treatment in TREATMENTS.items():
            if applies(treatment, codec):
                found = measure_point(clip, Setting(name, codec, quality))
                assert found.roi_psnr_db > (24 if treatment.scale < 1 else 35), name
                assert found.coverage <= found.coverage_sent < 0.6


def test_treatments_apply_where_the_codec_can_carry_them() -> None:
    assert not applies(TREATMENTS["align8-rows"], "h264")
    assert applies(TREATMENTS["align8-rows"], "jpeg")
    assert not applies(TREATMENTS["align8-freeze"], "webp")
    assert applies(TREATMENTS["align8-freeze"], "h264")
    assert applies(TREATMENTS["soft-0.2"], "h264")
    assert not applies(TREATMENTS["soft-0.2"], "jpeg")
    cells = StudyPlan((CLIP,), ("align8-rows", "align8-zero"), ("jpeg",)).cells()
    assert [(cell.codec, cell.treatment) for cell in cells] == [
        ("h264", "whole"), ("jpeg", "whole"), ("jpeg", "align8-zero"), ("jpeg", "align8-rows"),
    ]  # fmt: skip


def test_stopped_study_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = plan("align8-zero", "align16-grey")

    def stop(cell: Cell, points: Sequence[StudyPoint]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(wanted, tmp_path, workers=1, listener=stop)
    text = (tmp_path / POINTS_FILE).read_text()
    assert len(text.splitlines()) == 1 + 5
    # A crash may cut the last row; it is measured again.
    (tmp_path / POINTS_FILE).write_text(text[:-20])
    measured: list[Setting] = []

    def counting(clip: object, setting: Setting) -> StudyPoint:
        measured.append(setting)
        return measure_point(clip, setting)  # type: ignore[arg-type]

    monkeypatch.setattr(codec_study, "measure_point", counting)
    told: list[Cell] = []
    points = run_study(wanted, tmp_path, workers=1, listener=lambda cell, found: told.append(cell))
    assert measured[0] == Setting("whole", "h264", 38)
    assert len(measured) == 11
    assert len(told) == 3
    assert [(p.treatment, p.quality) for p in points] == [
        (treatment, crf) for treatment in ("whole", "align8-zero", "align16-grey") for crf in CRFS
    ]
    measured.clear()
    again = run_study(wanted, tmp_path, workers=1)
    assert measured == []
    assert again == points
    anew = run_study(wanted, tmp_path, workers=1, again=True)
    assert len(measured) == 15
    assert [without_times(one) for one in anew] == [without_times(one) for one in points]
    assert run_study(wanted, tmp_path, workers=1) == anew


def test_two_workers_give_what_one_gives(tmp_path: Path) -> None:
    wanted = plan("align8-zero", clips=(CLIP, LOOP))
    alone = run_study(wanted, tmp_path / "one", workers=1)
    shared = run_study(wanted, tmp_path / "two", workers=2)
    assert [without_times(one) for one in shared] == [without_times(one) for one in alone]
    with PointStore(tmp_path / "two" / POINTS_FILE) as store:
        assert sorted(map(repr, store.points.values())) == sorted(map(repr, shared))


def test_errors_of_workers_reach_the_caller(tmp_path: Path) -> None:
    # Every quality is the codec's own to judge, so that only a worker finds this out.
    wanted = StudyPlan((CLIP,), ("align8-zero",), ("h264",), {"h264": (99, 18)})
    with pytest.raises(CodecError, match=r"h264 quality must be 0\.\.51, got 99"):
        run_study(wanted, tmp_path, workers=2)


def test_unreadable_clip_is_found_before_anything_is_coded(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="nowhere"):
        run_study(plan("align8-zero", clips=(CLIP, replace(CLIP, clip="video:nowhere.mp4"))), tmp_path, workers=1)
    assert len((tmp_path / POINTS_FILE).read_text().splitlines()) == 1


def test_file_of_other_columns_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / POINTS_FILE
    path.write_text("clip,bytes\na,1\n")
    with pytest.raises(ConfigurationError, match="other columns"):
        run_study(plan("align8-zero"), tmp_path, workers=1)
    assert path.read_text() == "clip,bytes\na,1\n"


def test_unwritable_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="can't write"):
        run_study(plan("align8-zero"), tmp_path / "file", workers=1)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: plan("align7"), "treatment 'align7' is unknown; use some of whole, pixel-zero"),
        (lambda: plan("align8-zero", clips=()), "needs a clip"),
        (lambda: plan("align8-zero", clips=(CLIP, CLIP)), "same clip twice"),
        (lambda: StudyPlan((CLIP,), (), ("mpeg2",)), "codec 'mpeg2' is unknown"),
        (lambda: default_qualities("webp-lossless"), "no usual qualities"),
        (lambda: replace(CLIP, mask="sky"), "use corridor or loop"),
    ],
    ids=["treatment", "no clip", "twice", "codec", "quality", "mask"],
)
def test_misuse_is_told(make: object, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        make()  # type: ignore[operator]


def test_clip_without_truth_needs_a_detector_for_the_loop(tmp_path: Path, shared_detector: Path) -> None:
    for index in range(3):
        image = np.full((96, 160, 3), 90, np.uint8)
        image[30:60, 20 + 4 * index : 60 + 4 * index] = 230
        cv2.imwrite(str(tmp_path / f"{index:03d}.png"), image)
    request = ClipRequest(f"video:{tmp_path}", 3, "loop", fps=10.0)
    for check in (check_clip, prepare_clip):
        with pytest.raises(ConfigurationError, match="give --detector embedded or --detector onnx:FILE"):
            check(request)
    detected = prepare_clip(replace(request, detector=f"onnx:{shared_detector}"))
    assert detected.regions[0].whole
    assert len(detected.regions) == 3
    assert detected.request.mask_label == f"loop, onnx:{shared_detector}"


def test_boxes_of_visible_objects_are_judged() -> None:
    truth = GroundTruth(
        np.array([[2.5, 3.5, 10.5, 30.0], [0, 0, 50, 10], [20, 5, 30, 39]], np.float32),
        np.full(3, 2, np.int32), np.arange(3, dtype=np.int32), np.array([1.0, 1.0, 0.3], np.float32),
    )  # fmt: skip
    pixels = box_pixels(truth, 40, 60)
    expected = np.zeros((40, 60), np.bool_)
    expected[3:30, 2:11] = True
    assert pixels is not None
    assert np.array_equal(pixels, expected)
    empty = Detections.empty()
    nothing = GroundTruth(empty.boxes_xyxy, empty.class_ids, empty.class_ids, empty.scores)
    assert box_pixels(nothing, 40, 60) is None
    assert box_pixels(None, 40, 60) is None


def study_points() -> list[StudyPoint]:
    whole = [(18, 40_000, 44.0), (23, 20_000, 41.0), (28, 10_000, 38.0), (33, 5_000, 35.0), (38, 2_500, 32.0)]
    rows = [point("whole", crf, size, psnr, mask_bytes=0, bitstream_bytes=size) for crf, size, psnr in whole]
    rows += [point("align8-zero", crf, size // 2, psnr) for crf, size, psnr in whole]
    rows += [point("align16-zero", crf, size // 4, psnr + 20) for crf, size, psnr in whole]
    other = [replace(row, clip="synthetic:1", box_psnr_db=row.roi_psnr_db - 1) for row in rows]
    # On the second clip the treated stream needs 4 of 5 bytes.
    return rows + [
        replace(row, bitstream_bytes=round(row.total_bytes * 1.6) - 100) if row.treatment == "align8-zero" else row
        for row in other
    ]


def test_results_compare_masks_included_with_whole_frames() -> None:
    results = StudyResults(study_points())
    first, second = results.views
    way = Way("align8-zero", "h264")
    assert [first.title, second.title] == ["drives/a", "synthetic:1"]
    one = results.compare(first, way, MEASURES["roi_psnr"])
    two = results.compare(second, way, MEASURES["roi_psnr"])
    assert one is not None
    assert two is not None
    assert one.bd_rate == pytest.approx(-50.0)
    assert two.bd_rate == pytest.approx(-20.0)
    assert one.overlap == 1.0
    assert mean_and_worst([one, two]) == (pytest.approx(-35.0), pytest.approx(-20.0))
    assert results.byte_saving(first, way) == pytest.approx(0.5)
    assert results.compare(first, way, MEASURES["box_psnr"]) is None
    far = results.compare(first, Way("align16-zero", "h264"), MEASURES["roi_psnr"])
    assert far is not None
    assert far.bd_rate is None
    assert "share 0 % of their quality range" in far.refusal
    assert mean_and_worst([one, far]) == (None, None)
    assert mean_and_worst([]) == (None, None)
    assert mean_and_worst([Comparison(-10.0, 1.0, 0), None]) == (None, None)


def test_means_are_taken_for_each_kind_of_region_alone() -> None:
    rows = study_points()
    looped = [replace(row, mask="loop, truth") for row in rows if row.clip == "synthetic:1"]
    kinds = StudyResults(rows + looped).by_kind()
    assert {kind: len(part.views) for kind, part in kinds.items()} == {"corridor": 2, "loop": 1}
    way = Way("align8-zero", "h264")
    comparisons = [kinds["loop"].compare(view, way, MEASURES["roi_psnr"]) for view in kinds["loop"].views]
    assert mean_and_worst(comparisons)[0] == pytest.approx(-20.0)


def test_similarity_is_compared_in_decibels() -> None:
    of = MEASURES["roi_ssim"].of
    assert of(point("whole", 28, 100, 40.0, roi_ssim=0.99)) == pytest.approx(20.0)
    assert of(point("whole", 28, 100, 40.0, roi_ssim=1.0)) == math.inf


def test_lossless_points_take_no_part() -> None:
    rows = [replace(row, roi_psnr_db=math.inf) if row.quality == 18 else row for row in study_points()]
    results = StudyResults(rows)
    curve = results.curve(ClipView("synthetic:1", "corridor"), Way("whole", "h264"), MEASURES["roi_psnr"])
    assert curve is not None
    assert len(curve) == 4


def test_tables_and_files_say_it(tmp_path: Path) -> None:
    results = StudyResults(study_points())
    console = Console(width=150, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(render_study(results))
    text = console.export_text()
    row = next(line for line in text.splitlines() if line.startswith(" align8-zero"))
    assert row.split()[2:6] == ["-50.0", "-20.0", "-35.0", "-20.0"]
    assert "no BD-rate for align16-zero h264 on drives/a, corridor: the curves share 0 %" in text
    write_comparisons(results, tmp_path / "bd.csv")
    lines = (tmp_path / "bd.csv").read_text().splitlines()
    assert "video:drives/a.mp4,corridor,align8-zero,h264,roi_psnr,-50.0000,1.0000,0," in lines


def test_figure_has_every_curve() -> None:
    pytest.importorskip("plotly", reason="needs plotly, in the study extra")
    from cable_rpc.study.codec_study_figure import study_figure

    figure = study_figure(StudyResults(study_points()))
    curves = [trace for trace in figure.data if trace.type == "scatter"]
    assert len(curves) == 6
    assert list(curves[0].x) == sorted(curves[0].x)
    bars = {trace.name: list(trace.y) for trace in figure.data if trace.type == "bar"}
    assert bars["align8-zero · h264"] == [pytest.approx(-50.0), pytest.approx(-20.0)]
