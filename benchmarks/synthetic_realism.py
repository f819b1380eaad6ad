"""How near the rendered world is to photographs: detector recall and coded bytes per pixel."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
VEHICLES = (2, 5, 7)


def detect(session: Any, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels, boxes and scores of the DEIMv2 detector."""
    pixels = cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), (416, 416)).astype(np.float32) / 255.0
    size = np.array([[image.shape[1], image.shape[0]]], dtype=np.int64)
    labels, boxes, scores = session.run(
        ["labels", "boxes", "scores"], {"images": pixels.transpose(2, 0, 1)[None], "orig_target_sizes": size}
    )
    return labels[0], boxes[0], scores[0]


def overlap(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Intersection over union of one box with many."""
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=1)
    area = np.prod(box[2:] - box[:2]) + np.prod(others[:, 2:] - others[:, :2], axis=1) - shared
    return shared / np.maximum(area, 1e-9)


def recall(session: Any, seeds: Iterable[int], frames: Iterable[int]) -> dict[int, tuple[int, int]]:
    """Found and wanted large, well visible vehicles per seed."""
    result = {}
    for seed in seeds:
        source, found, wanted = SyntheticSource(SyntheticConfig(seed=seed)), 0, 0
        for index in frames:
            frame = source.frame(index)
            labels, boxes, scores = detect(session, frame.image)
            candidates = boxes[np.isin(labels, VEHICLES) & (scores >= 0.4)]
            truth = frame.truth
            for box, kind, seen in zip(truth.boxes_xyxy, truth.class_ids, truth.visibility, strict=True):
                if kind not in VEHICLES or box[3] - box[1] < 40 or seen < 0.7:
                    continue
                wanted += 1
                found += int(len(candidates) > 0 and overlap(box, candidates).max() >= 0.5)
        result[seed] = (found, wanted)
    return result


def bytes_per_pixel(frames: list[np.ndarray]) -> float:
    """Mean H.264 bytes per pixel and frame at CRF 28, veryfast, zerolatency, one thread."""
    height, width = frames[0].shape[0] // 2 * 2, frames[0].shape[1] // 2 * 2
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = width, height, "yuv420p"
    codec.time_base, codec.framerate = Fraction(1, 25), Fraction(25, 1)
    codec.color_range, codec.colorspace, codec.gop_size, codec.thread_count = 1, 6, 250, 1
    codec.options = {"preset": "veryfast", "tune": "zerolatency", "crf": "28"}
    codec.open()
    total = 0
    for image in frames:
        i420 = cv2.cvtColor(np.ascontiguousarray(image[:height, :width]), cv2.COLOR_BGR2YUV_I420)
        total += sum(packet.size for packet in codec.encode(av.VideoFrame.from_numpy_buffer(i420, format="yuv420p")))
    total += sum(packet.size for packet in codec.encode(None))
    return total / (len(frames) * height * width)


def read_video(path: Path, limit: int) -> list[np.ndarray]:
    """The first frames of a video, BGR."""
    frames = []
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            frames.append(frame.to_ndarray(format="bgr24"))
            if len(frames) == limit:
                break
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--frames", type=int, nargs="+", default=[5, 40, 75, 110])
    parser.add_argument("--clip-seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--clip-frames", type=int, default=60)
    parser.add_argument("--clip-fps", type=float, nargs="+", default=[10.0, 25.0])
    parser.add_argument("--shared", type=Path, default=SHARED)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.seeds:
        import onnxruntime

        settings = onnxruntime.SessionOptions()
        settings.intra_op_num_threads = 1
        model = options.shared / "weights/deimv2_hgnetv2_femto_coco/deimv2_hgnetv2_femto_coco.onnx"
        session = onnxruntime.InferenceSession(str(model), settings, providers=["CPUExecutionProvider"])
        rows = recall(session, range(options.seeds), options.frames)
        for seed, (found, wanted) in rows.items():
            print(f"seed {seed:3}: {found:3} of {wanted:3} vehicles found")
        found, wanted = (sum(row[part] for row in rows.values()) for part in (0, 1))
        print("vehicles >= 40 px high, >= 70 % visible; found at score >= 0.4, IoU >= 0.5:")
        print(f"recall {found}/{wanted} = {found / max(wanted, 1):.3f}")
    if not options.clip_seeds:
        return
    data, real = options.shared / "data", {}
    for name, path in (
        ("highway-720p 25 fps", data / "highway-720p/project_video_short.mp4"),
        ("urban-540p", data / "urban-540p/traffic.mp4"),
        ("highway-540p 25 fps", data / "highway-540p/solidWhiteRight.mp4"),
    ):
        if path.exists():
            real[name] = bytes_per_pixel(read_video(path, options.clip_frames))
    pictures = sorted((data / "kitti-tracking-0002").rglob("*.png"))[: options.clip_frames]
    if pictures:
        real["kitti-tracking-0002 10 fps"] = bytes_per_pixel([cv2.imread(str(path)) for path in pictures])
    for name, value in real.items():
        print(f"{name:34} {value:.5f} bytes per pixel and frame")
    if real:
        values = list(real.values())
        print(f"real: mean {np.mean(values):.5f}, geometric mean {np.exp(np.mean(np.log(values))):.5f}")
    for fps in options.clip_fps:
        rendered = []
        for seed in options.clip_seeds:
            source = SyntheticSource(SyntheticConfig(seed=seed, fps=fps, frame_count=options.clip_frames))
            rendered.append(bytes_per_pixel([frame.image for frame in source]))
            print(f"synthetic:{seed:<3} {fps:4.0f} fps               {rendered[-1]:.5f}")
        print(f"synthetic {fps:.0f} fps: median {np.median(rendered):.5f}")


if __name__ == "__main__":
    main()
