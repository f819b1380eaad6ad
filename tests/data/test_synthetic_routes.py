"""The rendered world's routes: tight turns, straights, standstill, nobody about; and that the default has not moved."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations

import cv2
import numpy as np
import pytest

from cable_rpc.data.source import open_source
from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.data.synthetic.actors import Vehicle, actor_pose
from cable_rpc.data.synthetic.buildings import Building
from cable_rpc.data.synthetic.shadows import rectangle
from cable_rpc.errors import ConfigurationError
from cable_rpc.types import CameraIntrinsics, CameraMount


@lru_cache(maxsize=16)
def routed(seed: int, route: str = "streets", traffic: str = "normal", frame_count: int = 100) -> SyntheticSource:
    return SyntheticSource(
        SyntheticConfig(seed=seed, width=320, height=180, frame_count=frame_count, route=route, traffic=traffic)
    )


# Seed, actors, props, road heading, sum of all vehicles' places at the end, ego x and y after 5 s, last prop's x and y,
# wear of the markings; 64x48, 60 frames, as of the first published world.
FIRST_WORLDS = [
    (0, 125, 128, 0.500703764, 3029.697247, 156.57764, -1.543253, 355.799703, 41.976342, 0.435031931),
    (1, 69, 172, 0.366492093, 4939.233462, 161.522436, 4.856107, 324.880711, 27.906923, 0.434571421),
    (2, 74, 535, -0.407971889, 2161.777334, 154.85163, -1.614567, 288.996188, -76.62156, 0.288601196),
    (3, 38, 244, -0.465618636, 3233.731186, 169.265283, -15.13609, 294.397532, -24.685747, 0.316323218),
]


@pytest.mark.parametrize("first", FIRST_WORLDS, ids=lambda first: f"seed{first[0]}")
def test_a_bare_seed_stands_for_the_world_it_always_stood_for(first: tuple[float, ...]) -> None:
    source = open_source(f"synthetic:{first[0]}", size=(64, 48), max_frames=60)
    assert isinstance(source, SyntheticSource)
    world = source.world
    ego, last = world.ego(5.0)[0], world.props[-1].anchor
    found = (
        len(world.actors), len(world.props), world.road.heading[400], world.traffic.s[-1].sum(), ego.x, ego.y,
        last[0], last[1], world.ground.painter.wear,
    )  # fmt: skip
    assert found == pytest.approx(first[1:], abs=2e-6)


def test_defaults_may_be_spelled_out() -> None:
    spelled = open_source("synthetic:3?route=streets&traffic=normal", size=(96, 64), max_frames=2)
    bare = open_source("synthetic:3", size=(96, 64), max_frames=2)
    assert spelled.name == bare.name == "synthetic:3"
    for one, other in zip(spelled, bare, strict=True):
        assert np.array_equal(one.image, other.image)


@pytest.mark.parametrize(
    "spec",
    ["synthetic:0?route=standstill&traffic=none", "synthetic:12?traffic=none"],
)
def test_the_name_opens_the_same_world_again(spec: str) -> None:
    source = open_source(spec, size=(96, 64), max_frames=1)
    assert source.name == spec
    again = open_source(source.name, size=(96, 64), max_frames=1)
    assert np.array_equal(next(iter(source)).image, next(iter(again)).image)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("synthetic:3?rout=turns", r"'rout'; known are route, traffic"),
        ("synthetic:3?route=loop", r"'loop'; known are streets, turns, straight, standstill"),
        ("synthetic:3?route=", r"''; known are streets"),
        ("synthetic:3?traffic=heavy", r"'heavy'; known are normal, none"),
        ("synthetic:3?turns", "key=value"),
        ("synthetic:3?route=turns&route=straight", "once"),
        ("synthetic:x?route=turns", "seed"),
        ("synthetic:?route=turns", "seed"),
    ],
)
def test_unknown_options_list_the_known(spec: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        open_source(spec)


@pytest.mark.parametrize("seed", range(3))
def test_turns_are_as_tight_as_street_corners(seed: int) -> None:
    world = routed(seed, "turns").world
    motions = [world.ego(i / 10)[1] for i in range(100)]
    rates = np.degrees([motion.yaw_rate_radps for motion in motions])
    assert 0.25 <= (np.abs(rates) >= 20.0).mean() <= 0.65
    assert rates.max() > 15.0
    assert rates.min() < -15.0
    assert 20.0 < np.abs(rates).max() < 36.0
    lateral = [abs(motion.yaw_rate_radps) * motion.speed_mps for motion in motions]
    assert max(lateral) < 4.2


@pytest.mark.parametrize("seed", range(3))
def test_ego_motion_in_turns_is_the_motion_of_the_pose(seed: int) -> None:
    """Integrated over any 2 s, speed and yaw rate lead to the true pose within 1 % of the way and of the turn."""
    world = routed(seed, "turns").world
    step, turned = 0.02, []
    for begin in np.arange(0.0, 7.6, 0.75):
        pose, reached = world.ego(begin)[0], world.ego(begin + 2.0)[0]
        x, y, heading, way = pose.x, pose.y, pose.heading, 0.0
        for index in range(round(2.0 / step)):
            motion = world.ego(begin + (index + 0.5) * step)[1]
            middle = heading + motion.yaw_rate_radps * step / 2
            x += motion.speed_mps * math.cos(middle) * step
            y += motion.speed_mps * math.sin(middle) * step
            heading += motion.yaw_rate_radps * step
            way += motion.speed_mps * step
        assert math.hypot(x - reached.x, y - reached.y) < 0.01 * way
        assert abs(heading - reached.heading) < 0.01 * abs(reached.heading - pose.heading) + 2e-3
        turned.append(reached.heading - pose.heading)
    # World headings are counter-clockwise: both signs occur.
    assert max(turned) > 0.1
    assert min(turned) < -0.1


@pytest.mark.parametrize("seed", range(3))
def test_nothing_stands_on_the_road_of_a_turn(seed: int) -> None:
    world = routed(seed, "turns").world
    half = world.street.road_half_width
    kerb = half + world.street.pavement
    centre = np.column_stack([world.road.x, world.road.y])
    buildings = [prop for prop in world.props if isinstance(prop, Building)]
    assert len(buildings) >= 12
    for building in buildings:
        outline = np.vstack([building.outline, building.outline])
        sides = np.vstack(
            [outline[i] + (outline[i + 1] - outline[i]) * np.linspace(0, 1, 20)[:, None] for i in range(4)]
        )
        assert distance(sides, centre).min() > kerb - 0.5
    others = np.array([prop.anchor[:2] for prop in world.props if not isinstance(prop, Building)])
    assert distance(others, centre).min() > half


def distance(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Distance [N] of points to the nearest sample of the centreline."""
    gaps: np.ndarray = np.hypot(*(points[:, None, :] - centre[None]).transpose(2, 0, 1)).min(axis=1)
    return gaps


