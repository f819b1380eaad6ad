"""Waymo: both versions hold the same drive, real records load, damage is found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.rendered_drive import RenderedDrive
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.synthetic import SyntheticConfig
from cable_rpc.data.waymo import open_waymo, sequences, write_waymo, write_waymo_v1
from cable_rpc.data.waymo.crc32c import crc32c
from cable_rpc.errors import SourceError

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "formats" / "waymo-v1"
CLASS_READ = {0: 0, 1: 1, 2: 2, 3: 1, 5: 2, 7: 2}


@pytest.fixture(scope="module")
def drive():
    return list(RenderedDrive(SyntheticConfig(seed=3, width=320, height=192, frame_count=4, route="turns")))


@pytest.mark.parametrize("write", [write_waymo, write_waymo_v1])
def test_written_drive_is_read_back(tmp_path, drive, write):
    if write is write_waymo:
        pytest.importorskip("pyarrow")
    write(tmp_path, {"one": drive})
    assert sequences(tmp_path) == ["one"]
    frames = list(open_waymo(str(tmp_path), SourceOptions()))
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    for read, written in zip(frames, (row.frame for row in drive), strict=True):
        assert read.ego.speed_mps == pytest.approx(written.ego.speed_mps, abs=1e-4)
        assert read.ego.lateral_mps == pytest.approx(written.ego.lateral_mps, abs=1e-4)
        assert read.ego.yaw_rate_radps == pytest.approx(written.ego.yaw_rate_radps, abs=1e-9)
        assert read.mount.height_m == pytest.approx(written.mount.height_m)
        assert read.mount.pitch_down_rad == pytest.approx(written.mount.pitch_down_rad)
        assert read.truth.class_ids.tolist() == [CLASS_READ[number] for number in written.truth.class_ids.tolist()]
        assert np.allclose(read.truth.boxes_xyxy, written.truth.boxes_xyxy, atol=1e-3)
        assert np.abs(read.image.astype(int) - written.image).mean() < 5


def test_damaged_record_is_found_and_can_be_skipped(tmp_path, drive):
    write_waymo_v1(tmp_path, {"one": drive})
    path = next(tmp_path.glob("*.tfrecord"))
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    with pytest.raises(SourceError, match="record 4: the checksum"):
        list(open_waymo(str(tmp_path), SourceOptions()))
    bad = BadFrames(skip=True)
    assert len(list(open_waymo(str(tmp_path), SourceOptions(bad_frames=bad)))) == 3
    assert len(bad.skipped) == 1


def test_checksum_of_rfc_3720():
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(bytes(32)) == 0x8A9136AA


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real records aren't here")
def test_real_record():
    (frame,) = open_waymo(f"{SHARED}#pvps_data_one_frame", SourceOptions())
    assert frame.image.shape == (1280, 1920, 3)
    assert len(frame.truth) == 13
    assert frame.truth.boxes_xyxy[0] == pytest.approx(
        [355.6 - 115.6, 936.0 - 232.1, 355.6 + 115.6, 936.0 + 232.1], abs=0.2
    )
