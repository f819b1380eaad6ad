"""Which frames of the rendered world a model is trained and judged on, and their rendering into sample folders."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from cable_models.training.samples import LabelledImage, append_sample

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.errors import SourceError
from cable_rpc.types import Frame

SEQUENCE_FRAMES = 120
TRAINING_SEEDS = range(10_000, 20_000)
HELD_OUT_SEEDS = range(90_000, 90_042)
"""Far from the seeds of demos, tests and studies, so that those show scenes a model never saw."""


@dataclass(frozen=True, slots=True)
class RenderPlan:
    """Which frames are rendered."""

    seeds: range
    frames_per_seed: int
    width: int
    height: int
    vary: bool
    """Other roads for a quarter of the seeds, and another camera for a quarter, instead of the defaults."""

    def frame_indices(self, seed: int) -> list[int]:
        """Frames spread over the sequence, at another offset for each seed."""
        stride = SEQUENCE_FRAMES // self.frames_per_seed
        return [seed % stride + stride * position for position in range(self.frames_per_seed)]

    def world(self, seed: int) -> SyntheticConfig:
        """What a seed shows, and the camera that sees it."""
        plain = SyntheticConfig(seed=seed, width=self.width, height=self.height, frame_count=SEQUENCE_FRAMES)
        if not self.vary:
            return plain
        rng = np.random.default_rng([seed, 7])
        route = str(rng.choice(("streets", "turns", "straight"), p=(0.75, 0.14, 0.11)))
        if rng.random() >= 0.25:
            return replace(plain, route=route)
        return replace(
            plain,
            route=route,
            horizontal_fov_deg=float(rng.uniform(52, 84)),
            mount_height_m=float(rng.uniform(1.2, 1.9)),
            pitch_down_deg=float(rng.uniform(0.5, 3.5)),
            noise_strength=float(rng.uniform(0.5, 3.0)),
            blur_sigma=float(rng.uniform(0.35, 0.9)),
        )


TRAINING_PLAN = RenderPlan(TRAINING_SEEDS, frames_per_seed=8, width=512, height=288, vary=True)
HELD_OUT_PLAN = RenderPlan(HELD_OUT_SEEDS, frames_per_seed=2, width=640, height=360, vary=False)


SampleWriter = Callable[[Path, str, Frame], None]
"""Writes a rendered frame into a sample folder, under a name, the picture as ``NAME.jpg``."""


def write_boxes(folder: Path, name: str, frame: Frame) -> None:
    """Writes a rendered frame as a sample of a detector's training.

    Raises:
        SourceError: the frame has no truth.
    """
    append_sample(folder, name, labelled(frame))


def render_into(folder: Path, plan: RenderPlan, frames: int, write: SampleWriter = write_boxes) -> Iterator[str]:
    """Renders what is missing of a plan's first frames into a sample folder, and yields the name of each frame.

    Args:
        folder: Sample folder, made where it is missing.
        plan: Which frames.
        frames: How many of them in all, those already there included.
        write: Writes a frame; its errors pass through.
    """
    folder.mkdir(parents=True, exist_ok=True)
    left = frames
    for seed in plan.seeds:
        names = {index: f"{seed:06d}_{index:03d}" for index in plan.frame_indices(seed)[:left]}
        source: SyntheticSource | None = None
        for index, name in names.items():
            if not (folder / f"{name}.jpg").is_file():
                source = source or SyntheticSource(plan.world(seed))
                write(folder, name, source.frame(index))
            yield name
        left -= len(names)
        if left <= 0:
            return


def labelled(frame: Frame) -> LabelledImage:
    """A rendered frame with its truth, as the training code takes it.

    Raises:
        SourceError: the frame has no truth.
    """
    if frame.truth is None:
        raise SourceError(f"frame {frame.index} has no truth to learn from; render it with a truth-giving source")
    truth = frame.truth
    return LabelledImage(frame.image, truth.boxes_xyxy, truth.class_ids, truth.visibility)