@pytest.mark.parametrize("seed", range(3))
def test_vehicles_keep_clear_of_one_another_in_turns(seed: int) -> None:
    world = routed(seed, "turns").world
    for time_s in (0.0, 3.0, 6.0, 9.0):
        ego = world.ego(time_s)[0]
        outlines = [ego.to_world(rectangle(4.0, 1.7)).astype(np.float32)]
        for actor in world.actors:
            pose = actor_pose(world.road, actor.place(time_s))
            if isinstance(actor, Vehicle) and math.hypot(pose.x - ego.x, pose.y - ego.y) < 70.0:
                outlines.append(pose.to_world(rectangle(*actor.footprint)).astype(np.float32))
        for one, other in combinations(outlines, 2):
            assert cv2.intersectConvexConvex(one, other)[0] < 0.4


def test_turns_are_full_of_road_users() -> None:
    counts = []
    for index in range(5, 100, 18):
        truth = routed(0, "turns").frame(index).truth
        assert truth is not None
        # 8 rows of 180 are 25 of 540.
        counts.append((truth.boxes_xyxy[:, 3] - truth.boxes_xyxy[:, 1] >= 8).sum())
    assert np.mean(np.array(counts) >= 2) >= 0.8


def test_straight_has_no_bend() -> None:
    world = routed(2, "straight").world
    assert np.all(world.road.curvature == 0.0)
    assert all(world.ego(i / 10)[1].yaw_rate_radps == 0.0 for i in range(100))
    assert world.ego(9.0)[1].speed_mps >= 0.0
    assert max(world.ego(i / 10)[1].speed_mps for i in range(100)) > 3.0


