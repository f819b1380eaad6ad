"""Frames of several drives as each strategy sends them and as the cloud sees them: what a figure of examples shows.

Every strategy goes through the real loop in lock-step: the edge's frame encoder with the real codec, the session's
decoder, and the models. Models run on every frame only where the strategy listens to them.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np
from cable_codecs import CodecParameters

from cable_rpc.cloud.backends import Detector, Segmenter
from cable_rpc.cloud.perception import Perception, PerceptionModels, PerceptionRequest
from cable_rpc.cloud.stream_decoder import StreamDecoder
from cable_rpc.data.source import FrameSource
from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.edge.client import SessionRequest
from cable_rpc.edge.frame_encoder import FrameEncoder
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.strategy import RoiStrategy, WithoutFeedback
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.strategies import open_strategy
from cable_rpc.types import BoolMask, Detections, Frame, Image, RoiMask

WHOLE = "full-frame"
SETTLED_FRAME = 30
"""Where no frame is asked for, one from here on is shown: the loop has left its first keyframe behind."""
SEARCH_FRAMES = 15
"""So many frames further it is looked for one that no strategy sends whole."""
NO_LIMIT = 1 << 30


@dataclass(frozen=True, slots=True)
class FigureSettings:
    """How the frames are sent, and what is asked of the models."""

    strategies: tuple[str, ...] = ("motion-only", "cable")
    """Names as in `STRATEGIES`, one column each; whole frames always have theirs."""
    roi: RoiConfig = field(default_factory=RoiConfig)
    codec: str = "h264"
    quality: int | None = None
    """None: the codec's default."""
    prompt: str = ""
    min_score: float = 0.4
    block_size: int = 8


@dataclass(frozen=True, slots=True)
class SentView:
    """One frame as one strategy sent it, and what the cloud made of it."""

    strategy: str
    received: Image
    """uint8 [H, W, 3] BGR, as decoded; what stands outside the region is the treatment's."""
    region: RoiMask
    """What was sent."""
    keyframe: bool
    packet_bytes: int
    detections: Detections
    mask: BoolMask
    """bool [H, W], the cloud's mask of it."""


@dataclass(frozen=True, slots=True)
class FigureRow:
    """One frame of one drive."""

    source: str
    frame: Frame
    whole: SentView
    views: tuple[SentView, ...]
    """In the order of the strategies."""


class FigureLane:
    """One strategy's stream over a drive, without a network; closes its codecs at the end of a with block.

    Args:
        name: of the strategy.
        source: the drive.
        settings: how it is sent.
        models: what perceives, and the loop that runs them.

    Raises:
        ConfigurationError: the strategy is unknown.
        CodecError: the codec can't be opened.
    """

    def __init__(self, name: str, source: FrameSource, settings: FigureSettings, models: RunningModels) -> None:
        self.name = name
        self._strategy = open_strategy(name, settings.roi, settings.block_size)
        self._settings = settings
        self._models = models
        width, height = source.size_wh
        parameters = CodecParameters(settings.codec, width, height, source.fps, settings.quality)
        self._encoder = FrameEncoder(self._strategy, parameters)
        request = SessionRequest(
            settings.codec, width, height, source.fps, settings.quality or 0, treatment=self._encoder.treatment
        )
        self._decoder = StreamDecoder(request.to_hello().codec_config, NO_LIMIT)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._encoder.close()
        self._decoder.close()
        self._models.forget(self.name)

    def step(self, frame: Frame, *, shown: bool) -> SentView | None:
        """Send the next frame and take the answer.

        Returns:
            The frame's view; None where it isn't to be shown.

        Raises:
            CableError: what strategy, codec or models raise.
        """
        prepared = self._encoder.prepare(CapturedFrame(frame, 0, time.monotonic_ns()), force_keyframe=False)
        self._strategy.sent(frame.index, prepared.uplink_message_bytes)
        decoded = self._decoder.decode(prepared.message)
        if not shown and not listens(self._strategy):
            return None
        seen = self._models.perceive(decoded.image, decoded.roi, self._settings, frame.index, self.name)
        answer = seen.segmentation
        self._strategy.update(frame.index, answer.mask, confidence=answer.confidence, uncertainty=answer.uncertainty)
        if not shown:
            return None
        return SentView(
            self.name,
            decoded.image,
            prepared.sent_region,
            prepared.proposal.keyframe,
            len(prepared.encoded.data),
            seen.detections,
            answer.mask,
        )


