"""`cable-rpc verify lisa`: whether the cloud's shortcuts hold on your weights, your machine and your pictures."""

from __future__ import annotations

import itertools
import json
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from cable_rpc.cli.stream import parse_size
from cable_rpc.cloud.perception import DEFAULT_PROMPT
from cable_rpc.data.source import open_source
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.study.verify_lisa import VariantResult, Verification, variants, verify

if TYPE_CHECKING:
    from cable_models.lisa.golden import StageError
    from cable_models.lisa.loader import LoadedLisa

LOG_WIDTH = 130
"""Columns where the output is no terminal."""

verify_app = typer.Typer(help="Check a model on your weights and your machine.", no_args_is_help=True)


@verify_app.callback()
def root() -> None:
    """Check a model on your weights and your machine."""


@verify_app.command()
def lisa(
    model: Annotated[
        str | None,
        typer.Option(help="Checkpoint to verify: a folder or a hub's id.", metavar="FOLDER|ID"),
    ] = None,
    source: Annotated[
        str | None, typer.Option(help="A drive: video:FILE, video:FOLDER of images, or synthetic:SEED.")
    ] = None,
    prompt: Annotated[str, typer.Option(help="Question to ask of every frame.")] = DEFAULT_PROMPT,
    frames: Annotated[int, typer.Option(help="Frames of the drive, the first one for warming up.", min=2)] = 12,
    coverage: Annotated[
        float | None,
        typer.Option(
            help="A fixed corridor of this share of the frame, in place of the region that the edge's tracker follows."
        ),
    ] = None,
    wanted: Annotated[
        float, typer.Option(help="IoU with the full computation from which on a switch is recommended.")
    ] = 0.95,
    golden: Annotated[
        Path | None,
        typer.Option(help="Folder of reference tensors of the original code; its own tiny checkpoint is compared."),
    ] = None,
    clip: Annotated[str | None, typer.Option(help="CLIP tower, where not the one that the checkpoint names.")] = None,
    revision: Annotated[str | None, typer.Option(help="Branch, tag or commit on the hub.")] = None,
    device: Annotated[str, typer.Option(help="auto | cpu | cuda")] = "auto",
    dtype: Annotated[str, typer.Option(help="auto (bf16 on a GPU, fp32 on a CPU) | bf16 | fp16 | fp32")] = "auto",
    threads: Annotated[int, typer.Option(help="CPU threads.", min=1)] = 2,
    size: Annotated[str | None, typer.Option(help="Resize the frames to WIDTHxHEIGHT.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write everything as JSON too.")] = None,
) -> None:
    """Is the forced answer the generated one, what does each ROI switch cost and save, and which should be taken?

    [bold]cable-rpc verify lisa --model Senqiao/LISA_Plus_7b --source video:drive.mp4[/bold]

    Every switch runs beside the published inference, on the regions that the edge would send, in one process and in
    turns. J is the IoU of two masks inside the region, F the accuracy of their boundaries (DAVIS).
    """
    if model is None and golden is None:
        raise ConfigurationError("nothing to verify: give --model with --source, or --golden")
    if (model is None) != (source is None):
        raise ConfigurationError("--model needs a --source to run on, and --source a --model")
    console = Console(width=None if sys.stdout.isatty() else LOG_WIDTH, highlight=False)
    report: dict[str, object] = {}
    passed = True
    with model_errors():
        if golden is not None:
            errors = golden_errors(golden)
            console.print(golden_table(errors))
            passed = all(error.passed for error in errors)
            print_golden_verdict(console, errors)
            report["golden"] = [asdict(error) | {"passed": error.passed} for error in errors]
        if model is not None and source is not None:
            loaded = load(model, clip, revision, device, dtype, threads)
            facts = facts_of(model, loaded)
            console.print(facts.text())
            question = prompt if loaded.tokenizer is not None else golden_prompt(golden, loaded)
            found = run(loaded, source, size, question, frames, coverage, wanted, console)
            print_verification(console, found, model)
            console.print(f"peak memory {peak_memory_mb(loaded):.0f} MB")
            report |= {"model": asdict(facts), "verification": as_json(found), "peak_mb": peak_memory_mb(loaded)}
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(report, indent=1), encoding="utf-8")
        console.print(f"wrote {out}")
    if not passed:
        raise typer.Exit(1)


