"""nuScenes: the rendered world written in its format and read back, interpolation, ego-motion, real fragments."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cable_rpc.data.cuboids import Cuboid
from cable_rpc.data.nuscenes import open_nuscenes, sequences, write_nuscenes
from cable_rpc.data.nuscenes.annotations import Annotation, annotations_between
from cable_rpc.data.nuscenes.categories import class_of_category, is_ignored
from cable_rpc.data.poses import rigid
from cable_rpc.data.rendered_drive import DriveFrame, RenderedDrive
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.synthetic import SyntheticConfig
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion, Frame, GroundTruth

START_NS = 1_532_402_927_612_460_000
PLAIN = SourceOptions()


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """A drive of 13 frames at 12 Hz through tight bends, two keyframes and a half, and its data set."""
    root = tmp_path_factory.mktemp("nuscenes")
    frames = list(RenderedDrive(SyntheticConfig(4, 480, 270, 12.0, 13, route="turns")))
    write_nuscenes(root, {"scene-0001": frames})
    return root, frames


def overlap(a, b) -> float:
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    common = float(np.prod(np.maximum(sides, 0)))
    return common / (float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])) - common)


def test_round_trip(rendered) -> None:
    root, driven = rendered
    assert sequences(root) == ["scene-0001"]
    source = open_nuscenes(str(root), PLAIN)
    assert (source.name, source.size_wh, source.frame_count) == ("scene-0001", (480, 270), 13)
    assert source.fps == pytest.approx(12.0, abs=1e-3)
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(13))
    for frame, drive in zip(frames, driven, strict=True):
        wanted = drive.frame
        assert abs(frame.capture_time_ns - START_NS - wanted.capture_time_ns) <= 500
        assert np.abs(frame.image.astype(int) - wanted.image).mean() < 4.0
        assert frame.intrinsics == wanted.intrinsics
        assert (frame.mount.height_m, frame.mount.pitch_down_rad, frame.mount.forward_m) == pytest.approx(
            (wanted.mount.height_m, wanted.mount.pitch_down_rad, 0.0)
        )
        # Braking within the half step makes the first and the last difference coarser.
        loose = frame.index in (0, 12)
        assert frame.ego.speed_mps == pytest.approx(wanted.ego.speed_mps, abs=0.1 if loose else 0.05)
        assert frame.ego.yaw_rate_radps == pytest.approx(wanted.ego.yaw_rate_radps, abs=0.03 if loose else 0.01)
        assert frame.ego.lateral_mps == pytest.approx(0.0, abs=0.02)
    assert min(frame.ego.yaw_rate_radps for frame in frames) < -0.3
    assert [frame.truth is not None for frame in frames] == [index % 6 == 0 for index in range(13)]
    assert [frame.index for frame in source] == list(range(13))


def test_boxes_of_keyframes(rendered) -> None:
    """Every object drawn has its box at its place, with its class, and under one track id over the scene."""
    root, driven = rendered
    tracks: dict[int, int] = {}
    overlaps = []
    for frame, drive in zip(open_nuscenes(str(root), PLAIN), driven, strict=True):
        if frame.truth is None:
            continue
        wanted = drive.frame.truth
        assert len(frame.truth) == len(wanted) > 3
        assert frame.truth.ignored_boxes_xyxy is None
        pairs = list(zip(frame.truth.track_ids.tolist(), wanted.track_ids.tolist(), strict=True))
        for place, (track, original) in enumerate(pairs):
            assert tracks.setdefault(track, original) == original
            assert frame.truth.class_ids[place] == wanted.class_ids[place]
            box, seen = frame.truth.boxes_xyxy[place], wanted.boxes_xyxy[place]
            assert (box[:2] - seen[:2]).max() < 1.5
            assert (seen[2:] - box[2:]).max() < 1.5
            level = min((0.2, 0.5, 0.7, 0.9), key=lambda middle, share=wanted.visibility[place]: abs(middle - share))
            if (box > 1).all() and (box[2:] < (479, 269)).all():
                assert frame.truth.visibility[place] == pytest.approx(level, abs=0.31)
            if wanted.visibility[place] > 0.95:
                overlaps.append(overlap(box, seen))
    assert len(set(tracks.values())) == len(tracks)
    assert np.mean(overlaps) > 0.65


def test_interpolated_boxes_follow_the_objects(rendered) -> None:
    """Half a second between keyframes, tracks of both: boxes of the sweeps are where the objects are drawn."""
    root, driven = rendered
    checked = 0
    known: dict[int, int] = {}
    for frame, drive in zip(open_nuscenes(f"{root}?boxes=interpolate", PLAIN), driven, strict=True):
        assert frame.truth is not None
        wanted = drive.frame.truth
        if frame.index % 6 == 0:
            known |= dict(zip(frame.truth.track_ids.tolist(), wanted.track_ids.tolist(), strict=True))
            continue
        rows = {track: row for row, track in enumerate(wanted.track_ids.tolist())}
        for box, track in zip(frame.truth.boxes_xyxy, frame.truth.track_ids.tolist(), strict=True):
            row = rows.get(known[track])
            if row is None or wanted.visibility[row] < 0.5:
                continue
            # Walkers and cars don't quite move in straight lines at constant speed.
            assert (box[:2] - wanted.boxes_xyxy[row][:2]).max() < 3.0
            assert (wanted.boxes_xyxy[row][2:] - box[2:]).max() < 3.0
            checked += 1
    assert checked > 20


def test_can_bus(rendered) -> None:
    root, driven = rendered
    for frame, drive in zip(open_nuscenes(f"{root}#scene-0001?ego=can", PLAIN), driven, strict=True):
        wanted = drive.frame.ego
        assert frame.ego.speed_mps == pytest.approx(wanted.speed_mps, abs=0.01)
        assert frame.ego.yaw_rate_radps == pytest.approx(wanted.yaw_rate_radps, abs=0.01)


def test_options(rendered) -> None:
    root, driven = rendered
    small = open_nuscenes(str(root), SourceOptions(size=(240, 135), max_frames=2))
    frames = list(small)
    assert (small.size_wh, small.frame_count, len(frames)) == ((240, 135), 2, 2)
    assert frames[0].image.shape == (135, 240, 3)
    assert frames[0].intrinsics.fx == pytest.approx(driven[0].frame.intrinsics.fx / 2)
    whole = next(iter(open_nuscenes(str(root), PLAIN)))
    assert frames[0].truth.boxes_xyxy == pytest.approx(whole.truth.boxes_xyxy / 2)
    slow = open_nuscenes(str(root), SourceOptions(fps=4.0))
    assert slow.fps == 4.0
    times = [frame.capture_time_ns for frame in slow]
    assert np.diff(times) / 1e9 == pytest.approx([0.25] * 4, abs=1e-5)
    keyed = open_nuscenes(f"{root}?frames=keyframes", PLAIN)
    assert keyed.fps == pytest.approx(2.0, abs=1e-3)
    assert [frame.truth is None for frame in keyed] == [False] * 3


def straight_drive(frames: int, turn_rad: float, drift_mps: float, cuboid: Cuboid) -> list[DriveFrame]:
    """A drive of 8 m/s at 10 Hz without a picture, turning by `turn_rad` per second and drifting to the right."""
    intrinsics = CameraIntrinsics(100.0, 100.0, 31.5, 15.5)
    optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    driven, x, y = [], 400.0, 1100.0
    for index in range(frames):
        heading = 2.0 + turn_rad * index / 10
        turn = np.array(
            [[math.cos(heading), -math.sin(heading), 0], [math.sin(heading), math.cos(heading), 0], [0, 0, 1]]
        )
        box = np.array([[28.0, 14.0, 36.0, 18.0]], np.float32)
        truth = GroundTruth(box, np.array([2], np.int32), np.array([7], np.int32), np.array([0.65], np.float32))
        ego = EgoMotion(8.0, drift_mps, turn_rad)
        image = np.full((32, 64, 3), 10 * index, np.uint8)
        frame = Frame(image, index, index * 100_000_000, ego, intrinsics, truth, CameraMount(1.6, 0.0, 1.7))
        driven.append(DriveFrame(frame, rigid(turn, (x, y, 0.0)), rigid(optical, (1.7, 0.0, 1.6)), (cuboid,)))
        middle = heading + turn_rad / 20
        x += (8.0 * math.cos(middle) + drift_mps * math.sin(middle)) / 10
        y += (8.0 * math.sin(middle) - drift_mps * math.cos(middle)) / 10
    return driven


CAR = Cuboid((11.7, 1.0, 1.0), (4.0, 2.0, 1.0), 0.0, 2, 7)


@pytest.mark.parametrize("ego", ["pose", "can"])
def test_signs_of_ego_motion(tmp_path: Path, ego: str) -> None:
    """A left turn has a positive yaw rate, a drift to the right a positive lateral speed."""
    write_nuscenes(tmp_path, {"a": straight_drive(5, 0.4, 0.0, CAR), "b": straight_drive(5, -0.2, 0.5, CAR)})
    for frame in open_nuscenes(f"{tmp_path}#a?ego={ego}", PLAIN):
        assert frame.ego.speed_mps == pytest.approx(8.0, abs=0.01)
        assert frame.ego.yaw_rate_radps == pytest.approx(0.4, abs=1e-4)
        assert frame.ego.lateral_mps == pytest.approx(0.0, abs=1e-4)
    for frame in open_nuscenes(f"{tmp_path}#b?ego={ego}", PLAIN):
        assert frame.ego.yaw_rate_radps == pytest.approx(-0.2, abs=1e-4)
        assert frame.ego.lateral_mps == pytest.approx(0.5, abs=0.01)


def test_a_box_by_hand(tmp_path: Path) -> None:
    """A car whose rear is 8 m before the camera and up to 2 m left of it: the box by similar triangles."""
    write_nuscenes(tmp_path, {"a": straight_drive(1, 0.0, 0.0, CAR)})
    frame = next(iter(open_nuscenes(str(tmp_path), PLAIN)))
    assert frame.ego is None
    assert frame.mount == CameraMount(pytest.approx(1.6), pytest.approx(0.0, abs=1e-9), pytest.approx(1.7))
    # Rear 11.7 - 2 - 1.7 = 8 m ahead, front 12 m; y 0..2 left; z 0.5..1.5, camera at 1.6.
    expected = [31.5 - 100 * 2 / 8, 15.5 + 100 * 0.1 / 12, 31.5, 15.5 + 100 * 1.1 / 8]
    assert frame.truth.boxes_xyxy[0] == pytest.approx(expected, abs=1e-3)
    assert (frame.truth.class_ids[0], frame.truth.track_ids[0]) == (2, 1)
    assert frame.truth.visibility[0] == pytest.approx(0.7)


def test_visibility_counts_the_image_border(tmp_path: Path) -> None:
    beside = replace(CAR, centre_m=(11.7, 4.0, 1.0))
    write_nuscenes(tmp_path, {"a": straight_drive(1, 0.0, 0.0, beside)})
    truth = next(iter(open_nuscenes(str(tmp_path), PLAIN))).truth
    # y 3..5: u from 31.5 - 62.5 = -31 to 31.5 - 25 = 6.5 (front corner), so 6.5 of 37.5 px are inside.
    assert truth.boxes_xyxy[0, [0, 2]] == pytest.approx([0.0, 6.5], abs=1e-3)
    assert truth.visibility[0] == pytest.approx(6.5 / 37.5, abs=1e-3)


def annotation(track: int, x: float, yaw: float, visibility: float = 0.9) -> Annotation:
    return Annotation(Cuboid((x, 2.0 * x, 1.0), (4.0, 2.0, 1.5), yaw, 2, track), visibility, False)


def test_interpolation_by_hand() -> None:
    samples = {"one": 1_000_000_000, "two": 1_500_000_000}
    known = {"one": [annotation(1, 0.0, 3.0), annotation(2, 5.0, 0.0)], "two": [annotation(1, 10.0, -3.0, 0.5)]}
    found = annotations_between(known, samples, 1_100_000_000)
    assert found is not None
    moved, lost = found
    assert moved.cuboid.centre_m == pytest.approx((2.0, 4.0, 1.0))
    # From 3.0 to -3.0 the short way is 0.283 rad through pi.
    assert moved.cuboid.yaw_rad == pytest.approx(3.0 + 0.2 * (2 * math.pi - 6.0))
    assert moved.visibility == pytest.approx(0.82)
    assert not moved.ignored
    assert lost.ignored
    assert lost.cuboid.centre_m == (5.0, 10.0, 1.0)
    assert annotations_between(known, samples, 999_999_999) is None
    assert annotations_between(known, samples, 1_500_000_001) is None
    assert annotations_between(known, samples, 1_500_000_000) == known["two"]


@pytest.mark.parametrize(
    ("name", "class_id", "ignored"),
    [
        ("human.pedestrian.construction_worker", 0, False),
        ("vehicle.bus.bendy", 5, False),
        ("vehicle.trailer", 7, False),
        ("vehicle.construction", 7, False),
        ("vehicle.car", 2, False),
        ("vehicle.carriage", None, False),
        ("vehicle.emergency.police", None, True),
        ("static_object.bicycle_rack", None, True),
        ("animal", None, False),
        ("movable_object.barrier", None, False),
        ("other_vehicle", 7, False),
        ("emergency_vehicle", None, True),
    ],
)
def test_categories(name: str, class_id: int | None, ignored: bool) -> None:
    assert class_of_category(name) == class_id
    assert is_ignored(name) == ignored
