"""Cuboids: corners by hand, projection against densely sampled surfaces and OpenCV."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from cable_rpc.data.cuboids import NEAR_PLANE_M, Cuboid, cuboid_corners, project_corners
from cable_rpc.data.poses import inverse_rigid, rigid, rotation_from_quaternion
from cable_rpc.types import CameraIntrinsics

CAMERA = CameraIntrinsics(500.0, 480.0, 310.0, 190.0)
SIZE_WH = (640, 360)
VEHICLE_TO_OPTICAL = rigid(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), (0.0, 1.5, 0.0))
"""A level camera 1.5 m above the origin of a vehicle with x forward, y left, z up."""


def surface(cuboid: Cuboid, steps: int = 41) -> np.ndarray:
    """Points [M, 3] all over the surface, by a rotation matrix written out."""
    grid = np.linspace(-0.5, 0.5, steps)
    u, v = (part.ravel() for part in np.meshgrid(grid, grid))
    faces = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            face = np.empty((len(u), 3))
            face[:, axis] = side
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = u, v
            faces.append(face)
    local = np.vstack(faces) * cuboid.size_lwh_m
    c, s = math.cos(cuboid.yaw_rad), math.sin(cuboid.yaw_rad)
    x, y, z = cuboid.centre_m
    return np.column_stack(
        [c * local[:, 0] - s * local[:, 1] + x, s * local[:, 0] + c * local[:, 1] + y, local[:, 2] + z]
    )


def test_corners_of_a_turned_box() -> None:
    box = Cuboid((10.0, 2.0, 1.0), (4.0, 2.0, 1.0), math.pi / 2, 2, 1)
    corners = cuboid_corners([box])
    assert corners.shape == (1, 8, 3)
    # Its front looks to the left (+y); its left side then lies towards -x.
    assert corners[0, 0] == pytest.approx([9.0, 4.0, 1.5])
    assert corners[0, 3] == pytest.approx([11.0, 4.0, 0.5])
    assert corners[0, 7] == pytest.approx([11.0, 0.0, 0.5])
    assert cuboid_corners([]).shape == (0, 8, 3)


def test_a_box_straight_ahead_by_hand() -> None:
    """Rear face 10 m away, 2 m wide and 1 m high, bottom on the road 1.5 m below the camera."""
    box = Cuboid((12.0, 0.0, 0.5), (4.0, 2.0, 1.0), 0.0, 2, 1)
    result = project_corners(cuboid_corners([box]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH)
    top = 190.0 + 480.0 * 0.5 / 14.0
    assert result.boxes_xyxy[0] == pytest.approx([310 - 50, top, 310 + 50, 190 + 480 * 0.15])
    assert result.inside_share[0] == pytest.approx(1.0)


cuboids = st.builds(
    Cuboid,
    st.tuples(st.floats(-4, 40), st.floats(-12, 12), st.floats(-1, 4)),
    st.tuples(st.floats(0.3, 12), st.floats(0.3, 3), st.floats(0.3, 4)),
    st.floats(-math.pi, math.pi),
    st.just(2),
    st.just(1),
)


@settings(max_examples=150, deadline=None)
@given(cuboids)
def test_box_bounds_the_surface_seen(cuboid: Cuboid) -> None:
    """All sampled surface points in view lie in the box, and the box is no larger than samples can show."""
    result = project_corners(cuboid_corners([cuboid]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH)
    points = surface(cuboid) @ VEHICLE_TO_OPTICAL[:3, :3].T + VEHICLE_TO_OPTICAL[:3, 3]
    points = points[points[:, 2] >= NEAR_PLANE_M]
    pixels = points[:, :2] / points[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    seen = pixels[((pixels >= 0) & (pixels <= SIZE_WH)).all(axis=1)]
    box = result.boxes_xyxy[0]
    assert (box >= 0).all()
    assert (box <= [*SIZE_WH, *SIZE_WH]).all()
    if not len(seen):
        return
    tolerance = 0.02 + 1e-4 * float(np.abs(pixels).max())
    assert (seen.min(axis=0) >= box[:2] - tolerance).all()
    assert (seen.max(axis=0) <= box[2:] + tolerance).all()
    if points[:, 2].min() > 3.0:
        spacing = max(cuboid.size_lwh_m) / 40 * 500 / points[:, 2].min() * 1.5
        assert (seen.min(axis=0) <= box[:2] + spacing).all()
        assert (seen.max(axis=0) >= box[2:] - spacing).all()
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        common = np.minimum(high, SIZE_WH) - np.maximum(low, 0)
        share = np.prod(np.maximum(common, 0)) / np.prod(high - low)
        assert result.inside_share[0] == pytest.approx(share, abs=0.01)


def test_nothing_behind_the_camera_and_nothing_mirrored() -> None:
    behind = Cuboid((-8.0, 3.0, 1.0), (4.0, 2.0, 1.5), 0.3, 2, 1)
    beside = Cuboid((0.0, 3.0, 0.8), (5.0, 1.8, 1.5), 0.0, 2, 2)
    result = project_corners(cuboid_corners([behind, beside]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH)
    assert result.boxes_xyxy[0].tolist() == [0, 0, 0, 0]
    assert result.inside_share[0] == 0.0
    # A car to the left that reaches 2.5 m ahead may only show up in the left part of the image.
    assert result.boxes_xyxy[1, 2] <= 310.0
    aside = Cuboid((10.0, 30.0, 1.0), (4.0, 2.0, 1.5), 0.0, 2, 1)
    result = project_corners(cuboid_corners([aside]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH)
    assert result.boxes_xyxy[0].tolist() == [0, 0, 0, 0]
    assert result.inside_share[0] == 0.0


def test_a_long_box_is_cut_before_it_is_bounded() -> None:
    """A truck that leaves the image on the left is bounded by what is inside, not by its near end outside."""
    truck = Cuboid((9.0, 5.0, 1.7), (14.0, 2.5, 3.4), 0.0, 7, 1)
    result = project_corners(cuboid_corners([truck]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH)
    # At the left border its right side (y = 3.75) is 3.75 * 500 / 310 m ahead.
    depth = 3.75 * 500 / 310
    assert result.boxes_xyxy[0, 0] == 0.0
    assert result.boxes_xyxy[0, 3] == pytest.approx(min(190 + 480 * 1.5 / depth, 360), abs=0.01)
    assert result.inside_share[0] < 0.5


def test_distortion_agrees_with_opencv() -> None:
    """Boxes under a strong lens against the surface's points projected by OpenCV."""
    lens = np.array([-0.32, 0.11, 0.0008, -0.0012, -0.015])

    def distort(rays: np.ndarray) -> np.ndarray:
        x, y = rays.T
        r2 = x * x + y * y
        k1, k2, p1, p2, k3 = lens
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.column_stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        )

    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]])
    random = np.random.default_rng(4)
    compared = 0
    for _ in range(60):
        box = Cuboid(
            (random.uniform(6, 25), random.uniform(-12, 12), 0.9),
            (random.uniform(3, 9), 1.8, 1.6),
            random.uniform(-3, 3),
            2,
            1,
        )
        result = project_corners(cuboid_corners([box]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH, distort)
        points = surface(box) @ VEHICLE_TO_OPTICAL[:3, :3].T + VEHICLE_TO_OPTICAL[:3, 3]
        # Beyond this angle the model folds back; nothing out there is in the image.
        points = points[(points[:, 2] > 0.5) & (np.abs(points[:, 0]) < 1.1 * points[:, 2])]
        if not len(points):
            continue
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]
        seen = pixels[((pixels >= 0) & (pixels <= SIZE_WH)).all(axis=1)]
        if len(seen) > 20:
            assert result.boxes_xyxy[0] == pytest.approx([*seen.min(axis=0), *seen.max(axis=0)], abs=3.0)
            assert result.inside_share[0] > 0
            compared += 1
    assert compared > 30
    far = Cuboid((2.0, 9.0, 1.0), (4.0, 2.0, 1.5), 0.0, 2, 1)
    assert not project_corners(cuboid_corners([far]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH, distort).boxes_xyxy.any()


def test_no_cuboids() -> None:
    result = project_corners(cuboid_corners([]), VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH)
    assert result.boxes_xyxy.shape == (0, 4)
    assert result.boxes_xyxy.dtype == np.float32
    assert result.inside_share.shape == (0,)


def test_the_frame_does_not_matter() -> None:
    """The same box told in world axes gives the same pixels."""
    box = Cuboid((14.0, -2.0, 0.8), (4.4, 1.8, 1.6), 0.4, 2, 1)
    world_from_vehicle = rigid(np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]), (411.0, 1180.0, 3.0))
    corners = cuboid_corners([box])
    moved = corners @ world_from_vehicle[:3, :3].T + world_from_vehicle[:3, 3]
    here = project_corners(corners, VEHICLE_TO_OPTICAL, CAMERA, SIZE_WH)
    there = project_corners(moved, VEHICLE_TO_OPTICAL @ inverse_rigid(world_from_vehicle), CAMERA, SIZE_WH)
    assert there.boxes_xyxy == pytest.approx(here.boxes_xyxy, abs=1e-3)