class RunningModels:
    """Detector and segmenter in threads of their own, asked from plain code; use as a context manager."""

    def __init__(self, detector: Detector, segmenter: Segmenter) -> None:
        self._models = PerceptionModels.in_process(detector, segmenter)
        self._runner = asyncio.Runner()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._runner.close()
        self._models.close()

    def perceive(
        self, image: Image, roi: BoolMask | None, settings: FigureSettings, sequence: int, stream: str
    ) -> Perception:
        """Boxes and mask of a picture, as a server answers it."""
        asked = self._models.perceive(
            PerceptionRequest(image, roi, settings.min_score, settings.prompt, sequence), stream
        )
        return self._runner.run(asked)

    def forget(self, stream: str) -> None:
        """Lets the segmenter drop what it keeps of a stream."""

        async def farewell() -> None:
            self._models.forget_stream(stream)

        self._runner.run(farewell())


def listens(strategy: RoiStrategy) -> bool:
    """Whether the strategy learns anything from the cloud's answers."""
    learn: object = type(strategy).update
    return learn is not WithoutFeedback.update


def figure_rows(
    source: FrameSource,
    frames: Sequence[int],
    settings: FigureSettings,
    detector: Detector,
    segmenter: Segmenter,
    listener: Callable[[int], None] | None = None,
) -> list[FigureRow]:
    """Send a drive from its beginning with every strategy, and keep the frames that are asked for.

    Args:
        source: the drive.
        frames: numbers of the frames, from 0; none: the first from `SETTLED_FRAME` on that no strategy sends whole,
            or the last of a short drive.
        settings: how it is sent.
        detector: the cloud's.
        segmenter: the cloud's.
        listener: is told the number of each frame that is done.

    Raises:
        ConfigurationError: the drive has no such frame, or a strategy is unknown.
        CableError: what source, codec or models raise.
    """
    rows: dict[int, FigureRow] = {}
    count = 0

    def tell(index: int) -> None:
        nonlocal count
        count += 1
        if listener is not None:
            listener(index)

    for row in sent_rows(source, frames, settings, detector, segmenter, tell):
        # Where no frame is asked for, the newest stands until one is settled.
        rows = {**rows, row.frame.index: row} if frames else {row.frame.index: row}
        if not frames and is_settled(row):
            break
    missing = [index for index in frames if index not in rows]
    if missing:
        raise ConfigurationError(
            f"{source.name} has {count} frames, from 0 on; it has no frame {', '.join(map(str, sorted(missing)))}"
        )
    if not rows:
        raise ConfigurationError(f"{source.name} gave {count} frames, fewer than it lists; say which one to show")
    return [rows[index] for index in frames or rows]


def sent_rows(
    source: FrameSource,
    frames: Sequence[int],
    settings: FigureSettings,
    detector: Detector,
    segmenter: Segmenter,
    listener: Callable[[int], None],
) -> Iterator[FigureRow]:
    """The frames that may be shown, each after all before it were sent; arguments as of `figure_rows`."""
    names = dict.fromkeys((WHOLE, *settings.strategies))
    with ExitStack() as stack:
        models = stack.enter_context(RunningModels(detector, segmenter))
        lanes = [stack.enter_context(FigureLane(name, source, settings, models)) for name in names]
        for frame in source:
            shown = frame.index in frames if frames else is_candidate(source, frame.index)
            views = [lane.step(frame, shown=shown) for lane in lanes]
            listener(frame.index)
            by_name = {view.strategy: view for view in views if view is not None}
            if shown:
                chosen = tuple(by_name[name] for name in settings.strategies)
                yield FigureRow(source.name, frame, by_name[WHOLE], chosen)
            if frame.index >= (max(frames) if frames else SETTLED_FRAME + SEARCH_FRAMES):
                return


def is_settled(row: FigureRow) -> bool:
    """Whether the loop runs, and no strategy sends the frame whole that does not always."""
    keyframes = any(view.keyframe for view in row.views if view.strategy != WHOLE)
    return row.frame.index >= SETTLED_FRAME and not keyframes


def is_candidate(source: FrameSource, index: int) -> bool:
    """Whether a frame may be shown where none is asked for."""
    count = source.frame_count
    return index >= SETTLED_FRAME or count is None or index >= min(count, SETTLED_FRAME) - 1


def kept_pixels(view: SentView, outside: tuple[int, int, int]) -> Image:
    """What arrived of a frame, uint8 [H, W, 3] BGR, painted over where nothing was sent."""
    picture = view.received.copy()
    picture[np.logical_not(view.region.pixels())] = outside
    return picture
