"""Waymo version 1: records encoded here octet by octet, after the protocol buffers' wire format."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.source import SourceOptions
from cable_rpc.data.waymo import open_waymo, sequences
from cable_rpc.data.waymo.crc32c import crc32c
from cable_rpc.errors import SourceError

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "formats" / "waymo-v1"
START_US = 1_550_000_000_000_000
STEP_US = 100_000
WIDTH, HEIGHT = 64, 48
FRONT, FRONT_LEFT = 1, 2
SPEED_MPS = 8.0


def bitwise_crc32c(data: bytes) -> int:
    """RFC 3720 appendix B.4, a bit at a time."""
    register = 0xFFFFFFFF
    for octet in data:
        register ^= octet
        for _ in range(8):
            register = register >> 1 ^ (0x82F63B78 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def masked(data: bytes) -> bytes:
    value = bitwise_crc32c(data)
    return struct.pack("<I", ((value >> 15 | value << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def record(data: bytes) -> bytes:
    length = struct.pack("<Q", len(data))
    return length + masked(length) + data + masked(data)


def varint(value: int) -> bytes:
    octets = bytearray()
    while value > 0x7F:
        octets.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*octets, value])


def field(number: int, value: int | float | bytes, *, single: bool = False) -> bytes:
    """A varint, a double (or float), or a delimited field."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    if isinstance(value, bytes):
        return varint(number << 3 | 2) + varint(len(value)) + value
    return varint(number << 3 | (5 if single else 1)) + struct.pack("<f" if single else "<d", value)


def doubles(number: int, values, *, packed: bool = False) -> bytes:
    if packed:
        return field(number, struct.pack(f"<{len(values)}d", *values))
    return b"".join(field(number, float(value)) for value in values)


def pose_on_plane(x: float, y: float, heading: float) -> list[float]:
    c, s = math.cos(heading), math.sin(heading)
    return [c, -s, 0, x, s, c, 0, y, 0, 0, 1, 0, 0, 0, 0, 1]


def jpeg(shade: int) -> bytes:
    return cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), shade, np.uint8))[1].tobytes()


def camera_calibration(camera: int, packed: bool) -> bytes:
    intrinsic = doubles(2, [60, 61, 32, 24, 0, 0, 0, 0, 0], packed=packed)
    extrinsic = field(3, doubles(1, np.eye(4).ravel(), packed=packed))
    return field(2, field(1, camera) + intrinsic + extrinsic + field(4, WIDTH) + field(5, HEIGHT))


def camera_image(camera: int, data: bytes, pose, velocity, packed: bool) -> bytes:
    message = field(1, camera) + field(2, data) + field(3, doubles(1, pose, packed=packed))
    if velocity is not None:
        linear = b"".join(field(axis + 1, float(value), single=True) for axis, value in enumerate(velocity[:3]))
        message += field(4, linear + b"".join(field(axis + 4, float(velocity[axis + 3])) for axis in range(3)))
    return field(4, message)


def label(object_id: str, kind: int, centre, along_x: float, along_y: float, difficulty: int = 0) -> bytes:
    box = field(1, float(centre[0])) + field(2, float(centre[1])) + field(4, float(along_y)) + field(5, float(along_x))
    return field(2, field(1, box) + field(3, kind) + field(4, object_id.encode()) + field(5, difficulty))


def frame(
    step: int,
    *,
    pose=None,
    image_pose=None,
    velocity=(0.0,) * 6,
    labels: bytes = b"",
    data: bytes | None = None,
    packed: bool = False,
) -> bytes:
    """A Frame with images of two cameras, FRONT_LEFT before FRONT, and fields that nobody here reads."""
    pose = pose_on_plane(0, 0, 0) if pose is None else pose
    context = field(1, b"segment") + camera_calibration(FRONT_LEFT, packed) + camera_calibration(FRONT, packed)
    at_image = pose if image_pose is None else image_pose
    images = camera_image(FRONT_LEFT, jpeg(200), at_image, velocity, packed)
    images += camera_image(FRONT, jpeg(20 + 10 * step) if data is None else data, at_image, velocity, packed)
    unread = field(5, b"\x00" * 40) + field(99, 7) + field(98, 1.5) + field(97, 1.5, single=True)
    head = field(1, context) + field(2, START_US + step * STEP_US)
    return head + unread + field(3, doubles(1, pose, packed=packed)) + images + labels


def write(root: Path, *frames: bytes) -> Path:
    path = root / "segment-one_with_camera_labels.tfrecord"
    path.write_bytes(b"".join(map(record, frames)))
    return path


def opened(root: Path, query: str = "", **options):
    return open_waymo(f"{root}{query}", SourceOptions(**options))


def shades(frames) -> list[int]:
    return [round(float(frame.image.mean()) / 10) * 10 for frame in frames]


def told(ego) -> tuple[float, float, float]:
    return ego.speed_mps, ego.lateral_mps, ego.yaw_rate_radps


