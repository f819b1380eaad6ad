"""Waymo: a rendered drive written in either version is read back as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cable_rpc.data.rendered_drive import DriveFrame, RenderedDrive
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.synthetic import SyntheticConfig
from cable_rpc.data.waymo import open_waymo, sequences, write_waymo, write_waymo_v1
from cable_rpc.data.waymo.camera import CameraName
from cable_rpc.types import GroundTruth


@pytest.fixture(scope="module")
def drive() -> list[DriveFrame]:
    return list(RenderedDrive(SyntheticConfig(seed=3, width=320, height=192, frame_count=4, route="turns")))


@pytest.fixture(params=[write_waymo, write_waymo_v1], ids=["tables", "records"])
def write(request):
    if request.param is write_waymo:
        pytest.importorskip("pyarrow", reason="Parquet tables need pyarrow")
    return request.param


def opened(root: Path, query: str = ""):
    return open_waymo(f"{root}{query}", SourceOptions())


def changed(row: DriveFrame, **parts) -> DriveFrame:
    return replace(row, frame=replace(row.frame, **parts))


def test_written_drives_are_read_back(tmp_path, drive, write) -> None:
    write(tmp_path, {"one": drive, "two": drive[:2]})
    assert sequences(tmp_path) == ["one", "two"]
    source = opened(tmp_path, "#one")
    assert (source.size_wh, source.frame_count) == ((320, 192), 4)
    frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    for read, written in zip(frames, (row.frame for row in drive), strict=True):
        assert read.ego.speed_mps == pytest.approx(written.ego.speed_mps, abs=1e-4)
        assert read.ego.lateral_mps == pytest.approx(written.ego.lateral_mps, abs=1e-4)
        assert read.ego.yaw_rate_radps == pytest.approx(written.ego.yaw_rate_radps, abs=1e-9)
        assert read.intrinsics == written.intrinsics
        assert read.mount.height_m == pytest.approx(written.mount.height_m)
        assert read.mount.pitch_down_rad == pytest.approx(written.mount.pitch_down_rad)
        since_start_ns = read.capture_time_ns - frames[0].capture_time_ns
        assert abs(since_start_ns - (written.capture_time_ns - drive[0].frame.capture_time_ns)) <= 1000
        assert np.allclose(read.truth.boxes_xyxy, written.truth.boxes_xyxy, atol=1e-3)
        assert np.abs(read.image.astype(int) - written.image).mean() < 5
    tracks = {
        (before, after)
        for read, row in zip(frames, drive, strict=True)
        for before, after in zip(row.frame.truth.track_ids.tolist(), read.truth.track_ids.tolist(), strict=True)
    }
    assert len(tracks) == len(dict(tracks)) == len({after for _, after in tracks}) > 0


def test_classes_that_waymo_tells_apart(tmp_path, drive, write) -> None:
    """Its labelling specifications: motorcycles with their riders are vehicles, a bicycle's rider is a cyclist."""
    class_ids = np.array([0, 1, 2, 3, 5, 7], np.int32)
    boxes = np.tile(np.array([[10, 10, 30, 40]], np.float32), (6, 1))
    visibility = np.array([1.0, 1.0, 0.3, 1.0, 1.0, 1.0], np.float32)
    truth = GroundTruth(boxes, class_ids, np.arange(6, dtype=np.int32), visibility)
    write(tmp_path, {"one": [changed(drive[0], truth=truth)]})
    (read,) = opened(tmp_path)
    assert read.truth.class_ids.tolist() == [0, 1, 2, 2, 2, 2]
    assert read.truth.visibility.tolist() == [1.0, 1.0, 0.5, 1.0, 1.0, 1.0]


def test_another_camera_without_labels(tmp_path, drive, write) -> None:
    write(tmp_path, {"one": [changed(row, truth=None) for row in drive[:2]]}, camera=CameraName.FRONT_LEFT)
    frames = list(opened(tmp_path, "?camera=FRONT_LEFT"))
    assert [frame.truth for frame in frames] == [None, None]


@pytest.mark.parametrize("lacking", ["ego", "intrinsics"])
def test_what_a_writer_must_know(tmp_path, drive, write, lacking) -> None:
    with pytest.raises(ValueError, match="frame 0 has no"):
        write(tmp_path, {"one": [changed(drive[0], **{lacking: None})]})
    with pytest.raises(ValueError, match="drive 'none' has no frame"):
        write(tmp_path, {"none": []})
