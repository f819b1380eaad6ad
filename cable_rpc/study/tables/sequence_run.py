"""One sequence under several strategies at once: each frame is read once, and sent whole once, for all of them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace

from cable_codecs import RegionTreatment

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.source import FrameSource, open_source
from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.edge.strategy import FullFrame
from cable_rpc.errors import SourceError
from cable_rpc.study.closed_loop.failure import told
from cable_rpc.study.closed_loop.lane import Lane, LaneSettings, Passage
from cable_rpc.study.closed_loop.measured_frame import Reference, measured_frame
from cable_rpc.study.closed_loop.models import LoadedModels, ModelLoader, load_models
from cable_rpc.study.sequence_metrics import OPERATING_SCORE, SequenceMeter
from cable_rpc.study.strategies import open_strategy
from cable_rpc.study.tables.cells import Cell
from cable_rpc.study.tables.equal_quality import EqualQuality
from cable_rpc.study.tables.ladder import LadderFrame, WholeFrameLadder
from cable_rpc.study.tables.settings import FULL_FRAME, REFERENCE_CODEC, RunSettings, SequenceRequest
from cable_rpc.types import Frame


@dataclass(frozen=True, slots=True)
class SequenceTask:
    """What a worker is given at a time."""

    request: SequenceRequest
    strategies: tuple[str, ...]
    settings: RunSettings


@dataclass(slots=True)
class RunningStrategy:
    """One strategy under way: its measurements so far, or what ended it."""

    name: str
    lane: Lane | None
    """None where the reference's passages are its own."""
    meter: SequenceMeter
    error: str = ""
    equal_quality: EqualQuality | None = None

    def cell(self, common: Cell) -> Cell:
        """What became of it."""
        if self.error:
            return replace(common, strategy=self.name, error=self.error)
        return replace(common, strategy=self.name, metrics=self.meter.metrics(), equal_quality=self.equal_quality)


def run_sequence(task: SequenceTask, load: ModelLoader = load_models) -> list[Cell]:
    """Run a sequence under each strategy; what fails is a cell with its error, in place of an exception."""
    bad = BadFrames(skip=task.settings.skip_bad)
    common = Cell(task.request, "")
    running: list[RunningStrategy] = []
    error = ""
    try:
        source = open_sequence(task, bad)
        common = replace(common, sequence=source.name)
        models = load(task.settings.models)
        detector, segmenter = models.names
        common = replace(common, detector=detector, segmenter=segmenter)
        asyncio.run(run_strategies(task, source, models, running))
    except Exception as failure:
        error = told(failure)
    common = replace(common, skipped=tuple(bad.skipped))
    if error:
        return [replace(common, strategy=strategy, error=error) for strategy in task.strategies]
    return [one.cell(common) for one in running]


def open_sequence(task: SequenceTask, bad: BadFrames) -> FrameSource:
    """The sequence's source."""
    settings = task.settings
    return open_source(
        task.request.spec,
        max_frames=settings.max_frames,
        size=settings.size,
        fps=settings.fps,
        bad_frames=bad,
    )


async def run_strategies(
    task: SequenceTask, source: FrameSource, models: LoadedModels, running: list[RunningStrategy]
) -> None:
    """Take every frame through the reference and then through each strategy that still runs.

    Raises:
        SourceError: the source can't be read, or has no frame.
        CableError, CodecError: the reference failed, without which nothing can be judged.
    """
    settings = task.settings
    async with AsyncExitStack() as stack:
        reference = await stack.enter_async_context(
            Lane(FullFrame(settings.block_size), reference_settings(settings), source, models)
        )
        ladder = WholeFrameLadder(reference_settings(settings), source) if settings.equal_quality else None
        if ladder is not None:
            stack.enter_context(ladder)
        running.extend([await start(name, settings, source, models, stack) for name in task.strategies])
        count = 0
        for captured in captured_frames(source):
            whole = await reference.carry(captured)
            at_all_settings = None if ladder is None else ladder.code(captured.frame.image, whole)
            for one in running:
                await advance(one, captured, whole, at_all_settings)
            count += 1
        if count == 0:
            raise SourceError(f"'{task.request.spec}' has no frames; choose another sequence or allow more of them")


async def start(
    name: str, settings: RunSettings, source: FrameSource, models: LoadedModels, stack: AsyncExitStack
) -> RunningStrategy:
    """Open one strategy's lane."""
    meter = SequenceMeter(source.name, source.fps)
    if name == FULL_FRAME and settings.codec == REFERENCE_CODEC:
        return RunningStrategy(name, None, meter)
    try:
        strategy = open_strategy(name, settings.roi, settings.block_size, keep_steps=True)
        lane = Lane(strategy, lane_settings(settings), source, models)
        return RunningStrategy(name, await stack.enter_async_context(lane), meter)
    except Exception as failure:
        return RunningStrategy(name, None, meter, told(failure))


async def advance(
    one: RunningStrategy, captured: CapturedFrame, whole: Passage, at_all_settings: LadderFrame | None
) -> None:
    """One more frame of a strategy that has not failed."""
    if one.error:
        return
    try:
        passage = whole if one.lane is None else await one.lane.carry(captured)
        one.meter.add(measured_frame(captured.frame, passage, Reference.sent_whole(whole)))
        if at_all_settings is not None:
            found = at_all_settings.beside(passage)
            one.equal_quality = found if one.equal_quality is None else one.equal_quality + found
    except Exception as failure:
        where = f"frame {captured.frame.index}"
        text = told(failure)
        one.error = text if text.startswith(where) else f"{where}: {text}"


def captured_frames(source: FrameSource) -> Iterator[CapturedFrame]:
    """The frames, each as if it had just come from the camera."""
    frames: Iterator[Frame] = iter(source)
    while True:
        started_ns = time.monotonic_ns()
        frame = next(frames, None)
        if frame is None:
            return
        now_ns = time.monotonic_ns()
        yield CapturedFrame(frame, now_ns - started_ns, now_ns)


def lane_settings(settings: RunSettings) -> LaneSettings:
    """How the strategies' frames are coded."""
    return LaneSettings(settings.codec, settings.quality, settings.used_treatment, settings.prompt, OPERATING_SCORE)


def reference_settings(settings: RunSettings) -> LaneSettings:
    """How whole frames are coded: nothing of them is treated."""
    treatment = RegionTreatment.default_for(stateless=False)
    return LaneSettings(REFERENCE_CODEC, settings.reference_quality, treatment, settings.prompt, OPERATING_SCORE)
