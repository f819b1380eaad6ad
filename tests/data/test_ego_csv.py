"""Ego-motion logs: columns, interpolation, signs and errors that say where."""

from __future__ import annotations

from pathlib import Path

import pytest

from cable_rpc.data.ego_csv import read_ego_csv
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import EgoMotion

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def write(folder, text):
    path = folder / "ego.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_by_frame(tmp_path):
    log = read_ego_csv(write(tmp_path, "frame,speed_mps,yaw_rate_radps\n36,12.5,-0.02\n38,12.0,0.03\n"))
    assert log.at(36, 0.0) == EgoMotion(12.5, 0.0, -0.02)
    assert log.at(38, 99.0) == EgoMotion(12.0, 0.0, 0.03)
    assert log.at(37, 0.1) is None
    assert log.at(39, 0.1) is None


def test_by_time_is_interpolated_and_not_extended(tmp_path):
    text = "yaw_rate_radps, lateral_mps, time_s, speed_mps, note\n0,1,0.5,10,a\n0.2,-1,1.5,20,b\n"
    log = read_ego_csv(write(tmp_path, text))
    middle = log.at(0, 0.75)
    assert middle is not None
    assert middle.speed_mps == pytest.approx(12.5)
    assert middle.lateral_mps == pytest.approx(0.5)
    assert middle.yaw_rate_radps == pytest.approx(0.05)
    assert log.at(0, 1.5) == EgoMotion(20.0, -1.0, 0.2)
    assert log.at(0, 0.49) is None
    assert log.at(0, 1.51) is None


def test_byte_order_mark_and_blank_lines(tmp_path):
    path = write(tmp_path, "\ufeffframe,speed_mps,yaw_rate_radps\r\n\r\n0,1,0\r\n\r\n1,2,0\r\n")
    assert read_ego_csv(path).at(1, 0.0) == EgoMotion(2.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame,speed_mps,yaw_rate_radps\n0,1,0\n1,fast,0\n", ["line 3", "column speed_mps", "'fast'"]),
        ("frame,speed_mps,yaw_rate_radps\n0,1,nan\n", ["line 2", "column yaw_rate_radps"]),
        ("frame,speed_mps,yaw_rate_radps\n0,1\n", ["line 2", "2 values under 3 columns"]),
        ("frame,speed_mps,yaw_rate_radps\n5,1,0\n5,1,0\n", ["line 3", "column frame", "of line 2"]),
        ("frame,speed_kmh\n0,1\n", ["line 1", "speed_mps, yaw_rate_radps", "found frame, speed_kmh"]),
        ("speed_mps,yaw_rate_radps\n1,0\n", ["line 1", "time_s or frame"]),
        ("", ["line 1", "found nothing"]),
    ],
)
def test_errors_name_file_line_and_column(tmp_path, text, words):
    with pytest.raises(ConfigurationError) as caught:
        read_ego_csv(write(tmp_path, text))
    for word in ["ego.csv", *words]:
        assert word in str(caught.value)


def test_no_rows(tmp_path):
    with pytest.raises(SourceError, match="no rows"):
        read_ego_csv(write(tmp_path, "frame,speed_mps,yaw_rate_radps\n"))


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(SourceError, match=r"nowhere\.csv"):
        read_ego_csv(tmp_path / "nowhere.csv")
    path = tmp_path / "binary.csv"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(SourceError, match="CSV"):
        read_ego_csv(path)


@pytest.mark.parametrize(
    ("name", "first", "speed"),
    [
        ("kitti-tracking-0002/ego/ego_motion_from_pose.csv", 36, 12.5350),
        ("kitti-odometry-gray/ego_motion_from_pose.csv", 0, 11.9941),
    ],
)
def test_real_logs(name, first, speed):
    path = SHARED / name
    if not path.is_file():
        pytest.skip(f"shared data set {name} is not here")
    log = read_ego_csv(path)
    assert log.key == "frame"
    motion = log.at(first, 0.0)
    assert motion is not None
    assert motion.speed_mps == pytest.approx(speed)
