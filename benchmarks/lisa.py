"""Speed, memory and operations of LISA++ with random weights: ``python benchmarks/lisa.py --help``."""

from __future__ import annotations

import argparse
import json
import platform
import random
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from cable_models.lisa.architecture import LisaArchitecture
from cable_models.lisa.compiled import COMPILE_MODES, compile_model
from cable_models.lisa.flops import FrameFlops, meta_lisa
from cable_models.lisa.original import typical_question
from cable_models.lisa.random_weights import lisa_7b, lisa_small, lisa_tiny, random_lisa
from lisa_runs import REGIONS, Case, Record, Runner, count, list_cases, resident_bytes
from rich.console import Console
from rich.progress import track as rich_track

SIZES = {"7b": lisa_7b, "small": lisa_small, "tiny": lisa_tiny}
STAGES = (
    "preprocess",
    "clip",
    "projector",
    "prefill",
    "decode",
    "lm_head",
    "sam_encoder",
    "mask_decoder",
    "postprocess",
)
EXPLANATION = """\
rows
  original   the published inference: no key-value cache, CLIP and the whole sequence again for each of the answer's
             5 tokens ("Sure, [SEG]." and the end token), all 24 blocks of CLIP, the language head on all positions
  cached     the same answer token by token with a cache
  forced     the same answer given, one pass (neither is checked against greedy decoding here)
  a switch   forced, and what it names computed for the region only
All rows run in one process, one after the other in each round and in a new order each round, so that whatever else
the machine does hits all alike; a row's figure is the median over the rounds. The prompt has 94 text tokens. Weights
are random: speed and memory are those of the real ones, the masks mean nothing.

columns
  ms         frames in memory to masks in memory; stages by CUDA events on a GPU, by the clock elsewhere. The gaps
             between the stages' kernels, which a GPU spends waiting for Python, are part of them.
  x time     original / row, frame for frame;  x FLOP the same of the operations. Where they differ, the row is bound
             by memory (13.5 GB of weights are read whatever the number of tokens) or by the launching of kernels.

a first look          python benchmarks/lisa.py --size tiny --minutes 0.5
operations alone      python benchmarks/lisa.py --size 7b --flops-only --regions compact,corridor,scattered
this machine          python benchmarks/lisa.py --size small --device cpu --minutes 10
the published sizes   python benchmarks/lisa.py --size 7b --device cuda --dtype bfloat16 --minutes 5
with CUDA graphs      python benchmarks/lisa.py --size 7b --device cuda --compile reduce-overhead --bucket 32
"""


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXPLANATION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", choices=SIZES, default="small", help="sizes of the network (default: small)")
    parser.add_argument("--clip-size", type=int, choices=(224, 336), help="CLIP's input: 256 or 576 image tokens")
    parser.add_argument(
        "--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cpu, cuda, cuda:1 ..."
    )
    parser.add_argument("--dtype", default="", help="bfloat16, float16 or float32; default: bfloat16 on a GPU")
    parser.add_argument("--frame", default="1600x900", help="width x height of the frames (default: 1600x900)")
    parser.add_argument("--minutes", type=float, default=5.0, help="time for the rounds; at least three are made")
    parser.add_argument("--coverage", default=".5,.25,.1", help="shares of the frame that regions cover")
    parser.add_argument("--regions", default="corridor", help=f"any of {','.join(REGIONS)}")
    parser.add_argument("--batches", default="2,4,8", help="frames at once, of different streams; 1 = singles only")
    parser.add_argument("--compile", choices=COMPILE_MODES, default="none", help="torch.compile of the deep stacks")
    parser.add_argument("--bucket", type=int, default=0, help="pad prompts to a multiple, for compiled graphs")
    parser.add_argument("--threads", type=int, default=0, help="threads of the processor (default: torch's choice)")
    parser.add_argument("--no-flops", action="store_true", help="skip counting the operations")
    parser.add_argument("--flops-only", action="store_true", help="count the operations and run nothing")
    parser.add_argument("--out", type=Path, default=Path("out/lisa"), help="gets lisa.json and lisa.md")
    return parser.parse_args()


def measure(runner: Runner, cases: Sequence[Case], minutes: float, console: Console) -> dict[Case, Record]:
    """Interleaved rounds over all cases, after one round that doesn't count."""
    for case in track(cases, "warming up", console):
        runner.run(case, Record())
    records = {case: Record() for case in cases}
    deadline = time.monotonic() + 60 * minutes
    rounds = 0
    while rounds < 3 or time.monotonic() < deadline:
        for case in random.sample(list(cases), len(cases)):
            runner.run(case, records[case])
        rounds += 1
        console.print(f"round {rounds}")
    return records


def track(cases: Sequence[Case], what: str, console: Console) -> Iterable[Case]:
    """The cases, with a bar on a terminal."""
    return rich_track(cases, what, console=console, transient=True, disable=not console.is_terminal)