@pytest.mark.parametrize("packed", [False, True])
def test_motion_boxes_and_image_of_a_record(tmp_path, packed) -> None:
    heading = math.radians(60)
    ahead, right = (math.cos(heading), math.sin(heading)), (math.sin(heading), -math.cos(heading))
    velocity = [SPEED_MPS * ahead[0] + 0.5 * right[0], SPEED_MPS * ahead[1] + 0.5 * right[1], 0.1, 0.0, 0.0, 0.2]
    rows = label("a", 1, (30, 20), 10, 4, 1) + label("b", 2, (50, 46), 2, 8, 2) + label("c", 3, (9, 9), 4, 4)
    other = field(8, field(1, FRONT_LEFT) + label("d", 4, (9, 9), 4, 4))
    labels = other + field(8, field(1, FRONT) + rows)
    at_image = pose_on_plane(7, 7, heading)
    write(tmp_path, frame(3, image_pose=at_image, velocity=velocity, labels=labels, packed=packed))
    assert sequences(tmp_path) == ["one"]
    (read,) = opened(tmp_path)
    assert shades([read]) == [50]
    assert told(read.ego) == pytest.approx((SPEED_MPS, 0.5, 0.2), abs=1e-6)
    assert read.capture_time_ns == (START_US + 3 * STEP_US) * 1000
    assert read.truth.boxes_xyxy.tolist() == [[25, 18, 35, 22], [49, 42, 51, 48]]
    assert read.truth.class_ids.tolist() == [2, 0]
    assert read.truth.visibility.tolist() == [1.0, 0.5]
    (aside,) = opened(tmp_path, "?camera=FRONT_LEFT")
    assert shades([aside]) == [200]
    assert aside.truth.class_ids.tolist() == [1]


def test_no_labels_at_all_and_none_of_this_camera(tmp_path) -> None:
    write(tmp_path, frame(0), frame(1, labels=field(8, field(1, FRONT_LEFT))))
    first, second = opened(tmp_path)
    assert first.truth is None
    assert len(second.truth) == 0


def circle_to_the_left(time_s: float) -> list[float]:
    angle, radius = SPEED_MPS * time_s / 20.0, 20.0
    return pose_on_plane(radius * math.sin(angle), radius * (1 - math.cos(angle)), angle)


def drift_to_the_right(time_s: float) -> list[float]:
    return pose_on_plane(SPEED_MPS * time_s, -0.5 * time_s, 0.0)


@pytest.mark.parametrize(
    ("drive", "motion"),
    [(circle_to_the_left, (SPEED_MPS, 0.0, 0.4)), (drift_to_the_right, (SPEED_MPS, 0.5, 0.0))],
)
def test_poses_tell_the_motion_where_no_velocity_is_stored(tmp_path, drive, motion) -> None:
    write(tmp_path, *(frame(step, pose=drive(step * 0.1), velocity=None) for step in range(4)))
    source = opened(tmp_path)
    for read in source:
        assert told(read.ego) == pytest.approx(motion, abs=1e-9)
    (alone,) = opened(tmp_path, max_frames=1)
    assert told(alone.ego) == pytest.approx(motion, abs=1e-9)
    write(tmp_path, frame(0, velocity=None))
    (single,) = opened(tmp_path)
    assert single.ego is None


def test_damaged_pose_costs_its_frame_only(tmp_path) -> None:
    poses = [drift_to_the_right(step * 0.1) for step in range(4)]
    poses[1] = [math.inf, *poses[1][1:]]
    write(tmp_path, *(frame(step, pose=pose, velocity=None) for step, pose in enumerate(poses)))
    with pytest.raises(SourceError, match="record 2: the pose is inf, "):
        list(opened(tmp_path))
    frames = list(opened(tmp_path, bad_frames=BadFrames(skip=True)))
    assert shades(frames) == [20, 40, 50]
    assert told(frames[1].ego) == pytest.approx((SPEED_MPS, 0.5, 0.0))


