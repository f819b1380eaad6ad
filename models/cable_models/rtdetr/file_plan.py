"""Which form of a checkpoint is exported; free of torch, so that a cached export is served without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from cable_models.errors import ModelError

Precision = Literal["fp32", "fp16", "int8"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)

OPSET = 17
OPSETS = range(16, 21)
"""GridSample came with 16; the exporter ends at 20."""


@dataclass(frozen=True, slots=True)
class GraphOptions:
    """Form of the exported graph."""

    postprocess: bool = False
    """Answer ``labels``, ``boxes``, ``scores`` (the original repository's signature) instead of logits."""
    batch: int | None = None
    """Fixed batch size; None = any."""
    opset: int = OPSET

    def __post_init__(self) -> None:
        """Refuses what the exporter can't do.

        Raises:
            ModelError: which option, and its range.
        """
        if self.batch is not None and self.batch < 1:
            raise ModelError(f"the batch must be at least 1, got {self.batch}")
        if self.opset not in OPSETS:
            raise ModelError(f"opset must be {OPSETS[0]} to {OPSETS[-1]} (RT-DETR needs GridSample), got {self.opset}")


@dataclass(frozen=True, slots=True)
class FilePlan:
    """Which file to make."""

    graph: GraphOptions = field(default_factory=GraphOptions)
    precision: Precision = "fp32"
    size_wh: tuple[int, int] | None = None
    """Input size instead of the checkpoint's own, multiples of 32."""
    provider: str = "cpu"
    """Where the cheaper forms are measured."""
    notes: Mapping[str, str] = field(default_factory=dict)
    """Further metadata, such as the command."""

    @property
    def key(self) -> str:
        """Part of a file name that tells plans apart."""
        size = "" if self.size_wh is None else f"-{self.size_wh[0]}x{self.size_wh[1]}"
        batch = "" if self.graph.batch is None else f"-b{self.graph.batch}"
        return f"{self.precision}{size}{batch}{'-pp' if self.graph.postprocess else ''}-op{self.graph.opset}"
