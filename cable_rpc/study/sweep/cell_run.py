"""Measures one cell: a strategy's loop over a prepared clip, with answers as late as the cell wants them."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.errors import CableError
from cable_rpc.study.closed_loop.failure import told
from cable_rpc.study.closed_loop.lane import Lane, LaneSettings, Passage
from cable_rpc.study.closed_loop.measured_frame import Reference, dropped_frame, measured_frame, sends_all
from cable_rpc.study.closed_loop.models import LoadedModels, ModelLoader, load_models
from cable_rpc.study.sequence_metrics import OPERATING_SCORE, MeasuredFrame, SequenceMeter
from cable_rpc.study.strategies import open_strategy
from cable_rpc.study.sweep.cell import CellResult, ExampleFrame, MeasuredCell, RegionQuality, SweepCell, UplinkBytes
from cable_rpc.study.sweep.example import draw_example
from cable_rpc.study.sweep.fidelity import box_pixels, region_fidelity
from cable_rpc.study.sweep.reference import PreparedClip, prepared_clip
from cable_rpc.study.sweep.simulated_link import LinkClock
from cable_rpc.types import Frame

SSIM_EVERY = 3
"""Frames from one whose SSIM is measured to the next: on every frame it would take a quarter of a cell's time."""


def run_cell(cell: SweepCell, cache: Path, load: ModelLoader = load_models) -> MeasuredCell:
    """Measure a cell; what fails is told in place of an exception.

    Args:
        cell: all settings.
        cache: the folder of decoded clips; the clip is prepared now where it isn't there.
        load: what loads the models.
    """
    started = time.monotonic()
    try:
        clip = prepared_clip(cell.clip, cache, load)
        models = load(cell.clip.models)
        run = asyncio.run(measure(cell, clip, models))
    except Exception as failure:
        where = f"{cell.clip.source}: "
        text = told(failure)
        return MeasuredCell(
            cell, None, text if text.startswith(where) else where + text, seconds_taken=time.monotonic() - started
        )
    return MeasuredCell(cell, run.result(models), "", run.example, time.monotonic() - started)


@dataclass(slots=True)
class Answer:
    """An answer that the edge does not have yet; or a frame that was dropped, in its place in the order."""

    frame: Frame
    reference: Reference
    passage: Passage | None
    due_index: int = 0
    """First frame whose proposal may use it."""
    due_ns: int = 0
    """When it is there, on the source's clock."""

    def is_there(self, index: int, time_ns: int) -> bool:
        """Whether the edge has it when a frame is looked at."""
        return self.passage is None or (index >= self.due_index and time_ns >= self.due_ns)


async def measure(cell: SweepCell, clip: PreparedClip, models: LoadedModels) -> CellRun:
    """Take every frame of the clip through the loop."""
    strategy = open_strategy(cell.strategy, cell.roi, cell.block_size, keep_steps=True)
    run = CellRun(cell, clip)
    async with Lane(strategy, lane_settings(cell), clip.clip, models) as lane:
        for frame, reference in clip:
            run.apply_answers(lane, frame)
            if run.link is not None and not run.link.has_room(frame.capture_time_ns):
                run.drop(frame, reference)
                continue
            try:
                passage = await lane.send(CapturedFrame(frame, 0, time.monotonic_ns()))
            except CableError as error:
                raise type(error)(f"frame {frame.index}: {error}") from error
            run.sent(frame, reference, passage)
        run.apply_answers(lane, None)
    return run


def lane_settings(cell: SweepCell) -> LaneSettings:
    """How the cell's frames are coded."""
    return LaneSettings(
        cell.codec,
        cell.rate.quality,
        cell.treatment,
        cell.clip.prompt,
        OPERATING_SCORE,
        bitrate_kbps=cell.rate.bitrate_kbps,
        nominal_times=True,
    )