def damaged_at(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("place", "message", "left"),
    [
        ("length", "record 2 at byte {start} and what follows .* checksum of its length is wrong", [20]),
        ("length checksum", "record 2 at byte {start} and what follows .* checksum of its length is wrong", [20]),
        ("data", "record 2: the checksum of its data is wrong", [20, 40]),
        ("data checksum", "record 2: the checksum of its data is wrong", [20, 40]),
        ("cut in data", "record 3 is cut off: {length} bytes, {there} are there", [20, 30]),
        ("cut in head", "record 3 at byte {third} and what follows .* the file ends in it", [20, 30]),
    ],
)
def test_damaged_file(tmp_path, place, message, left) -> None:
    frames = [frame(step) for step in range(3)]
    path = write(tmp_path, *frames)
    start = len(record(frames[0]))
    third = start + len(record(frames[1]))
    known = {"start": start, "third": third, "length": len(frames[2]), "there": len(frames[2]) - 96}
    if place == "cut in data":
        path.write_bytes(path.read_bytes()[:-100])
    elif place == "cut in head":
        path.write_bytes(path.read_bytes()[: third + 7])
    else:
        offset = {"length": 1, "length checksum": 9, "data": len(frames[1]) // 2, "data checksum": third - start - 1}
        damaged_at(path, start + offset[place])
    with pytest.raises(SourceError, match=f"{path.name} {message.format(**known)}"):
        list(opened(tmp_path))
    bad = BadFrames(skip=True)
    frames_left = list(opened(tmp_path, bad_frames=bad))
    assert shades(frames_left) == left
    assert [read.index for read in frames_left] == list(range(len(left)))
    assert len(bad.skipped) == 1


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (frame(1, data=jpeg(30)[:-40]), "record 2, camera FRONT: the image is cut off"),
        (frame(1, data=b"no picture"), "record 2, camera FRONT: the image is cut off or no JPEG"),
        (b"\xff" * 60, "record 2 is no Waymo Frame: a number in it has no end"),
        (b"\x0f" * 60, "record 2 is no Waymo Frame: a field of wire type 7"),
        (frame(1)[:-3], "record 2 is no Waymo Frame"),
        (b"\x0a\xff\x01one", "record 2 is no Waymo Frame: field 1 is longer than the record"),
        (field(1, b"segment"), "record 2 is no Waymo Frame: it has no time stamp"),
        (frame(0), f"record 2: its time stamp of {START_US} us doesn't rise above that of record 1"),
        (field(1, b"") + field(2, START_US + STEP_US), "record 2 has no image of camera FRONT"),
        (frame(1, velocity=[math.nan] * 6), r"record 2: the velocity is \[nan, "),
        (frame(1, velocity=[1.0] * 6, pose=[2.0] * 16), "record 2: the pose is no rigid transform"),
    ],
)
def test_sound_record_of_a_damaged_frame(tmp_path, second, message) -> None:
    path = write(tmp_path, frame(0), second, frame(2))
    with pytest.raises(SourceError, match=f"{path.name} {message}"):
        list(opened(tmp_path))
    frames = list(opened(tmp_path, bad_frames=BadFrames(skip=True)))
    assert shades(frames) == [20, 40]
    assert [read.index for read in frames] == [0, 1]


def test_damaged_label(tmp_path) -> None:
    labels = field(8, field(1, FRONT) + label("a", 1, (30, 20), 10, 4) + label("b", 9, (30, 20), 10, 4))
    write(tmp_path, frame(0, labels=labels))
    with pytest.raises(SourceError, match="record 1, label 2 of FRONT: type is 9"):
        list(opened(tmp_path))
    (read,) = opened(tmp_path, bad_frames=BadFrames(skip=True))
    assert read.truth.class_ids.tolist() == [2]


@pytest.mark.parametrize("skip", [False, True])
def test_file_without_frames_or_camera(tmp_path, skip) -> None:
    bad = BadFrames(skip=skip)
    write(tmp_path, frame(0))
    with pytest.raises(SourceError, match="record 1 has no calibration of camera SIDE_RIGHT"):
        opened(tmp_path, "?camera=SIDE_RIGHT", bad_frames=bad)
    write(tmp_path)
    with pytest.raises(SourceError, match="holds no frame"):
        opened(tmp_path, bad_frames=bad)


@settings(max_examples=60, deadline=None)
@given(st.one_of(st.binary(max_size=80), st.binary(min_size=500, max_size=2500)))
def test_checksum_is_that_of_the_literal_loop(data) -> None:
    assert crc32c(data) == bitwise_crc32c(data)


@pytest.mark.parametrize(
    ("data", "checksum"),
    [
        (bytes(32), 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
        (bytes(range(31, -1, -1)), 0x113FDB5C),
        (b"123456789", 0xE3069283),
    ],
)
def test_checksums_of_rfc_3720(data, checksum) -> None:
    assert crc32c(data) == checksum


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the real records of waymo-v1 in ../shared/data/formats")
def test_real_record() -> None:
    (read,) = open_waymo(f"{SHARED}#pvps_data_one_frame", SourceOptions())
    assert read.image.shape == (1280, 1920, 3)
    assert len(read.truth) == 13
    # The crossing pedestrian, as seen when drawn: centre (355.6, 936.0), 231.2 wide and 464.2 high.
    assert read.truth.boxes_xyxy[0] == pytest.approx(
        [355.6 - 115.6, 936.0 - 232.1, 355.6 + 115.6, 936.0 + 232.1], abs=0.2
    )
    assert told(read.ego) == pytest.approx((0, 0, 0), abs=0.02)
    assert (read.mount.height_m, read.mount.forward_m) == pytest.approx((2.12, 1.54), abs=0.01)
    (aside,) = open_waymo(f"{SHARED}#pvps_data_one_frame?camera=SIDE_LEFT", SourceOptions())
    assert aside.image.shape == (886, 1920, 3)
    assert aside.mount is None


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the real records of waymo-v1 in ../shared/data/formats")
def test_real_record_without_images() -> None:
    with pytest.raises(SourceError, match=r"val_labels_only.tfrecord record 1 has no image of camera FRONT"):
        list(open_waymo(f"{SHARED}#val_labels_only", SourceOptions()))
