"""Cells of a sweep: against a loop written out literally, late answers, dropped frames, and what cells share."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cable_codecs import (
    CodecParameters,
    RegionTreatment,
    TreatedDecoder,
    TreatedEncoder,
    create_decoder,
    create_encoder,
    encode_mask,
    roi_psnr,
    roi_ssim,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from test_tables_engine import TileDetector, cheap_models

from cable_rpc.cloud.backends import FrameContext
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.data.source import open_source
from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.edge.strategy import FullFrame
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.study.closed_loop.models import ModelChoice
from cable_rpc.study.metrics import retained
from cable_rpc.study.sweep import cell_run, clip_store
from cable_rpc.study.sweep.cell import CellResult, ClipRequest, MeasuredCell, RatePoint, SweepCell
from cable_rpc.study.sweep.cell_run import run_cell
from cable_rpc.study.sweep.clip_store import clip_key, stored_clip
from cable_rpc.study.sweep.fidelity import region_fidelity
from cable_rpc.study.sweep.reference import pseudo_truth
from cable_rpc.study.sweep.simulated_link import SimulatedLink
from cable_rpc.types import BoolMask, Detections, Frame

CLIP = ClipRequest("synthetic:11", size=(160, 96), max_frames=5, models=ModelChoice("boxes", "tiles"))
FROZEN = RegionTreatment.default_for(stateless=False)
CELL = SweepCell(CLIP, "cable", "default", FROZEN, "h264", RatePoint(30))


def measured(cell: SweepCell, cache: Path) -> CellResult:
    found = run_cell(cell, cache, cheap_models)
    assert found.error == ""
    assert found.result is not None
    return found.result


def timeless(result: CellResult) -> dict[str, Any]:
    content = result.to_json()
    del content["metrics"]["stage_ns"], content["metrics"]["end_to_end_ns"]
    return content


def sure(found: Detections) -> Detections:
    return found.select(found.scores >= 0.4)


def test_whole_frames_cost_and_keep_what_the_codec_alone_makes_of_them(tmp_path: Path) -> None:
    """No region, so the loop is the plain codec: bytes, error and detections follow from it frame by frame."""
    result = measured(replace(CELL, strategy="full-frame"), tmp_path)
    frames = list(open_source("synthetic:11", size=(160, 96), max_frames=5))
    parameters = CodecParameters("h264", 160, 96, 10.0, 30)
    detector = TileDetector()
    size, error, counts = 0, 0.0, np.zeros(3, np.int64)
    with create_encoder(parameters) as encoder, create_decoder(parameters) as decoder:
        for frame in frames:
            packet = encoder.encode(frame.image, None)
            size += len(packet.data)
            shown = decoder.decode(packet.data)
            grey = [cv2.cvtColor(one, cv2.COLOR_BGR2GRAY).astype(np.float64) for one in (frame.image, shown)]
            error += float(((grey[0] - grey[1]) ** 2).sum())
            kept = retained(sure(detector.one(frame.image)), sure(detector.one(shown)))
            counts += (kept.retained, kept.reference_count, kept.spurious)
    assert result.uplink.keyframe_pictures + result.uplink.region_pictures == size
    assert result.uplink.side_information == 0
    assert result.sent.pixels == 5 * 160 * 96
    assert result.sent.squared_error == pytest.approx(error)
    assert result.metrics.retention[0].tolist() == counts.tolist()
    assert result.seconds == pytest.approx(0.5)


def test_the_loop_is_that_of_tracker_and_codec_written_out(tmp_path: Path) -> None:
    # The uncertainty travels rounded; without its dilation only the mask matters.
    roi = RoiConfig(dilation_uncertainty_px=0.0)
    result = measured(replace(CELL, roi=roi), tmp_path)
    parameters = CodecParameters("h264", 160, 96, 10.0, 30)
    encoder, decoder = TreatedEncoder(parameters, FROZEN), TreatedDecoder(parameters, FROZEN)
    tracker, detector = RoiTracker(roi, 8), TileDetector()
    pictures = regions = 0
    for frame in open_source("synthetic:11", size=(160, 96), max_frames=5):
        proposal = tracker.propose(frame)
        whole = proposal.keyframe or bool(proposal.roi.blocks.all())
        packet = encoder.encode(frame.image, None if whole else proposal.roi.blocks, 8)
        pictures += len(packet.encoded.data)
        regions += 0 if packet.blocks is None else len(encode_mask(packet.blocks))
        shown = decoder.decode(packet.encoded.data, packet.blocks, packet.block_size).image
        region = np.ones((96, 160), np.bool_)
        if packet.blocks is not None:
            region = np.kron(packet.blocks, np.ones((packet.block_size,) * 2, np.bool_))[:96, :160]
        context = FrameContext(frame.index, sure(detector.one(shown)), "")
        told = BoxSegmenter().segment(shown, region, "", context)
        tracker.update(frame.index, told.mask & region, confidence=told.confidence)
    encoder.close()
    decoder.close()
    assert result.uplink.keyframe_pictures + result.uplink.region_pictures == pictures
    assert result.uplink.side_information == regions


def test_equal_settings_give_equal_figures_and_their_json_holds_them(tmp_path: Path) -> None:
    first, second = measured(CELL, tmp_path / "a"), measured(CELL, tmp_path / "b")
    assert timeless(first) == timeless(second)
    again = CellResult.from_json(json.loads(json.dumps(first.to_json())))
    assert again.to_json() == first.to_json()


class Recorder(FullFrame):
    """Sends everything, and notes when it is asked and told."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[tuple[str, int]] = []

    def propose(self, frame: Frame) -> RoiProposal:
        self.events.append(("propose", frame.index))
        return super().propose(frame)

    def update(self, index: int, mask: BoolMask, **_: object) -> None:
        self.events.append(("update", index))


