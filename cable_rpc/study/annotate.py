"""Drawing what was sent and what came back onto camera frames, and writing them as video."""

from __future__ import annotations

import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import cv2
import numpy as np
from av.container import OutputContainer
from av.video.stream import VideoStream

from cable_rpc.errors import ConfigurationError
from cable_rpc.types import CLASS_GROUPS, COCO_ROAD_USERS, BoolMask, Detections, GroundTruth, Image

Colour = tuple[int, int, int]

GROUP_COLOURS: dict[str, Colour] = {
    "vehicle": (255, 176, 64),
    "pedestrian": (72, 120, 255),
    "cyclist": (80, 220, 120),
}
"""BGR, by class group."""
OTHER_COLOUR: Colour = (200, 200, 200)
OUTLINE_COLOUR: Colour = (0, 214, 255)
MASK_COLOUR: Colour = (210, 60, 190)
TRUTH_COLOUR: Colour = (255, 255, 255)
STRIP_COLOUR: Colour = (28, 24, 22)
TEXT_COLOUR: Colour = (235, 235, 235)
FONT = cv2.FONT_HERSHEY_SIMPLEX


def annotate(
    image: Image,
    *,
    roi: BoolMask | None = None,
    mask: BoolMask | None = None,
    detections: Detections | None = None,
    truth: GroundTruth | None = None,
    status: Sequence[str] = (),
    keyframe: bool = False,
    dim: float = 0.45,
) -> Image:
    """Draw one frame's perception on a copy of it.

    Args:
        image: uint8 [H, W, 3] BGR.
        roi: bool [H, W], what was sent; outside is dimmed, its outline drawn. None draws neither.
        mask: bool [H, W], the cloud's mask, tinted.
        detections: Boxes with class and score.
        truth: Ground truth, thin white corner marks.
        status: Texts of the strip below the picture; without any text there is no strip.
        keyframe: Puts a KEY flag into the strip.
        dim: Brightness outside the ROI, 0..1.

    Returns:
        uint8 BGR of the same width; higher by ``strip_height(W)`` where there is a strip.
    """
    canvas = image.copy()
    width = image.shape[1]
    line = max(1, round(width / 900))
    if roi is not None:
        shade_outside(canvas, roi, dim)
    if mask is not None:
        tint(canvas, mask)
    if roi is not None and not roi.all():
        contours, _ = cv2.findContours(roi.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(canvas, contours, -1, OUTLINE_COLOUR, line, cv2.LINE_AA)
    if truth is not None:
        for box in truth.boxes_xyxy:
            draw_corners(canvas, box, line)
    if detections is not None:
        draw_detections(canvas, detections, line)
    if not status and not keyframe:
        return canvas
    strip = status_strip(width, status, keyframe=keyframe)
    return np.concatenate([canvas, strip], axis=0)


def status_line(
    index: int,
    *,
    coverage: float | None = None,
    message_bytes: int | None = None,
    staleness_frames: int | None = None,
    end_to_end_ns: int | None = None,
    outcome: str = "answered",
) -> list[str]:
    """The usual texts of the status strip, what is None left out."""
    texts = [f"frame {index}"]
    if coverage is not None:
        texts.append(f"sent {100 * coverage:.0f} % of pixels")
    if message_bytes is not None:
        texts.append(f"{message_bytes / 1e3:.1f} kB")
    if staleness_frames is not None:
        texts.append(f"mask {staleness_frames} old")
    if end_to_end_ns is not None:
        texts.append(f"{end_to_end_ns / 1e6:.0f} ms")
    if outcome != "answered":
        texts.append(outcome.upper())
    return texts


def shade_outside(canvas: Image, roi: BoolMask, brightness: float) -> None:
    """Darken the pixels outside the region, in place."""
    dark = cv2.convertScaleAbs(canvas, alpha=brightness)
    cv2.copyTo(dark, np.where(roi, np.uint8(0), np.uint8(255)), canvas)


def tint(canvas: Image, mask: BoolMask, strength: float = 0.45) -> None:
    """Blend the mask's colour over its pixels, in place."""
    colour = np.full_like(canvas, MASK_COLOUR)
    blended = cv2.addWeighted(canvas, 1.0 - strength, colour, strength, 0.0)
    cv2.copyTo(blended, mask.astype(np.uint8), canvas)


def draw_detections(canvas: Image, detections: Detections, line: int) -> None:
    """Draw boxes with class and score, the best on top."""
    scale, thickness = text_size(canvas.shape[1])
    for row in np.argsort(detections.scores, kind="stable"):
        class_id = int(detections.class_ids[row])
        colour = GROUP_COLOURS.get(CLASS_GROUPS.get(class_id, ""), OTHER_COLOUR)
        x0, y0, x1, y1 = (round(float(value)) for value in detections.boxes_xyxy[row])
        cv2.rectangle(canvas, (x0, y0), (x1 - 1, y1 - 1), colour, line + 1, cv2.LINE_AA)
        label = f"{COCO_ROAD_USERS.get(class_id, f'class {class_id}')} {detections.scores[row]:.2f}"
        (text_width, text_height), baseline = cv2.getTextSize(label, FONT, scale, thickness)
        top = y0 - text_height - baseline - 2
        # A box at the upper edge carries its label inside.
        top = top if top >= 0 else max(0, y0)
        bottom = top + text_height + baseline + 2
        left = max(0, min(x0, canvas.shape[1] - text_width - 6))
        cv2.rectangle(canvas, (left, top), (left + text_width + 5, bottom), colour, cv2.FILLED)
        cv2.putText(canvas, label, (left + 3, bottom - baseline), FONT, scale, (20, 20, 20), thickness, cv2.LINE_AA)


def draw_corners(canvas: Image, box: np.ndarray[tuple[int, ...], np.dtype[np.float32]], line: int) -> None:
    """Mark the four corners of a truth box."""
    x0, y0, x1, y1 = (round(float(value)) for value in box)
    x1, y1 = x1 - 1, y1 - 1
    arm = max(3, min(x1 - x0, y1 - y0) // 4)
    for x, y, step_x, step_y in ((x0, y0, 1, 1), (x1, y0, -1, 1), (x0, y1, 1, -1), (x1, y1, -1, -1)):
        cv2.line(canvas, (x, y), (x + step_x * arm, y), TRUTH_COLOUR, line, cv2.LINE_AA)
        cv2.line(canvas, (x, y), (x, y + step_y * arm), TRUTH_COLOUR, line, cv2.LINE_AA)


def text_size(width: int) -> tuple[float, int]:
    """(font scale, stroke) that reads well on a picture of this width."""
    scale = float(np.clip(width / 1900.0, 0.33, 1.2))
    return scale, max(1, round(scale * 1.4))


def strip_height(width: int) -> int:
    """Height in pixels of the status strip under a picture of this width, even."""
    return 2 * round(max(20.0, width / 38.0) / 2)


def status_strip(width: int, texts: Sequence[str], *, keyframe: bool) -> Image:
    """A dark strip with the texts spread from the left and a KEY flag at the right, uint8 BGR."""
    height = strip_height(width)
    strip: Image = np.full((height, width, 3), STRIP_COLOUR, np.uint8)
    scale, thickness = text_size(width)
    line = "   ".join(texts)
    flag_width = round(2.4 * height) if keyframe else 0
    (text_width, text_height), _ = cv2.getTextSize(line, FONT, scale, thickness)
    room = width - flag_width - height
    if text_width > room > 0:
        scale *= room / text_width
    middle = (height + text_height) // 2
    cv2.putText(strip, line, (height // 2, middle), FONT, scale, TEXT_COLOUR, thickness, cv2.LINE_AA)
    if keyframe:
        cv2.rectangle(strip, (width - flag_width, 0), (width, height), OUTLINE_COLOUR, cv2.FILLED)
        flag_scale, _ = text_size(width)
        (key_width, _), _ = cv2.getTextSize("KEY", FONT, flag_scale, thickness + 1)
        left = width - flag_width + (flag_width - key_width) // 2
        cv2.putText(strip, "KEY", (left, middle), FONT, flag_scale, STRIP_COLOUR, thickness + 1, cv2.LINE_AA)
    return strip


def side_by_side(left: Image, right: Image) -> Image:
    """Two pictures beside each other, the lower one filled up at its foot with the strip's colour."""
    height = max(left.shape[0], right.shape[0])
    return np.concatenate([fill_foot(left, height), fill_foot(right, height)], axis=1)


def fill_foot(image: Image, height: int) -> Image:
    """The picture with rows of the strip's colour added below up to the given height."""
    missing = height - image.shape[0]
    if missing == 0:
        return image
    foot: Image = np.full((missing, image.shape[1], 3), STRIP_COLOUR, np.uint8)
    return np.concatenate([image, foot], axis=0)


class AnnotatedVideoWriter:
    """Context manager that writes pictures as an H.264 MP4.

    The file takes its name when the block ends, by an exception too, so that an interrupted run leaves a
    whole video of the frames so far; without any frame it leaves no file.
    """

    def __init__(self, path: Path, fps: float, *, crf: int = 20) -> None:
        """Prepare a writer; the file is opened with the first picture, which sets the size.

        Raises:
            ConfigurationError: The frame rate is not positive.
        """
        if not fps > 0.0:
            raise ConfigurationError(f"a video needs a positive frame rate, got {fps}")
        self.path = path
        self.part = path.with_name(path.name + ".part")
        self.rate = Fraction(fps).limit_denominator(1001)
        self.crf = crf
        self.frames = 0
        self.size_hw = (0, 0)
        self.container: OutputContainer | None = None
        self.stream: VideoStream | None = None

    def __enter__(self) -> AnnotatedVideoWriter:
        return self

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def write(self, image: Image, received: Image | None = None) -> None:
        """Add one picture.

        Args:
            image: uint8 [H, W, 3] BGR, the annotated camera view.
            received: uint8 BGR of any height, what the cloud decoded; drawn to the right.

        Raises:
            ConfigurationError: The picture has another size than the first.
        """
        picture = image if received is None else side_by_side(image, received)
        if self.container is None:
            self.open(picture.shape[0], picture.shape[1])
        if picture.shape[:2] != self.size_hw:
            raise ConfigurationError(
                f"{self.path.name} holds pictures of {self.size_hw[1]}x{self.size_hw[0]}, "
                f"got {picture.shape[1]}x{picture.shape[0]}: write equal sizes"
            )
        height, width = self.size_hw
        even = cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        planes = np.asarray(cv2.cvtColor(even, cv2.COLOR_BGR2YUV_I420), np.uint8)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        frame.pts = self.frames
        self.frames += 1
        if self.container is not None and self.stream is not None:
            self.container.mux(self.stream.encode(frame))

    def open(self, height: int, width: int) -> None:
        """Open the unfinished file for pictures of this size."""
        self.size_hw = (height, width)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.container = av.open(str(self.part), "w", format="mp4", options={"movflags": "faststart"})
        stream = self.container.add_stream("libx264", rate=self.rate)
        stream.width, stream.height = width + width % 2, height + height % 2
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(self.crf), "preset": "veryfast"}
        # OpenCV's I420 is BT.601 limited range: say so, or players assume BT.709 from the size.
        stream.codec_context.colorspace = 6
        stream.codec_context.color_primaries = 6
        stream.codec_context.color_trc = 6
        stream.codec_context.color_range = 1
        self.stream = stream

    def close(self) -> None:
        """Finish the file and give it its name; further calls do nothing."""
        container, stream = self.container, self.stream
        self.container = self.stream = None
        if container is None or stream is None:
            return
        try:
            container.mux(stream.encode(None))
        finally:
            container.close()
        if self.frames:
            os.replace(self.part, self.path)
        else:
            self.part.unlink(missing_ok=True)
