"""The rendered world's poses and 3-D boxes against its pictures and its own ego-motion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest

from cable_rpc.data.cuboids import cuboid_corners, project_corners
from cable_rpc.data.poses import inverse_rigid, motion_from_poses
from cable_rpc.data.rendered_drive import DriveFrame, RenderedDrive, drawn_extent
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource


@lru_cache(maxsize=4)
def drive(seed: int, route: str, fps: float) -> tuple[DriveFrame, ...]:
    return tuple(RenderedDrive(SyntheticConfig(seed, 480, 270, fps, 5, route=route)))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    common = float(np.prod(np.maximum(sides, 0)))
    return common / (float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])) - common)


def test_cuboids_enclose_what_is_drawn() -> None:
    """No truth box of any visibility sticks out of its projected cuboid by more than 1.5 pixels.

    Unoccluded ones fill it: vehicles by a mean IoU above 0.8 (a box around a rounded body), people, whose boxes
    hold a whole stride, above 0.6.
    """
    vehicles: list[float] = []
    people: list[float] = []
    for seed, route, fps in ((0, "streets", 1.0), (3, "turns", 10.0)):
        for frame in drive(seed, route, fps):
            truth, intrinsics = frame.frame.truth, frame.frame.intrinsics
            assert truth is not None
            assert intrinsics is not None
            assert [cuboid.track_id for cuboid in frame.cuboids] == truth.track_ids.tolist()
            assert [cuboid.class_id for cuboid in frame.cuboids] == truth.class_ids.tolist()
            camera_from_vehicle = inverse_rigid(frame.vehicle_from_camera)
            found = project_corners(cuboid_corners(frame.cuboids), camera_from_vehicle, intrinsics, (480, 270))
            for box, seen, kind, share in zip(
                found.boxes_xyxy, truth.boxes_xyxy, truth.class_ids, truth.visibility, strict=True
            ):
                assert (box[:2] - seen[:2]).max() < 1.5
                assert (seen[2:] - box[2:]).max() < 1.5
                if share > 0.98 and max(seen[2:] - seen[:2]) > 20:
                    (people if kind in (0, 1) else vehicles).append(overlap(box, seen))
    assert len(vehicles) > 8
    assert len(people) > 8
    assert np.mean(vehicles) > 0.8
    assert np.mean(people) > 0.6


def test_poses_tell_the_same_motion() -> None:
    """Central differences of the poses give the simulation's own speeds and yaw rates, signs included."""
    frames = drive(3, "turns", 10.0)
    times_ns = np.array([frame.frame.capture_time_ns for frame in frames], np.int64)
    poses = np.array([frame.world_from_vehicle for frame in frames])
    turning = 0.0
    for motion, frame in list(zip(motion_from_poses(times_ns, poses), frames, strict=True))[1:-1]:
        assert frame.frame.ego is not None
        assert motion.speed_mps == pytest.approx(frame.frame.ego.speed_mps, abs=0.08)
        assert motion.lateral_mps == pytest.approx(0.0, abs=0.05)
        assert motion.yaw_rate_radps == pytest.approx(frame.frame.ego.yaw_rate_radps, abs=0.01)
        turning = max(turning, abs(motion.yaw_rate_radps))
    assert turning > 0.05


def test_parked_cars_stand_still_in_the_world() -> None:
    """Parked and standing cuboids keep their place and heading in world axes while the vehicle drives by."""
    frames = drive(0, "streets", 1.0)
    places: dict[int, list[np.ndarray]] = {}
    for frame in frames:
        for cuboid, corners in zip(frame.cuboids, cuboid_corners(frame.cuboids), strict=True):
            world = corners @ frame.world_from_vehicle[:3, :3].T + frame.world_from_vehicle[:3, 3]
            places.setdefault(cuboid.track_id, []).append(world)
            assert abs(world[:, 2].min()) < 0.1
    parked = {actor.track_id for actor in source().world.actors if is_parked(actor)}
    still = [
        np.ptp(np.array(seen), axis=0).max() for track, seen in places.items() if track in parked and len(seen) > 1
    ]
    assert len(still) >= 2
    assert max(still) < 1e-6


@lru_cache(maxsize=1)
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(0, 480, 270, 1.0, 5))


def is_parked(actor: object) -> bool:
    return getattr(actor, "traffic", 0) is None


def test_frames_are_those_of_the_source() -> None:
    rendered = RenderedDrive(source().config)
    assert (rendered.name, rendered.fps, rendered.size_wh) == ("synthetic:0", 1.0, (480, 270))
    theirs, mine = source().frame(3), drive(0, "streets", 1.0)[3].frame
    assert np.array_equal(mine.image, theirs.image)
    assert (mine.index, mine.ego, mine.mount) == (3, theirs.ego, theirs.mount)


def test_camera_pose() -> None:
    """The optical axis points ahead and 1.8 degrees down from 1.45 m above the road."""
    pose = drive(0, "streets", 1.0)[0].vehicle_from_camera
    assert pose[:3, 3] == pytest.approx([0.0, 0.0, 1.45])
    tilt = np.radians(1.8)
    assert pose[:3, 2] == pytest.approx([np.cos(tilt), 0.0, -np.sin(tilt)])
    assert pose[:3, 0] == pytest.approx([0.0, -1.0, 0.0])
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


@dataclass
class Crate:
    """An actor that the drive knows nothing special about."""

    footprint: tuple[float, float] = (2.0, 1.0)
    height: float = 0.7


def test_extent_of_any_other_actor_is_its_footprint() -> None:
    assert drawn_extent(Crate()).tolist() == [[-1.0, -0.5, 0.0], [1.0, 0.5, 0.7]]  # type: ignore[arg-type]