SHARED_BOXES = Path(__file__).resolve().parents[3] / "shared" / "data" / "formats" / "coco"


def side_deviation(
    centre: np.ndarray,
    size: tuple[float, float, float],
    camera: CameraIntrinsics,
    camera_from_world: np.ndarray,
    stated: np.ndarray,
    yaw: float,
) -> float:
    """Largest deviation in pixels of the four sides of a cuboid's box from a stated one."""
    box = Cuboid(tuple(centre.tolist()), size, yaw, 2, 1)
    found = project_corners(cuboid_corners([box]), camera_from_world, camera, (1600, 900))
    return float(np.abs(found.boxes_xyxy[0] - stated).max())


def test_real_nuscenes_boxes_of_the_devkit() -> None:
    """2-D boxes that the nuScenes devkit projected from real annotations, in six cameras.

    The file tells centre and size of each cuboid exactly, its yaw about the map's z axis only through the box. So one
    unknown is fitted to four sides that must agree to a quarter of a pixel (the median is 0.02).
    """
    path = SHARED_BOXES / "nus_infos_mono3d.coco.json"
    if not path.exists():
        pytest.skip(f"needs {path.name} in ../shared/data/formats/coco")
    document = json.loads(path.read_text())
    images = {image["id"]: image for image in document["images"]}
    assert len(document["annotations"]) == 11
    for annotation in document["annotations"]:
        image = images[annotation["image_id"]]
        vehicle_from_camera = rigid(rotation_from_quaternion(image["cam2ego_rotation"]), image["cam2ego_translation"])
        world_from_vehicle = rigid(
            rotation_from_quaternion(image["ego2global_rotation"]), image["ego2global_translation"]
        )
        world_from_camera = world_from_vehicle @ vehicle_from_camera
        x, y, z, width, length, height, _ = annotation["bbox_cam3d"]
        centre = (world_from_camera @ [x, y, z, 1.0])[:3]
        k = image["cam_intrinsic"]
        camera = CameraIntrinsics(k[0][0], k[1][1], k[0][2], k[1][2])
        left, top, box_width, box_height = annotation["bbox"]
        stated = np.array([left, top, left + box_width, top + box_height])

        camera_from_world = inverse_rigid(world_from_camera)
        deviation = partial(side_deviation, centre, (length, width, height), camera, camera_from_world, stated)
        coarse = min(np.linspace(-math.pi, math.pi, 361), key=deviation)
        best = minimize_scalar(deviation, bounds=(coarse - 0.02, coarse + 0.02), method="bounded")
        assert best.fun < 0.25, annotation["id"]
