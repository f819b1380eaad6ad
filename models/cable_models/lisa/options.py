"""How LISA++ is run: the decoding, the prompt, and every switch that makes a small region cheaper."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from cable_models.errors import ModelError
from cable_models.lisa.compiled import CompileMode
from cable_models.lisa.images import ClipFit
from cable_models.lisa.prompt import PromptMode, SystemPrompt
from cable_models.lisa.sam_plan import SamPadding, SamWindows

Decoding = Literal["forced", "generate"]
ImageTokens = Literal["all", "drop", "compact"]
ClipPatches = Literal["all", "drop"]
ImageMarkers = Literal["config", "yes", "no"]


@dataclass(frozen=True, slots=True)
class LisaOptions:
    """Switches of one model in use.

    Where the region is the whole frame, none of them changes a bit of the masks, but for the three that choose
    another picture, question or kernel: ``clip_fit``, ``sam_padding="always"`` and ``token_bucket``.
    """

    decoding: Decoding = field(
        default="forced",
        metadata={"help": "forced: a fixed answer in one pass, checked against greedy decoding; generate: greedy"},
    )
    answer: str = field(default="Sure, [SEG].", metadata={"help": "the answer that is forced at first"})
    forced_ids: tuple[int, ...] | None = field(
        default=None, metadata={"help": "token ids of that answer, end token included, in place of its text"}
    )
    verify_frames: int = field(
        default=8, metadata={"help": "frames of a stream on which a forced answer is checked; 0 = trust it blindly"}
    )
    verify_interval: int = field(default=50, metadata={"help": "after them every n-th frame is checked; 0 = none"})
    max_disagreements: int = field(
        default=3, metadata={"help": "checks failed after which a stream is generated for good"}
    )
    max_new_tokens: int = field(default=64, metadata={"help": "longest generated answer, tokens"})
    mode: PromptMode = field(default="semantic", metadata={"help": "LISA++ task suffix that follows the question"})
    system: SystemPrompt = field(default="human", metadata={"help": "wording of the system prompt"})
    image_markers: ImageMarkers = field(
        default="config", metadata={"help": "<im_start> and <im_end> around the image: yes, no, or as config.json says"}
    )
    image_tokens: ImageTokens = field(
        default="drop",
        metadata={
            "help": "drop: image tokens outside the region don't enter the language model, the others keep their "
            "positions; compact: they close up; all: none is dropped"
        },
    )
    clip_patches: ClipPatches = field(
        default="all", metadata={"help": "drop: patches outside the region are dropped before CLIP already"}
    )
    clip_fit: ClipFit = field(
        default="crop",
        metadata={"help": "crop: CLIP sees the central square (as published); pad, squash: the whole frame"},
    )
    min_patch_overlap: float = field(
        default=0.01, metadata={"help": "share of a CLIP patch inside the region from which on it is kept"}
    )
    patch_ring: int = field(default=0, metadata={"help": "rings of neighbours kept around the kept CLIP patches"})
    sam_padding: SamPadding = field(
        default="drop",
        metadata={"help": "drop: SAM skips the padding of frames with a region; always: of whole frames too; keep"},
    )
    sam_windows: SamWindows = field(
        default="skip",
        metadata={
            "help": "skip: SAM computes the attention windows that meet the region; tokens: only the region's own "
            "tokens; all"
        },
    )
    sam_margin: int = field(default=1, metadata={"help": "SAM tokens by which the region is grown before"})
    compile: CompileMode = field(
        default="none",
        metadata={
            "help": "none; default: torch.compile of the blocks; reduce-overhead: of the whole stacks, with CUDA graphs"
        },
    )
    token_bucket: int = field(
        default=0, metadata={"help": "prompts are padded to a multiple of this, for compiled graphs; 0 = not"}
    )

    def __post_init__(self) -> None:
        if self.clip_patches == "drop" and self.image_tokens == "all":
            raise ModelError(
                "clip_patches=drop leaves no image tokens outside the region; set image_tokens to drop or compact"
            )
        if not 0.0 <= self.min_patch_overlap <= 1.0:
            raise ModelError(f"min_patch_overlap is {self.min_patch_overlap}; it is a share, give 0..1")
        counts = ("verify_frames", "verify_interval", "max_disagreements", "patch_ring", "sam_margin", "token_bucket")
        for name in counts:
            if getattr(self, name) < 0:
                raise ModelError(f"{name} is {getattr(self, name)}; give 0 or more")
        if self.max_new_tokens < 1:
            raise ModelError(f"max_new_tokens is {self.max_new_tokens}; give 1 or more")


PLAIN = LisaOptions(
    decoding="generate",
    image_tokens="all",
    clip_patches="all",
    clip_fit="crop",
    sam_padding="keep",
    sam_windows="all",
)
"""The published inference, but for the key-value cache."""
