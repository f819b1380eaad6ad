"""Cells of the tables: against a real server's run, resumed after a kill, and with parts that fail."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cable_codecs import CodecParameters, create_encoder
from cable_models import embedded_detector_path

from cable_rpc.cloud.backends import FrameContext
from cable_rpc.cloud.perception import PerceptionModels, PerceptionRequest
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.service import PerceptionServer, ServerConfig
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.data.source import open_source
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.study.closed_loop.models import LoadedModels, ModelChoice
from cable_rpc.study.closed_loop.score_keeper import ScoreKeeper
from cable_rpc.study.sequence_metrics import SequenceMetrics, pool
from cable_rpc.study.stream_run import StreamRun, StreamRunConfig
from cable_rpc.study.tables import data_sets, identity
from cable_rpc.study.tables.cells import CELLS_FOLDER, Cell
from cable_rpc.study.tables.data_sets import sequence_requests
from cable_rpc.study.tables.engine import WORKER_DIED, run_cells
from cable_rpc.study.tables.identity import cell_identity, cell_key
from cable_rpc.study.tables.sequence_run import SequenceTask, run_sequence
from cable_rpc.study.tables.settings import RunSettings, SequenceRequest
from cable_rpc.types import BoolMask, Detections, Image, Segmentation

SETTINGS = RunSettings(detector="tiles", segmenter="boxes", max_frames=4, size=(160, 96))
SEEDS = ("synthetic:11", "synthetic:12", "synthetic:13")
STRATEGIES = ("cable", "full-frame")


class TileDetector:
    """A box for every busy tile of the picture, as sure as the tile is busy: cheap, and depends on what was decoded."""

    name = "tiles"
    revision = "1"
    device = "cpu"

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        return [self.one(image) for image in images]

    def one(self, image: Image) -> Detections:
        height, width = image.shape[0] // 4, image.shape[1] // 4
        grey = image[: 4 * height, : 4 * width].mean(axis=2).reshape(4, height, 4, width)
        rows, columns = np.nonzero(grey.std(axis=(1, 3)) > 8)
        boxes = np.stack([columns * width, rows * height, (columns + 1) * width, (rows + 1) * height], axis=1)
        scores = np.minimum(1.0, grey.std(axis=(1, 3))[rows, columns] / 50)
        return Detections(boxes.astype(np.float32), np.full(len(rows), 2, np.int32), scores.astype(np.float32))


class WholeFrameSegmenter(BoxSegmenter):
    """Fails on every picture that is cut to a region."""

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        if not roi.all():
            raise ModelError("only whole frames, please")
        return super().segment(image, roi, prompt, context)


def cheap_models(choice: ModelChoice, segmenter: BoxSegmenter | None = None) -> LoadedModels:
    keeper = ScoreKeeper(TileDetector())
    return LoadedModels(PerceptionModels.in_process(keeper, segmenter or BoxSegmenter()), keeper)


cheap_run = partial(run_sequence, load=cheap_models)


def slow_run(task: SequenceTask) -> list[Cell]:
    """Leaves a moment to be killed in."""
    time.sleep(0.5)
    return cheap_run(task)


def dying_run(task: SequenceTask) -> list[Cell]:
    if task.request.spec.endswith("12"):
        os._exit(3)
    return cheap_run(task)


def one_cell(spec: str, strategy: str, settings: RunSettings = SETTINGS) -> Cell:
    (request,) = sequence_requests([spec])
    (cell,) = cheap_run(SequenceTask(request, (strategy,), settings))
    assert cell.error == ""
    return cell


def without_times(cell: Cell) -> dict[str, Any]:
    content = cell.to_json()
    for name in ("stage_ns", "end_to_end_ns"):
        del content["metrics"][name]
    # Time stamps of the clock are variable-length numbers inside the messages.
    for layer in ("message", "transport"):
        del content["metrics"]["layers"][layer]
    for tally in (content["equal_quality"], *content["equal_quality"]["rungs"]):
        del tally["bytes_up"]
    return content


@pytest.mark.parametrize("strategy", ["cable", "motion-only"])
async def test_a_cell_is_what_a_real_server_makes_of_the_same_frames(strategy: str, tmp_path: Path) -> None:
    """The same sequence through `stream` against a server on a socket: the other composition of the same parts."""
    models = cheap_models(SETTINGS.models).perception
    async with PerceptionServer(models, ServerConfig("127.0.0.1:0", SessionLimits(), drain_s=1.0)) as server:
        source = open_source("synthetic:11", max_frames=4, size=(160, 96))
        config = StreamRunConfig(f"127.0.0.1:{server.port}", tmp_path, strategy=strategy)
        summary = await StreamRun(source, config, lambda *_: None).run()
    cell = await asyncio.to_thread(one_cell, "synthetic:11", strategy)
    pooled = pool([cell.metrics] if cell.metrics else [])
    for layer in ("bitstream", "with_roi"):
        theirs, ours = summary.layer(layer), pooled.layer(layer)
        assert ours.up_per_frame == theirs.uplink_bytes_per_frame
        assert ours.saving.value == pytest.approx(theirs.byte_saving)
    # Time stamps are variable-length numbers in the messages.
    assert pooled.layer("message").up_per_frame == pytest.approx(summary.layer("message").uplink_bytes_per_frame, abs=3)
    assert pooled.layer("bitstream").down_per_frame == summary.layer("bitstream").downlink_bytes_per_frame
    assert pooled.figure("coverage_tx").value == pytest.approx(summary.coverage_tx)
    if strategy == "cable":
        assert pooled.figure("coverage_roi").value == pytest.approx(summary.coverage_roi)
    assert pooled.figure("keyframe_rate").value == summary.keyframe_rate
    for threshold, share in summary.quality.recognition:
        assert pooled.recognition(threshold, region="sent", variant="visible").value == pytest.approx(share)
    assert summary.quality.micro is not None
    assert pooled.figure("roi_recall_visible").value == pytest.approx(summary.quality.micro.recall)
    assert pooled.figure("retention").value == pytest.approx(summary.quality.retention)
    assert pooled.figure("spurious_rate").value == pytest.approx(summary.quality.spurious_rate)


def test_whole_frames_are_coded_once_in_h264_and_are_their_own_reference() -> None:
    pooled = pool([metrics_of(one_cell("synthetic:11", "full-frame"))])
    parameters = CodecParameters("h264", 160, 96, open_source("synthetic:11").fps)
    with create_encoder(parameters) as encoder:
        sizes = [
            len(encoder.encode(frame.image, None).data)
            for frame in open_source("synthetic:11", max_frames=4, size=(160, 96))
        ]
    assert pooled.layer("bitstream").up_per_frame == sum(sizes) / 4
    for name in ("coverage_tx", "coverage_roi", "retention", "mask_iou", "recognition_95", "keyframe_rate"):
        assert pooled.figure(name).value == 1.0
    for name in ("byte_saving_bitstream", "byte_saving_transport", "spurious_rate", "pixel_saving"):
        assert pooled.figure(name).value == 0.0
    assert pooled.figure("roi_ap").value == pooled.figure("full_ap").value


def test_the_reference_stays_h264_where_regions_are_jpeg() -> None:
    h264 = pool([metrics_of(one_cell("synthetic:11", "full-frame"))]).layer("bitstream")
    jpeg = pool([metrics_of(one_cell("synthetic:11", "full-frame", replace(SETTINGS, codec="jpeg")))])
    assert jpeg.layer("bitstream").full_up_per_frame == h264.up_per_frame
    assert jpeg.layer("bitstream").up_per_frame > h264.up_per_frame


async def test_weak_detections_reach_average_precision_and_are_not_answered() -> None:
    models = cheap_models(SETTINGS.models)
    image = next(iter(open_source("synthetic:11", max_frames=1, size=(160, 96)))).image
    answer = await models.perception.perceive(PerceptionRequest(image, None, min_score=0.4))
    kept = models.keeper.newest
    assert 0 < len(answer.detections) < len(kept)
    assert answer.detections.scores.min() >= 0.4 > kept.scores.min()


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """kill -9 in mid-run: whole files only, nothing measured twice, the same figures as without the kill."""
    monkeypatch.setattr(identity, "code_digest", pinned_digest)
    program = f"import test_tables_engine as t; t.run_in_child({str(tmp_path)!r})"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    child = subprocess.Popen([sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    assert child.stdout.readline()
    os.kill(child.pid, signal.SIGKILL)
    # Workers hold the pipe's other end: it is closed when the last of them has gone.
    child.communicate(timeout=20)
    kept = sorted((tmp_path / CELLS_FOLDER).glob("*.json"))
    assert 0 < len(kept) < len(SEEDS) * len(STRATEGIES)
    for path in kept:
        assert json.loads(path.read_text())["cell"]["metrics"] is not None
    measured: list[str] = []

    def counting_run(task: SequenceTask) -> list[Cell]:
        measured.extend(f"{task.request.spec} {name}" for name in task.strategies)
        return cheap_run(task)

    requests = sequence_requests(SEEDS)
    resumed = run_cells(requests, STRATEGIES, SETTINGS, tmp_path, runner=counting_run)
    assert len(measured) == len(set(measured)) == len(resumed) - len(kept)
    assert {path.name for path in kept} < {path.name for path in (tmp_path / CELLS_FOLDER).glob("*.json")}
    afresh = run_cells(requests, STRATEGIES, SETTINGS, tmp_path / "afresh", runner=cheap_run)
    assert list(map(without_times, resumed)) == list(map(without_times, afresh))
    again = run_cells(requests, STRATEGIES, SETTINGS, tmp_path, runner=counting_run)
    assert [cell.to_json() for cell in again] == [cell.to_json() for cell in resumed]


def test_what_fails_is_a_cell_with_its_reason_and_is_tried_again(tmp_path: Path) -> None:
    """A strategy that needs truth on a clip without any, a file that isn't there, and a healthy sequence."""
    clip = tmp_path / "clip"
    clip.mkdir()
    for number in range(2):
        cv2.imwrite(str(clip / f"{number:03d}.png"), np.full((96, 160, 3), 40 * number, np.uint8))
    requests = sequence_requests([f"video:{clip}", "video:nowhere.mp4", "synthetic:11"])
    settings = replace(SETTINGS, max_frames=2)
    cells = run_cells(requests, ("oracle-boxes", "cable"), settings, tmp_path, runner=cheap_run)
    errors = {(cell.request.spec.partition(":")[2], cell.strategy): cell.error for cell in cells}
    assert errors[str(clip), "oracle-boxes"].startswith("frame 0 has no annotated boxes")
    assert errors[str(clip), "cable"] == errors["11", "oracle-boxes"] == errors["11", "cable"] == ""
    assert "nowhere.mp4" in errors["nowhere.mp4", "cable"] == errors["nowhere.mp4", "oracle-boxes"]
    tried: list[SequenceTask] = []

    def noting_run(task: SequenceTask) -> list[Cell]:
        tried.append(task)
        return cheap_run(task)

    run_cells(requests, ("oracle-boxes", "cable"), settings, tmp_path, runner=noting_run)
    assert [(task.request.spec.partition(":")[2], task.strategies) for task in tried] == [
        (str(clip), ("oracle-boxes",)),
        ("nowhere.mp4", ("oracle-boxes", "cable")),
    ]


