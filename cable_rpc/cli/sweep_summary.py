"""What a sweep found, in short, for the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table

from cable_rpc.study.metrics.bootstrap import Bootstrap
from cable_rpc.study.rate_quality import DeltaResult, Method, bd_rate_between, pooled_points, saving_at
from cable_rpc.study.sweep.qualities import QUALITIES, methods_of
from cable_rpc.study.sweep.run_folder import SweepRun
from cable_rpc.study.sweep_report.methods import anchors_of, cells_by_method

MOST_METHODS = 40
MOST_REASONS = 5


def render_methods(run: SweepRun) -> Table:
    """A line for each method: rates, quality, BD-rate against its anchor, saving at a fixed retention."""
    quality = QUALITIES[run.qualities[0]]
    level = run.retention_levels[0]
    table = Table(title=f"{run.name}: kbit/s against {quality.title}", title_justify="left")
    table.add_column("method")
    for heading in ("kbit/s", f"{quality.title} {quality.unit}".strip(), "BD-rate %", f"saved % at {level:g} % kept"):
        table.add_column(heading, justify="right")
    methods = {method.label: method for method in methods_of(run.cells, quality.name)}
    kept = {method.label: method for method in methods_of(run.cells, "retention")}
    anchors = anchors_of(cells_by_method(run.cells), run.anchor)
    reasons: dict[str, None] = {}
    for label, method in list(methods.items())[:MOST_METHODS]:
        anchor = anchors.get(label)
        delta = saving = "–"
        if anchor is None:
            delta = "anchor" if anchor_like(label, run) else "no anchor"
        else:
            found = bd_rate_between(methods[anchor], method, Bootstrap())
            delta = bd_text(found)
            if found.reason:
                reasons[found.reason] = None
            saving = saving_text(kept[anchor], kept[label], level)
        table.add_row(label, *ranges(method), delta, saving)
    captions = [f"BD-rate against {run.anchor}, 95 % interval over sequences where there are three; PCHIP"]
    if len(methods) > MOST_METHODS:
        captions.append(f"{len(methods) - MOST_METHODS} more methods are in the report")
    captions += [f"– : {reason}" for reason in list(reasons)[:MOST_REASONS]]
    table.caption, table.caption_justify = "\n".join(captions), "left"
    return table


def anchor_like(label: str, run: SweepRun) -> bool:
    """Whether a method is the anchor, at any frame rate."""
    return label == run.anchor or label.startswith(f"{run.anchor} · ")


def ranges(method: Method) -> tuple[str, str]:
    """Least and most rate and quality, pooled over sequences."""
    points = pooled_points(method)
    if not points:
        return "–", "–"
    rates = [point.rate_kbps for point in points]
    values = [point.quality for point in points]
    return f"{min(rates):.0f}..{max(rates):.0f}", f"{min(values):.1f}..{max(values):.1f}"


def bd_text(found: DeltaResult) -> str:
    """ "-32.1 [-38, -27]"."""
    if found.value is None:
        return "–"
    interval = found.interval
    return f"{found.value:+.1f}" + ("" if interval is None else f" [{interval.low:+.0f}, {interval.high:+.0f}]")


def saving_text(anchor: Method, test: Method, level: float) -> str:
    """Percent of the anchor's rate that is saved where so much is kept."""
    found = saving_at(anchor, test, level, Bootstrap())
    if found.saving is None:
        return "–"
    interval = found.interval
    text = f"{100 * found.saving:.1f}"
    return text + ("" if interval is None else f" [{100 * interval.low:.0f}, {100 * interval.high:.0f}]")


def failures(run: SweepRun) -> Iterator[str]:
    """What failed and why, and what to do."""
    reasons: dict[str, list[str]] = {}
    for cell in run.cells:
        if cell.error:
            reasons.setdefault(cell.error, []).append(cell.cell.title)
    for reason, titles in list(reasons.items())[:MOST_REASONS]:
        yield f"{len(titles)} cells failed, the first of them {titles[0]}: {reason}"
    if len(reasons) > MOST_REASONS:
        yield f"{len(reasons) - MOST_REASONS} more reasons are in cells.csv"
    if reasons:
        count = sum(map(len, reasons.values()))
        yield f"{count} of {len(run.cells)} cells failed; the same command tries them again"
