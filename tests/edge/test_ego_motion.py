"""Models of the vehicle's motion against hand-computed pixels and an independent projection."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.actor_warp import warp_actors
from cable_rpc.edge.ego_motion import (
    EgoStep,
    ego_step,
    ground_plane_homographies,
    planar_motion,
    rotation_homography,
    translation_homography,
)
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.view_warp import MAX_MAGNIFICATION, ViewWarp, warp_frame, warp_mask
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion

CAMERA = CameraIntrinsics(1000.0, 1100.0, 800.0, 450.0)
MOUNT = CameraMount(1.5, 0.03, 1.2)
PAPER = RoiConfig.paper()
ROBUST = RoiConfig()


def translation(shift):
    homography = np.eye(3)
    homography[0, 2] = shift
    return homography


def mapped(homography, x, y):
    u, v, w = homography @ (x, y, 1.0)
    return u / w, v / w


def pixel_of(ground, pose, camera, mount):
    """Pixels of world ground points [N, 2] (east, north) from a pose (east, north, heading left of east)."""
    east, north, heading = pose
    ahead = (ground[:, 0] - east) * np.cos(heading) + (ground[:, 1] - north) * np.sin(heading)
    left = -(ground[:, 0] - east) * np.sin(heading) + (ground[:, 1] - north) * np.cos(heading)
    ahead = ahead - mount.forward_m
    depth = ahead * np.cos(mount.pitch_down_rad) + mount.height_m * np.sin(mount.pitch_down_rad)
    down = mount.height_m * np.cos(mount.pitch_down_rad) - ahead * np.sin(mount.pitch_down_rad)
    return np.column_stack([camera.cx - camera.fx * left / depth, camera.cy + camera.fy * down / depth])


def drive(pose, ego, dt_s, pieces=20_000):
    """Where constant speeds lead, by many small steps (midpoint rule)."""
    east, north, heading = pose
    small = dt_s / pieces
    for _ in range(pieces):
        middle = heading + ego.yaw_rate_radps * small / 2
        east += (ego.speed_mps * np.cos(middle) + ego.lateral_mps * np.sin(middle)) * small
        north += (ego.speed_mps * np.sin(middle) - ego.lateral_mps * np.cos(middle)) * small
        heading += ego.yaw_rate_radps * small
    return east, north, heading


# --- the paper's model --------------------------------------------------------------------------------


def test_homography_formula_does_not_depend_on_frame_rate():
    ego = EgoMotion(speed_mps=10.0, lateral_mps=0.1)
    for dt in (0.05, 0.1, 0.3):
        assert translation_homography(ego, dt, 1266.0, 1e-6) == pytest.approx(translation(-12.66))


def test_driving_left_moves_the_scene_right():
    left = EgoMotion(speed_mps=10.0, lateral_mps=-0.5)
    warp = ViewWarp(translation_homography(left, 0.1, 100.0, 1e-6))
    mask = np.zeros((10, 40), np.bool_)
    mask[4:6, 10:12] = True
    assert np.flatnonzero(warp_mask(mask, warp).any(axis=0)).tolist() == [15, 16]


@pytest.mark.parametrize("known", [(None, 100.0), (EgoMotion(10.0, 1.0), None)])
def test_unknown_ego_or_camera_is_identity(known):
    ego, fx = known
    assert np.array_equal(translation_homography(ego, 0.1, fx, 1e-6), np.eye(3))


def test_paper_blows_up_at_standstill():
    step = ego_step(EgoMotion(0.0, 0.02), CAMERA, None, 0.1, PAPER, 1600)
    assert step.warp.ground[0, 2] == pytest.approx(-2e6)
    assert (step.model, step.clamped) == ("paper", False)
    assert not warp_mask(np.ones((5, 9), np.bool_), step.warp).any()


def test_shift_is_clamped():
    config = RoiConfig(ego_model="paper", max_shift_share=0.05)
    step = ego_step(EgoMotion(10.0, 3.0), CAMERA, None, 0.1, config, 1600)
    assert (step.warp.ground[0, 2], step.clamped) == (-80.0, True)
    step = ego_step(EgoMotion(10.0, 0.3), CAMERA, None, 0.1, config, 1600)
    assert (step.warp.ground[0, 2], step.clamped) == (pytest.approx(-30.0), False)
    assert not step.then(EgoStep()).clamped
    assert EgoStep(clamped=True).then(step).clamped


# --- choice of the model ------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["paper", "identity", "rotation", "ground_plane", "flow"])
def test_nothing_moves_at_standstill(model):
    step = ego_step(EgoMotion(0.1, 0.1, 0.02), CAMERA, MOUNT, 0.1, RoiConfig(ego_model=model), 1600)
    assert step.warp.is_identity
    assert step.model == "identity"
    assert step.yaw_change_deg == pytest.approx(0.1146, abs=1e-4)
    assert step.displacement_m == pytest.approx(0.01414, abs=1e-4)


@pytest.mark.parametrize(
    ("wanted", "known", "used"),
    [
        ("ground_plane", "ego camera mount", "ground_plane"),
        ("ground_plane", "ego camera", "rotation"),
        ("ground_plane", "ego mount", "flow"),
        ("ground_plane", "camera mount", "flow"),
        ("rotation", "ego camera", "rotation"),
        ("rotation", "camera", "flow"),
        ("paper", "ego camera", "paper"),
        ("paper", "ego", "flow"),
        ("identity", "ego camera mount", "identity"),
        ("flow", "", "flow"),
    ],
)
def test_model_falls_back_to_what_can_be_computed(wanted, known, used):
    ego = EgoMotion(5.0, 0.0, 0.1) if "ego" in known else None
    camera = CAMERA if "camera" in known else None
    mount = MOUNT if "mount" in known else None
    step = ego_step(ego, camera, mount, 0.1, RoiConfig(ego_model=wanted), 1600)
    assert step.model == used
    assert (step.displacement_m > 0) == ("ego" in known)
    assert step.warp.is_identity == (used in ("flow", "identity", "paper"))


def test_unusable_mount_or_camera_counts_as_unknown():
    ego = EgoMotion(5.0, 0.0, 0.1)
    assert ego_step(ego, CAMERA, CameraMount(0.0), 0.1, ROBUST, 1600).model == "rotation"
    assert ego_step(ego, CameraIntrinsics(0, 0, 0, 0), MOUNT, 0.1, ROBUST, 1600).model == "flow"


@pytest.mark.parametrize("model", ["paper", "identity", "rotation", "ground_plane"])
def test_step_measures_metres_and_degrees(model):
    ego = EgoMotion(3.0, 4.0, yaw_rate_radps=-np.pi / 18)
    step = ego_step(ego, CAMERA, MOUNT, 0.1, RoiConfig(ego_model=model), 1600)
    assert step.displacement_m == pytest.approx(0.5)
    assert step.yaw_change_deg == pytest.approx(1.0)
    both = step.then(step)
    assert (both.displacement_m, both.yaw_change_deg) == (pytest.approx(1.0), pytest.approx(2.0))


def test_paper_shifts_add_up():
    step = ego_step(EgoMotion(3.0, 4.0), CAMERA, None, 0.1, PAPER, 1600)
    assert step.then(step).warp.ground[0, 2] == pytest.approx(2 * step.warp.ground[0, 2])


# --- rotation and ground plane ------------------------------------------------------------------------


def test_turning_left_moves_the_picture_right():
    level = rotation_homography(CAMERA, 0.0, 0.02)
    # On the optical axis by f tan(psi), elsewhere by the tangent of the sum of angles.
    assert mapped(level, 800, 450) == pytest.approx((800 + 1000 * np.tan(0.02), 450))
    angle = np.arctan(0.5) + 0.02
    assert mapped(level, 1300, 450)[0] == pytest.approx(800 + 1000 * np.tan(angle))
    assert np.array_equal(rotation_homography(CAMERA, 0.03, 0.0), np.eye(3))


def test_horizon_stays_under_any_turn():
    horizon = CAMERA.cy - CAMERA.fy * np.tan(MOUNT.pitch_down_rad)
    turned = rotation_homography(CAMERA, MOUNT.pitch_down_rad, -0.3)
    for x in (0.0, 700.0, 1599.0):
        assert mapped(turned, x, horizon)[1] == pytest.approx(horizon)


def test_ground_point_ahead_comes_down():
    mount = CameraMount(1.5)
    ground, far = ground_plane_homographies(CAMERA, mount, 2.0, 0.0, 0.0)
    # 1.5 m below a level camera, 20 m and then 18 m ahead, 3 m to the right.
    before = (800 + 1000 * 3 / 20, 450 + 1100 * 1.5 / 20)
    assert mapped(ground, *before) == pytest.approx((800 + 1000 * 3 / 18, 450 + 1100 * 1.5 / 18))
    assert np.array_equal(far, np.eye(3))
    still, _ = ground_plane_homographies(CAMERA, mount, 0.0, 0.0, 0.0)
    assert np.array_equal(still, np.eye(3))


def test_camera_ahead_of_the_axle_swings_to_the_left():
    ground, _ = ground_plane_homographies(CAMERA, CameraMount(1.5, 0.0, 2.0), 0.0, 0.0, np.pi / 2)
    # A right angle on the spot: what was 12 m ahead of the axle and 12 m to its left is now 12 m to its right and
    # 12 m ahead, both times 10 m before the camera.
    before = (800 + 1000 * -12 / 10, 450 + 1100 * 1.5 / 10)
    assert mapped(ground, *before) == pytest.approx((800 + 1000 * 12 / 10, 450 + 1100 * 1.5 / 10))


@given(
    speed=st.floats(-5, 35),
    lateral=st.floats(-1, 1),
    yaw_rate=st.floats(-0.8, 0.8),
    dt=st.floats(0.01, 0.3),
    pitch=st.floats(-0.05, 0.2),
    lever=st.floats(-1, 3),
    seed=st.integers(0, 999),
)
@settings(deadline=None, max_examples=40)
def test_ground_points_are_where_projection_puts_them(speed, lateral, yaw_rate, dt, pitch, lever, seed):
    ego, mount = EgoMotion(speed, lateral, yaw_rate), CameraMount(1.5, pitch, lever)
    rng = np.random.default_rng(seed)
    start = (*rng.uniform(-50, 50, 2), rng.uniform(-3, 3))
    end = drive(start, ego, dt, 1000)
    ahead, left = rng.uniform(18, 60, 20), rng.uniform(-8, 8, 20)
    cosine, sine = np.cos(start[2]), np.sin(start[2])
    points = np.column_stack([start[0] + ahead * cosine - left * sine, start[1] + ahead * sine + left * cosine])
    motion = planar_motion(ego, dt)
    ground, _ = ground_plane_homographies(CAMERA, mount, motion.forward_m, motion.right_m, motion.yaw_rad)
    before, after = pixel_of(points, start, CAMERA, mount), pixel_of(points, end, CAMERA, mount)
    moved = np.array([mapped(ground, *pixel) for pixel in before])
    assert np.abs(moved - after).max() < 1e-3


@pytest.mark.parametrize("ego", [EgoMotion(12.0, 0.3, 0.4), EgoMotion(7.0, 0.0, 0.0), EgoMotion(9.0, 0.0, -1e-9)])
def test_short_steps_compose_to_one_long(ego):
    short = ego_step(ego, CAMERA, MOUNT, 0.05, ROBUST, 1600)
    long = ego_step(ego, CAMERA, MOUNT, 0.2, ROBUST, 1600)
    gap = short.then(short).then(short).then(short)
    assert gap.warp.ground == pytest.approx(long.warp.ground, rel=1e-9, abs=1e-9)
    assert gap.warp.far == pytest.approx(long.warp.far, rel=1e-9, abs=1e-9)
    assert gap.warp.horizon_row == long.warp.horizon_row
    assert (gap.displacement_m, gap.yaw_change_deg) == pytest.approx((long.displacement_m, long.yaw_change_deg))


@pytest.mark.parametrize("seed", [1, 3])
def test_rendered_road_moves_as_predicted(seed):
    source = SyntheticSource(SyntheticConfig(seed=seed, width=640, height=360, frame_count=40))
    camera, world = source.camera, source.world
    mount = CameraMount(camera.mount_height_m, camera.pitch_down_rad)
    points = np.column_stack([np.repeat([8.0, 15, 40], 3), np.tile([-3.0, 0, 3], 3), np.zeros(9)])
    for index in (5, 20, 35):
        begin, _ = world.ego((index - 1) / 10)
        end, _ = world.ego(index / 10)
        # Ego-motion is the middle's: the world brakes and steers within a step, the model holds both.
        _, ego = world.ego((index - 0.5) / 10)
        before, _ = camera.project(points)
        cosine, sine = np.cos(begin.heading), np.sin(begin.heading)
        ahead, right = points[:, 0], points[:, 1]
        seen_from_world = np.column_stack(
            [begin.x + cosine * ahead + sine * right, begin.y + sine * ahead - cosine * right]
        )
        local = end.to_local(seen_from_world)
        after, _ = camera.project(np.column_stack([local, np.zeros(9)]))
        step = ego_step(ego, camera.intrinsics, mount, 0.1, ROBUST, 640)
        moved = np.array([mapped(step.warp.ground, *pixel) for pixel in before])
        # What is left comes from the motion's change within the step.
        assert np.abs(moved - after).max() < 0.35


@given(
    speed=st.floats(allow_nan=False, allow_infinity=False),
    lateral=st.floats(allow_nan=False, allow_infinity=False),
    yaw_rate=st.floats(allow_nan=False, allow_infinity=False),
    dt=st.sampled_from([0.0, 1e-9, 0.1, 5.0, 1e9]),
    height=st.sampled_from([1e-300, 0.01, 1.5, 1e300]),
    model=st.sampled_from(["paper", "identity", "rotation", "ground_plane"]),
    seed=st.integers(0, 99),
)
@settings(deadline=None, max_examples=300)
def test_absurd_motion_never_raises_nor_floods_the_frame(speed, lateral, yaw_rate, dt, height, model, seed):
    ego = EgoMotion(speed, lateral, yaw_rate)
    camera = CameraIntrinsics(60.0, 60.0, 39.5, 22.0)
    step = ego_step(ego, camera, CameraMount(height, 0.03, 1.0), dt, RoiConfig(ego_model=model), 80)
    check_bounded(step.then(step).warp, seed)
    check_bounded(step.warp.scaled(0.25), seed)


@given(
    speed=st.floats(-60, 60),
    yaw_rate=st.floats(-20, 20),
    dt=st.floats(0, 1),
    height=st.floats(0.2, 3),
    seed=st.integers(0, 99),
)
@settings(deadline=None, max_examples=300)
def test_wild_motion_magnifies_within_bounds(speed, yaw_rate, dt, height, seed):
    camera = CameraIntrinsics(60.0, 60.0, 39.5, 22.0)
    step = ego_step(EgoMotion(speed, 0.0, yaw_rate), camera, CameraMount(height, 0.03, 1.0), dt, ROBUST, 80)
    check_bounded(step.warp, seed)


def check_bounded(warp, seed):
    mask = np.zeros((45, 80), np.bool_)
    y, x = np.random.default_rng(seed).integers(0, (40, 74))
    mask[y : y + 5, x : x + 6] = True
    # A plane's image grows in area by the cube of the ratio of depths; half a pixel around for rounding.
    limit = MAX_MAGNIFICATION**3 * 7 * 8
    assert np.count_nonzero(warp_mask(mask, warp)) <= limit
    assert np.count_nonzero(warp_actors(mask, warp)) <= MAX_MAGNIFICATION**2 * 7 * 8
    grey, valid = warp_frame(mask.view(np.uint8), warp)
    assert grey.shape == mask.shape
    assert valid is None or valid.shape == mask.shape


def test_overflowing_steps_compose():
    step = EgoStep(ViewWarp(translation(1.7e308))).then(EgoStep(ViewWarp(translation(1.7e308))))
    assert not warp_mask(np.ones((4, 4), np.bool_), step.warp).any()


def test_a_turn_shifts_the_centre_by_the_focal_length_times_its_tangent():
    camera = CameraIntrinsics(800.0, 800.0, 479.5, 269.5)
    warp = ViewWarp(rotation_homography(camera, 0.0, math.radians(2.0)))
    assert warp.centre_shift_px((540, 960)) == pytest.approx(800 * math.tan(math.radians(2.0)))
    assert ViewWarp().centre_shift_px((540, 960)) == 0
    assert math.isnan(ViewWarp(rotation_homography(camera, 0.0, math.pi)).centre_shift_px((540, 960)))