def test_a_model_that_fails_in_mid_sequence_fails_that_cell(tmp_path: Path) -> None:
    runner = partial(run_sequence, load=partial(cheap_models, segmenter=WholeFrameSegmenter()))
    cells = run_cells(sequence_requests(["synthetic:11"]), STRATEGIES, SETTINGS, tmp_path, runner=runner)
    assert re.fullmatch(r"frame [1-3]: only whole frames, please", cells[0].error)
    assert cells[1].error == ""


def test_a_worker_that_dies_costs_its_own_sequence_only(tmp_path: Path) -> None:
    requests = sequence_requests(SEEDS[:2])
    cells = run_cells(requests, ("full-frame",), replace(SETTINGS, max_frames=2), tmp_path, workers=2, runner=dying_run)
    assert [cell.error for cell in cells] == ["", WORKER_DIED]
    assert [cell.request for cell in cells] == list(requests)


def test_everything_that_changes_a_figure_changes_the_key(tmp_path: Path) -> None:
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"1")
    request = SequenceRequest("video", f"video:{clip}")
    base = replace(SETTINGS, detector="embedded")
    changes = [
        {"codec": "jpeg"}, {"quality": 30}, {"roi": RoiConfig.paper()}, {"size": (320, 192)}, {"max_frames": 6},
        {"fps": 5.0}, {"segmenter": "embedded"}, {"prompt": "cars"}, {"block_size": 16}, {"skip_bad": True},
        {"equal_quality": False},
    ]  # fmt: skip
    keys = [cell_key(cell_identity(request, "cable", replace(base, **change))) for change in [{}, *changes]]  # type: ignore[arg-type]
    keys.append(cell_key(cell_identity(request, "open-loop", base)))
    keys.append(cell_key(cell_identity(SequenceRequest("video", "video:other.mp4"), "cable", base)))
    clip.write_bytes(b"another")
    keys.append(cell_key(cell_identity(request, "cable", base)))
    assert len(set(keys)) == len(keys)
    assert cell_key(cell_identity(request, "cable", base)) == keys[-1]
    stated = cell_identity(request, "cable", base)
    assert stated["detector_weights"] == hashlib.sha256(embedded_detector_path().read_bytes()).hexdigest()[:12]


