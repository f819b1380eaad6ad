"""What the edge sends and what it catches, paper beside robust: ``python benchmarks/edge_quality.py --quick``.

A perfect segmenter that needs to see a quarter of an object answers late through a simulated link; there is no codec
and no network. Every sequence is rendered once and run through all variants. The figures:

a  agreement of the warped prior with the next true mask, turning and straight
b  recognition at equal coverage, over strengths of margins and dilation
c  newcomers from the sides inside the sent region within three frames
d  delays of the answers
e  keyframes in a scene without actors
f  keyframes and coverage at a long standstill with noisy ego velocity
g  robust with one setting after the other as in the paper
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from edge_quality_runs import (
    ABLATION,
    ABLATION_DELAY,
    CATCH_FRAMES,
    DELAYS,
    EGO_NOISE_MPS,
    PRESETS,
    ROUTES,
    STANDING,
    STRAIGHT_DPS,
    STRENGTHS,
    TURNING_DPS,
    Clip,
    Run,
    Variant,
    ablations,
    measure_all,
    variants_of,
)
from rich.console import Console
from rich.table import Table

from cable_rpc.study.loop_simulator import (
    SimulationSummary,
)
from cable_rpc.study.metrics import RECOGNITION_THRESHOLDS


def weighted(pairs: Iterable[tuple[float | None, int]]) -> float:
    """Mean of (value, weight) pairs, None values left out; NaN of nothing."""
    known = [(value, weight) for value, weight in pairs if value is not None]
    total = sum(weight for _, weight in known)
    return sum(value * weight for value, weight in known) / total if total else float("nan")


@dataclass(frozen=True, slots=True)
class Pool:
    """The runs of one variant over several sequences as one."""

    runs: Sequence[Run] = field(default_factory=list)

    def mean(self, read: Callable[[SimulationSummary], float | None]) -> float:
        """Mean over frames."""
        return weighted([(read(run.summary), run.summary.frame_count) for run in self.runs])

    def recognition(self, threshold: float = 0.5, *, of_roi: bool = False) -> float:
        """Pooled over objects."""
        column = RECOGNITION_THRESHOLDS.index(threshold)
        pairs = []
        for run in self.runs:
            curve = run.summary.recognition_roi if of_roi else run.summary.recognition
            pairs.append((None if curve is None else curve[column], run.summary.visible_count))
        return weighted(pairs)

    @property
    def coverage_tx(self) -> float:
        return self.mean(lambda summary: summary.coverage_tx)

    @property
    def coverage_roi(self) -> float:
        return self.mean(lambda summary: summary.coverage_roi)

    @property
    def keyframe_rate(self) -> float:
        return self.mean(lambda summary: summary.keyframe_rate)

    @property
    def columns(self) -> list[str]:
        """Coverages, recognition and keyframe rate, in percent."""
        values = (
            self.coverage_roi,
            self.coverage_tx,
            self.recognition(0.05),
            self.recognition(),
            self.recognition(of_roi=True),
            self.keyframe_rate,
        )
        return [f"{100 * value:.1f}" for value in values]


COLUMNS = ("cov. R_k %", "cov. sent %", "rec. 5 %", "rec. 50 %", "rec. 50 % in R_k", "keyframes %")


class Results:
    """All runs, by group and label; the group ``pooled`` is all routes."""

    def __init__(self, runs: Iterable[Run]) -> None:
        self.runs = list(runs)

    def pool(self, group: str, label: str) -> Pool:
        groups = ROUTES if group == "pooled" else (group,)
        return Pool([run for run in self.runs if run.group in groups and run.label == label])

    @property
    def groups(self) -> list[str]:
        present = [route for route in ROUTES if any(run.group == route for run in self.runs)]
        return [*present, "pooled"] if len(present) > 1 else present

    def labels(self, prefix: str) -> list[str]:
        return list(dict.fromkeys(run.label for run in self.runs if run.label.startswith(prefix)))


def table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    made = Table(title=title, title_justify="left", pad_edge=False)
    for number, head in enumerate(heads):
        made.add_column(head, justify="left" if number == 0 else "right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    return made


def warp_table(results: Results) -> Table:
    """Figure a."""
    rows = []
    for label in (*PRESETS, *results.labels("warp, ")):
        pool = results.pool("pooled", label)
        cells = [label]
        for kind in ("turning", "straight"):
            values = [iou for run in pool.runs for iou in getattr(run, kind)]
            cells += [f"{np.mean(values):.3f}" if values else "-", str(len(values))]
        rows.append(cells)
    title = "a  IoU of warped prior and true mask; warp: robust, from the true mask"
    return table(title, ("prior", f"|yaw| >= {TURNING_DPS:g} deg/s", "n", f"< {STRAIGHT_DPS:g} deg/s", "n"), rows)


def curve_of(results: Results, group: str, mode: str, *, of_roi: bool) -> tuple[np.ndarray, np.ndarray]:
    """Coverage and best recognition at 50 % up to it, over all strengths by rising coverage."""
    pools = [results.pool(group, label) for label in (mode, *results.labels(f"{mode} x"))]
    points = sorted(
        (pool.coverage_roi if of_roi else pool.coverage_tx, pool.recognition(of_roi=of_roi)) for pool in pools
    )
    coverages, recognised = np.array(points).T
    # A strength that sends more and catches less than another is nobody's choice.
    return coverages, np.maximum.accumulate(recognised)


def equal_coverage_table(results: Results) -> Table:
    """Figure b: robust less paper where both curves exist."""
    rows = []
    for of_roi in (False, True):
        for group in results.groups:
            ours, papers = (curve_of(results, group, mode, of_roi=of_roi) for mode in ("robust", "paper"))
            low, high = max(ours[0][0], papers[0][0]), min(ours[0][-1], papers[0][-1])
            ranges = [f"{100 * curve[0][0]:.0f}..{100 * curve[0][-1]:.0f}" for curve in (papers, ours)]
            levels = [f"{100 * curve[1][0]:.0f}..{100 * curve[1][-1]:.0f}" for curve in (papers, ours)]
            cells = [group, "R_k" if of_roi else "sent", *ranges, *levels]
            if low >= high:
                rows.append([*cells, "-", "-", "-"])
                continue
            at = np.linspace(low, high, 21)
            gain = 100 * (np.interp(at, *ours) - np.interp(at, *papers))
            own = results.pool(group, "robust")
            default = own.coverage_roi if of_roi else own.coverage_tx
            there = 100 * (np.interp(default, *ours) - np.interp(default, *papers)) if low <= default <= high else None
            rows.append(
                [*cells, f"{gain.mean():+.1f}", f"{gain.min():+.1f}", "-" if there is None else f"{there:+.1f}"]
            )
    heads = ("group", "coverage of", "paper %", "robust %", "paper rec. %", "robust rec. %")
    gains = ("mean gain", "worst", "at robust default")
    return table("b  recognition at 50 %, robust less paper, at equal coverage (points)", (*heads, *gains), rows)


def newcomer_table(results: Results) -> Table:
    """Figure c."""
    rows = []
    for mode in PRESETS:
        for group in (*results.groups, STANDING, "all"):
            groups = (*ROUTES, STANDING) if group == "all" else (group,)
            pools = [results.pool(each, mode) for each in groups]
            waited = [frames for pool in pools for run in pool.runs for frames in run.newcomers]
            caught = [sum(frames is not None and frames <= late for frames in waited) for late in range(CATCH_FRAMES)]
            cells = [f"{100 * count / len(waited):.1f}" if waited else "-" for count in caught]
            rows.append([mode, group, str(len(waited)), *cells])
    title = "c  newcomers from the sides at least half inside the sent region (%)"
    return table(title, ("mode", "group", "newcomers", "at once", "within 2 frames", "within 3"), rows)


def run_table(results: Results, title: str, groups: Sequence[str], labels: Sequence[str]) -> Table:
    """Coverages, recognition and keyframe rate of some variants."""
    rows = [[label, group, *results.pool(group, label).columns] for group in groups for label in labels]
    return table(title, ("variant", "group", *COLUMNS), rows)


def ablation_table(results: Results) -> Table:
    """Figure g; the labels of both modes are their names."""
    rows = []
    for label in results.labels(ABLATION):
        quiet = [f"{100 * results.pool(group, label).keyframe_rate:.1f}" for group in ("empty", "standstill")]
        rows.append([label.removeprefix(ABLATION), *results.pool("pooled", label).columns, *quiet])
    title = f"g  robust with one setting as in the paper; drives with answers {ABLATION_DELAY} frames late"
    return table(title, ("setting", *COLUMNS, "keyf. empty", "standing"), rows)


def quiet_table(results: Results, group: str, title: str, fps: float) -> Table:
    """Figures e and f: keyframes where little or nothing happens."""
    rows = []
    for mode in PRESETS:
        pool = results.pool(group, mode)
        for run in pool.runs:
            keyframes, frames = len(run.reasons), run.summary.frame_count
            causes = ", ".join(f"{reason} {run.reasons.count(reason)}" for reason in dict.fromkeys(run.reasons))
            columns = [f"{60 * fps * keyframes / frames:.1f}", *pool.columns[:2]]
            rows.append([mode, str(frames), str(keyframes), *columns, causes])
    return table(title, ("mode", "frames", "keyframes", "per minute", "cov. R_k %", "cov. sent %", "causes"), rows)


def clips_of(options: argparse.Namespace) -> list[Clip]:
    """The sequences that the chosen figures need."""
    figures, size = options.figures, tuple(options.size)
    strengths = (0.25, 1.0, 4.0) if options.quick else STRENGTHS
    delays = (1, 4) if options.quick else DELAYS
    clips = []
    both = tuple(Variant(name, config) for name, config in PRESETS.items())
    if set(figures) & set("abcdg"):
        for route in options.routes:
            for number, seed in enumerate(options.seeds):
                variants = variants_of(figures, strengths, delays)
                # The ablation's many variants run on few sequences.
                if "g" in figures and number < options.ablation_seeds:
                    variants += ablations(ABLATION_DELAY)
                clips.append(Clip(route, f"synthetic:{seed}?route={route}", options.frames, size, variants))
    if "c" in figures:
        spec = "synthetic:{}?route=standstill"
        clips += [Clip(STANDING, spec.format(seed), options.frames, size, both) for seed in options.seeds]
    quiet = both + ablations(1) if "g" in figures else both
    first, *others = options.seeds
    if set(figures) & set("eg"):
        clips.append(Clip("empty", f"synthetic:{first}?traffic=none", 100, size, quiet))
    if "e" in figures and not options.quick:
        clips += [Clip("empty", f"synthetic:{seed}?traffic=none", 100, size, both) for seed in others]
    if set(figures) & set("fg"):
        rendered = 30 if options.quick else 100
        clips.append(Clip("standstill", f"synthetic:{first}?route=standstill", rendered, (480, 270), quiet, 600))
    return clips


def print_figures(results: Results, figures: str, console: Console) -> None:
    """One table after another."""
    if "a" in figures:
        console.print(warp_table(results))
    if "b" in figures:
        labels = [label for mode in PRESETS for label in (mode, *results.labels(f"{mode} x"))]
        console.print(run_table(results, "b  strengths of margins and dilation", results.groups, labels))
        console.print(equal_coverage_table(results))
    if "c" in figures:
        console.print(newcomer_table(results))
    if "d" in figures:
        labels = [label for mode in PRESETS for label in (mode, *results.labels(f"{mode} d"))]
        console.print(run_table(results, "d  answers late by 1 (unnamed), 2, 4, 8 frames", results.groups, labels))
    if "e" in figures:
        console.print(quiet_table(results, "empty", "e  no actors", 10.0))
    if "f" in figures:
        title = f"f  standstill, ego velocity with {100 * EGO_NOISE_MPS:g} cm/s of noise"
        console.print(quiet_table(results, "standstill", title, 10.0))
    if "g" in figures:
        console.print(ablation_table(results))


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figures", default="abcdefg", help="which to measure, default all: abcdefg")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3], help="of each route, default 0 1 2 3")
    parser.add_argument("--routes", nargs="+", choices=ROUTES, default=list(ROUTES))
    parser.add_argument("--frames", type=int, default=80, help="of each sequence, default 80")
    parser.add_argument(
        "--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), default=[960, 540], help="of the frames"
    )
    parser.add_argument("--ablation-seeds", type=int, default=1, help="seeds of each route for figure g, default 1")
    parser.add_argument("--workers", type=int, default=2, help="processes, default 2")
    parser.add_argument("--quick", action="store_true", help="two seeds, 40 frames, half the size, fewer variants")
    options = parser.parse_args(arguments)
    if unknown := set(options.figures) - set("abcdefg"):
        parser.error(f"unknown figures {''.join(sorted(unknown))}; known are abcdefg")
    if options.quick:
        options.seeds, options.frames, options.size = options.seeds[:2], 40, [480, 270]
    return options


def main() -> None:
    options = parse()
    console = Console()
    if not console.is_terminal:
        console = Console(width=150)
    runs = measure_all(clips_of(options), options.workers, console)
    print_figures(Results(runs), options.figures, console)


if __name__ == "__main__":
    main()
