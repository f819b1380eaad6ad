"""Waymo version 2: tables written here column by column, with motion, boxes and damage known beforehand."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.source import SourceOptions, open_source
from cable_rpc.data.waymo import open_waymo, sequences
from cable_rpc.data.waymo.components import read_motion
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion

arrow = pytest.importorskip("pyarrow", reason="Parquet tables need pyarrow")
parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet tables need pyarrow")

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "formats" / "waymo-v2"
START_US = 1_550_000_000_000_000
STEP_US = 100_000
WIDTH, HEIGHT = 64, 48
SPEED_MPS = 8.0


def jpeg(shade: int, size_wh=(WIDTH, HEIGHT)) -> bytes:
    return cv2.imencode(".jpg", np.full((size_wh[1], size_wh[0], 3), shade, np.uint8))[1].tobytes()


def pose_on_plane(x: float, y: float, heading: float) -> list[float]:
    c, s = math.cos(heading), math.sin(heading)
    return [c, -s, 0, x, s, c, 0, y, 0, 0, 1, 0, 0, 0, 0, 1]


def image_row(step: int, camera=1, **changes) -> dict:
    row = {
        "key.segment_context_name": "one",
        "key.frame_timestamp_micros": START_US + step * STEP_US,
        "key.camera_name": camera,
        "[CameraImageComponent].image": jpeg(20 + 10 * step),
        "[CameraImageComponent].pose.transform": pose_on_plane(0, 0, 0),
    }
    for part in ("linear", "angular"):
        row |= {f"[CameraImageComponent].velocity.{part}_velocity.{axis}": 0.0 for axis in "xyz"}
    return row | changes


def calibration_row(camera=1, **changes) -> dict:
    intrinsic = {"f_u": 60.0, "f_v": 61.0, "c_u": 32.0, "c_v": 24.0} | dict.fromkeys(
        ("k1", "k2", "p1", "p2", "k3"), 0.0
    )
    row = {"key.segment_context_name": "one", "key.camera_name": camera}
    row |= {f"[CameraCalibrationComponent].intrinsic.{name}": value for name, value in intrinsic.items()}
    row |= {
        "[CameraCalibrationComponent].extrinsic.transform": np.eye(4).ravel().tolist(),
        "[CameraCalibrationComponent].width": WIDTH,
        "[CameraCalibrationComponent].height": HEIGHT,
    }
    return row | changes


def box_row(step: int, object_id, kind, centre, size, difficulty=0, camera=1) -> dict:
    return {
        "key.frame_timestamp_micros": None if step is None else START_US + step * STEP_US,
        "key.camera_name": camera,
        "key.camera_object_id": object_id,
        "[CameraBoxComponent].box.center.x": centre[0],
        "[CameraBoxComponent].box.center.y": centre[1],
        "[CameraBoxComponent].box.size.x": size[0],
        "[CameraBoxComponent].box.size.y": size[1],
        "[CameraBoxComponent].type": kind,
        "[CameraBoxComponent].difficulty_level.detection": difficulty,
    }


def pose_row(step: int, transform) -> dict:
    return {
        "key.frame_timestamp_micros": START_US + step * STEP_US,
        "[VehiclePoseComponent].world_from_vehicle.transform": transform,
    }


def write(root: Path, component: str, rows: list[dict], camera_type="int8", rows_per_group=2, name="one") -> Path:
    table = arrow.table({key: [row[key] for row in rows] for key in rows[0]})
    if "key.camera_name" in table.column_names:
        place = table.column_names.index("key.camera_name")
        keys = table.column(place).cast(getattr(arrow, camera_type)())
        table = table.set_column(place, "key.camera_name", keys)
    path = root / component / f"{name}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path, row_group_size=rows_per_group, use_dictionary=False)
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Four standing frames without labels."""
    write(tmp_path, "camera_image", [image_row(step) for step in range(4)])
    write(tmp_path, "camera_calibration", [calibration_row()])
    return tmp_path


def opened(root: Path, query: str = "", **options):
    return open_waymo(f"{root}{query}", SourceOptions(**options))


