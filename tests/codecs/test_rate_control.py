"""A stream of still images keeps its bit rate: on real clips through a real encoder, and on made-up content."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from cable_codecs.errors import CodecError
from cable_codecs.rate_control import JPEG_CURVE, WEBP_CURVE, QualityCurve, StillRateController
from hypothesis import given, settings
from hypothesis import strategies as st

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
CLIPS = {
    "urban-540p": ("urban-540p/traffic.mp4", 30.0, (1500, 2500, 4400)),
    "highway-540p": ("highway-540p/solidWhiteRight.mp4", 25.0, (1250, 2100, 3600)),
    "kitti-tracking-0002": ("kitti-tracking-0002/training/image_02", 10.0, (1100, 1900, 3000)),
}


def read_clip(name: str, count: int) -> list[np.ndarray]:
    path = DATA / CLIPS[name][0]
    if not path.exists():
        pytest.skip(f"no {path.name} in ../shared/data")
    if path.is_dir():
        return [cv2.imread(str(file)) for file in sorted(path.rglob("*.*"))[:count]]
    capture = cv2.VideoCapture(str(path))
    images = []
    while len(images) < count:
        found, image = capture.read()
        if not found:
            break
        images.append(image)
    return images


def masked_stream(images: list[np.ndarray]) -> Iterator[tuple[np.ndarray, int, bool]]:
    """Image, pixels kept, whether whole: every 20th frame whole, the region jumping every 7 frames."""
    rng = np.random.default_rng(1)
    height, width = images[0].shape[:2]
    top, bottom, left, right = height // 3, height * 3 // 4, width // 4, width * 3 // 4
    for index, image in enumerate(images):
        if index % 7 == 3:
            tall, wide = int(rng.uniform(0.3, 0.9) * height), int(rng.uniform(0.15, 0.9) * width)
            top, left = int(rng.integers(height - tall)) // 8 * 8, int(rng.integers(width - wide)) // 8 * 8
            bottom, right = top + tall // 8 * 8, left + wide // 8 * 8
        if index % 20 == 0:
            yield image, height * width, True
            continue
        masked = np.zeros_like(image)
        masked[top:bottom, left:right] = image[top:bottom, left:right]
        yield masked, (bottom - top) * (right - left), False


def jpeg_size(image: np.ndarray, quality: int) -> int:
    return len(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1])


def webp_size(image: np.ndarray, quality: int) -> int:
    return len(cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1])


def worst_window(sizes: list[int], frame_rate: float, target_kbps: float) -> float:
    """Largest share by which the rate over 2 s is off the target; over all frames where there are fewer."""
    count = min(len(sizes), round(2 * frame_rate))
    wanted = target_kbps * 125 / frame_rate * count
    return max(abs(sum(sizes[first : first + count]) / wanted - 1) for first in range(len(sizes) - count + 1))


def code_stream(
    stream: list[tuple[np.ndarray, int, bool]], controller: StillRateController, size: Callable[[np.ndarray, int], int]
) -> list[int]:
    sizes = []
    for image, pixels, whole in stream:
        sizes.append(size(image, controller.quality_for(pixels, whole=whole)))
        controller.coded(sizes[-1])
    return sizes


@pytest.mark.parametrize("clip", CLIPS)
def test_real_clips_with_jumping_regions(clip):
    _, frame_rate, targets = CLIPS[clip]
    stream = list(masked_stream(read_clip(clip, 75)))
    for target in targets:
        controller = StillRateController(target, frame_rate, frame_pixels=stream[0][0].size // 3)
        sizes = code_stream(stream, controller, jpeg_size)
        assert worst_window(sizes, frame_rate, target) <= 0.1
        status = controller.status
        assert status.frames == len(stream)
        assert status.mean_kbps == pytest.approx(sum(sizes) * frame_rate / 125 / len(sizes))
        assert status.largest_overshoot == pytest.approx(max(sizes) / (target * 125 / frame_rate) - 1)
        assert status.largest_overshoot < 1.5


def test_coding_again_bounds_the_largest_frame():
    stream = list(masked_stream(read_clip("highway-540p", 75)))
    controller = StillRateController(2100, 25, frame_pixels=stream[0][0].size // 3)
    sizes, trials = [], 0
    for image, pixels, whole in stream:
        quality: int | None = controller.quality_for(pixels, whole=whole)
        while quality is not None:
            size, before = jpeg_size(image, quality), quality
            quality = controller.retry_quality(size)
            assert quality is None or quality < before
            trials += 1
        sizes.append(size)
        controller.coded(size)
    assert controller.status.largest_overshoot <= 0.6
    assert trials <= len(stream) + 5
    assert worst_window(sizes, 25, 2100) <= 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clip", "targets"),
    [
        ("urban-540p", (1500, 1900, 2400)),
        ("highway-540p", (800, 1000, 1300)),
        ("kitti-tracking-0002", (1000, 1500, 2200)),
    ],
)
def test_webp_on_real_clips(clip, targets):
    frame_rate = CLIPS[clip][1]
    stream = list(masked_stream(read_clip(clip, 75)))
    for target in targets:
        controller = StillRateController(target, frame_rate, frame_pixels=stream[0][0].size // 3, curve=WEBP_CURVE)
        sizes = code_stream(stream, controller, webp_size)
        assert worst_window(sizes, frame_rate, target) <= 0.1


def test_targets_out_of_reach_are_reported():
    stream = list(masked_stream(read_clip("highway-540p", 30)))
    pixels = stream[0][0].size // 3
    starved = StillRateController(50, 25, frame_pixels=pixels, lowest_quality=20)
    code_stream(stream, starved, jpeg_size)
    assert starved.status.limit == "floor"
    assert starved.status.frames_at_floor >= 29
    assert starved.status.mean_kbps > 100
    rich = StillRateController(80_000, 25, frame_pixels=pixels, highest_quality=60)
    code_stream(stream, rich, jpeg_size)
    assert rich.status.limit == "ceiling"
    assert rich.status.frames_at_ceiling == 30
    # Neither debt nor credit from that time spoils what comes after.
    for controller in (starved, rich):
        controller.retarget(1500)
        sizes = code_stream(stream * 4, controller, jpeg_size)
        assert worst_window(sizes[25:], 25, 1500) <= 0.1


@dataclass
class MadeUpCodec:
    """Bytes after another law than the controller's: a fixed part, another slope, and detail that wanders."""

    seed: int
    slope: float
    wander: float
    density: float

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.detail = math.log(self.density)

    def size(self, pixels: float, quality: int) -> int:
        self.detail += float(self.rng.uniform(-self.wander, self.wander))
        return 300 + round(math.exp(self.detail + self.slope * JPEG_CURVE.at(quality)) * pixels)


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 1000),
    slope=st.floats(0.8, 1.2),
    wander=st.floats(0, 0.08),
    density=st.floats(0.04, 0.12),
    frame_rate=st.sampled_from([10.0, 15.0, 25.0, 30.0]),
)
def test_made_up_content(seed, slope, wander, density, frame_rate):
    rng = np.random.default_rng(seed)
    codec = MadeUpCodec(seed, slope, wander, density)
    target = 500_000 * 0.3 * density * frame_rate / 125
    controller = StillRateController(target, frame_rate, frame_pixels=500_000, lowest_quality=1, highest_quality=100)
    sizes, pixels = [], 200_000.0
    for index in range(round(6 * frame_rate)):
        if index % 9 == 4:
            pixels = rng.uniform(90_000, 400_000)
        whole = index % 50 == 0
        area = 500_000 if whole else pixels
        sizes.append(codec.size(area, controller.quality_for(area, whole=whole)))
        controller.coded(sizes[-1])
    settled = sizes[round(frame_rate) :]
    status = controller.status
    if not status.frames_at_floor and not status.frames_at_ceiling:
        assert worst_window(settled, frame_rate, target) <= 0.1


