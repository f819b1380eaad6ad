"""The rendered world: ego-motion and camera geometry against independent formulas."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
import pytest

from cable_rpc.data.synthetic import Camera, SyntheticConfig, SyntheticSource


@lru_cache(maxsize=32)
def source(seed: int, **changes: float) -> SyntheticSource:
    settings = {"width": 320, "height": 180, "frame_count": 120, "noise_strength": 0.0, **changes}
    return SyntheticSource(SyntheticConfig(seed=seed, **settings))  # type: ignore[arg-type]


def test_camera_looks_forward_with_right_to_the_right() -> None:
    camera = Camera.with_field_of_view(641, 481, 90.0, 1.5, 0.0)
    pixels, depth = camera.project(np.array([[10.0, 0.0, 1.5], [10.0, 10.0, 1.5], [10.0, 0.0, 0.0], [-5.0, 0.0, 1.5]]))
    assert pixels[0] == pytest.approx([320.0, 240.0])
    assert pixels[1, 0] - 320.0 == pytest.approx(641 / 2)
    assert pixels[2, 1] - 240.0 == pytest.approx(641 / 2 * 1.5 / 10.0)
    assert depth.tolist() == pytest.approx([10.0, 10.0, 10.0, -5.0])
    assert camera.horizon_row == pytest.approx(240.0)


def test_ground_homography_equals_projection() -> None:
    camera = Camera.with_field_of_view(960, 540, 68.0, 1.45, 0.04)
    ground = np.random.default_rng(0).uniform([2.0, -8.0], [60.0, 8.0], (50, 2))
    homogeneous = np.column_stack([ground, np.ones(50)]) @ camera.ground_to_image.T
    pixels, _ = camera.project(np.column_stack([ground, np.zeros(50)]))
    assert homogeneous[:, :2] / homogeneous[:, 2:] == pytest.approx(pixels)


def test_ground_points_move_by_the_plane_homography() -> None:
    """p' ~ K (R - t n^T / h) K^-1 p with the plane n.X = h of the first camera."""
    world = source(0)
    camera = world.camera
    one, two = (world.world.ego(time)[0] for time in (1.0, 1.1))
    rotation_one, rotation_two = (camera.vehicle_to_camera @ flipped(-pose.heading) for pose in (one, two))
    rotation = rotation_two @ rotation_one.T
    travel = np.array([two.x - one.x, -(two.y - one.y), 0.0])
    translation = rotation_two @ travel
    normal = rotation_one @ np.array([0.0, 0.0, -1.0])
    homography = (
        camera.matrix
        @ (rotation - np.outer(translation, normal) / camera.mount_height_m)
        @ np.linalg.inv(camera.matrix)
    )
    ground = np.random.default_rng(1).uniform([5.0, -5.0], [30.0, 5.0], (40, 2))
    fixed = one.to_world(np.column_stack([ground, np.zeros(40)]))
    before, _ = camera.project(one.to_local(fixed))
    after, _ = camera.project(two.to_local(fixed))
    moved = np.column_stack([before, np.ones(40)]) @ homography.T
    assert moved[:, :2] / moved[:, 2:] == pytest.approx(after, abs=1e-6)


def flipped(heading: float) -> np.ndarray:
    """World axes with y to the right, turned by a clockwise heading, to vehicle axes."""
    cosine, sine = math.cos(heading), math.sin(heading)
    return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def test_rendered_road_follows_the_homography() -> None:
    """The picture itself, not only the formula: patches of road move as predicted, to a small part of a pixel.

    One frame's road warped onto the next by the homography differs from it in grey value, since grain is
    filtered to the pixel's footprint and gets finer on approach. It does not differ in place: phase
    correlation finds no common offset (below 0.1 pixels over all patches of all clips) and no patch that is
    typically displaced by 0.3 pixels, so textures have the right origin at every level.
    """
    offsets = np.vstack([road_displacements(seed) for seed in (2, 3, 5)])
    assert len(offsets) >= 40
    assert np.abs(np.median(offsets, axis=0)).max() < 0.1
    assert np.median(np.hypot(*offsets.T)) < 0.3
    assert np.quantile(np.hypot(*offsets.T), 0.9) < 0.4