def shades(frames) -> list[int]:
    return [round(float(frame.image.mean()) / 10) * 10 for frame in frames]


def without_velocity(step: int, **changes) -> dict:
    row = image_row(step, **changes)
    return {key: value for key, value in row.items() if "velocity" not in key}


def circle_to_the_left(time_s: float) -> list[float]:
    angle, radius = SPEED_MPS * time_s / 20.0, 20.0
    return pose_on_plane(radius * math.sin(angle), radius * (1 - math.cos(angle)), angle)


def drift_to_the_right(time_s: float) -> list[float]:
    return pose_on_plane(SPEED_MPS * time_s, -0.5 * time_s, 0.0)


DRIVES = [(circle_to_the_left, (SPEED_MPS, 0.0, 0.4)), (drift_to_the_right, (SPEED_MPS, 0.5, 0.0))]


def told(ego: EgoMotion) -> tuple[float, float, float]:
    return ego.speed_mps, ego.lateral_mps, ego.yaw_rate_radps


def test_stored_velocity_is_global_and_becomes_forward_right_and_left_turn(root) -> None:
    heading = math.radians(60)
    ahead, right = (math.cos(heading), math.sin(heading)), (math.sin(heading), -math.cos(heading))
    velocity = {
        f"[CameraImageComponent].velocity.linear_velocity.{axis}": SPEED_MPS * ahead[i] + 0.5 * right[i]
        for i, axis in enumerate("xy")
    }
    turn = {"[CameraImageComponent].velocity.angular_velocity.z": 0.2}
    pose = {"[CameraImageComponent].pose.transform": pose_on_plane(100, -7, heading)}
    write(root, "camera_image", [image_row(0, **velocity, **turn, **pose)])
    (frame,) = opened(root)
    assert told(frame.ego) == pytest.approx((SPEED_MPS, 0.5, 0.2))
    assert frame.capture_time_ns == START_US * 1000


@pytest.mark.parametrize(("drive", "motion"), DRIVES)
@pytest.mark.parametrize("lacking", ["column", "value"])
def test_poses_tell_the_motion_where_no_velocity_is_stored(root, drive, motion, lacking) -> None:
    nan = {"[CameraImageComponent].velocity.linear_velocity.y": math.nan}
    rows = [without_velocity(step) if lacking == "column" else image_row(step, **nan) for step in range(4)]
    write(root, "camera_image", rows)
    write(root, "vehicle_pose", [pose_row(step, drive(step * 0.1)) for step in (3, 0, 2, 1)])
    for frame in opened(root):
        assert told(frame.ego) == pytest.approx(motion, abs=1e-9)


def test_one_pose_tells_no_motion(root) -> None:
    write(root, "camera_image", [without_velocity(0)])
    write(root, "vehicle_pose", [pose_row(0, pose_on_plane(0, 0, 0))])
    (frame,) = opened(root)
    assert frame.ego is None


def test_damaged_pose_row_costs_its_frame_only(root) -> None:
    write(root, "camera_image", [without_velocity(step) for step in range(4)])
    poses = [drift_to_the_right(step * 0.1) for step in range(4)]
    poses[2] = [math.nan, *poses[2][1:]]
    write(root, "vehicle_pose", [pose_row(step, pose) for step, pose in enumerate(poses)])
    with pytest.raises(SourceError, match=r"vehicle_pose/one.parquet row 3: the pose is nan, "):
        list(opened(root))
    bad = BadFrames(skip=True)
    frames = list(opened(root, bad_frames=bad))
    assert shades(frames) == [20, 30, 50]
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert told(frames[2].ego) == pytest.approx((SPEED_MPS, 0.5, 0.0))
    assert len(bad.skipped) == 2


@pytest.mark.parametrize("skip", [False, True])
def test_pose_component_missing_is_no_damage_of_frames(root, skip) -> None:
    write(root, "camera_image", [without_velocity(step) for step in range(2)])
    with pytest.raises(SourceError, match=r"vehicle_pose/one.parquet is missing.*waymo.com/open"):
        list(opened(root, bad_frames=BadFrames(skip=skip)))


