"""Video files and image folders as frame sources: colour, time, size, thinning, damage."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from cable_rpc.data.source import open_source
from cable_rpc.errors import ConfigurationError, SourceError
from cable_rpc.types import CameraIntrinsics

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"

COEFFICIENTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
"""Matrix code of ITU-T H.273 to (Kr, Kb)."""


def write_video(path, planes, *, codec="libx264", rate=Fraction(25), tags=(6, 1), options=None):
    """Encode I420 arrays uint8 [height * 3 / 2, width], losslessly unless told otherwise."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        height, width = planes[0].shape[0] * 2 // 3, planes[0].shape[1]
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.colorspace, stream.codec_context.color_range = tags
        stream.options = {"qp": "0", "preset": "ultrafast", **(options or {})}
        for plane in planes:
            frame = av.VideoFrame.from_ndarray(plane, format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def numbered(count, width=64, height=48):
    """Flat frames whose luma tells their number."""
    planes = [np.full((height * 3 // 2, width), 128, np.uint8) for _ in range(count)]
    for number, plane in enumerate(planes):
        plane[:height] = 16 + 2 * number
    return planes


def number_of(frame):
    return round((float(frame.image.mean()) * 219 / 255) / 2)


def colour_planes(matrix, full):
    """A BGR test card, and its I420 by the defining equations."""
    bgr = np.random.default_rng(matrix).integers(0, 256, (6, 8, 3)).repeat(8, 0).repeat(8, 1).astype(float)
    kr, kb = COEFFICIENTS[matrix]
    blue, green, red = bgr[..., 0], bgr[..., 1], bgr[..., 2]
    luma = kr * red + (1 - kr - kb) * green + kb * blue
    cb, cr = (blue - luma) / (2 * (1 - kb)), (red - luma) / (2 * (1 - kr))
    if not full:
        luma, cb, cr = 16 + luma * 219 / 255, cb * 224 / 255, cr * 224 / 255
    height, width = luma.shape
    chroma = [(128 + c)[::2, ::2].reshape(height // 4, width) for c in (cb, cr)]
    return bgr, np.clip(np.rint(np.concatenate([luma, *chroma])), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("matrix", [1, 5, 6, 9])
@pytest.mark.parametrize("full", [False, True])
def test_colours_follow_the_files_tags(tmp_path, matrix, full):
    bgr, planes = colour_planes(matrix, full)
    path = write_video(tmp_path / "card.mkv", [planes] * 2, tags=(matrix, 2 if full else 1))
    error = next(iter(open_source(f"video:{path}"))).image - bgr
    assert abs(error.mean()) < 0.4
    assert np.abs(error).max() <= 2


@pytest.mark.parametrize(("size", "matrix"), [((1280, 720), 1), ((64, 48), 5)])
def test_untagged_colours_go_by_size(tmp_path, size, matrix):
    bgr, small = colour_planes(matrix, full=False)
    width, height = size
    y = cv2.resize(small[:48], size, interpolation=cv2.INTER_NEAREST)
    chroma = [
        cv2.resize(plane, (width // 2, height // 2), interpolation=cv2.INTER_NEAREST).reshape(-1, width)
        for plane in (small[48:60].reshape(24, 32), small[60:].reshape(24, 32))
    ]
    path = write_video(tmp_path / "plain.mkv", [np.concatenate([y, *chroma])], tags=(2, 0))
    image = next(iter(open_source(f"video:{path}"))).image
    expected = cv2.resize(bgr, size, interpolation=cv2.INTER_NEAREST)
    assert np.median(np.abs(image - expected)) <= 1


def test_b_frames_come_in_display_order(tmp_path):
    path = write_video(tmp_path / "b.mp4", numbered(30), options={"bf": "3", "b_strategy": "0", "qp": "10"})
    with av.open(str(path)) as container:
        assert any(frame.pict_type == av.video.frame.PictureType.B for frame in container.decode(video=0))
    source = open_source(f"video:{path}")
    frames = list(source)
    assert [number_of(frame) for frame in frames] == list(range(30))
    assert [frame.index for frame in frames] == list(range(30))
    assert [frame.capture_time_ns for frame in frames] == [k * 40_000_000 for k in range(30)]
    assert (source.fps, source.size_wh, source.frame_count, source.name) == (25.0, (64, 48), 30, "b")
    assert len(list(source)) == 30


def test_ntsc_rate(tmp_path):
    path = write_video(tmp_path / "ntsc.mp4", numbered(12), rate=Fraction(30000, 1001))
    source = open_source(f"video:{path}")
    assert source.fps == pytest.approx(29.97, abs=0.001)
    times = [frame.capture_time_ns for frame in source]
    assert times == pytest.approx([k * 1001 / 30000 * 1e9 for k in range(12)], abs=1)


@pytest.mark.parametrize("size", [(65, 49), (63, 48), (64, 47)])
def test_odd_sizes(tmp_path, size):
    width, height = size
    picture = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    path = tmp_path / "odd.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = width, height, "bgr0"
        for _ in range(2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    source = open_source(f"video:{path}")
    assert source.size_wh == size
    assert np.array_equal(next(iter(source)).image, picture)


@pytest.mark.parametrize("size", [(65, 49), (63, 48)])
def test_odd_sizes_with_halved_chroma(tmp_path, size):
    width, height = size
    grey = av.VideoFrame(width, height, "yuv420p")
    for plane, level in zip(grey.planes, (126, 128, 128), strict=True):
        plane.update(bytes([level]) * plane.buffer_size)
    path = tmp_path / "odd.webm"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libvpx-vp9", rate=10)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"lossless": "1", "cpu-used": "8"}
        container.mux(stream.encode(grey))
        container.mux(stream.encode(None))
    image = next(iter(open_source(f"video:{path}"))).image
    assert image.shape == (height, width, 3)
    assert np.abs(image.astype(int) - round(110 * 255 / 219)).max() <= 1


def test_thinning_keeps_true_times(tmp_path):
    path = write_video(tmp_path / "fast.mp4", numbered(30), rate=Fraction(30))
    source = open_source(f"video:{path}", fps=10)
    frames = list(source)
    assert [number_of(frame) for frame in frames] == list(range(0, 30, 3))
    assert [frame.index for frame in frames] == list(range(10))
    assert frames[3].capture_time_ns == pytest.approx(300e6, abs=1)
    assert (source.fps, source.frame_count) == (10, 10)
    uneven = [number_of(frame) for frame in open_source(f"video:{path}", fps=12)]
    assert len(uneven) == 12
    assert set(np.diff(uneven)) == {2, 3}
    assert len(list(open_source(f"video:{path}", fps=60))) == 30


def test_thinning_an_ntsc_file_drifts_nowhere(tmp_path):
    path = write_video(tmp_path / "ntsc.mp4", numbered(90), rate=Fraction(30000, 1001))
    times = [frame.capture_time_ns / 1e9 for frame in open_source(f"video:{path}", fps=10)]
    assert len(times) == 30
    assert np.abs(np.array(times) - np.arange(30) / 10).max() < 0.034


def test_size_scales_the_camera(tmp_path):
    path = write_video(tmp_path / "big.mp4", numbered(3))
    source = open_source(f"video:{path}", size=(32, 12), intrinsics=CameraIntrinsics(100, 100, 32, 24))
    frame = next(iter(source))
    assert source.size_wh == (32, 12)
    assert source.intrinsics == frame.intrinsics
    assert frame.image.shape == (12, 32, 3)
    assert frame.intrinsics == CameraIntrinsics(50, 25, 16, 6)


def test_max_frames(tmp_path):
    path = write_video(tmp_path / "long.mp4", numbered(9))
    source = open_source(f"video:{path}", max_frames=4)
    assert source.frame_count == 4
    assert len(list(source)) == 4


def test_ego_motion_comes_along(tmp_path):
    path = write_video(tmp_path / "drive.mp4", numbered(6))
    by_frame = tmp_path / "frames.csv"
    by_frame.write_text(
        "frame,speed_mps,yaw_rate_radps\n" + "".join(f"{k},{k},0\n" for k in range(6)), encoding="utf-8"
    )
    speeds = [f.ego.speed_mps for f in open_source(f"video:{path}", ego_csv=by_frame, fps=12.5)]
    assert speeds == [0, 2, 4]
    by_time = tmp_path / "times.csv"
    by_time.write_text("time_s,speed_mps,yaw_rate_radps\n0,0,0\n0.2,10,0\n", encoding="utf-8")
    speeds = [f.ego.speed_mps for f in open_source(f"video:{path}", ego_csv=by_time)]
    assert speeds == pytest.approx([0, 2, 4, 6, 8, 10])


def test_display_rotation(tmp_path):
    planes = numbered(1)
    planes[0][:48] = 16
    planes[0][:8, :16] = 235
    path = write_video(tmp_path / "phone.mp4", planes)
    data = path.read_bytes()
    one, minus_one = (1 << 16).to_bytes(4, "big"), (-1 << 16).to_bytes(4, "big", signed=True)
    zero, unit = bytes(4), (1 << 30).to_bytes(4, "big")
    upright = one + zero * 3 + one + zero * 3 + unit
    clockwise = zero + one + zero + minus_one + zero * 4 + unit
    track = data.index(b"tkhd")
    place = data.index(upright, track)
    path.write_bytes(data[:place] + clockwise + data[place + len(upright) :])
    source = open_source(f"video:{path}")
    image = next(iter(source)).image
    assert source.size_wh == (48, 64)
    assert image[:16, 40:].min() > 200
    assert image[:, :40].max() < 50


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(SourceError, match="no such video file"):
        open_source(f"video:{tmp_path / 'none.mp4'}")
    text = tmp_path / "text.mp4"
    text.write_text("this is no video", encoding="utf-8")
    with pytest.raises(SourceError, match=r"text\.mp4"):
        open_source(f"video:{text}")
    sound = tmp_path / "sound.wav"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        silence.sample_rate = 8000
        container.mux(stream.encode(silence))
        container.mux(stream.encode(None))
    with pytest.raises(SourceError, match="no video stream"):
        open_source(f"video:{sound}")


def test_truncated_file_gives_what_it_has(tmp_path):
    rng = np.random.default_rng(0)
    noise = [rng.integers(16, 235, (72, 64), dtype=np.uint8) for _ in range(20)]
    whole = write_video(tmp_path / "whole.mkv", noise, options={"g": "1"})
    data = whole.read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(data[: len(data) // 2])
    frames = list(open_source(f"video:{cut}"))
    assert 5 <= len(frames) <= 11
    complete = list(open_source(f"video:{whole}"))
    assert np.array_equal(frames[4].image, complete[4].image)
    stump = tmp_path / "stump.mkv"
    stump.write_bytes(data[: data.index(b"\x1f\x43\xb6\x75")])
    with pytest.raises(SourceError, match="stump"):
        open_source(f"video:{stump}")


def test_folder_of_images(tmp_path):
    pictures = {}
    for number in (36, 37, 38):
        pictures[number] = np.random.default_rng(number).integers(0, 256, (20, 30, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / f"{number:06d}.png"), pictures[number])
    log = tmp_path / "ego.csv"
    log.write_text("frame,speed_mps,yaw_rate_radps\n36,1,0\n38,3,0\n", encoding="utf-8")
    source = open_source(f"video:{tmp_path}", fps=5, ego_csv=log)
    frames = list(source)
    assert (source.fps, source.frame_count, source.size_wh) == (5, 3, (30, 20))
    assert [frame.capture_time_ns for frame in frames] == [0, 200_000_000, 400_000_000]
    assert all(np.array_equal(f.image, pictures[36 + k]) for k, f in enumerate(frames))
    assert [f.ego and f.ego.speed_mps for f in frames] == [1, None, 3]
    assert len(list(open_source(f"video:{tmp_path}", max_frames=2))) == 2
    (tmp_path / "000037.png").write_bytes(b"no image")
    with pytest.raises(SourceError, match=r"000037\.png"):
        list(source)


def test_folder_without_images(tmp_path):
    with pytest.raises(SourceError, match="no PNG or JPEG"):
        open_source(f"video:{tmp_path}")


@pytest.mark.parametrize("spec", ["webcam:0", "video", "video:", "clip.mp4", ""])
def test_unknown_scheme_lists_the_known(spec):
    with pytest.raises(ConfigurationError, match=r"synthetic:\.\.\., video:\.\.\."):
        open_source(spec)


def test_bare_file_name_gets_a_hint(tmp_path):
    path = tmp_path / "clip.mp4"
    path.touch()
    with pytest.raises(ConfigurationError, match=r"write 'video:.*clip\.mp4'"):
        open_source(str(path))


@pytest.mark.parametrize("options", [{"max_frames": 0}, {"size": (0, 10)}, {"fps": 0.0}, {"fps": float("nan")}])
def test_unusable_options(options):
    with pytest.raises(ConfigurationError, match=next(iter(options))):
        open_source("video:any.mp4", **options)


@pytest.mark.parametrize(
    ("name", "fps", "size"),
    [
        ("highway-540p/solidWhiteRight.mp4", 25.0, (960, 540)),
        ("scenes-360p/rainy.mp4", 30000 / 1001, (640, 360)),
    ],
)
def test_real_clip(name, fps, size):
    path = SHARED / name
    if not path.is_file():
        pytest.skip(f"shared clip {name} is not here")
    source = open_source(f"video:{path}", max_frames=10)
    frames = list(source)
    assert source.fps == pytest.approx(fps)
    assert (source.size_wh, len(frames)) == (size, 10)
    assert [f.capture_time_ns for f in frames] == pytest.approx([k / fps * 1e9 for k in range(10)], abs=1)
    assert all(20 < frame.image.mean() < 235 for frame in frames)


def test_frame_count_honours_edit_lists():
    path = SHARED / "scenes-360p/rainy.mp4"
    if not path.is_file():
        pytest.skip("shared clip scenes-360p/rainy.mp4 is not here")
    with av.open(str(path)) as container:
        assert container.streams.video[0].frames == 968
    source = open_source(f"video:{path}", size=(16, 9))
    assert source.frame_count == sum(1 for _ in source) == 959


def test_synthetic_source_takes_the_options():
    source = open_source("synthetic:7", max_frames=3, size=(320, 180), fps=5)
    assert (source.fps, source.size_wh, source.frame_count) == (5, (320, 180), 3)


@pytest.mark.parametrize("spec", ["synthetic:first", "synthetic:-1", "synthetic:1.5"])
def test_synthetic_seed_is_a_whole_number(spec):
    with pytest.raises(ConfigurationError, match="seed"):
        open_source(spec)


def test_synthetic_source_has_its_own_ego_motion(tmp_path):
    with pytest.raises(ConfigurationError, match="ego_csv"):
        open_source("synthetic:1", ego_csv=tmp_path / "ego.csv")
