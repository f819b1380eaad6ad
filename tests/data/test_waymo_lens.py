"""Undistortion against the lens equation, written out."""

from __future__ import annotations

import numpy as np
import pytest

from cable_rpc.data.waymo.camera import Calibration
from cable_rpc.data.waymo.lens import Lens
from cable_rpc.types import CameraIntrinsics, GroundTruth

WIDTH, HEIGHT = 240, 160
FX, FY, CX, CY = 250.0, 255.0, 118.0, 83.0
K1, K2, P1, P2, K3 = LENS = (-0.35, 0.12, 0.003, -0.002, 0.01)


def bent(x, y):
    """Where the lens puts pixel (x, y) of a pinhole camera: Brown's model in OpenCV's order."""
    u, v = (x - CX) / FX, (y - CY) / FY
    r2 = u * u + v * v
    radial = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
    u_bent = u * radial + 2 * P1 * u * v + P2 * (r2 + 2 * u * u)
    v_bent = v * radial + P1 * (r2 + 2 * v * v) + 2 * P2 * u * v
    return u_bent * FX + CX, v_bent * FY + CY


def straightened(x, y):
    """The inverse, by fixed-point iteration in pixels."""
    guess_x, guess_y = np.array(x, float), np.array(y, float)
    for _ in range(60):
        there_x, there_y = bent(guess_x, guess_y)
        guess_x, guess_y = guess_x + x - there_x, guess_y + y - there_y
    return guess_x, guess_y


def scene(x, y):
    return 128 + 60 * np.sin(x / 9.0) + 50 * np.cos(y / 7.0)


@pytest.fixture
def lens() -> Lens:
    return Lens(Calibration(CameraIntrinsics(FX, FY, CX, CY), LENS, np.eye(4), (WIDTH, HEIGHT)))


def test_image_is_that_of_the_pinhole_camera(lens) -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    taken_x, taken_y = straightened(x, y)
    taken = np.repeat(scene(taken_x, taken_y)[..., None], 3, axis=2).round().astype(np.uint8)
    # The picture as taken holds the scene where the lens puts it; undone, it must stand where it is.
    difference = np.abs(lens.undistort(taken)[..., 0] - scene(x, y))
    margin = 12
    assert difference[margin:-margin, margin:-margin].max() < 3
    assert np.abs(taken[..., 0] - scene(x, y)).max() > 40


def test_boxes_bound_the_straightened_outline(lens) -> None:
    boxes = np.array([[5, 4, 60, 40], [100, 60, 140, 100], [200, 0, 240, 160], [0, 0, 12, 8]], np.float32)
    truth = GroundTruth(
        boxes, np.array([2, 0, 1, 2], np.int32), np.array([1, 2, 3, 4], np.int32), np.ones(4, np.float32)
    )
    moved = lens.undistort_truth(truth)
    along = np.linspace(0, 1, 201)
    rows = []
    for x_min, y_min, x_max, y_max in boxes:
        x, y = x_min + along * (x_max - x_min), y_min + along * (y_max - y_min)
        outline_x = np.concatenate([x, x, np.full_like(y, x_min), np.full_like(y, x_max)])
        outline_y = np.concatenate([np.full_like(x, y_min), np.full_like(x, y_max), y, y])
        out_x, out_y = straightened(outline_x, outline_y)
        rows.append((out_x.min(), out_y.min(), out_x.max(), out_y.max()))
    whole = np.array(rows)
    seen = np.clip(whole, 0, [WIDTH, HEIGHT, WIDTH, HEIGHT])
    share = np.prod(seen[:, 2:] - seen[:, :2], axis=1) / np.prod(whole[:, 2:] - whole[:, :2], axis=1)
    kept = share > 0
    assert moved.boxes_xyxy == pytest.approx(seen[kept], abs=0.3)
    assert moved.visibility == pytest.approx(share[kept], abs=0.02)
    assert share.min() < 0.9 < share.max()
    assert moved.track_ids.tolist() == truth.track_ids[kept].tolist()


def test_no_boxes_stay_no_boxes(lens) -> None:
    none = GroundTruth(np.zeros((0, 4), np.float32), *(np.zeros(0, kind) for kind in (np.int32, np.int32, np.float32)))
    assert len(lens.undistort_truth(none)) == 0