@pytest.mark.parametrize(("camera_type", "keys"), [("int8", (1, 3)), ("string", ("FRONT", "FRONT_RIGHT"))])
def test_cameras_share_tables_in_any_order(tmp_path, camera_type, keys) -> None:
    front, right = keys
    order = [(2, front, 30), (0, right, 110), (0, front, 10), (3, front, 40), (1, right, 120), (1, front, 20)]
    order.append((2, right, 130))
    rows = [image_row(step, camera, **{"[CameraImageComponent].image": jpeg(shade)}) for step, camera, shade in order]
    write(tmp_path, "camera_image", rows, camera_type)
    size = {"[CameraCalibrationComponent].width": WIDTH}
    aside = pose_on_plane(1.5, -0.1, math.radians(-45))
    right_row = calibration_row(right, **size, **{"[CameraCalibrationComponent].extrinsic.transform": aside})
    write(tmp_path, "camera_calibration", [right_row, calibration_row(front, **size)], camera_type)
    boxes = [box_row(0, "a", 1, (30, 20), (4, 6), camera=front), box_row(0, "b", 2, (9, 9), (3, 3), camera=right)]
    write(tmp_path, "camera_box", boxes, camera_type)

    source = opened(tmp_path)
    for _ in range(2):
        frames = list(source)
        assert shades(frames) == [10, 20, 30, 40]
        assert [frame.capture_time_ns // 1000 - START_US for frame in frames] == [0, 100_000, 200_000, 300_000]
        assert [frame.truth.class_ids.tolist() for frame in frames] == [[2], [], [], []]
    assert source.fps == pytest.approx(10.0)

    aside_source = opened(tmp_path, "?camera=front_right")
    frames = list(aside_source)
    assert aside_source.name != source.name
    assert shades(frames) == [110, 120, 130]
    assert frames[0].truth.class_ids.tolist() == [0]
    assert frames[0].mount is None
    with pytest.raises(SourceError, match="no row of camera SIDE_LEFT; found"):
        opened(tmp_path, "?camera=SIDE_LEFT")


def test_mount_and_intrinsics_follow_from_the_calibration(root) -> None:
    pitch = math.radians(5)
    c, s = math.cos(pitch), math.sin(pitch)
    # Camera axes x forward, y left, z up: a positive turn about y lowers the view.
    extrinsic = [c, 0, s, 1.5, 0, 1, 0, 0, -s, 0, c, 2.1, 0, 0, 0, 1]
    row = calibration_row(**{"[CameraCalibrationComponent].extrinsic.transform": extrinsic})
    write(root, "camera_calibration", [row])
    frame = next(iter(opened(root)))
    assert frame.intrinsics == CameraIntrinsics(60.0, 61.0, 32.0, 24.0)
    mount = frame.mount
    assert (mount.height_m, mount.pitch_down_rad, mount.forward_m) == pytest.approx((2.1, pitch, 1.5))


def test_boxes_classes_and_visibility(root) -> None:
    rows = [
        box_row(0, "car", 1, (30.0, 20.0), (10.0, 4.0), 1),
        box_row(0, "walker", 2, (50.0, 30.0), (2.0, 8.0), 2),
        box_row(0, "rider", 4, (0.0, 40.0), (8.0, 4.0), None),
        box_row(0, "sign", 3, (10.0, 10.0), (4.0, 4.0)),
        box_row(0, "unknown", 0, (10.0, 10.0), (4.0, 4.0)),
        box_row(0, "outside", 1, (-20.0, 10.0), (4.0, 4.0)),
        box_row(2, "walker", 2, (48.0, 46.0), (2.0, 16.0), 0),
    ]
    write(root, "camera_box", rows)
    truths = [frame.truth for frame in opened(root)]
    assert truths[0].class_ids.tolist() == [2, 0, 1]
    assert truths[0].boxes_xyxy.tolist() == [[25, 18, 35, 22], [49, 26, 51, 34], [0, 38, 4, 42]]
    assert truths[0].visibility.tolist() == [1.0, 0.5, 0.5]
    assert [len(truth) for truth in truths] == [3, 0, 1, 0]
    assert truths[2].boxes_xyxy.tolist() == [[47, 38, 49, 48]]
    assert truths[2].visibility[0] == pytest.approx(10 / 16)
    assert truths[2].track_ids[0] == truths[0].track_ids[1]


def test_test_split_has_no_truth(root) -> None:
    assert [frame.truth for frame in opened(root)] == [None] * 4


@pytest.mark.parametrize(
    ("damaged", "message"),
    [
        (box_row(1, "bad", 1, (math.nan, 20.0), (4.0, 4.0)), r"row 2: centre \(nan, 20.0\)"),
        (box_row(1, "bad", 1, (10.0, 20.0), (None, 4.0)), r"row 2: .* size \(None, 4.0\)"),
        (box_row(1, "bad", 1, (10.0, 20.0), (4.0, -4.0)), "row 2: size is 4.0 x -4.0"),
        (box_row(1, "bad", 9, (10.0, 20.0), (4.0, 4.0)), "row 2: type is 9; known are 0, 1, 2, 3, 4"),
        (box_row(1, "bad", 1, (10.0, 20.0), (4.0, 4.0), 7), "row 2: difficulty level is 7"),
        (box_row(1, None, 1, (10.0, 20.0), (4.0, 4.0)), "row 2: the object's id is None"),
        (box_row(None, "bad", 1, (10.0, 20.0), (4.0, 4.0)), "row 2: key.frame_timestamp_micros is None"),
    ],
)
def test_damaged_label_row_is_named_or_left_out(root, damaged, message) -> None:
    good = box_row(1, "good", 1, (30.0, 20.0), (10.0, 4.0))
    write(root, "camera_box", [good, damaged, box_row(1, "other", 2, (5.0, 5.0), (2.0, 2.0))])
    with pytest.raises(SourceError, match=f"camera_box/one.parquet {message}"):
        list(opened(root))
    bad = BadFrames(skip=True)
    frames = list(opened(root, bad_frames=bad))
    assert [frame.truth.class_ids.tolist() for frame in frames] == [[], [2, 0], [], []]
    assert len(bad.skipped) == 1


@pytest.mark.parametrize(
    ("image", "message"),
    [(jpeg(30)[:-40], "is cut off"), (None, "has no image"), (jpeg(30, (60, 40)), "image is 60x40, .* for 64x48")],
)
def test_damaged_image_is_named_or_left_out(root, image, message) -> None:
    rows = [image_row(step) for step in range(4)]
    rows[1]["[CameraImageComponent].image"] = image
    write(root, "camera_image", rows)
    place = rf"camera_image/one.parquet row 2 \(frame {START_US + STEP_US}, camera FRONT\)"
    with pytest.raises(SourceError, match=f"{place}.*{message}"):
        list(opened(root))
    bad = BadFrames(skip=True)
    frames = list(opened(root, bad_frames=bad))
    assert shades(frames) == [20, 40, 50]
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert len(bad.skipped) == 1


@pytest.mark.parametrize(("micros", "message"), [(None, "is None"), (START_US, "is the one of row 1 too")])
def test_image_row_of_no_time_of_its_own(root, micros, message) -> None:
    rows = [image_row(step) for step in range(3)]
    rows[1]["key.frame_timestamp_micros"] = micros
    write(root, "camera_image", rows)
    with pytest.raises(SourceError, match=f"camera_image/one.parquet row 2: .*{message}"):
        opened(root)
    assert shades(opened(root, bad_frames=BadFrames(skip=True))) == [20, 40]


def test_images_are_read_group_by_group(root) -> None:
    path = write(root, "camera_image", [image_row(step) for step in range(4)])
    group = parquet.ParquetFile(path).metadata.row_group(1)
    columns = [group.column(number) for number in range(group.num_columns)]
    image = next(column for column in columns if column.path_in_schema.endswith(".image"))
    data = bytearray(path.read_bytes())
    data[image.data_page_offset : image.data_page_offset + image.total_compressed_size] = bytes(
        image.total_compressed_size
    )
    path.write_bytes(data)
    frames = iter(opened(root))
    assert shades([next(frames), next(frames)]) == [20, 30]
    with pytest.raises(SourceError, match=r"camera_image/one.parquet can't be read as a Parquet table"):
        next(frames)


@pytest.mark.parametrize("skip", [False, True])
def test_structural_damage_is_never_skipped(root, skip) -> None:
    options = {"bad_frames": BadFrames(skip=skip)}
    calibration = root / "camera_calibration" / "one.parquet"
    no_height = {key: value for key, value in calibration_row().items() if not key.endswith("height")}
    write(root, "camera_calibration", [no_height])
    with pytest.raises(SourceError, match=r"camera_calibration/one.parquet has no column .*height; found key"):
        opened(root, **options)
    write(root, "camera_calibration", [calibration_row(**{"[CameraCalibrationComponent].intrinsic.f_u": math.nan})])
    with pytest.raises(SourceError, match=r"row 1: the intrinsics are \[nan, 61.0"):
        opened(root, **options)
    mirrored = np.diag([1.0, -1.0, 1.0, 1.0]).ravel().tolist()
    write(
        root, "camera_calibration", [calibration_row(**{"[CameraCalibrationComponent].extrinsic.transform": mirrored})]
    )
    with pytest.raises(SourceError, match="row 1: the extrinsic is no rigid transform"):
        opened(root, **options)
    calibration.write_bytes(calibration.read_bytes()[:-30])
    with pytest.raises(SourceError, match=r"camera_calibration/one.parquet can't be read as a Parquet table"):
        opened(root, **options)
    calibration.unlink()
    with pytest.raises(SourceError, match=r"camera_calibration/one.parquet is missing.*waymo.com/open"):
        opened(root, **options)
    (root / "camera_image" / "one.parquet").unlink()
    with pytest.raises(SourceError, match=r"camera_image is missing; there is camera_calibration"):
        opened(root, **options)


def test_row_group_of_more_rows_than_are_read_at_once(root) -> None:
    write(root, "camera_image", [image_row(step) for step in range(20)], rows_per_group=20)
    assert shades(opened(root)) == list(range(20, 220, 10))
    assert shades(opened(root, fps=2.0)) == [20, 70, 120, 170]


def test_thinning_size_and_count(tmp_path) -> None:
    write(tmp_path, "camera_image", [image_row(step) for step in range(7)], rows_per_group=3)
    write(tmp_path, "camera_calibration", [calibration_row()])
    write(tmp_path, "camera_box", [box_row(2, "car", 1, (30.0, 20.0), (10.0, 4.0))])
    source = opened(tmp_path, fps=5.0, size=(32, 48), max_frames=3)
    assert (source.fps, source.size_wh, source.frame_count) == (5.0, (32, 48), 3)
    frames = list(source)
    assert shades(frames) == [20, 40, 60]
    assert frames[1].image.shape == (48, 32, 3)
    assert frames[1].intrinsics == CameraIntrinsics(30.0, 61.0, 16.0, 24.0)
    assert frames[1].truth.boxes_xyxy.tolist() == [[12.5, 18, 17.5, 22]]
    faster = opened(tmp_path, fps=30.0)
    assert (faster.fps, faster.frame_count) == (pytest.approx(10.0), 7)


def test_undistortion_is_opencvs(root) -> None:
    lens = {"k1": -0.3, "k2": 0.1, "p1": 0.002, "p2": -0.001}
    row = calibration_row(**{f"[CameraCalibrationComponent].intrinsic.{name}": value for name, value in lens.items()})
    write(root, "camera_calibration", [row])
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), (0, 0), 3)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    write(root, "camera_image", [image_row(0, **{"[CameraImageComponent].image": data})])
    write(root, "camera_box", [box_row(0, "car", 1, (14.0, 12.0), (16.0, 12.0))])
    matrix, bent = np.array([[60.0, 0, 32], [0, 61, 24], [0, 0, 1]]), np.array([-0.3, 0.1, 0.002, -0.001, 0.0])
    (plain,), (straight,) = opened(root), opened(root, "?undistort=1")
    assert plain.truth.boxes_xyxy.tolist() == [[6, 6, 22, 18]]
    expected = cv2.undistort(plain.image, matrix, bent)
    assert np.abs(straight.image.astype(int) - expected).max() <= 1
    outline = np.array([(x, y) for x in np.linspace(6, 22, 65) for y in np.linspace(6, 18, 49)])
    points = cv2.undistortPoints(outline.reshape(-1, 1, 2), matrix, bent, P=matrix)[:, 0]
    assert straight.truth.boxes_xyxy[0] == pytest.approx([*points.min(axis=0), *points.max(axis=0)], abs=0.02)
    assert straight.intrinsics == plain.intrinsics