@contextmanager
def model_errors() -> Iterator[None]:
    """Turns the models' errors into the command's.

    Raises:
        ConfigurationError: the cloud's packages are not installed.
    """
    try:
        from cable_models.errors import ModelError as LisaError
    except ModuleNotFoundError as error:
        raise ConfigurationError(f"verify needs {error.name}: pip install 'cable-rpc[cloud]'") from error
    try:
        yield
    except LisaError as error:
        raise ModelError(str(error)) from error


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """What was loaded."""

    name: str
    parameters: int
    dtype: str
    device: str
    image_tokens: int
    clip_size: int
    sam_size: int

    def text(self) -> str:
        """One line."""
        return (
            f"{self.name}: {self.parameters / 1e6:,.1f} M parameters, {self.dtype} on {self.device}, "
            f"{self.image_tokens} image tokens (CLIP {self.clip_size} px), SAM {self.sam_size} px"
        )


def load(model: str, clip: str | None, revision: str | None, device: str, dtype: str, threads: int) -> LoadedLisa:
    """The checkpoint on its device.

    Raises:
        ConfigurationError: an unknown device or number format.
        LisaError: it can't be loaded.
    """
    import torch
    from cable_models.lisa import load_lisa

    from cable_rpc.cloud.lisa_segmenter import number_formats, torch_device

    torch.set_num_threads(threads)
    place = torch_device(device)
    formats = number_formats(place)
    if dtype not in formats:
        raise ConfigurationError(f"--dtype is '{dtype}'; use {', '.join(formats)}")
    return load_lisa(model, clip=clip, revision=revision, device=place, dtype=formats[dtype])


def facts_of(model: str, loaded: LoadedLisa) -> ModelFacts:
    """What a reader of the figures must know of the model."""
    from cable_models.lisa.sam_encoder import grid_of

    return ModelFacts(
        model,
        sum(weight.numel() for weight in loaded.model.parameters()),
        str(loaded.model.dtype).removeprefix("torch."),
        str(loaded.model.device),
        loaded.architecture.image_tokens,
        loaded.clip_preprocessing.size,
        grid_of(loaded.model.sam.vision_encoder).image_size,
    )


def golden_errors(folder: Path) -> list[StageError]:
    """A golden's checkpoint, loaded as users load theirs, against its tensors."""
    import torch
    from cable_models.lisa import load_lisa
    from cable_models.lisa.golden import compare_golden

    return compare_golden(load_lisa(folder, dtype=torch.float32), folder)


def golden_prompt(golden: Path | None, loaded: LoadedLisa) -> list[int]:
    """The golden's prompt ids, for a checkpoint that can't read words.

    Raises:
        ConfigurationError: there is no golden to take them from.
    """
    from cable_models.lisa.golden import read_archive

    if golden is None:
        raise ConfigurationError(
            f"{loaded.folder} has no tokenizer.model and can't read a prompt; put the checkpoint's own there"
        )
    ids: list[int] = read_archive(golden / "inputs.npz")["input_ids_prompt"][0].tolist()
    return ids


def run(
    loaded: LoadedLisa,
    source: str,
    size: str | None,
    prompt: str | list[int],
    count: int,
    coverage: float | None,
    wanted: float,
    console: Console,
) -> Verification:
    """All variants over the drive, with a progress bar."""
    from cable_models.lisa import LisaPipeline

    opened = open_source(source, size=parse_size(size))
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task(f"{len(variants())} variants on each frame", total=count)
        return verify(
            lambda options: LisaPipeline(loaded, options),
            itertools.islice(opened, count),
            prompt,
            wanted=wanted,
            coverage=coverage,
            listener=lambda: progress.advance(task),
        )