@pytest.mark.parametrize("delay", [1, 3])
def test_answers_are_there_so_many_frames_later(delay: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder()
    monkeypatch.setattr(cell_run, "open_strategy", lambda *_, **__: recorder)
    measured(replace(CELL, feedback_delay=delay), tmp_path)
    expected: list[tuple[str, int]] = []
    for k in range(5):
        expected += [("update", k - delay)] if k >= delay else []
        expected.append(("propose", k))
    expected += [("update", k) for k in range(5 - delay, 5)]
    assert recorder.events == expected


def test_a_link_delays_answers_and_drops_what_finds_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of 100 ms; a frame's way takes 250 ms whatever its size, and two may be under way."""
    recorder = Recorder()
    monkeypatch.setattr(cell_run, "open_strategy", lambda *_, **__: recorder)
    link = SimulatedLink("l", uplink_kbps=1e9, downlink_kbps=1e12, delay_ms=125, edge_ms=0, cloud_ms=0, window=2)
    result = measured(replace(CELL, link=link), tmp_path)
    assert recorder.events == [
        ("propose", 0),
        ("propose", 1),
        ("update", 0),
        ("propose", 3),
        ("update", 1),
        ("propose", 4),
        ("update", 3),
        ("update", 4),
    ]
    assert result.dropped == 1
    assert result.metrics.frames == 5
    assert [round(one / 1e6) for one in result.metrics.end_to_end_ns] == [250] * 4
    whole = measured(CELL, tmp_path)
    assert result.metrics.retention[0, 1] == whole.metrics.retention[0, 1], "a dropped frame's objects are missed"


def test_image_codecs_keep_a_target_rate_too(tmp_path: Path) -> None:
    jpeg = replace(CELL, codec="jpeg", treatment=RegionTreatment.default_for(stateless=True), strategy="full-frame")
    low, high = (measured(replace(jpeg, rate=RatePoint(bitrate_kbps=rate)), tmp_path) for rate in (150, 600))
    assert low.uplink.total < high.uplink.total
    assert low.sent.squared_error > high.sent.squared_error


def test_clips_are_decoded_once_and_give_back_what_was_read(tmp_path: Path) -> None:
    clip = stored_clip(CLIP, tmp_path)
    before = (clip.folder / clip_store.FRAMES_FILE).stat().st_mtime_ns
    assert stored_clip(CLIP, tmp_path) == clip
    assert (clip.folder / clip_store.FRAMES_FILE).stat().st_mtime_ns == before
    source = open_source("synthetic:11", size=(160, 96), max_frames=5)
    assert (clip.name, clip.fps, clip.size_wh, clip.frame_count) == (source.name, source.fps, source.size_wh, 5)
    for ours, theirs in zip(clip, source, strict=True):
        np.testing.assert_array_equal(ours.image, theirs.image)
        assert (ours.index, ours.capture_time_ns, ours.ego) == (theirs.index, theirs.capture_time_ns, theirs.ego)
        assert (ours.intrinsics, ours.mount) == (theirs.intrinsics, theirs.mount)
        assert ours.truth is not None
        assert theirs.truth is not None
        np.testing.assert_array_equal(ours.truth.boxes_xyxy, theirs.truth.boxes_xyxy)
        np.testing.assert_array_equal(ours.truth.track_ids, theirs.truth.track_ids)
        np.testing.assert_array_equal(ours.truth.visibility, theirs.truth.visibility)
    assert [path.name for path in tmp_path.iterdir()] == [clip_key(CLIP)], "nothing half done is left behind"


def test_a_clip_that_fails_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(clip_store, "write_frames", full)
    with pytest.raises(ConfigurationError, match="No space left"):
        stored_clip(CLIP, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_cells_of_a_clip_run_the_models_on_its_frames_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []
    real = clip_store.open_source
    monkeypatch.setattr(clip_store, "open_source", lambda *a, **k: opened.append(a) or real(*a, **k))
    for quality in (25, 30, 35):
        measured(replace(CELL, rate=RatePoint(quality)), tmp_path)
    assert len(opened) == 1
    (folder,) = tmp_path.iterdir()
    assert len(list(folder.glob("reference-*.npz"))) == 1


def test_failures_are_told_and_not_raised(tmp_path: Path) -> None:
    unreadable = run_cell(replace(CELL, clip=replace(CLIP, source=f"video:{tmp_path}/no.mp4")), tmp_path, cheap_models)
    assert unreadable.result is None
    assert "no.mp4" in unreadable.error
    lossless = run_cell(replace(CELL, codec="webp", treatment=FROZEN), tmp_path, cheap_models)
    assert lossless.result is None
    assert lossless.error.startswith("synthetic:11: ")


def test_pseudo_truth_is_what_the_detector_is_sure_of(tmp_path: Path) -> None:
    boxes = np.array([[0, 0, 9, 9], [10, 0, 19, 9], [20, 0, 29, 9]], np.float32)
    found = Detections(boxes, np.array([2, 2, 9], np.int32), np.array([0.9, 0.39, 0.8], np.float32))
    truth = pseudo_truth(found)
    assert truth.boxes_xyxy.tolist() == [[0, 0, 9, 9]], "neither the doubtful car nor the traffic light"
    annotated = measured(CELL, tmp_path)
    told = measured(replace(CELL, clip=replace(CLIP, truth="detector")), tmp_path)
    assert (annotated.truth, told.truth) == ("annotated", "detector")
    assert told.metrics.retention.tolist() == annotated.metrics.retention.tolist()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), top=st.integers(0, 20), height=st.integers(1, 40))