def road_displacements(seed: int) -> np.ndarray:
    """Rendered minus predicted motion [N, 2] in pixels of road patches between the two frames of fastest travel."""
    clip = source(seed, width=640, height=360, blur_sigma=0.0, vignette=0.0)
    camera = clip.camera
    index = max(range(20, 100), key=lambda i: clip.world.ego(i / 10)[1].speed_mps)
    frames = [clip.frame(index), clip.frame(index + 1)]
    poses = [clip.world.ego(i / 10)[0] for i in (index, index + 1)]
    corners = np.array([[6.0, -3.0, 0.0], [6.0, 3.0, 0.0], [16.0, 3.0, 0.0], [16.0, -3.0, 0.0]])
    world = poses[0].to_world(corners)
    before, after = (camera.project(pose.to_local(world))[0].astype(np.float32) for pose in poses)
    matrix = cv2.getPerspectiveTransform(before, after)
    grey = [cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY).astype(np.float32) for frame in frames]
    warped = cv2.warpPerspective(grey[0], matrix, (640, 360), flags=cv2.INTER_CUBIC)
    known = cv2.warpPerspective(np.ones((360, 640), np.uint8), matrix, (640, 360)) > 0
    for frame in frames:
        assert frame.truth is not None
        assert frame.truth.instance_mask is not None
    free = known & (frames[1].truth.instance_mask == 0)  # type: ignore[union-attr]
    side, found = 48, []
    window = cv2.createHanningWindow((side, side), cv2.CV_32F)
    for forward in (5.0, 6.0, 7.0, 8.0, 10.0, 12.0):
        for right in (-1.5, -0.8, 0.0, 0.8, 1.5):
            middle = camera.project(np.array([[forward, right, 0.0]]))[0][0]
            x, y = (int(value) - side // 2 for value in middle)
            part = (slice(y, y + side), slice(x, x + side))
            if 0 <= x <= 640 - side and 0 <= y <= 360 - side and free[part].all():
                found.append(cv2.phaseCorrelate(warped[part], grey[1][part], window)[0])
    return np.array(found).reshape(-1, 2)


def test_pose_integrates_speed_and_yaw_rate() -> None:
    for seed in (0, 2, 5):
        world = source(seed).world
        step = 0.01
        x, y, heading = world.ego(0.0)[0].x, world.ego(0.0)[0].y, world.ego(0.0)[0].heading
        for index in range(1000):
            motion = world.ego((index + 0.5) * step)[1]
            assert motion.lateral_mps == 0.0
            middle = heading + motion.yaw_rate_radps * step / 2
            x += motion.speed_mps * math.cos(middle) * step
            y += motion.speed_mps * math.sin(middle) * step
            heading += motion.yaw_rate_radps * step
        reached = world.ego(10.0)[0]
        assert (reached.x, reached.y) == pytest.approx((x, y), abs=0.25)
        assert reached.heading == pytest.approx(heading, abs=0.01)


def test_left_turn_moves_far_scenery_to_the_right() -> None:
    checked = 0
    for seed in range(8):
        if checked >= 3:
            break
        clip = source(seed)
        rates = [clip.world.ego(i / 10)[1].yaw_rate_radps for i in range(119)]
        index = int(np.argmax(np.abs(rates)))
        if abs(rates[index]) < 0.06:
            continue
        here, there = (clip.world.ego(i / 10)[0] for i in (index, index + 1))
        far = here.to_world(np.array([[5000.0, 0.0, 20.0]]))
        shift = clip.camera.project(there.to_local(far))[0][0, 0] - clip.camera.intrinsics.cx
        assert math.copysign(1.0, shift) == math.copysign(1.0, rates[index])
        strips = []
        for frame in (clip.frame(index), clip.frame(index + 1)):
            rows = frame.image[: int(clip.camera.horizon_row) - 30]
            strips.append(cv2.cvtColor(rows, cv2.COLOR_BGR2GRAY).astype(np.float32))
        moved = cv2.phaseCorrelate(*strips, cv2.createHanningWindow(strips[0].shape[::-1], cv2.CV_32F))[0][0]
        if abs(moved) > 0.5:
            assert math.copysign(1.0, moved) == math.copysign(1.0, rates[index])
            checked += 1
    assert checked >= 2


def test_there_are_stops_turns_and_speed_changes() -> None:
    speeds, rates = [], []
    for seed in range(10):
        world = source(seed).world
        motions = [world.ego(i / 10)[1] for i in range(120)]
        speeds.append([motion.speed_mps for motion in motions])
        rates.append([motion.yaw_rate_radps for motion in motions])
    lowest = np.min(speeds, axis=1)
    assert (lowest < 0.1).sum() >= 1
    assert (lowest > 2.0).sum() >= 1
    assert (np.max(rates, axis=1) > 0.04).any()
    assert (np.min(rates, axis=1) < -0.04).any()
    assert np.min(speeds) >= 0.0
    assert np.abs(np.diff(speeds, axis=1)).max() < 1.0