def test_a_root_stands_for_all_its_sequences(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(data_sets.SOURCES, "kitti", data_sets.SOURCES["video"])  # type: ignore[index]
    monkeypatch.setattr(
        data_sets, "sequence_listing", lambda scheme: {"kitti": lambda root: ["0000", root.name]}.get(scheme)
    )
    found = sequence_requests(["kitti:/data/set?camera=2", "kitti:/data/set#0007", "synthetic:1", "synthetic:1"])
    assert [(one.dataset, one.spec) for one in found] == [
        ("kitti", "kitti:/data/set#0000?camera=2"),
        ("kitti", "kitti:/data/set#set?camera=2"),
        ("kitti", "kitti:/data/set#0007"),
        ("synthetic", "synthetic:1"),
    ]
    with pytest.raises(ConfigurationError, match="known are"):
        sequence_requests(["carla:town"])
    with pytest.raises(ConfigurationError, match="need data"):
        sequence_requests([])


def metrics_of(cell: Cell) -> SequenceMetrics:
    assert cell.metrics is not None
    return cell.metrics


def pinned_digest() -> str:
    """Whoever edits a source while the test runs would make all cells stale."""
    return "pinned"


def run_in_child(folder: str) -> None:
    """Runs in a process of its own; says when the first cell is there."""
    identity.code_digest = pinned_digest  # type: ignore[assignment]
    run_cells(
        sequence_requests(SEEDS), STRATEGIES, SETTINGS, Path(folder), workers=2, runner=slow_run,
        listener=lambda *_: print("a cell", flush=True),
    )  # fmt: skip