def test_fidelity_is_that_of_each_region_alone(seed: int, top: int, height: int) -> None:
    random = np.random.default_rng(seed)
    first = random.integers(0, 256, (64, 48, 3)).astype(np.uint8)
    second = np.clip(first.astype(int) + random.integers(-9, 10, first.shape), 0, 255).astype(np.uint8)
    region = np.zeros((64, 48), np.bool_)
    region[top : top + height, 5:40] = True
    ours, nothing = region_fidelity(first, second, (region, np.zeros_like(region)))
    assert nothing.frames == nothing.pixels == 0
    error = ours.squared_error / ours.pixels
    assert 10 * np.log10(255**2 / error) == pytest.approx(roi_psnr(first, second, region))
    if height > 6:
        assert ours.ssim == pytest.approx(roi_ssim(first, second, region), abs=1e-5)
    else:
        assert ours.ssim_frames == 0


def test_labels_take_no_part_in_what_a_cell_is() -> None:
    named = replace(CELL, treatment_label="other", roi_label="mine", link=SimulatedLink("a", uplink_kbps=1.0))
    renamed = replace(CELL, treatment_label="x", roi_label="y", link=SimulatedLink("b", uplink_kbps=1.0))
    assert named.settings() == renamed.settings()
    assert CELL.settings() != replace(CELL, feedback_delay=2).settings()
    assert os.linesep not in MeasuredCell(CELL, None, "x").cell.title


def test_a_source_without_frames_is_refused(tmp_path: Path) -> None:
    class Empty:
        name, fps, size_wh = "empty", 10.0, (8, 8)

        def __iter__(self):
            return iter(())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clip_store, "open_source", lambda *_, **__: Empty())
        with pytest.raises(SourceError, match="no frames"):
            stored_clip(CLIP, tmp_path)