def golden_table(errors: list[StageError]) -> Table:
    """One row for each stage, with its worst array, and one for each array that failed."""
    table = Table(title="against the original code's tensors, float32", title_justify="left")
    table.add_column("stage")
    table.add_column("arrays", justify="right")
    table.add_column("largest error")
    table.add_column("limit", justify="right")
    for stage in dict.fromkeys(error.stage for error in errors):
        arrays = [error for error in errors if error.stage == stage]
        worst = max(arrays, key=lambda error: error.error / (error.limit or 1e-12))
        shown = [error for error in arrays if not error.passed] or [worst]
        for error in shown:
            verdict = "" if error.passed else "  FAILED"
            table.add_row(stage, str(len(arrays)), f"{error.error:.1e}  {error.array}{verdict}", f"{error.limit:.0e}")
    return table


def print_golden_verdict(console: Console, errors: list[StageError]) -> None:
    """One line."""
    failed = [f"{error.stage}/{error.array}" for error in errors if not error.passed]
    if failed:
        console.print(f"[bold red]{len(failed)} of {len(errors)} arrays differ from the original: {', '.join(failed)}")
    else:
        console.print(f"[bold green]all {len(errors)} arrays are those of the original code")


def print_verification(console: Console, found: Verification, model: str) -> None:
    """The table, and what to make of it."""
    console.print(variant_table(found))
    equal = found.forced_equal == found.frames
    console.print(
        f"forced answer: what greedy decoding says on {found.forced_equal} of {found.frames} frames "
        f"(J {found.forced_masks.region:.3f}); the model says: {found.answer!r}"
    )
    if not equal:
        console.print("[yellow]leave decoding=forced with its checks on: they fall back to greedy decoding")
    published = found.results[0].wall_ms
    best = next(result for result in found.results if result.variant == found.recommended)
    options = recommended_options(found)
    console.print(
        f"[bold green]recommended: {best.variant.name}[/] (J {best.to_region.region:.3f} >= {found.wanted:.2f}, "
        f"{published / best.wall_ms:.1f}x as fast as the published inference)"
    )
    console.print(f"  cable-rpc serve --segmenter 'lisa:{model}?{options}'", soft_wrap=True)


def recommended_options(found: Verification) -> str:
    """The recommended switches as `serve` takes them."""
    options = found.recommended.options
    names = ("image_tokens", "clip_patches", "sam_padding", "sam_windows")
    return "&".join(f"{name}={getattr(options, name)}" for name in names)


def variant_table(found: Verification) -> Table:
    """One row for each variant."""
    title = f"{found.frames} frames, region {100 * found.coverage:.0f} % of the frame, masks compared inside it"
    table = Table(title=title, title_justify="left")
    table.add_column("variant")
    headings = ("ms", "x", "clip", "prefill", "decode", "sam", "tokens", "J publ.", "J&F", "J region", "worst")
    for heading in headings:
        table.add_column(heading, justify="right")
    for result in found.results:
        table.add_row(result.variant.name, *variant_cells(result, found.results[0].wall_ms))
    table.caption = (
        "x: against the published inference, here with a key-value cache. J publ., J&F: against its masks of the "
        "whole frame; J region, worst: against the full computation on the same region."
    )
    return table


def variant_cells(result: VariantResult, published_ms: float) -> list[str]:
    """Figures of one row."""
    stages = [result.stage_ms.get(name, 0.0) for name in ("clip", "prefill", "decode", "sam_encoder")]
    return [
        f"{result.wall_ms:.1f}",
        f"{published_ms / result.wall_ms:.2f}",
        *(f"{stage:.1f}" for stage in stages),
        f"{100 * result.token_share:.0f} %",
        f"{result.to_published.region:.3f}",
        f"{result.to_published.mean:.3f}",
        f"{result.to_region.region:.3f}",
        f"{result.worst:.3f}",
    ]


def peak_memory_mb(loaded: LoadedLisa) -> float:
    """Most memory held so far: of the GPU, or resident in this process."""
    import torch

    if loaded.model.device.type == "cuda":
        return torch.cuda.max_memory_allocated() / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def as_json(found: Verification) -> dict[str, object]:
    """Everything, for a file."""
    return asdict(found)