class CellRun:
    """What has been measured of a cell, and the answers that are still on their way."""

    def __init__(self, cell: SweepCell, clip: PreparedClip) -> None:
        self.cell = cell
        self.clip = clip
        self.link = None if cell.link is None else LinkClock(cell.link)
        self.meter = SequenceMeter(clip.clip.name, clip.clip.fps)
        self.uplink = UplinkBytes()
        self.inside_sent = RegionQuality()
        self.inside_objects = RegionQuality()
        self.dropped = 0
        self.example: ExampleFrame | None = None
        self._answers: deque[Answer] = deque()
        self._sent_any = False

    def apply_answers(self, lane: Lane, frame: Frame | None) -> None:
        """Gives the strategy what is there when a frame is looked at; everything where there is no more frame."""
        while self._answers and (frame is None or self._answers[0].is_there(frame.index, frame.capture_time_ns)):
            self.finish(lane, self._answers.popleft())

    def finish(self, lane: Lane, answer: Answer) -> None:
        """Applies one answer, which makes its frame's measurement complete."""
        if answer.passage is None:
            self.meter.add(dropped_frame(answer.frame, answer.reference))
            return
        passage = replace(answer.passage, apply_ns=lane.apply(answer.passage))
        measured = measured_frame(answer.frame, passage, answer.reference)
        self.meter.add(self.on_the_link(measured, answer))

    def on_the_link(self, measured: MeasuredFrame, answer: Answer) -> MeasuredFrame:
        """With the simulated time in place of the sum of stages."""
        if self.link is None:
            return measured
        return replace(measured, end_to_end_ns=answer.due_ns - answer.frame.capture_time_ns)

    def drop(self, frame: Frame, reference: Reference) -> None:
        """The link had no room for a frame."""
        self.dropped += 1
        self._answers.append(Answer(frame, reference, None))

    def sent(self, frame: Frame, reference: Reference, passage: Passage) -> None:
        """A frame went the whole way; when its answer is there depends on the cell."""
        answer = Answer(frame, reference, passage, frame.index + self.cell.feedback_delay)
        if self.link is not None:
            answer.due_ns = self.link.send(
                frame.capture_time_ns, passage.prepared.uplink_message_bytes, passage.answer.message_bytes
            )
        self._answers.append(answer)
        self.uplink += uplink_bytes(passage, first=not self._sent_any)
        self._sent_any = True
        boxes = np.zeros((0, 4), np.float32) if frame.truth is None else frame.truth.boxes_xyxy
        regions = passage.prepared.sent_region.pixels(), box_pixels(boxes, frame.size_hw)
        inside_sent, inside_objects = region_fidelity(
            frame.image, passage.picture, regions, with_ssim=frame.index % SSIM_EVERY == 0
        )
        self.inside_sent += inside_sent
        self.inside_objects += inside_objects
        if self.example is None and frame.index >= self.clip.clip.frame_count // 2:
            self.example = draw_example(passage, reference)

    def result(self, models: LoadedModels) -> CellResult:
        """The sums."""
        detector, segmenter = models.names
        clip = self.clip.clip
        return CellResult(
            sequence=clip.name,
            seconds=clip.frame_count / clip.fps,
            truth=self.clip.truth,
            detector=detector,
            segmenter=segmenter,
            metrics=self.meter.metrics(),
            uplink=self.uplink,
            sent=self.inside_sent,
            objects=self.inside_objects,
            dropped=self.dropped,
            size_wh=clip.size_wh,
        )


def uplink_bytes(passage: Passage, *, first: bool) -> UplinkBytes:
    """What a frame's bytes were spent on."""
    prepared = passage.prepared
    picture, region = len(prepared.encoded.data), len(prepared.message.region.data)
    whole = first or (prepared.proposal.keyframe and not sends_all(prepared.proposal))
    return UplinkBytes(
        keyframe_pictures=picture if whole else 0,
        region_pictures=0 if whole else picture,
        side_information=region,
        message_overhead=prepared.uplink_message_bytes - picture - region,
    )