def test_layouts(root, tmp_path_factory) -> None:
    above = tmp_path_factory.mktemp("splits")
    (above / "training").symlink_to(root)
    assert sequences(above) == ["one"]
    assert shades(open_source(f"waymo:{above}#one")) == [20, 30, 40, 50]
    assert shades(opened(root / "camera_image" / "one.parquet")) == [20, 30, 40, 50]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("#two", "there is no sequence 'two'; use one of 'one'"),
        ("?camera=REAR", "there is no camera 'REAR'; known are FRONT, FRONT_LEFT"),
        ("?camera=FRONT&camera=FRONT", "give camera once"),
        ("?lens=1", "option 'lens=1'; .*known are camera, undistort"),
        ("?camera", "write key=value"),
        ("?undistort=yes", "there is no undistort 'yes'; known are 0, 1"),
    ],
)
def test_unusable_specs(root, query, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        opened(root, query)


def test_choice_among_segments(root) -> None:
    for number in range(12):
        write(root, "camera_image", [image_row(0)], name=f"n{number:02}")
    with pytest.raises(ConfigurationError, match=r"has 13 sequences; add #SEQUENCE, one of 'n00'.* and 3 more"):
        opened(root)


@pytest.mark.parametrize(
    "option",
    [
        {"ego_csv": Path("log.csv")},
        {"intrinsics": CameraIntrinsics(60.0, 60.0, 32.0, 24.0)},
        {"mount": CameraMount(1.5, 0.0, 0.0)},
    ],
)
def test_what_the_set_knows_itself_cant_be_given(root, option) -> None:
    with pytest.raises(ConfigurationError, match="leave ego_csv, intrinsics and mount out"):
        opened(root, **option)


def test_nothing_there(tmp_path) -> None:
    with pytest.raises(SourceError, match=r"holds no Waymo segment.*waymo.com/open"):
        sequences(tmp_path)
    with pytest.raises(SourceError, match=r"no such file or folder: .*waymo.com/open"):
        opened(tmp_path / "elsewhere")
    film = tmp_path / "film.mp4"
    film.touch()
    with pytest.raises(SourceError, match=r"film.mp4 is no file of the Waymo Open Dataset"):
        opened(film)


def test_pyarrow_missing(root, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ConfigurationError, match=r"needs pyarrow; install it with: pip install 'cable-rpc\[study\]'"):
        opened(root)


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the real tables of waymo-v2 in ../shared/data/formats")
def test_real_poses_slow_to_a_stop() -> None:
    """The set's own test file: text camera names, float32 poses, a car that stops at a crossing."""
    path = next((SHARED / "vehicle_pose").glob("*.parquet"))
    motion = read_motion(path, BadFrames())
    rows = parquet.read_table(path).to_pydict()
    times_s = np.array(rows["key.frame_timestamp_micros"]) / 1e6
    poses = np.array(rows["[VehiclePoseComponent].world_from_vehicle.transform"], np.float64).reshape(-1, 4, 4)
    distance_m = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum()
    egos = [motion[time] for time in sorted(motion)]
    assert len(egos) == 199
    assert egos[0].speed_mps == pytest.approx(1.9, abs=0.3)
    assert abs(egos[-1].speed_mps) < 0.05
    assert max(abs(ego.lateral_mps) for ego in egos) < 0.3
    travelled_m = np.trapezoid([ego.speed_mps for ego in egos], np.sort(times_s))
    assert travelled_m == pytest.approx(distance_m, rel=0.05)
    with pytest.raises(SourceError, match="camera_image is missing; there is vehicle_pose of version 2 only"):
        sequences(SHARED)
