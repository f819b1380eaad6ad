"""From a checkpoint to a detector's file that has proved itself."""

from __future__ import annotations

import json
import logging
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from transformers import RTDetrForObjectDetection

from cable_models.detection import Image
from cable_models.errors import ModelError
from cable_models.rtdetr.agreement import RANKED_SCORE, Agreement, measure_agreement
from cable_models.rtdetr.checkpoints import Checkpoint
from cable_models.rtdetr.compact import for_inference
from cable_models.rtdetr.export import add_metadata, export_checkpoint
from cable_models.rtdetr.file_plan import FilePlan
from cable_models.rtdetr.onnx_detector import DetectorSettings, OnnxDetector
from cable_models.rtdetr.precision import to_fp16, to_int8
from cable_models.rtdetr.providers import SessionSettings
from cable_models.rtdetr.verify import ExportCheck, check_export, require

log = logging.getLogger(__name__)

OPERATING_SCORE = 0.4
LEAST_MATCHED = 0.5
"""A cheaper form that loses more than half of the objects is broken, not cheap."""


@dataclass(frozen=True, slots=True)
class MadeFile:
    """A detector's file and what it proved."""

    path: Path
    check: ExportCheck | None
    """Against torch, in fp32; None where nobody wanted to know."""
    agreement: Agreement | None
    """Of a cheaper form with the fp32 one; None in fp32 or without frames."""


def make_file(
    checkpoint: Checkpoint,
    target: Path,
    plan: FilePlan,
    verify: Sequence[Image],
    calibrate: Sequence[Image] = (),
    say: Callable[[str], None] = log.info,
) -> MadeFile:
    """Exports, verifies, converts; only a file that passed gets its name.

    Args:
        checkpoint: What to export.
        target: ONNX file to write, replaced if there.
        plan: Which form.
        verify: uint8 [height, width, 3] BGR; empty = nothing is verified or measured.
        calibrate: Frames for int8, none of them in ``verify``.
        say: Told of each step.

    Raises:
        ModelError: the export differs from torch, a conversion failed or lost most objects, or no file can be written.
    """
    if plan.size_wh is not None:
        checkpoint = checkpoint.resized(plan.size_wh)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".export-") as folder:
            exported = Path(folder) / "fp32.onnx"
            say(f"exporting {checkpoint.notes.get('source', 'the network')}, opset {plan.graph.opset}")
            export_checkpoint(simplified(checkpoint), exported, plan.graph, plan.notes)
            check = None
            if verify:
                say(f"comparing with torch on {len(verify)} frames")
                check = check_export(checkpoint, exported, verify)
                require(check, target)
                add_metadata(exported, {"verified": json.dumps(asdict(check))})
            finished, agreement = convert(exported, plan, verify, calibrate, say)
            os.replace(finished, target)
    except OSError as error:
        raise ModelError(f"{target} can't be written: {error}") from error
    return MadeFile(target, check, agreement)


def simplified(checkpoint: Checkpoint) -> Checkpoint:
    """The same answers with fewer operations, where that is known how."""
    model = checkpoint.model
    if not isinstance(model, RTDetrForObjectDetection):
        return checkpoint
    return replace(checkpoint, model=for_inference(model, checkpoint.recipe.size_wh))


def convert(
    exported: Path, plan: FilePlan, verify: Sequence[Image], calibrate: Sequence[Image], say: Callable[[str], None]
) -> tuple[Path, Agreement | None]:
    """The form that the plan asks for, beside the fp32 file, and what it costs.

    Raises:
        ModelError: the conversion failed, or lost most objects.
    """
    if plan.precision == "fp32":
        return exported, None
    converted = exported.with_name(f"{plan.precision}.onnx")
    if plan.precision == "fp16":
        say("converting to half precision")
        to_fp16(exported, converted)
    else:
        say(f"calibrating 8 bits on {len(calibrate)} frames")
        to_int8(exported, converted, calibrate)
    if not verify:
        return converted, None
    say(f"measuring {plan.precision} against fp32 on {len(verify)} frames")
    session = SessionSettings(provider=plan.provider)
    agreement = measure_agreement(
        OnnxDetector(exported, session, DetectorSettings(min_score=OPERATING_SCORE)),
        OnnxDetector(converted, session, DetectorSettings(min_score=RANKED_SCORE)),
        verify,
    )
    if agreement.matched < LEAST_MATCHED:
        raise ModelError(
            f"{plan.precision} loses too much: {agreement.summary()}. Keep fp32, or calibrate on more frames"
        )
    add_metadata(converted, {"agreement_with_fp32": json.dumps(asdict(agreement))})
    return converted, agreement