@settings(max_examples=100, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 10_000_000), min_size=1, max_size=60),
    pixels=st.integers(0, 1000),
    low=st.integers(1, 100),
    high=st.integers(1, 100),
)
def test_any_history_gives_the_same_quality_in_range(sizes, pixels, low, high):
    low, high = min(low, high), max(low, high)
    twins = [StillRateController(100, 10, frame_pixels=1000, lowest_quality=low, highest_quality=high) for _ in "ab"]
    for index, size in enumerate(sizes):
        first, second = (twin.quality_for(pixels, whole=index % 3 == 0) for twin in twins)
        assert first == second
        assert low <= first <= high
        for twin in twins:
            twin.coded(size)
    assert twins[0].status == twins[1].status


@settings(max_examples=100, deadline=None)
@given(size=st.integers(200, 50_000), more=st.integers(1, 100_000))
def test_more_bytes_never_raise_the_quality(size, more):
    qualities = []
    for spent in (size, size + more):
        controller = StillRateController(1000, 10, frame_pixels=500_000)
        for _ in range(3):
            controller.quality_for(200_000)
            controller.coded(spent)
        qualities.append(controller.quality_for(200_000))
    assert qualities[1] <= qualities[0]


def test_curve_there_and_back():
    for curve in (JPEG_CURVE, WEBP_CURVE):
        for quality in range(1, 101):
            assert curve.quality_of(curve.at(quality)) == pytest.approx(quality)
        assert curve.at(50) == 0


def test_dropped_frame_leaves_no_trace():
    first, second = (StillRateController(1000, 10, frame_pixels=1000) for _ in "ab")
    for controller in (first, second):
        controller.quality_for(500)
        controller.coded(9000)
    assert first.quality_for(700) == second.quality_for(700)
    second.quality_for(700)
    first.coded(11_000)
    second.coded(11_000)
    assert first.status == second.status


def test_misuse():
    with pytest.raises(CodecError, match="target_kbps"):
        StillRateController(0, 10, frame_pixels=100)
    with pytest.raises(CodecError, match="frame_rate"):
        StillRateController(100, math.nan, frame_pixels=100)
    with pytest.raises(CodecError, match="lowest"):
        StillRateController(100, 10, frame_pixels=100, lowest_quality=80, highest_quality=60)
    with pytest.raises(CodecError, match="rising"):
        QualityCurve((1, 1), (0.0, 1.0))
    controller = StillRateController(100, 10, frame_pixels=100)
    with pytest.raises(CodecError, match="quality_for"):
        controller.coded(10)
    with pytest.raises(CodecError, match=r"0\.\.100"):
        controller.quality_for(101)
    controller.quality_for(100)
    with pytest.raises(CodecError, match="1 byte"):
        controller.coded(0)