def rows_of(records: dict[Case, Record], counts: dict[Case, FrameFlops | None]) -> list[dict[str, Any]]:
    """The table as data."""
    original = next(case for case in records if case.decoding == "original")
    rows = []
    for case, record in records.items():
        flops, most = counts.get(case), counts.get(original)
        wall = record.median()
        rows.append(
            {
                **asdict(case),
                "ms": wall,
                "ms_quartiles": [float(np.percentile(record.wall_ms, share)) for share in (25, 75)],
                "runs": len(record.wall_ms),
                "stages_ms": {stage: float(np.median(times)) for stage, times in record.stages_ms.items()},
                "frames_per_s": 1e3 * case.batch / wall,
                "speedup_time": records[original].median() * case.batch / wall,
                "image_tokens": record.image_tokens,
                "peak_bytes": record.peak_bytes,
                "flops": asdict(flops) | {"total": flops.total} if flops else None,
                "speedup_flops": most.total / flops.total if flops and most else None,
            }
        )
    return rows


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The table for people."""
    used = [stage for stage in STAGES if any(stage in row["stages_ms"] for row in rows)]
    titles = ["row", "region", "batch", "image tokens", "ms", "frames/s", "x time", "GFLOP", "x FLOP", *used, "peak GB"]
    lines = ["| " + " | ".join(titles) + " |", "|" + " --- |" * len(titles)]
    for row in rows:
        case = Case(row["decoding"], row["switch"], row["region"], row["coverage"], row["batch"])
        flops, ratio = row["flops"], row["speedup_flops"]
        cells = [
            name_of(case),
            region_name(case),
            str(row["batch"]),
            "/".join(map(str, row["image_tokens"])),
            f"{row['ms']:.1f}",
            f"{row['frames_per_s']:.2f}",
            f"{row['speedup_time']:.2f}",
            f"{flops['total'] / 1e9:,.1f}" if flops else "",
            f"{ratio:.2f}" if ratio else "",
            *(f"{row['stages_ms'].get(stage, 0.0):.1f}" for stage in used),
            f"{row['peak_bytes'] / 1e9:.2f}" if row["peak_bytes"] else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def count_all(
    cases: Sequence[Case], architecture: LisaArchitecture, frame_hw: tuple[int, int], console: Console
) -> dict[Case, FrameFlops | None]:
    """Operations of every case."""
    shapes, question = meta_lisa(architecture), typical_question(architecture.llama.vocab_size)
    counts = {}
    for case in track(cases, "counting the operations", console):
        counts[case] = count(case, shapes, question, frame_hw)
    return counts


def flops_table(counts: dict[Case, FrameFlops | None]) -> str:
    """The operations alone, in units of 10^12."""
    stages = [field.name for field in fields(FrameFlops)]
    titles = ["row", "region", *stages, "total", "x less"]
    lines = ["| " + " | ".join(titles) + " |", "|" + " --- |" * len(titles)]
    most = next(flops for case, flops in counts.items() if case.decoding == "original" and flops)
    for case, flops in counts.items():
        if flops is None:
            continue
        numbers = [getattr(flops, stage) / 1e12 for stage in stages]
        cells = [name_of(case), region_name(case), *(f"{number:.3f}" for number in numbers)]
        cells += [f"{flops.total / 1e12:.2f}", f"{most.total / flops.total:.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def name_of(case: Case) -> str:
    """What runs."""
    return " ".join(part for part in (case.decoding, case.switch) if part)


def region_name(case: Case) -> str:
    """Where it runs."""
    if case.coverage >= 1:
        return "whole"
    return f"{case.region} {case.coverage:.0%}" if case.batch == 1 else "mixed"


def main() -> None:
    """Measures and writes."""
    arguments = parse_arguments()
    console = Console()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    if device.index is not None:
        torch.cuda.set_device(device)
    dtype = getattr(torch, arguments.dtype or ("bfloat16" if device.type == "cuda" else "float32"))
    build = SIZES[arguments.size]
    architecture = build(arguments.clip_size) if arguments.clip_size else build()
    width, height = (int(side) for side in arguments.frame.split("x"))
    cases = list_cases(
        [float(share) for share in arguments.coverage.split(",")],
        [kind for kind in arguments.regions.split(",") if kind],
        [int(batch) for batch in arguments.batches.split(",")],
    )
    if arguments.flops_only:
        console.print(
            flops_table(count_all(cases, architecture, (height, width), console)), markup=False, soft_wrap=True
        )
        return
    question = typical_question(architecture.llama.vocab_size)
    began = time.monotonic()
    model = random_lisa(architecture, device=device, dtype=dtype)
    compile_model(model, arguments.compile)
    parameters = sum(weight.numel() for weight in model.parameters())
    console.print(f"{parameters / 1e9:.3f} billion weights drawn in {time.monotonic() - began:.1f} s")
    runner = Runner(model, question, (height, width), arguments.bucket)
    records = measure(runner, cases, arguments.minutes, console)
    counts = {} if arguments.no_flops else count_all(cases, architecture, (height, width), console)
    rows = rows_of(records, counts)
    machine = {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "transformers": transformers.__version__,
        "python": platform.python_version(),
        "parameters": parameters,
        "resident_bytes_peak": resident_bytes(),
        "arguments": {name: str(value) for name, value in vars(arguments).items()},
        "dtype": str(dtype),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "lisa.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    text = f"{markdown(rows)}\nPeak resident memory of the process: {machine['resident_bytes_peak'] / 1e9:.2f} GB.\n"
    (arguments.out / "lisa.md").write_text(text)
    console.print(text, markup=False, soft_wrap=True)
    console.print(f"written to {arguments.out}")


if __name__ == "__main__":
    main()