def test_at_a_standstill_only_the_others_move() -> None:
    source = routed(0, "standstill")
    world = source.world
    poses = {(world.ego(i / 10)[0], world.ego(i / 10)[1].speed_mps) for i in range(100)}
    assert len(poses) == 1
    assert next(iter(poses))[1] == 0.0
    moved = 0
    first, later = source.frame(0).truth, source.frame(20).truth
    assert first is not None
    assert later is not None
    before = dict(zip(first.track_ids.tolist(), first.boxes_xyxy, strict=True))
    for track, box in zip(later.track_ids.tolist(), later.boxes_xyxy, strict=True):
        moved += track in before and np.abs(box - before[track]).max() > 4.0
    assert moved >= 1


@pytest.mark.parametrize("route", ["turns", "standstill"])
def test_without_traffic_it_is_the_same_drive_past_the_same_scenery(route: str) -> None:
    peopled, empty = routed(1, route, frame_count=30), routed(1, route, "none", frame_count=30)
    one, other = peopled.frame(20), empty.frame(20)
    assert one.ego == other.ego
    assert other.truth is not None
    assert len(other.truth) == 0
    assert one.truth is not None
    assert one.truth.instance_mask is not None
    # The sky is free of road users and their shadows, apart from what stands up against it.
    sky = np.zeros(one.image.shape[:2], bool)
    sky[:40] = True
    away = sky & (cv2.dilate((one.truth.instance_mask > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) == 0)
    assert np.array_equal(one.image[away], other.image[away])


def test_turns_render_the_same_in_any_order() -> None:
    forward = routed(1, "turns", frame_count=30)
    pictures = {index: forward.frame(index).image for index in (0, 20)}
    other = SyntheticSource(forward.config)
    for index in (20, 0):
        assert np.array_equal(other.frame(index).image, pictures[index])


def test_frames_know_how_the_camera_is_mounted() -> None:
    config = SyntheticConfig(seed=0, width=96, height=64, frame_count=1, mount_height_m=2.1, pitch_down_deg=4.0)
    source = SyntheticSource(config)
    mount = source.frame(0).mount
    assert mount == source.mount == CameraMount(2.1, math.radians(4.0))
    # A point on the ground 10 m ahead is seen atan(2.1 / 10) below the horizontal.
    k = source.intrinsics
    row = k.cy + k.fy * math.tan(math.atan2(mount.height_m, 10.0) - mount.pitch_down_rad)
    assert source.camera.row_at_distance(10.0) == pytest.approx(row)


def test_a_video_takes_the_mount_it_is_given(tmp_path) -> None:
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((20, 30, 3), np.uint8))
    mount = CameraMount(1.6, 0.05, 1.2)
    frames = list(open_source(f"video:{tmp_path}", mount=mount, intrinsics=CameraIntrinsics(30, 30, 15, 10)))
    assert [frame.mount for frame in frames] == [mount, mount]
    assert next(iter(open_source(f"video:{tmp_path}"))).mount is None
    movie = tmp_path / "clip.mkv"
    writer = cv2.VideoWriter(str(movie), cv2.VideoWriter_fourcc(*"FFV1"), 10.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV can't write FFV1")
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert next(iter(open_source(f"video:{movie}", mount=mount))).mount == mount


@pytest.mark.parametrize("mount", [CameraMount(0.0), CameraMount(-1.0), CameraMount(math.nan), CameraMount(1.5, 1.5)])
def test_impossible_mounts(mount: CameraMount) -> None:
    with pytest.raises(ConfigurationError, match="mount"):
        open_source("video:any.mp4", mount=mount)


def test_a_synthetic_source_knows_its_own_mount() -> None:
    with pytest.raises(ConfigurationError, match="mount"):
        open_source("synthetic:1", mount=CameraMount(1.5))
