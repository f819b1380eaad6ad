"""nuScenes: real fragments of scene-0061, of its CAN bus and of Lyft Level 5."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.nuscenes import open_nuscenes, sequences
from cable_rpc.data.nuscenes.scene import read_scene
from cable_rpc.data.nuscenes.truth import truth_of
from cable_rpc.data.poses import motion_from_poses, rigid, rotation_from_quaternion
from cable_rpc.data.source import SourceOptions
from cable_rpc.types import CameraIntrinsics, EgoMotion

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "formats"
PLAIN = SourceOptions()


def test_real_keyframe() -> None:
    """The fragment of scene-0061: one image, no boxes (no such table), the pose of one moment."""
    root = SHARED / "nuscenes"
    if not root.exists():
        pytest.skip("needs the nuScenes fragment in ../shared/data/formats")
    assert sequences(root) == ["scene-0061"]
    source = open_nuscenes(str(root), PLAIN)
    assert (source.name, source.size_wh, source.frame_count, source.fps) == ("scene-0061", (1600, 900), 1, 12.0)
    frame = next(iter(source))
    assert frame.capture_time_ns == 1_532_402_927_612_460_000
    assert frame.image.shape == (900, 1600, 3)
    assert frame.image.std() > 30
    assert frame.intrinsics == CameraIntrinsics(
        1266.417203046554, 1266.417203046554, 816.2670197447984, 491.50706579294757
    )
    # The optical axis of a camera mounted level points ahead to within a degree.
    assert (frame.mount.height_m, frame.mount.forward_m) == pytest.approx((1.51095763913, 1.70079118954))
    assert abs(frame.mount.pitch_down_rad) < 0.02
    assert (frame.ego, frame.truth) == (None, None)
    rear = open_nuscenes(f"{root}?camera=CAM_BACK", PLAIN)
    assert rear.name == "scene-0061-CAM_BACK"
    assert next(iter(rear)).mount is None


def test_real_can_messages(tmp_path: Path) -> None:
    """The real pose messages of scene-0061 at its real keyframe: 8.99 m/s, as the wheels say (SOURCE.md)."""
    if not (SHARED / "nuscenes").exists() or not (SHARED / "nuscenes-can-bus").exists():
        pytest.skip("needs the nuScenes fragments in ../shared/data/formats")
    (tmp_path / "v1.0-test").symlink_to(SHARED / "nuscenes" / "v1.0-test")
    (tmp_path / "samples").symlink_to(SHARED / "nuscenes" / "samples")
    (tmp_path / "can_bus").symlink_to(SHARED / "nuscenes-can-bus")
    frame = next(iter(open_nuscenes(f"{tmp_path}?ego=can", PLAIN)))
    # 53 ms before the first message, which still holds.
    assert frame.ego == EgoMotion(pytest.approx(8.988725931436823), 0.0, pytest.approx(0.017157725989818573))


def test_real_poses_and_speeds_agree() -> None:
    """Positions and headings of the real CAN poses, differentiated, against the velocities in the same messages."""
    path = SHARED / "nuscenes-can-bus" / "scene-0061_pose.json"
    if not path.exists():
        pytest.skip("needs the CAN bus fragment in ../shared/data/formats")
    messages = json.loads(path.read_text())
    times = np.array([message["utime"] * 1000 for message in messages], np.int64)
    poses = np.array([rigid(rotation_from_quaternion(m["orientation"]), m["pos"]) for m in messages])
    for motion, message in zip(motion_from_poses(times, poses), messages, strict=True):
        assert motion.speed_mps == pytest.approx(message["vel"][0], rel=0.03)
        assert abs(motion.lateral_mps) < 0.1
        # Over 20 ms the heading is known to a few tenths of a milliradian only.
        assert motion.yaw_rate_radps == pytest.approx(message["rotation_rate"][2], abs=0.025)


def test_lyft_tables() -> None:
    """One real sample of Lyft Level 5 with four cars: the fragment has no images, so skipping leaves no frame."""
    root = SHARED / "lyft-tables"
    if not root.exists():
        pytest.skip("needs the Lyft tables in ../shared/data/formats")
    skipping = BadFrames(skip=True)
    source = open_nuscenes(str(root), SourceOptions(bad_frames=skipping))
    assert (source.size_wh, source.frame_count) == ((1920, 1080), 1)
    assert list(source) == []
    assert "host-a101_cam0_1240710385850000006.jpeg" in skipping.skipped[0]
    tables = root / "v1.01-train"
    scene = read_scene(tables, "host-a101-lidar0-1240710366399037786-1240710391298976894", "CAM_FRONT", skipping)
    truth = truth_of(scene, scene.images[0], interpolate=False)
    rows = {name: json.loads((tables / f"{name}.json").read_text()) for name in ("sample_annotation", "ego_pose")}
    assert {row["visibility_token"] for row in rows["sample_annotation"]} == {""}
    # The same four centres by SciPy's rotations: those ahead must lie in the middle of a box of a car.
    image = scene.images[0]
    place = image.world_from_vehicle[:3, 3]
    pose = next(row for row in rows["ego_pose"] if row["translation"] == place.tolist())
    camera = image.calibration.vehicle_from_camera
    ahead = 0
    for row in rows["sample_annotation"]:
        w, x, y, z = pose["rotation"]
        in_vehicle = Rotation.from_quat([x, y, z, w]).inv().apply(np.array(row["translation"]) - place)
        right, down, forward = camera[:3, :3].T @ (in_vehicle - camera[:3, 3])
        k = image.calibration.intrinsics
        u, v = right / forward * k.fx + k.cx, down / forward * k.fy + k.cy
        if forward > 1 and 0 < u < 1920 and 0 < v < 1080:
            ahead += 1
            boxes = truth.boxes_xyxy
            assert ((boxes[:, :2] < (u, v)) & (boxes[:, 2:] > (u, v))).all(axis=1).any()
    assert len(truth) == ahead
    assert set(truth.class_ids.tolist()) <= {2}
    assert (truth.visibility > 0.99).all()
